"""What extensions say of single decision points, which a run's page says where it lists and shows these.

An extension adds such remarks by `adds={"remarks": {"name": "module:OBJECT"}}`. They are no section of the
page: each is about one decision point, or leads to some.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeVar, runtime_checkable

from markupsafe import Markup, escape

from harness.core.errors import UserError, one_line
from harness.core.plugins import Plugins
from harness.core.strangers import aside
from harness.report.runs import Runs
from harness.report.templating import visible
from harness.runs.folder import Run

T = TypeVar("T")
# By decision point, what was left out of a prompt or the fusion, and what that changed. Of each: its `item`;
# of whom: `role`, `viewer`, `condition`, `seed` or null; the likeliest `action` with it; and, null without
# an answer, that `instead`, the `change` of the probability of `action`, the `shift` of the distribution.
LeftOut = Mapping[str, Sequence[Mapping[str, Any]]]


@runtime_checkable
class Remarks(Protocol):
    """What says something of decision points."""

    def sentences(self, runs: Runs) -> Iterable[Markup]:
        """Return what stands above the list; `<a data-scene=… data-run=…>` leads to a decision point."""
        ...

    def left_out(self, run: Run) -> LeftOut:
        """Return what is drawn beside the answers of decision points: what they became without one thing."""
        ...


REMARKS: Plugins[Remarks] = Plugins("swarmdrive.remarks", Remarks, {})


def sentences(runs: Runs) -> list[Markup]:
    """Return what extensions say above the list. Of one that fails, a sentence says so in its place."""
    said: list[Markup] = []
    for name in REMARKS:
        try:
            said += _of(name, lambda remarks: list(remarks.sentences(runs)))
        except _Failed as error:
            said.append(escape(visible(f"{name}: {error}")))
    return said


def left_out(run: Run) -> LeftOut:
    """Return what extensions have beside a run's answers; of one that fails, nothing."""
    joined: dict[str, list[Mapping[str, Any]]] = {}
    for name in REMARKS:
        try:
            for scene, some in _of(name, lambda remarks: remarks.left_out(run)).items():
                joined.setdefault(scene, []).extend(some)
        except _Failed:
            continue
    return joined


class _Failed(Exception):
    """Remarks that cannot be asked; the text says why."""


def _of(name: str, ask: Callable[[Remarks], T]) -> T:
    """Ask an extension. Raises UserError if a file of the run is broken."""
    try:
        remarks = REMARKS[name]
    except UserError as error:
        raise _Failed(str(error)) from error
    try:
        with aside(f"remarks {name}"):
            return ask(remarks)
    except UserError:
        raise
    except Exception as error:  # a package's code
        raise _Failed(f"its package failed: {one_line(error)}") from error
