"""Logs of other programs, which `harness compare` takes in place of runs.

Shipped extensions read them: `adds={"logs": {"name": "module:OBJECT"}}`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from harness.core.errors import UserError, printable
from harness.core.plugins import Shipped
from harness.core.statistics import Estimate
from harness.report.compare.gate import Verdict

# Of a gate: the one metric of each scorer, what stands before its colon, and a valid one.
METRICS, PLACE, EXAMPLE = ("score",), "SCORER", "match:score < -0.01"


class ComparedLogs(Protocol):
    """Describe the comparison of two logs, A and B, whose answers are paired.

    A scorer is what gives an answer a number. `changes` has for each scorer B - A and its 95 %
    interval, in the unit of its scores; `alone` the scorers that only `A` or only `B` has. `unsure`
    says why gates, tests of a difference, have nothing sure to judge; empty if they have.
    """

    @property
    def title(self) -> str: ...
    @property
    def changes(self) -> Mapping[str, Estimate]: ...
    @property
    def alone(self) -> Mapping[str, Sequence[str]]: ...
    @property
    def unsure(self) -> str: ...

    def terminal(self, verdicts: Sequence[Verdict], most: int) -> str:
        """Return the comparison and its gates' verdicts as text for a terminal.

        `most` is how many answers and samples a list shows.
        """
        ...

    def markdown(self, verdicts: Sequence[Verdict], most: int) -> str:
        """Return the comparison and its gates' verdicts as Markdown; lists show up to `most`."""
        ...

    def mapping(self, verdicts: Sequence[Verdict], most: int) -> dict[str, Any]:
        """Return the comparison and its gates' verdicts as plain values for JSON."""
        ...


@runtime_checkable
class LogReader(Protocol):
    """Describe what reads and compares logs of one program, whose names end in `suffix`."""

    suffix: str  # such as `.eval`

    def compare(self, a: Path, b: Path) -> ComparedLogs:
        """Compare two logs. Raises UserError if one is none, or they cannot be paired."""
        ...


LOGS = Shipped[LogReader]("swarmdrive.logs", LogReader, {})  # of none but extensions that ship


def reader_of(a: Path, b: Path) -> LogReader | None:
    """Return what compares two files as logs of another program; None if neither is such a log.

    Raises UserError if only one is.
    """
    for reader in LOGS.values():
        are_logs = [path.suffix == reader.suffix and not path.is_dir() for path in (a, b)]
        if all(are_logs):
            return reader
        if any(are_logs):
            raise UserError(
                f"{printable(a)} and {printable(b)}: one is a log of another program "
                f"({reader.suffix}) and one is not; give two of a kind"
            )
    return None
