"""The door to a package's scenario: its functions cannot write to what they get, and what they
return is checked.

So they fail in one line, a UserError that names the scenario, and leave nothing odd for others to
stumble over.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from numbers import Real
from typing import Any

import numpy as np
from msgspec import convert

from harness.core.arrays import Bools, Floats, Texts, check_shape, read_only
from harness.core.errors import printable
from harness.core.strangers import is_in_harness, worded
from harness.world.fields import Kind, Number, Part, VehicleId
from harness.world.parameters import BOUNDS
from harness.world.road import Ground, PathKey, Road
from harness.world.scenario import Layout, Scenario, Seat, Spawn
from harness.world.state import Building

# What numbers of a layout may be at least and at most, as parameters may; whoever is parked has
# speed 0.
SPAWNED = {
    "arc_m": BOUNDS["_m"],
    "speed_mps": BOUNDS["_mps"],
    "brakes_at_s": BOUNDS["_s"],
    "brakes_mps2": BOUNDS["_mps2"],
    "brakes_to_mps": BOUNDS["_mps"],
}
BUILT = dict.fromkeys(("west_m", "north_m", "east_m", "south_m"), BOUNDS["_m"])


@dataclass(frozen=True)
class _Door:
    """A function of a package's scenario; two of the same function are equal."""

    what: str  # the scenario, in messages
    function: Callable[..., Any]  # the package's own


class _RoadDoor(_Door):
    def __call__(self) -> Road:
        return _road(self)


@dataclass(frozen=True)
class _LayoutDoor(_Door):
    road: Callable[[], Road]  # the scenario's

    def __call__(self, seed: int, parameters: Any) -> Layout:
        with worded(self.what):
            layout: Layout = _instance("layout", self.function(seed, parameters), Layout)
            _check_layout(layout, self.road())
            return layout


class _ClearedDoor(_Door):
    def __call__(self, xy_m: Floats, approaches: Texts, parameters: Any) -> Bools:
        with worded(self.what):
            cleared = self.function(read_only(xy_m), read_only(approaches), parameters)
            shape = xy_m.shape[:-2]
            if shape or not isinstance(cleared, bool | np.bool_):  # of one world it may be no array
                check_shape("cleared", cleared, shape)
            if np.asarray(cleared).dtype != bool:
                raise ValueError(f"cleared of type {cleared.dtype}, not bool")
            return np.array(cleared)


class _SeatsDoor(_Door):
    def __call__(self) -> Mapping[PathKey, Seat]:
        return _seats(self)


def put_doors(scenario: Scenario) -> None:
    """Replace the functions of another package's scenario, in place, by checking wrappers.

    The wrappers (of `road`, `layout`, `cleared` and `seats`) raise a one-line UserError that names
    the scenario when the function fails or returns something invalid. The harness's own functions
    stay.
    """
    what = f"scenario {printable(scenario.name)}"
    for name, door in (("road", _RoadDoor), ("cleared", _ClearedDoor), ("seats", _SeatsDoor)):
        function = getattr(scenario, name)
        if function is not None and not is_ours(function):
            object.__setattr__(scenario, name, door(what, _function_behind(function)))
    if not is_ours(scenario.layout):
        layout = _LayoutDoor(what, _function_behind(scenario.layout), scenario.road)
        object.__setattr__(scenario, "layout", layout)


def is_ours(function: Callable[..., Any]) -> bool:
    """Return whether a function is the harness's own, and not another package's.

    Of a `functools.partial` it is the function inside that counts.
    """
    return is_in_harness(getattr(function, "func", function))


def _function_behind(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what lies behind a door, which a copy of the scenario may have another name for."""
    return function.function if isinstance(function, _Door) else function


def _instance(name: str, given: Any, kind: type) -> Any:
    """Return what a function gave. Raises TypeError if it is of another type."""
    if not isinstance(given, kind):
        raise TypeError(f"{name} gives a {type(given).__name__} and no {kind.__name__}")
    return given


@cache  # a road is always the same object
def _road(door: _RoadDoor) -> Road:
    with worded(door.what):
        road: Road = _instance("road", door.function(), Road)
        if road.ego not in road.paths:
            raise ValueError(f"road has no path {road.ego}, which is its ego's")
    own_ground, own_goal_m = road.ground, road.goal_m

    @cache
    def network() -> Any:
        # Without it a scenario here fails in the same way: that is no fault of the package.
        import harness.world.highway  # noqa: F401

        with worded(door.what):
            lanes = road.network()
            for path in road.paths.values():
                for lane in path.lanes:
                    lanes.get_lane(lane)
            return lanes

    def ground(far_m: float) -> Ground:
        with worded(door.what):
            assert own_ground
            given: Ground = _instance("ground", own_ground(far_m), Ground)
            return given

    def goal_m(parameters: Any) -> float:
        with worded(door.what):
            assert own_goal_m
            arc_m: float = convert(float(own_goal_m(parameters)), Number)
            return arc_m

    return replace(
        road,
        network=network,
        ground=own_ground and ground,
        goal_m=own_goal_m and goal_m,
    )


@cache
def _seats(door: _SeatsDoor) -> Mapping[PathKey, Seat]:
    with worded(door.what):
        seats: Mapping[PathKey, Seat] = _instance("seats", door.function(), Mapping)
        for seat in seats.values():
            _instance("seats", seat, Seat)
        return seats


def _check_layout(layout: Layout, road: Road) -> None:
    """Raise ValueError or TypeError for a layout that no episode can begin with."""
    for building in layout.buildings:
        _check_numbers(_instance("layout", building, Building), BUILT)
    ids = list[str]()
    for spawn in layout.spawns:
        _check_spawn(_instance("layout", spawn, Spawn), road)
        ids.append(spawn.id)
    if twice := [id_ for id_ in ids if ids.count(id_) > 1]:
        raise ValueError(f"layout has two vehicles {twice[0]}")
    parts = [spawn.part for spawn in layout.spawns]
    if parts[:1] != ["ego"] or parts.count("ego") > 1:
        raise ValueError("layout does not have one ego, which is its first vehicle")
    dangers = {(sector, id_) for sector in road.sectors for id_ in ids} | {(None, None)}
    if (layout.danger, layout.danger_id) not in dangers:
        raise ValueError(
            f"layout has danger {layout.danger} of {layout.danger_id}, and no such sector or "
            "vehicle"
        )


def _check_spawn(spawn: Spawn, road: Road) -> None:
    for value, kind in ((spawn.id, VehicleId), (spawn.kind, Kind), (spawn.part, Part)):
        convert(value, kind)
    if (spawn.approach, spawn.route) not in road.paths:
        raise ValueError(f"{spawn.id} is on {spawn.approach}, {spawn.route}, no path of the road")
    _check_numbers(spawn, SPAWNED)


def _check_numbers(thing: Spawn | Building, bounds: Mapping[str, tuple[float, float]]) -> None:
    """Raise ValueError for a number, by name, that is not within its bounds."""
    for name, (least, most) in bounds.items():
        value = getattr(thing, name)
        if value is None and name == "brakes_at_s":  # it does not brake by itself
            continue
        if not (isinstance(value, Real) and least <= float(value) <= most):
            value_text = printable(repr(value))
            raise ValueError(f"{thing.id} has {name} {value_text}, not from {least:g} to {most:g}")
