"""The frozen world: recorded courses of scenes; a table says where each action would lead."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Ints
from harness.dataset.load import Dataset, Scene, argument
from harness.evaluate.success import Verdict, judge_choices, table
from harness.evaluate.walk import Decided, Due, channel_draws
from harness.runs.decisions import by_action
from harness.runs.metrics import World
from harness.runs.records import Episode, FrozenScenes
from harness.world.scenario import Scenario


@dataclass(frozen=True)
class FrozenSource:
    """A dataset, already limited to the first `limit` episodes; None for all."""

    dataset: Dataset
    limit: int | None = None
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

    def record(self) -> FrozenScenes:
        """The dataset, pinned by its digest."""
        scenes = self.dataset.scenes
        return FrozenScenes(
            name=self.dataset.name, sha256=self.dataset.sha256, scenes=len(scenes),
            episodes=len(self.dataset.episodes), limit=self.limit,
            delay_allowance_s=self.dataset.delay_allowance_s,
            path=str(self.dataset.path),
        )  # fmt: skip

    def options(self) -> list[tuple[str, object]]:
        """The dataset's folder and the limit."""
        return [("--dataset", argument(self.dataset.path)), ("--limit", self.limit)]


@dataclass(frozen=True)
class _Shown:
    """The scenes of a step, their positions in the dataset, and the decisions that are due in them."""

    places: Ints
    scenes: Sequence[Scene]
    due: Due


class FrozenWorld:
    """Every episode of a dataset, under all conditions and seeds.

    An episode takes the recorded course whatever it decides; a decision counts by its scene's outcome table.
    """

    def __init__(self, dataset: Dataset, seeds: Sequence[int]) -> None:
        self._dataset, self._seeds = dataset, seeds
        self._laid = table(dataset)
        self._shown: list[_Shown] = []  # of each step observed so far
        self._step = -1
        self._chosen: dict[str, Ints] = {}  # by condition, (S, n)
        self._columns: list[dict[str, Any]] = []

    def undecided(self) -> "FrozenWorld":
        """The same world before its first decision; both lay out a step's scenes and draws once."""
        world = copy(self)
        world._step, world._chosen, world._columns = -1, {}, []
        return world

    def observe(self) -> Sequence[Scene]:
        """The scenes of the next step."""
        self._step += 1
        if self._step == self._laid.index.shape[1]:
            return ()
        if self._step == len(self._shown):
            self._shown.append(self._show())
        return self._shown[self._step].scenes

    def _show(self) -> "_Shown":
        column, steps = self._laid.index[:, self._step], self._laid.index.shape[1]
        there = column >= 0
        places = column[there]
        scenes = [self._dataset.scenes[n] for n in places.tolist()]
        n, helpers = len(scenes), max(len(scene.viewers) for scene in scenes) - 1
        at, seed = np.tile(np.arange(n), len(self._seeds)), np.repeat(self._seeds, n)
        draws = channel_draws(seed, self._laid.seeds[there][at], np.full(len(at), self._step), steps, helpers)
        return _Shown(places, scenes, Due(at, self._laid.episodes[there][at], seed, draws))

    def due(self, point: OperatingPoint) -> Due:
        """Each scene of the step, with every seed."""
        return self._shown[self._step].due

    def step(self, decided: Sequence[Decided[Scene]]) -> None:
        """Look up where each action leads."""
        laid, n, shown = self._laid, len(self._laid.safe), self._shown[self._step]
        place = shown.places[shown.due.at]
        of_seed = np.repeat(np.arange(len(self._seeds)), len(shown.places))
        for part in decided:
            action = part.result.action
            chosen = self._chosen.setdefault(part.point.name, np.zeros((len(self._seeds), n), dtype=int))
            chosen[of_seed, place] = action
            self._columns.append({
                "safe": laid.safe[place, action], "delay_s": laid.delay_s[place, action],
                **by_action("safe", laid.safe[place], self._dataset.actions),
                **by_action("delay_s", laid.delay_s[place], self._dataset.actions),
            })  # fmt: skip

    def columns(self) -> dict[str, Any]:
        """Outcome of each decision, and of every other action, in the order of decisions."""
        return {name: np.concatenate([each[name] for each in self._columns]) for name in self._columns[0]}

    @property
    def numbers(self) -> Ints:
        """Of the episodes, (E,)."""
        return self._laid.episodes

    def verdicts(self, point: OperatingPoint) -> list[Verdict]:
        """How the episodes ended under a condition, arrays (E,) for each seed."""
        return [judge_choices(self._laid, chosen) for chosen in self._chosen[point.name]]

    def episodes(self) -> list[Episode]:
        """How each episode ended under each condition and seed."""
        return [
            episode
            for condition, chosen in self._chosen.items()
            for seed, of_seed in zip(self._seeds, chosen, strict=True)
            for episode in self._judged(condition, seed, of_seed)
        ]

    def _judged(self, condition: str, seed: int, chosen: Ints) -> list[Episode]:
        laid, scenes = self._laid, self._dataset.scenes
        verdict = judge_choices(laid, chosen)
        return [
            Episode(
                condition=condition, seed=seed, episode=int(laid.episodes[row]),
                layout_seed=int(laid.seeds[row]),
                danger=scenes[places[0]].record["danger"]["sector"] or "none",
                success=bool(verdict.success[row]),
                failure=self._first_unsafe(places, chosen) if verdict.unsafe[row]
                else "late" if verdict.late[row] else "",
                delay_s=round(float(verdict.delay_s[row]), 3),
            )
            for row, places in enumerate(laid.index)
        ]  # fmt: skip

    def _first_unsafe(self, places: Ints, chosen: Ints) -> str:
        """What the first unsafe decision of an episode leads to."""
        safe, actions = self._laid.safe, self._dataset.actions
        place = next(n for n in places[places >= 0] if safe[n].any() and not safe[n, chosen[n]])
        return str(self._dataset.scenes[place].record["outcomes"][actions[chosen[place]]]["result"])
