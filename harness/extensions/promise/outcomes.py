"""Hold what settings come to on the layouts of runs, and what can be promised of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.progress import Progress
from harness.core.statistics import Estimate
from harness.evaluate.table import columns
from harness.evaluate.walk import Decided
from harness.extensions.promise.grid import Grid, grid_of
from harness.extensions.promise.promises import Harm
from harness.runs.estimates import over_episodes
from harness.runs.headline import SUCCESS
from harness.runs.success import Success
from harness.studies.axes import Setting
from harness.studies.play import WalkResult
from harness.studies.replayed_run import ReplayedRun

WORDS: dict[Harm, str] = {"unsafe": "unsafe episodes", "failed": "failed episodes"}
AS_IT_IS, ALWAYS = "as it is", "always careful"
COSTS = ("requests", "latency_ms", "careful", "asked")


@dataclass(frozen=True)
class Outcome:
    """Hold how an ego does under one setting, for S seeds of the channel and E layouts."""

    harm: Floats  # 1 where an episode did harm, else 0, (S, E)
    success: Floats  # 1 where it succeeded, else 0, (S, E)
    # means by name of `COSTS`: per episode, or of decisions; none of an ego that looks at nothing
    costs: Mapping[str, float]

    def units(self, clusters: Ints | None) -> Floats:
        """Return the mean harm of each of n units that are drawn independently, (n,).

        A unit is a layout or, where layouts are cut from fewer scenes, such a cluster; `clusters`,
        (E,), has the number of each one's.
        """
        means: Floats = self.harm.mean(axis=0)
        if clusters is not None:
            means = np.bincount(clusters, means) / np.bincount(clusters)
        return means


@dataclass(frozen=True)
class Played:
    """Hold the outcomes of some settings on the layouts of one run."""

    run: ReplayedRun
    # by setting, as a condition, and of egos that look at nothing, by name
    outcomes: Mapping[OperatingPoint | str, Outcome]
    success_rule: Success  # how success is averaged over episodes

    @property
    def blind(self) -> list[str]:
        """Return the names of the egos that look at nothing."""
        return [each for each in self.outcomes if isinstance(each, str)]

    def harm(self, setting: OperatingPoint | str) -> Estimate:
        """Return the mean harm under a setting, 0 to 1, with its 95 % interval over layouts."""
        return over_episodes(SUCCESS, self.outcomes[setting].harm, self.run.clusters)

    def success(self, setting: OperatingPoint | str) -> Estimate:
        """Return success under a setting, 0 to 1, with its 95 % interval over layouts."""
        return self.success_rule.estimate(self.outcomes[setting].success)


@dataclass(frozen=True)
class Level:
    """Hold what can be promised of one share of harm."""

    at_most: float  # the share of harm
    needed: int  # number of tune layouts, all without harm, that a promise needs
    certified: int  # number of settings that may promise it
    chosen: OperatingPoint | None  # the best of them; None if there is none
    blind: str | None  # the best ego that may promise it looking at nothing; None if there is none

    @property
    def label(self) -> str:
        """Return what tables call it, such as `≤ 5 %`."""
        return f"≤ {percent(self.at_most)} %"


@dataclass(frozen=True)
class Result:
    """Hold a study of what one model may promise: levels, and outcomes on all layouts."""

    harm: Harm  # what counts as harm
    delta: float  # probability that a promise is wrong, at most
    grid: Grid  # the settings that were tried
    conditions: Sequence[OperatingPoint]  # those whose thresholds were varied
    seeds: Sequence[int]  # of the channel
    tune: Played  # all settings, on tune layouts
    report: Played  # some, on report layouts
    elsewhere: Sequence[Played]  # the same, on layouts that no promise is of
    levels: Sequence[Level]

    @cached_property
    def units(self) -> Floats:
        """Return the mean harm on tune layouts by setting and unit, (L, n), in the grid's order."""
        clusters = self.tune.run.clusters
        outcomes = [self.tune.outcomes[point] for point in self.grid.points]
        return np.array([outcome.units(clusters) for outcome in outcomes])

    @property
    def rows(self) -> dict[str, OperatingPoint]:
        """Return the settings that are shown, by label: references, and that of each level."""
        several = len(self.conditions) > 1
        rows = {}
        for condition in self.conditions:
            name = f" {condition.name}" if several else ""
            rows[f"{AS_IT_IS}{name}"] = condition
        actions = len(self.tune.run.run.actions)
        rows[ALWAYS] = grid_of(self.conditions[:1], actions, "unsafe").points[0]
        for level in self.levels:
            if level.chosen:
                rows[level.label] = level.chosen
        return rows


def is_binary(result: Result) -> bool:
    """Return whether the harm of a unit can be nothing but 0 or 1: of one layout and one draw."""
    return len(result.seeds) == 1 and result.tune.run.clusters is None


def unable(result: Result, level: Level) -> str:
    """Return in words that no setting can promise a level."""
    claim = f"{WORDS[result.harm]} ≤ {percent(level.at_most)} %"
    if level.needed > result.units.shape[1]:
        return f"{claim}: too few tune layouts to promise it"
    return f"No setting of {result.report.run.name} can promise {claim}"


def play(
    run: ReplayedRun,
    points: Sequence[OperatingPoint],
    harm: Harm,
    seeds: Sequence[int],
    progress: Progress,
) -> dict[OperatingPoint, Outcome]:
    """Play settings on a run's layouts from its stored answers; return outcomes by setting.

    Raises UserError if the model may not be asked and a setting comes to a decision point without
    an answer: a promise is of all layouts.
    """
    settings = [Setting(point.name, point, run.vehicles) for point in points]
    outcomes = {}
    for point, [walk] in zip(points, run.walked(settings, seeds, _columns, few=1), strict=True):
        if run.left_out:
            raise UserError(
                f"{printable(run.run.path)}: no stored answer at {len(run.left_out)} decision "
                "points that a setting leads to, and a promise is of all layouts; leave out "
                "--no-model"
            )
        outcomes[point] = _outcome(walk, harm)
        progress(1)
    return outcomes


def _columns(part: Decided[Any]) -> dict[str, Floats]:
    every = columns(part)
    return {
        "requests": every["requests"],
        "latency_ms": every["latency_ms"],
        "asked": every["triggered"],
        "careful": (part.result.action == 0).astype(float),
    }


def _outcome(walk: WalkResult, harm: Harm) -> Outcome:
    success = walk.ends[SUCCESS]
    harms = walk.ends["unsafe_rate"] if harm == "unsafe" else 1 - success
    means = {
        name: float(np.mean(walk.columns[name])) for name in ("latency_ms", "careful", "asked")
    }
    requests = float(walk.columns["requests"].sum()) / success.size
    return Outcome(harms, success, {"requests": requests, **means})


def percent(share: float) -> str:
    """Return a share from 0 to 1 in percent, with as many digits as it has, up to six."""
    return f"{100 * share:.6g}"
