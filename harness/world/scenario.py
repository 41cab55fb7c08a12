"""What a scenario provides. All other code takes one as an argument, and names none."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.world.road import Road
from harness.world.state import Building, Kind, Part


@dataclass(frozen=True)
class Parameters:
    """The dials that every scenario has; a scenario's own are those of a subclass.

    Attributes:
        target_speeds_mps: what SLOWER, IDLE and FASTER step through.
        braking_mps2: hardest braking.
        acceleration_mps2: hardest acceleration.
        decisions: decisions an episode.
        decision_period_s: seconds between two decisions.
        simulation_hz: frames a second.
        time_limit_s: an ego that has not reached its goal by then never will.
        delay_allowance_s: how much later than the full-view driver an ego may reach its goal.
    """

    target_speeds_mps: tuple[float, ...] = (0.0, 7.0, 14.0)
    braking_mps2: float = 8.0
    acceleration_mps2: float = 3.0
    decisions: int = 6
    decision_period_s: float = 1.0
    simulation_hz: int = 50
    time_limit_s: float = 10.0
    delay_allowance_s: float = 1.0


@dataclass(frozen=True)
class Spawn:
    """One vehicle at the start: where on which path, how fast, and its id."""

    id: str
    kind: Kind
    part: Part
    approach: str
    route: str
    arc_m: float
    speed_mps: float


@dataclass(frozen=True)
class Layout:
    """The start of one episode.

    Attributes:
        spawns: vehicles in spawn order, the ego first, then the helpers.
        buildings: what blocks sight besides vehicles.
        danger: sector the danger comes from, or None.
        danger_id: the dangerous vehicle, or None.
    """

    spawns: tuple[Spawn, ...]
    buildings: tuple[Building, ...]
    danger: str | None
    danger_id: str | None


@dataclass(frozen=True)
class Scenario:
    """One scenario. It travels between processes as its name and its parameters.

    Attributes:
        name: how users, manifests and frozen states call it.
        description: its first line is `Scenario <name>: <summary>`.
        actions: names of highway-env's meta-actions that the ego chooses from, in highway-env's order.
        parameters: its dials.
        road: gives the road, always the same one.
        layout: the start of the episode of a seed, `(seed, parameters)`.
        cleared: whether the ego has reached its goal, asked after every frame, `(vehicles, parameters)`:
            highway-env's vehicles, the ego first.
        words: what prompts may say of it, by name; templates read `words.<name>`.
    """

    name: str
    description: str
    actions: tuple[str, ...]
    parameters: Parameters
    road: Callable[[], Road]
    layout: Callable[[int, Any], Layout]
    cleared: Callable[[Sequence[Any], Any], bool]
    words: Mapping[str, str]

    @property
    def summary(self) -> str:
        """What happens, in a line."""
        return self.description.strip().splitlines()[0].partition(": ")[2]

    def __hash__(self) -> int:
        return hash((self.name, self.parameters))

    def __reduce__(self) -> tuple[Any, ...]:
        from harness.world import scenarios

        return scenarios.restore, (self.name, self.parameters)
