"""When a run has seen enough: after which layouts it is looked at, and what is enough."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec
from msgspec import Struct

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.files import sha256_file
from harness.core.statistics import Estimate, known_mean
from harness.extensions.early_stop.sequences import any_time, any_time_difference
from harness.runs.contradictions import sound
from harness.runs.folder import Run
from harness.runs.grid import Grid
from harness.runs.headline import ANY_TIME
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.records import Episode, Score
from harness.runs.settings import DriveSettings
from harness.runs.stopping import InterimLooks, StoppingRule, looked_otherwise
from harness.runs.success import Success, by_condition

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec

FIRST = 20  # layouts of the first look
MORE = 1.25  # times as many at each next one
WIDTH, DECIDED = "until_width", "until_decided"  # settings of a run


class LooksRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Hold the rule of a run that may stop early and its interim looks, as `run.json` has them.

    A layout is a start situation with one episode, and an interim look a test, after the first so
    many layouts, whether these are enough. They are if in every condition (settings of radio,
    asking and fusion) the interval of success is as narrow as `width`, or success differs from that
    of another run.
    """

    layouts: int  # how many layouts there were in all
    # how wide each condition's interval of success may be, as a share; None to compare with a run
    width: float | None = None
    against: str | None = None  # the name of the run from which every condition is to differ
    against_sha256: str | None = None  # hex SHA-256 of that run's episodes.csv
    at: tuple[int, ...] = ()  # numbers of layouts after which it looked; empty while it runs
    enough: bool = False  # whether the last look was enough


@dataclass(frozen=True)
class Until(StoppingRule):
    """Describe when a run may stop early: once every condition's success is known well enough.

    That is a 95 % interval no wider than `width`, a share, or a difference to the success of the
    run `against`, in `folder`, whose interval excludes 0; one of both is None. Layouts (start
    situations with one episode each) come in a fixed order, and the intervals are valid though one
    looks at them several times. It is a `StoppingRule`: `chosen_by` names the settings that choose
    it, and `interval` says what its intervals are.
    """

    chosen_by: ClassVar[tuple[str, ...]] = (WIDTH, DECIDED)
    interval: ClassVar[str] = "an interval of every look"

    width: float | None = None  # widest interval that is enough, a share; None to compare instead
    against: Run | None = None  # the run to compare with; None for a width
    folder: Path | None = None  # of `against`, as it was typed

    def opened(self, settings: Mapping[str, Any]) -> "Until | None":
        width, against = settings.get(WIDTH), settings.get(DECIDED)
        if width is not None and against is not None:
            raise UserError("--until-width and --until-decided: give one of them")
        if against is not None:
            return Until(against=sound(Path(against)), folder=Path(against))
        if width is None:
            return None
        if not 0.1 <= width < 100:
            raise UserError(f"--until-width {width:g} is out of range; give 0.1 to 99 points")
        return Until(width=width / 100)

    def settings(self) -> dict[str, Any]:
        if self.width is not None:
            return {WIDTH: round(100 * self.width, 9)}
        return {DECIDED: str(self.folder)}

    def check(self, run: "Spec") -> None:
        choice = run.source.choice
        if choice and isinstance(run.settings.world, DriveSettings):
            name, value = next(iter(choice.given.items()))
            raise UserError(
                f"--{name} {printable(value)}: a run that stops takes layouts in their order; "
                "leave it out"
            )
        if run.scenario.cluster is not None:
            raise UserError(
                f"{printable(run.scenario.name, 60)} has layouts that are cut from recordings, and "
                "an interval of every look needs layouts that are drawn on their own; leave out "
                "--until-width and --until-decided"
            )
        for point in run.points:
            if point.elsewhere:
                raise UserError(
                    f"{printable(point.name)}: its ego hears helpers of other layouts, and a run "
                    "that stops has not played all of them; leave out --until-width and "
                    "--until-decided"
                )
        if self.against is not None:
            self._check_against(run, self.against)

    def _check_against(self, run: "Spec", against: Run) -> None:
        """Raise UserError unless the run to compare with fits.

        It must be of the same scenes and channel seeds, and have all of the episodes and
        conditions.
        """
        where = f"--until-decided {printable(self.folder)}"
        world, other_world = run.source.record(), against.manifest.world
        if type(other_world) is not type(world) or other_world.pinned != world.pinned:
            raise UserError(f"{where} is not of the same scenes; give a run on these")
        if sorted(against.manifest.seeds) != sorted(run.seeds):
            seeds = printable(list(against.manifest.seeds), 40)
            raise UserError(f"{where} has the seeds {seeds}; give the same")
        names = [point.name for point in run.points]
        if missing := [name for name in names if name not in against.conditions]:
            raise UserError(
                f"{where} has no condition {printable(missing[0])}; give --condition with those "
                f"that it has: {printable(', '.join(against.conditions), 60)}"
            )
        numbers = run.source.numbers
        if lacking := sum(number not in against.grid.episodes for number in numbers):
            raise UserError(
                f"{where} lacks {lacking} of the {amount(len(numbers), 'layout')}; use fewer, or a "
                "longer run"
            )

    def planned_looks(self, layouts: int) -> Sequence[int]:
        return interim_looks(layouts)

    def enough(self, grid: Grid, episodes: Sequence[Episode]) -> bool:
        success, values = by_condition(grid, episodes)
        if self.width is not None:
            spans = [any_time_mean(success, of_condition) for of_condition in values.values()]
            return all(span.high - span.low <= self.width for span in spans)
        assert self.against
        other = self.against
        seeds = [other.grid.seeds.index(seed) for seed in grid.seeds]
        numbers = [other.grid.episodes.index(number) for number in grid.episodes]
        _, before = by_condition(other.grid, other.episodes)
        differences = [
            self.difference(success, of_condition, before[name][seeds][:, numbers])
            for name, of_condition in values.items()
        ]
        return all(change.low > 0 or change.high < 0 for change in differences)

    def record(self, looks: InterimLooks) -> dict[str, Any]:
        run = self.against
        record = LooksRecord(
            layouts=looks.layouts,
            width=self.width,
            against=run.manifest.name if run else None,
            against_sha256=sha256_file(run.path / "episodes.csv") if run else None,
            at=looks.at,
            enough=looks.is_enough,
        )
        plain: dict[str, Any] = msgspec.to_builtins(record)
        return plain

    def looks(self, record: Mapping[str, Any]) -> InterimLooks:
        looks = msgspec.convert(record, LooksRecord)
        counts = [0, *looks.at]
        if not looks.at or counts != sorted({*counts}) or counts[-1] > looks.layouts:
            raise ValueError("looks: at no layouts, at more than all, or not in their order")
        if looks.width is None and looks.against is None:
            raise ValueError("looks: neither a width nor a run to differ from")
        return InterimLooks(looks.layouts, looks.at, looks.enough)

    def contradictions(
        self, record: Mapping[str, Any], grid: Grid, episodes: Sequence[Episode]
    ) -> Iterator[str]:
        looks = msgspec.convert(record, LooksRecord)
        if looks.width is not None:
            yield from looked_otherwise(Until(looks.width), self.looks(record), grid, episodes)

    def unchecked(self, record: Mapping[str, Any]) -> str | None:
        looks = msgspec.convert(record, LooksRecord)
        if looks.width is not None:
            return None
        other = printable(looks.against, 40)
        return f"Whether success differed from that of {other} at its looks is not checked."

    def sentence(self, record: Mapping[str, Any]) -> str:
        looks = msgspec.convert(record, LooksRecord)
        what = f"success differs from that of {printable(looks.against, 40)}"
        if looks.width is not None:
            what = f"success is known within {100 * looks.width:g} points"
        every = f"all {looks.layouts} layouts" if looks.layouts > 1 else "the only layout"
        how = f"It took {every}, and still it is not so that"
        if looks.enough:
            how = f"It stopped after {looks.at[-1]} of {amount(looks.layouts, 'layout')}, when"
        return (
            f"{how} {what} in every condition. It was looked at {amount(len(looks.at), 'time')}: "
            "intervals of success and of its gain hold at every look; all others are for a number "
            "of layouts fixed before, and too narrow."
        )

    def scores(self, grid: Grid, episodes: Sequence[Episode]) -> Iterator[Score]:
        success, values = by_condition(grid, episodes)
        for by in success.ways:
            for name, of_condition in values.items():
                yield Score.of(name, by.metric, any_time_mean(by, of_condition), ANY_TIME)
                if BASELINE in values and name != BASELINE:
                    gain = self.difference(by, of_condition, values[BASELINE])
                    yield Score.of(name, GAINS[by.metric], gain, ANY_TIME)

    def difference(self, success: Success, a: Floats, b: Floats) -> Estimate:
        differences = known_mean(a - b, 0)
        return any_time_difference([differences[part] for part in success.parts])


RULE = Until()


def any_time_mean(success: Success, values: Floats) -> Estimate:
    """Return mean success with an interval that stays valid though one looks after every episode.

    A run may so be stopped as soon as the interval is narrow enough. `values`, (S, E), are 1 or 0
    by S channel seeds and E episodes, and `success` says how they are averaged: plainly, or
    balanced over episodes with a danger and without.
    """
    means = known_mean(values, 0)
    return any_time([means[part] for part in success.parts])


def interim_looks(layouts: int) -> list[int]:
    """Return after how many layouts a run tests whether it may stop, ascending up to `layouts`.

    A layout is a start situation with one episode, and `layouts` how many the run has in all.
    """
    at = [min(FIRST, layouts)]
    while at[-1] < layouts:
        at.append(min(math.ceil(at[-1] * MORE), layouts))
    return at
