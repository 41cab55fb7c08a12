"""Walk frozen scenes: an episode is a walk through the decision tree of its layout."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, ClassVar, NamedTuple

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools, Floats, Ints
from harness.core.covariate import LEAST
from harness.core.errors import UserError
from harness.dataset.load import Dataset, Scene, argument
from harness.dataset.schema import Edge
from harness.dataset.select import NONE, Choice
from harness.evaluate.helper_numbers import Helpers
from harness.evaluate.walk import Decided, Due, SceneWorld
from harness.radio.channel import Draws
from harness.runs.decisions import by_action
from harness.runs.difficulty import REFERENCES, Layout
from harness.runs.metric import World
from harness.runs.metric_values import by_danger
from harness.runs.records import Episode, FrozenScenes
from harness.runs.settings import FrozenSettings
from harness.world.lookouts import radios
from harness.world.outcome import rating
from harness.world.parameters import ROUNDING_FRAMES
from harness.world.scenario import Scenario

# layouts for each that is asked: more would cost time, and hardly make an interval narrower
MOST_KNOWN = 20


@dataclass(frozen=True)
class FrozenSource:
    """Describe the recorded scenes to evaluate on: some or all episodes of a dataset.

    `dataset` is cut to the episodes that are used: the first `limit` (None for all) of those that
    `choice`, by settings of an extension, has selected. `kind` is the kind of world.
    """

    dataset: Dataset  # the dataset, cut to the episodes that are used
    limit: int | None = None  # how many episodes were asked for, from the first; None for all
    # what chose some of the dataset's episodes before that; None for all
    choice: Choice | None = None
    kind: ClassVar[World] = "frozen"

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise UserError(f"--limit {self.limit}: give 1 or more episodes")

    @property
    def name(self) -> str:
        return self.dataset.name

    @property
    def actions(self) -> tuple[str, ...]:
        return self.dataset.actions

    @property
    def scenario(self) -> Scenario:
        return self.dataset.scenario

    @property
    def layout_seeds(self) -> Sequence[int]:
        return self.dataset.seeds

    def record(self) -> FrozenScenes:
        p = self.scenario.parameters
        return FrozenScenes(
            name=self.dataset.name,
            sha256=self.dataset.sha256,
            nodes=self.dataset.nodes,
            episodes=len(self.dataset.episodes),
            limit=self.limit,
            delay_allowance_s=p.delay_allowance_s,
            decision_lag_s=p.decision_lag_s,
            path=str(self.dataset.path),
            selection=dict(self.choice.given) if self.choice else {},
        )

    @property
    def numbers(self) -> Sequence[int]:
        """Return the numbers of the episodes to evaluate; a run that stops early has the first."""
        return self.dataset.episodes

    def first(self, count: int) -> "FrozenSource":
        """Return this source of scenes with at most `count` of its episodes, from the first."""
        numbers, limit = self.dataset.episodes[:count], self.limit
        if len(numbers) < len(self.dataset.episodes):
            limit = len(numbers)
        return FrozenSource(self.dataset.of_episodes(frozenset(numbers)), limit, self.choice)

    def layouts(self, n_asked: int) -> list[Layout]:
        """Return how hard each start situation is, of those asked and of others of the dataset.

        Such a situation, a layout, has one episode. How hard it is, is the success of reference
        policies in it, by which a run's success is corrected where the layouts asked are harder
        than the others. Those asked are the first `n_asked` of the source. The list is empty if
        there are no others, or too few were asked to correct anything.
        """
        if n_asked < LEAST:
            return []
        own_episodes, pool = self.dataset.episodes[:n_asked], self.dataset.whole
        if self.choice:
            pool = pool.of_episodes(frozenset(self.choice.pool))
        if len(pool.episodes) <= n_asked:
            return []
        pool = pool.of_episodes(frozenset((*own_episodes, *pool.episodes[: MOST_KNOWN * n_asked])))
        success = pool.reference_success()
        dangers = (tree.danger.sector or NONE for tree in pool.trees)
        reference_successes = (success[name].tolist() for name in REFERENCES)
        return [
            Layout(*each) for each in zip(pool.episodes, dangers, *reference_successes, strict=True)
        ]

    def trial(self, most: int, ego_alone: bool) -> Iterator[Scene]:
        """Yield the first scene of each of up to `most` episodes, such as to time a model on.

        It has what every vehicle knows, its scene graph, even if only the ego is asked
        (`ego_alone`).
        """
        forest = self.dataset.forest
        for root in forest.root[:most].tolist():
            yield from self.dataset.scenes([forest.ids[root]])

    def settings(self) -> FrozenSettings:
        return FrozenSettings(dataset=str(argument(self.dataset.path)), limit=self.limit)


class _Walks:
    """The walks under one condition, as arrays (S, E) of seeds and episodes.

    Attributes:
        at: the index of each walk's decision point in the forest; -1 once the episode is decided.
        last: the edge taken last.
        edges: the edges taken, one array a step; -1 where the episode was already decided.
        dropped: whether the walk is left out.
    """

    def __init__(self, seeds: int, root: Ints) -> None:
        shape = seeds, len(root)
        self.at, self.last = np.tile(root, (seeds, 1)), np.full(shape, -1)
        self.edges: list[Ints] = []
        self.dropped = np.zeros(shape, dtype=bool)


class _Layout(NamedTuple):
    """What the episodes of a layout have in common under all conditions and seeds."""

    episode: int  # the episode's number
    seed: int  # seed of the layout
    danger: str  # where the hidden danger comes from; `none` without one
    earliest_s: float  # when the goal can be reached; inf for never
    reference_s: float  # when the full-view driver reaches it; inf for never
    radios: Mapping[str, Any]  # its columns of witnesses and radios
    cluster: str | None  # what it is cut from, such as a recording; None for one of its own


class FrozenWorld(SceneWorld):
    """Play recorded scenes: go through the decision tree of each layout under all conditions.

    A decision tree has every scene that decisions can lead to from one start situation, the layout,
    and how each course ends. A condition is a named set of settings of the radio, of asking helpers
    and of fusing their messages; there is one course (walk) for each episode, condition and channel
    seed. An action takes effect one decision lag of the dataset after its scene, however long the
    decision took.
    """

    def __init__(
        self, dataset: Dataset, points: Sequence[OperatingPoint], seeds: Sequence[int]
    ) -> None:
        self._dataset, self._forest, self._seeds = dataset, dataset.forest, np.array(seeds)
        self.scenario = dataset.scenario
        self._walks = {point: _Walks(len(seeds), self._forest.root) for point in points}
        # where, which action, after how many seconds
        self._decided: list[tuple[Ints, Ints, Floats]] = []
        self._luck: tuple[Bools, Draws] | None = None  # of the decision points just shown
        self._helpers = Helpers()

    def observe(self) -> Sequence[Scene]:
        places = np.unique(np.concatenate([walks.at.ravel() for walks in self._walks.values()]))
        self._shown, self._luck = places[places >= 0], None
        self.scenes = self._dataset.scenes([self._forest.ids[n] for n in self._shown.tolist()])
        self._numbers = self._helpers.numbers(self.scenes)
        return self.scenes

    def due(self, point: OperatingPoint) -> Due:
        """Return the decisions due under a condition in the scenes just shown, one an open episode.

        Each episode is played once for each seed of the channel's draws. `point` is the condition,
        its settings of the radio, of asking helpers and of fusing their messages.
        """
        walks, forest = self._walks[point], self._forest
        undecided = walks.at >= 0
        seed_index, tree = np.nonzero(undecided)
        at = np.searchsorted(self._shown, walks.at[undecided])
        drawn, draws = self._draws()
        if len(at) < np.count_nonzero(drawn):
            draws = draws.take(undecided[drawn])
        draws = self._numbers.of(draws, at)
        return Due(at, forest.episodes[tree], self._seeds[seed_index], draws)

    def _draws(self) -> tuple[Bools, Draws]:
        """Return which seeds and episodes have a decision now under any condition,
        (S, E), and their draws, of helpers by their numbers.

        All decisions of an episode that are due now are of one step, whatever their condition.
        """
        if self._luck is None:
            forest, decisions = self._forest, self.scenario.parameters.decisions
            latest = np.max([walks.at for walks in self._walks.values()], axis=0)
            seed_index, tree = np.nonzero(latest >= 0)
            at = latest[seed_index, tree]
            keys = self._seeds[seed_index], forest.seeds[tree], forest.step[at], decisions
            draws = self._numbers.by_number(np.searchsorted(self._shown, at), *keys)
            self._luck = latest >= 0, draws
        return self._luck

    def leave_out(self, point: OperatingPoint, at: Bools) -> None:
        """End the episodes that are at some of the scenes just shown, and drop their results.

        It is for scenes without an answer, under one condition and all channel seeds. `point` is
        the condition, and the mask `at` says of each scene whether it is one of them. A condition
        is a named set of settings of the radio, of asking helpers and of fusing their messages.
        """
        walks = self._walks[point]
        undecided = walks.at >= 0
        ended = np.zeros_like(undecided)
        ended[undecided] = at[np.searchsorted(self._shown, walks.at[undecided])]
        walks.dropped |= ended
        walks.at[ended] = -1

    def step(self, decided: Sequence[Decided[Scene]]) -> None:
        for part in decided:
            walks, action = self._walks[part.point], part.result.action
            undecided = walks.at >= 0
            at = walks.at[undecided]
            edge = np.full_like(walks.at, -1)
            edge[undecided] = self._forest.edge[at, action]
            walks.edges.append(edge)
            walks.last[undecided] = edge[undecided]
            walks.at[undecided] = self._forest.child[at, action]
            self._decided.append((at, action, part.result.latency_s))

    def columns(self) -> dict[str, Any]:
        """Return what each decision and its alternatives were worth, as columns by name, `(n,)`.

        The n decisions are in the order of the calls of `step`, which plays them. `value` is
        whether success was possible, `safe` whether it still is, `regret` whether the action gave
        it away; `delay_s` by how much it puts off the earliest success, s; `miss` and `false_alarm`
        whether it made harm inevitable, or success alone impossible. Others are how near vehicles
        came in time, s, and safety and delay of every action.
        """
        at, action, latency_s = map(np.concatenate, zip(*self._decided, strict=True))
        forest, p = self._forest, self.scenario.parameters
        taken = np.ceil(np.nan_to_num(latency_s) * p.simulation_hz - ROUNDING_FRAMES)  # as `frames`
        return {
            "value": forest.value[at],
            "safe": forest.safe[at, action],
            "regret": np.where(forest.value[at], ~forest.safe[at, action], np.nan),
            "delay_s": forest.delay_s[at, action],
            "miss": forest.miss[at, action],
            "false_alarm": forest.false_alarm[at, action],
            "off_lag": np.where(np.isnan(latency_s), np.nan, taken != p.lag_frames),
            **{name: values[forest.edge[at, action]] for name, values in forest.conflicts.items()},
            **by_action("safe", forest.safe[at], forest.actions),
            **by_action("delay_s", forest.delay_s[at], forest.actions),
        }

    @property
    def numbers(self) -> Ints:
        """Return the numbers of the E episodes that are played, as the dataset has them, `(E,)`."""
        return self._forest.episodes

    def ends(self, point: OperatingPoint) -> dict[str, Floats]:
        """Return how each episode of a condition ended, by name of a metric, `(S, E)`.

        Values are 0 or 1, by S seeds of the channel's random draws and E episodes; NaN where one
        was left out. Success with a danger is NaN in episodes without one, and the other way round.
        `point` is the condition, its settings of the radio, of asking helpers and of fusing their
        messages.
        """
        walks, trees = self._walks[point], np.arange(len(self._forest.root))
        cleared = np.isfinite(self._forest.cleared_s[walks.last])
        success = self._forest.succeeds(walks.last, trees)
        unsafe = self._forest.unsafe(walks.last, self.scenario.parameters.limits)
        ends = {"success_rate": success, "unsafe_rate": unsafe, "late_rate": cleared & ~success}
        ends_or_nan = {
            name: np.where(walks.dropped, np.nan, values) for name, values in ends.items()
        }
        dangerous = np.array([danger is not None for danger in self._forest.dangers])
        return {**ends_or_nan, **by_danger(ends_or_nan["success_rate"], dangerous)}

    def episodes(self) -> list[Episode]:
        forest = self._forest
        seeds, earliest_s = forest.seeds.tolist(), forest.earliest_s[forest.root].min(axis=-1)
        layouts = [
            _Layout(
                number,
                seed,
                danger or "none",
                earliest_s=earliest,
                reference_s=reference,
                radios=radios(self.scenario, seed, danger),
                cluster=self.scenario.cluster_of(seed),
            )
            for number, seed, danger, earliest, reference in zip(
                forest.episodes.tolist(),
                seeds,
                forest.dangers,
                earliest_s.tolist(),
                forest.reference_s.tolist(),
                strict=True,
            )
        ]
        episodes = []
        for point, walks in self._walks.items():
            taken, successes = self._taken(walks)
            for n, seed in enumerate(self._seeds.tolist()):
                for layout, edges, success in zip(layouts, taken[n], successes[n], strict=True):
                    course = [forest.edges[edge] for edge in edges if edge >= 0]
                    episodes.append(self._episode(point.name, seed, layout, course, success))
        return episodes

    def _taken(self, walks: _Walks) -> tuple[list[list[list[int]]], list[list[bool]]]:
        """Return the edges that each walk took, (S, E, steps) with -1 after its end,
        and its success.
        """
        success = self._forest.succeeds(walks.last, np.arange(len(self._forest.root)))
        return np.stack(walks.edges, axis=-1).tolist(), success.tolist()

    def _episode(
        self, condition: str, seed: int, layout: _Layout, edges: Sequence[Edge], success: bool
    ) -> Episode:
        end = edges[-1].end
        assert end is not None
        cleared = end.result == "cleared"
        failure = "" if success else "late" if cleared else end.result
        reference_s = layout.reference_s
        return Episode(
            condition=condition,
            seed=seed,
            episode=layout.episode,
            layout_seed=layout.seed,
            danger=layout.danger,
            success=success,
            failure=failure,
            outcome=rating(failure, self.scenario.parameters),
            time_lost_s=round(end.time_s - layout.earliest_s, 3) if cleared else None,
            delay_s=round(end.time_s - reference_s, 3)
            if cleared and isfinite(reference_s)
            else None,
            time_s=end.time_s,
            partner=end.partner,
            striker=end.striker,
            fault=end.fault,
            least_gap_m=min([edge.least_gap_m for edge in edges]),
            hard_brakings=sum([edge.hard_brakings for edge in edges]),
            other_crashes=sum([edge.other_crashes for edge in edges]),
            cluster=layout.cluster,
            **layout.radios,
        )
