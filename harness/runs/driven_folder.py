"""A live run's folder, read again."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.runs import folder
from harness.runs.folder import NEEDED, NEEDED_IN_ROW, Form, Row, Run, number
from harness.runs.formats import DRIVE

LIVE = Form(DRIVE, "harness drive", (*NEEDED, "scenario", "first_seed", "episodes"), (*NEEDED_IN_ROW, "step"))
NUMBERS = ("time_s", "delay_s", "least_gap_m", "hard_brakings", "other_crashes")


@dataclass(frozen=True)
class Driven(Run):
    """A finished live run.

    Attributes:
        ends: what became of each episode, by condition, seed and number: `result`, `partner`, `striker` and
            `fault`, None without a collision, and `NUMBERS`.
    """

    ends: Mapping[tuple[str, int, int], Row]

    @property
    def source(self) -> str:
        """What its episodes are of."""
        return f"{self.config['scenario'].get('name')} (driven live)"


def read(path: Path) -> Driven:
    """Read the folder of a live run.

    Raises:
        UserError: it is none, or a file of it is missing or broken.
    """
    return driven(folder.read(path, LIVE))


def driven(run: Run) -> Driven:
    """A live run with its episodes. Raises UserError if episodes.csv is missing or broken."""
    file = run.path / "episodes.csv"
    ends = dict(folder.table(file, _end))
    for condition, seed, n in product(run.conditions, run.config["seeds"], range(run.config["episodes"])):
        if (condition, seed, n) not in ends:
            raise UserError(
                f"{printable(file)} lacks episode {n} of {printable(condition)} with seed {seed}; "
                "make the run again"
            )
    return Driven(**vars(run), ends=ends)


def _end(line: Mapping[str, str]) -> tuple[tuple[str, int, int], dict[str, Any]]:
    return (line["condition"], int(line["seed"]), int(line["episode"])), {
        "result": line["failure"] or "cleared",
        **{name: line[name] or None for name in ("partner", "striker", "fault")},
        **{name: number(line[name]) for name in NUMBERS},
    }
