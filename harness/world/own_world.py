"""Define a world that something beside the harness's simulator plays."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from harness.world.scenario import Scenario
from harness.world.state import ActionsTaken, WorldState
from harness.world.world import World


class OwnWorld(World):
    """Play an episode elsewhere, from its seed and the actions so far; a base class.

    Something beside the harness's simulator plays it, such as a gymnasium environment. A scenario
    of such worlds names the class (`Scenario.world`). The harness knows neither its layout, where
    vehicles start, nor a danger.
    """

    @classmethod
    @abstractmethod
    def begun(cls, scenario: Scenario, seed: int) -> "World":
        """Start the episode of a layout seed."""

    @classmethod
    def resumed(cls, scenario: Scenario, state: WorldState, snapshot: Any) -> World:
        """Restore the world of a state: play its episode again with the actions taken.

        `snapshot` is what `snapshot` returned for it, an `ActionsTaken`.
        """
        world = cls.begun(scenario, state.episode_seed)
        for frame, action in snapshot.taken:
            world.advance(frame)
            world.take(action)
        world.advance(snapshot.frame)
        world.step = state.step
        return world

    @abstractmethod
    def snapshot(self) -> ActionsTaken:
        """Return the actions so far, since equal actions from the start lead to equal worlds."""

    @classmethod
    def examine(cls, scenario: Scenario, seed: int) -> None:
        """Try the episode of a layout seed before many are frozen or driven.

        Raises UserError unless equal seeds and actions lead to equal episodes, also for copies.
        """

    @classmethod
    def configuration(cls, scenario: Scenario) -> Mapping[str, Any] | None:
        """Return what a dataset's manifest holds of how such worlds are made, as plain values;
        None for nothing.
        """
        return None
