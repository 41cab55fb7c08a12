"""One episode, decision by decision: a walk through its tree, or a drive in the simulator."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, unknown
from harness.core.seeds import LAST_SEED, purpose
from harness.dataset.freeze import edges, record_of
from harness.dataset.load import Dataset, Scene
from harness.extensions.learn.rewards.layouts import refuse, whole
from harness.extensions.learn.rewards.values import BEST, Values, balanced, best_constant, drawn
from harness.world.drivers import (
    CONSTANT,
    DRIVERS,
    OPEN_LOOP,
    PRIVILEGED,
    UNIFORM,
    constant,
    open_loop,
)
from harness.world.outcome import Outcome
from harness.world.reference import drive, finish
from harness.world.scenario import Scenario
from harness.world.seats import refuse_agents
from harness.world.world import World


class Trip(Protocol):
    """Describe one episode in progress for a learning program: where it is, how to go on.

    It stands at a decision point, a situation in which the ego must act, or is over.
    """

    @property
    def scene(self) -> Scene:
        """Return the present situation in which the ego must act, with what each vehicle sees.

        At the end of the episode it is the last one.
        """
        ...

    @property
    def values(self) -> Floats:
        """Return the probability of success after each of A actions at this point, (A,)."""
        ...

    @property
    def success(self) -> bool | None:
        """Return whether the episode succeeded; None while it is under way."""
        ...

    def take(self, action: int) -> None:
        """Take an action by its index, and go on to the next decision point or to the end.

        A decision point is a situation in which the ego must act.
        """
        ...


class Source(Protocol):
    """Describe where a learning environment's episodes come from: trees or the simulator.

    A decision tree has every course that actions can lead to, and how each ends.
    """

    @property
    def scenario(self) -> Scenario: ...

    @property
    def seeds(self) -> Sequence[int]:
        """Return the layout seeds, each of a start situation, among which an episode's is drawn."""
        ...

    def begin(self, seed: int) -> Trip:
        """Begin an episode on the layout (start situation) of this seed, and return it.

        Raises UserError if there is no such layout here.
        """
        ...


@dataclass(frozen=True)
class Trees:
    """Take the environment's episodes from the decision trees of a dataset, without a simulator.

    A decision tree has every course that actions can lead to from a layout (start situation), and
    how each episode ends. What an action is worth depends on who decides after it, `then`: `best`,
    `uniform` or a reference driver, a rule.
    """

    dataset: Dataset  # the trees, and the scenes of their decision points
    then: str = BEST  # who decides after the action whose worth is asked: `best`, or a driver

    @property
    def scenario(self) -> Scenario:
        return self.dataset.scenario

    @property
    def seeds(self) -> Sequence[int]:
        return self.dataset.seeds

    @cached_property
    def values(self) -> Values:
        return Values.of(self.dataset.forest, self.then)

    @cached_property
    def constant(self) -> int:
        """Return the index of the action that is always taken, beside which answers are judged.

        It is the scenario's measured best constant action, or else the best one of these layouts
        (start situations).
        """
        action = constant(self.scenario)
        if action is None:
            return best_constant(self.dataset.forest, self.dataset.dangerous)
        return self.scenario.actions.index(action)

    def drawn(self, per_level: int) -> Ints:
        """Return the indices, (n,), of random decision points at which the action matters.

        A decision point is a situation in which the ego must act; a decision tree has all that
        actions can lead to from a start situation, and indices are those in all trees. There are
        about `per_level` for each step (number of the decision) of each tree; the draw is the same
        every time.
        """
        data = self.dataset
        return drawn(
            data.forest, data.dangerous, self.values.decides, per_level, self.scenario.name
        )

    def references(self, at: Ints) -> dict[str, dict[str, float]]:
        """Return `advantage` and `success` of drivers that need no model, by the driver's name.

        `advantage` is the mean over decision points at indices `at` (n,) of the worth of what the
        driver does, less that of the action that is always taken (`constant`). `success` is the
        share of layouts (start situations) that succeed, where those with a danger, a vehicle that
        the ego would meet, and without weigh alike. Raises UserError if `at` is empty.
        """
        if not len(at):
            raise UserError("no decision of these layouts matters; give more layouts")
        forest, dangerous = self.dataset.forest, self.dataset.dangerous
        worth = self.values.table[at]
        less = worth[:, self.constant]
        always = forest.actions[self.constant]
        policies: dict[str, tuple[Floats, Floats | Bools]] = {
            CONSTANT: (less, forest.constant_success(always)),
            UNIFORM: (worth.mean(axis=-1), forest.uniform_success()),
        }
        if actions := open_loop(self.scenario):
            taken = forest.sequence(actions)[at]
            policies[OPEN_LOOP] = worth[np.arange(len(at)), taken], forest.sequence_success(actions)
        for name in ("local-view", PRIVILEGED):
            taken = forest.drivers[name][at]
            policies[name] = worth[np.arange(len(at)), taken], forest.driver_success(name)
        return {
            name: {"advantage": float((of - less).mean()), "success": balanced(success, dangerous)}
            for name, (of, success) in policies.items()
        }

    def begin(self, seed: int) -> "TreeTrip":
        seed = whole("layout seed", seed)
        if seed not in self.seeds:
            raise UserError(
                f"layout seed {seed} has no tree here; give one of {_range(self.seeds)}"
            )
        return TreeTrip(self, int(self.dataset.forest.root[self.seeds.index(seed)]))


@dataclass
class TreeTrip:
    """Walk through the tree of one layout: an episode that `Trees` began.

    A layout is a start situation, and its tree has all courses from there. `of` has the tree, and
    `at` is the index of the present decision point among those of all trees of the dataset.
    `success` is None until the episode ends.
    """

    of: Trees  # where the layout's tree is
    at: int  # index of the present decision point in the dataset's decision trees
    success: bool | None = None  # whether the episode succeeded; None while it is under way

    @property
    def scene(self) -> Scene:
        [scene] = self.of.dataset.scenes([self.of.values.ids[self.at]])
        return scene

    @property
    def values(self) -> Floats:
        return np.asarray(self.of.values.table[self.at])

    def take(self, action: int) -> None:
        forest = self.of.dataset.forest
        if (child := int(forest.child[self.at, action])) >= 0:
            self.at = child
        else:
            self.success = bool(forest.succeeds(forest.edge[self.at, action], forest.tree[self.at]))


@dataclass(frozen=True)
class Roads:
    """Take the environment's episodes from the simulator, so that no tree is built.

    Each of the layout `seeds` draws a start situation of `scenario`. `then` names the reference
    driver that decides after an action whose worth is asked; without one the worth is NaN.
    """

    scenario: Scenario  # what is driven
    seeds: Sequence[int]  # the layout seeds, which draw start situations
    # reference driver who decides after the action whose worth is asked; None: values are NaN
    then: str | None = None

    def __post_init__(self) -> None:
        refuse_agents(self.scenario, "an environment to learn in")
        if self.then not in (None, *DRIVERS):
            raise unknown("then", str(self.then), DRIVERS, "; only trees know more than drivers do")

    def begin(self, seed: int) -> "RoadTrip":
        seed = whole("layout seed", seed)
        if not 0 <= seed <= LAST_SEED:
            raise UserError(f"layout seed {seed}: give 0 to {LAST_SEED}")
        refuse(purpose(seed, 1), f"layout seed {seed}")
        return RoadTrip(self, World.start(self.scenario, seed))


@dataclass
class RoadTrip:
    """Drive one layout, a start situation, in the simulator: an episode that `Roads` began.

    `of` says what is driven, and `world` is the simulated world at the present decision point.
    `success` is None until the episode ends.
    """

    of: Roads  # what is driven
    world: World  # the simulated world, at the present decision point
    success: bool | None = None  # whether the episode succeeded; None while it is under way

    def __post_init__(self) -> None:
        self._look()

    @cached_property
    def reference(self) -> Outcome:
        """Return how the reference driver that sees everything ends on this layout.

        A layout is a start situation, and a reference driver is a rule that needs no model. The
        time that it takes says from when on the ego is too late.
        """
        return drive(self.of.scenario, PRIVILEGED, self.world.seed)

    def _look(self) -> None:
        state = self.world.state()
        record = record_of(self.world, state, 0, (state.ego, *state.helpers))
        self.scene, self.values = Scene.of(record, self.of.scenario), self._values()

    def _values(self) -> Floats:
        actions = self.of.scenario.actions
        values = np.full(len(actions), np.nan)
        if self.of.then:
            [branches], led = edges([self.world], [0])
            ends = finish([world for _, world in led], [self.of.then] * len(led))
            for edge in branches:
                end = Outcome(edge.end.result, edge.end.time_s) if edge.end else ends[edge.to or 0]
                values[[actions.index(action) for action in edge.actions]] = self._succeeded(end)
        return values

    def _succeeded(self, end: Outcome) -> bool:
        return end.judged(
            self.reference, self.world.layout.danger, self.of.scenario.parameters
        ).success

    def take(self, action: int) -> None:
        self.world.act(self.of.scenario.actions[action])
        if self.world.outcome.ended:
            self.success = self._succeeded(self.world.outcome)
        elif self.world.step < self.of.scenario.parameters.decisions:
            self._look()
        else:
            raise RuntimeError("an undecided episode after its last decision")


def _range(seeds: Sequence[int]) -> str:
    return f"{min(seeds)} to {max(seeds)}"
