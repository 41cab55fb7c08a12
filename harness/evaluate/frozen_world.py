"""The frozen world: an episode is a walk through its layout's decision tree."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.load import Dataset, Scene, argument
from harness.dataset.select import ALL, Selection
from harness.evaluate.walk import Decided, Due, Placed, channel_draws
from harness.runs.decisions import by_action
from harness.runs.metrics import World
from harness.runs.records import Episode, FrozenScenes
from harness.world.scenario import Scenario, frames


@dataclass(frozen=True)
class FrozenSource:
    """A dataset, which has only the selected episodes already."""

    dataset: Dataset
    selection: Selection = ALL
    kind: ClassVar[World] = "frozen"
    command: ClassVar[str] = "eval"

    @property
    def name(self) -> str:
        """The dataset's."""
        return self.dataset.name

    @property
    def actions(self) -> tuple[str, ...]:
        """The dataset's."""
        return self.dataset.actions

    @property
    def scenario(self) -> Scenario:
        """The dataset's."""
        return self.dataset.scenario

    @property
    def layout_seeds(self) -> Sequence[int]:
        """Of the selected episodes."""
        return self.dataset.seeds

    def record(self) -> FrozenScenes:
        """The dataset, pinned by its digest."""
        p = self.scenario.parameters
        return FrozenScenes(
            name=self.dataset.name, sha256=self.dataset.sha256, nodes=self.dataset.nodes,
            episodes=len(self.dataset.episodes), limit=self.selection.limit,
            delay_allowance_s=p.delay_allowance_s, decision_lag_s=p.decision_lag_s,
            path=str(self.dataset.path), selection=self.selection.given,
        )  # fmt: skip

    def options(self) -> list[tuple[str, object]]:
        """The dataset's folder, and which episodes of it."""
        given = [(f"--{key.replace('_', '-')}", value) for key, value in self.selection.given.items()]
        return [("--dataset", argument(self.dataset.path)), ("--limit", self.selection.limit), *given]


class _Walks:
    """The walks under one condition, arrays (S, E).

    Attributes:
        at: the decision point of each, among the forest's; -1 once the episode is decided.
        last: the edge taken last.
        edges: those taken, an array a step; -1 where the episode was decided.
        dropped: walks that are left out.
    """

    def __init__(self, seeds: int, root: Ints) -> None:
        shape = seeds, len(root)
        self.at, self.last = np.tile(root, (seeds, 1)), np.full(shape, -1)
        self.edges: list[Ints] = []
        self.dropped = np.zeros(shape, dtype=bool)


class FrozenWorld(Placed):
    """Every episode of a dataset, under all conditions and seeds.

    A decision acts the dataset's lag after its moment, however long it took.
    """

    def __init__(self, dataset: Dataset, points: Sequence[OperatingPoint], seeds: Sequence[int]) -> None:
        self._dataset, self._forest, self._seeds = dataset, dataset.forest, np.array(seeds)
        self.scenario = dataset.scenario
        self._walks = {point.name: _Walks(len(seeds), self._forest.root) for point in points}
        self._decided: list[tuple[Ints, Ints, Floats]] = []  # where, which action, after how many seconds

    def observe(self) -> Sequence[Scene]:
        """Every decision point to which some walk has come."""
        places = np.unique(np.concatenate([walks.at.ravel() for walks in self._walks.values()]))
        self._moments = places[places >= 0]
        self.scenes = self._dataset.scenes([self._forest.ids[n] for n in self._moments.tolist()])
        self._helpers = max((len(scene.viewers) for scene in self.scenes), default=1) - 1
        return self.scenes

    def due(self, point: OperatingPoint) -> Due:
        """Each walk of the condition that is not at its end."""
        walks, forest = self._walks[point.name], self._forest
        of_seed, tree = np.nonzero(walks.at >= 0)
        at = np.searchsorted(self._moments, walks.at[of_seed, tree])
        p = self.scenario.parameters
        seed, step = self._seeds[of_seed], forest.step[self._moments[at]]
        draws = channel_draws(seed, forest.seeds[tree], step, p.decisions, self._helpers)
        return Due(at, forest.episodes[tree], seed, draws)

    def leave_out(self, point: OperatingPoint, moments: Bools) -> None:
        """End the walks that have come to these of the moments just shown, and count them no longer."""
        walks = self._walks[point.name]
        there = walks.at >= 0
        out = np.zeros_like(there)
        out[there] = moments[np.searchsorted(self._moments, walks.at[there])]
        walks.dropped |= out
        walks.at[out] = -1

    def step(self, decided: Sequence[Decided[Scene]]) -> None:
        """Take the edge of each action."""
        for part in decided:
            walks, action = self._walks[part.point.name], part.result.action
            going = walks.at >= 0
            at = walks.at[going]
            taken = np.full_like(walks.at, -1)
            taken[going] = self._forest.edge[at, action]
            walks.edges.append(taken)
            walks.last[going] = taken[going]
            walks.at[going] = self._forest.child[at, action]
            self._decided.append((at, action, part.result.latency_s))

    def columns(self) -> dict[str, Any]:
        """What each decision was worth, and every other action, in the order of decisions."""
        at, action, latency_s = map(np.concatenate, zip(*self._decided, strict=True))
        forest, p = self._forest, self.scenario.parameters
        off_lag = [frames(each, p.simulation_hz) != p.lag_frames for each in np.nan_to_num(latency_s)]
        return {
            "value": forest.value[at], "safe": forest.safe[at, action],
            "regret": np.where(forest.value[at], ~forest.safe[at, action], np.nan),
            "delay_s": forest.delay_s[at, action],
            "off_lag": np.where(np.isnan(latency_s), np.nan, off_lag),
            **by_action("safe", forest.safe[at], forest.actions),
            **by_action("delay_s", forest.delay_s[at], forest.actions),
        }  # fmt: skip

    @property
    def numbers(self) -> Ints:
        """Of the episodes, (E,)."""
        return self._forest.episodes

    def ends(self, point: OperatingPoint) -> dict[str, Floats]:
        """Success, failure and lateness under a condition, (S, E); NaN where a walk was left out."""
        walks, trees = self._walks[point.name], np.arange(len(self._forest.root))
        cleared = np.isfinite(self._forest.cleared_s[walks.last])
        success = self._forest.succeeds(walks.last, trees)
        ends = {"success_rate": success, "unsafe_rate": ~cleared, "late_rate": cleared & ~success}
        return {name: np.where(walks.dropped, np.nan, values) for name, values in ends.items()}

    def episodes(self) -> list[Episode]:
        """How each episode ended under each condition and seed."""
        return [
            self._episode(condition, walks, place)
            for condition, walks in self._walks.items()
            for place in np.ndindex(*walks.at.shape)
        ]

    def _episode(self, condition: str, walks: _Walks, place: tuple[int, ...]) -> Episode:
        seed, tree = place
        forest, last = self._forest, int(walks.last[place])
        edges = [forest.edges[taken[place]] for taken in walks.edges if taken[place] >= 0]
        end, reference_s = forest.end(last), float(forest.reference_s[tree])
        cleared = end.result == "cleared"
        success = bool(forest.succeeds(np.array(last), np.array(tree)))
        return Episode(
            condition=condition, seed=int(self._seeds[seed]), episode=int(forest.episodes[tree]),
            layout_seed=int(forest.seeds[tree]), danger=forest.dangers[tree] or "none", success=success,
            failure="" if success else "late" if cleared else end.result,
            delay_s=round(end.time_s - reference_s, 3) if cleared and np.isfinite(reference_s) else None,
            time_s=end.time_s, partner=end.partner, striker=end.striker, fault=end.fault,
            least_gap_m=min(edge.least_gap_m for edge in edges),
            hard_brakings=sum(edge.hard_brakings for edge in edges),
            other_crashes=sum(edge.other_crashes for edge in edges),
        )  # fmt: skip
