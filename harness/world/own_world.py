"""Define a world that something beside the harness's simulator plays."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.state import ActionsTaken, WorldState
from harness.world.world import World


class OwnWorld(World):
    """Play an episode elsewhere, from its seed and the actions so far; a base class.

    Something beside the harness's simulator plays it, such as a gymnasium environment. A scenario
    of such episodes names the class (`Scenario.world`). The harness then knows neither its layout,
    where vehicles start, nor a danger, the vehicle that would meet a cruising ego.
    """

    @classmethod
    @abstractmethod
    def begun(cls, scenario: Scenario, seed: int) -> "World":
        """Start the episode of a layout seed, before its first decision.

        `seed` fixes how the episode starts, in the scenario `scenario`.
        """

    @classmethod
    def resumed(cls, scenario: Scenario, state: WorldState, snapshot: Any) -> World:
        """Restore the episode of a state: play it again from its seed with the actions taken.

        It is an episode of `scenario`; `snapshot` is the `ActionsTaken` that the method `snapshot`
        returned in that state.
        """
        world = cls.begun(scenario, state.episode_seed)
        for frame, action in snapshot.taken:
            world.advance(frame)
            world.take(action)
        world.advance(snapshot.frame)
        world.step = state.step
        return world

    def truth(self, agent: int = 0) -> WorldState:
        return self.state(agent)  # which may be a class's own

    @abstractmethod
    def snapshot(self) -> ActionsTaken:
        """Return what leads from the seed to the present state again: the actions so far.

        Each comes with the frame in which it was taken.
        """

    @classmethod
    def examine(cls, scenario: Scenario, seed: int) -> None:
        """Try the episode of a layout `seed` of `scenario`, before many are frozen or driven.

        Raises UserError unless equal seeds and actions lead to equal episodes, also for copies.
        """

    @classmethod
    def configuration(cls, scenario: Scenario) -> Mapping[str, Any] | None:
        """Return how episodes of `scenario` are made, for a dataset's manifest; None for nothing.

        Keys and values are the class's own: plain ones, which JSON can hold, such as an
        environment's settings.
        """
        return None

    @classmethod
    def files(cls, scenario: Scenario) -> Mapping[str, bytes]:
        """Return what a dataset of `scenario` must hold so that the scenario can be made from it.

        It is the content of each file by its name, such as the traffic that was recorded; a reader
        of scenario names finds them in the dataset's folder (`Family.kept_in`). Empty for nothing.
        """
        return {}

    @classmethod
    def problems(cls, scenario: Scenario) -> Iterator[str]:
        """Yield what a scenario's files state that they do not give, and only a search can tell.

        Such is which of a recording's moments were chosen. Mostly nothing.
        """
        yield from ()

    @classmethod
    def drivers(cls) -> Mapping[str, Callable[[Scenario, SceneGraph], str]]:
        """Return the reference drivers that only such worlds have, by name; mostly none.

        A driver takes a scenario and the ego's scene graph and returns the action that it takes,
        such as `SLOWER`; for its name there is a model card. One is who was recorded as the ego.
        """
        return {}
