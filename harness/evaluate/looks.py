"""Stop a run when it has seen enough: after which layouts it is looked at, and what is enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.files import sha256_file
from harness.core.statistics import Estimate
from harness.runs.folder import Run, read
from harness.runs.metrics import Grid
from harness.runs.records import ClosedLoop, Episode, FrozenScenes, Looks
from harness.runs.success import by_condition

FIRST = 20  # layouts of the first look
MORE = 1.25  # times as many at each next one


@dataclass(frozen=True)
class Until:
    """Describe when a run may stop early: every condition's success is known well enough.

    That is a confidence interval no wider than `width`, or a difference to another run's success
    whose interval excludes 0. Layouts come in a fixed order, and intervals hold at every look
    (`core.sequences`).
    """

    width: float | None = None  # widest interval that is enough, a share; None to compare instead
    against: Run | None = None  # the run to compare with; None for a width
    folder: Path | None = None  # of `against`, as it was typed
    looked: Looks | None = None  # how often the run was looked at, once it has stopped

    def settings(self) -> dict[str, Any]:
        """Return the run settings that ask for this rule, by name; the width is in points."""
        width = None if self.width is None else round(100 * self.width, 9)
        return {
            "until_width": width,
            "until_decided": None if self.folder is None else str(self.folder),
        }

    def record(self, layouts: int) -> Looks:
        """Return the record of this rule in a manifest, of a run over at most `layouts` layouts."""
        run = self.against
        return self.looked or Looks(
            layouts=layouts,
            width=self.width,
            against=run.manifest.name if run else None,
            against_sha256=sha256_file(run.path / "episodes.csv") if run else None,
        )

    def after(self, looks: Looks) -> "Until":
        """Return this rule with the record of a run that has stopped by it."""
        return replace(self, looked=looks)

    def check(
        self,
        world: FrozenScenes | ClosedLoop,
        numbers: Sequence[int],
        conditions: Sequence[str],
        seeds: Sequence[int],
    ) -> None:
        """Raise UserError unless the run to compare with fits: same scenes and channel seeds.

        It must also have all of these episode numbers and conditions. Without such a run nothing is
        checked.
        """
        run = self.against
        if run is None:
            return
        where = f"--until-decided {printable(self.folder)}"
        if type(run.manifest.world) is not type(world) or run.manifest.world.pinned != world.pinned:
            raise UserError(f"{where} is not of the same scenes; give a run on these")
        if sorted(run.manifest.seeds) != sorted(seeds):
            raise UserError(
                f"{where} has the seeds {printable(list(run.manifest.seeds), 40)}; give the same"
            )
        if missing := [name for name in conditions if name not in run.conditions]:
            raise UserError(
                f"{where} has no condition {printable(missing[0])}; give --condition with those "
                f"that it has: {printable(', '.join(run.conditions), 60)}"
            )
        if lacking := sum(number not in run.grid.episodes for number in numbers):
            raise UserError(
                f"{where} lacks {lacking} of the {amount(len(numbers), 'layout')}; use fewer, or a "
                "longer run"
            )

    def enough(self, grid: Grid, episodes: Sequence[Episode]) -> bool:
        """Return whether a run may stop: all conditions are known well enough by these episodes.

        `episodes` are those finished so far, in the grid's order.
        """
        success, values = by_condition(grid, episodes)
        if self.width is not None:
            spans: list[Estimate] = [
                success.any_time(of_condition) for of_condition in values.values()
            ]
            return all(span.high - span.low <= self.width for span in spans)
        assert self.against
        other = self.against
        order = [
            [other.grid.seeds.index(seed) for seed in grid.seeds],
            [other.grid.episodes.index(number) for number in grid.episodes],
        ]
        _, before = by_condition(other.grid, other.episodes)
        differences = [
            success.any_time_difference(b, before[name][order[0]][:, order[1]])
            for name, b in values.items()
        ]
        return all(e.low > 0 or e.high < 0 for e in differences)


def looks(layouts: int) -> list[int]:
    """Return after how many layouts a run checks whether it may stop; the last is `layouts`."""
    at = [min(FIRST, layouts)]
    while at[-1] < layouts:
        at.append(min(math.ceil(at[-1] * MORE), layouts))
    return at


def until(width: float | None, against: str | None) -> Until | None:
    """Return the rule by which a run stops early, from its settings; None without one.

    `width` is in percent points, `against` a run's folder. Raises UserError if both are given, one
    is out of range, or there is no such run.
    """
    if width is None and against is None:
        return None
    if width is not None and against is not None:
        raise UserError("--until-width and --until-decided: give one of them")
    if width is not None and not 0.1 <= width < 100:
        raise UserError(f"--until-width {width:g} is out of range; give 0.1 to 99 points")
    if against is not None:
        return Until(against=read(Path(against)), folder=Path(against))
    return Until(width=(width or 0.0) / 100)
