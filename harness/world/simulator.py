"""Vehicles on highway-env's roads, without its environments: what a world holds between two frames.

Other traffic keeps its route and speed; the ego is highway-env's `MDPVehicle` with physical limits.
Their `speed_control` says what `lockstep` simulates; highway-env's own frame of them is what it is
compared with.
"""

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from harness.world.highway import ControlledVehicle, MDPVehicle, Road, Vehicle
from harness.world.road import Lane
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import SIZES_M, WITH_LAMPS, VehicleState

NEAR_M = 1e-6  # more than the rounding of a distance; farther apart, highway-env finds no collision
# never drawn from; highway-env would seed its own by the clock
NOBODY_DRAWS = np.random.RandomState(0)
DECIMALS = 6  # decimals of a state's metres, radians and m/s
LAMPS_MPS2 = 1.0  # brake lamps are on above this deceleration
BRAKES_OFF_HZ = 20.0  # rate at which a vehicle that brakes by itself releases the brake at the end
# above this speed highway-env limits acceleration
FAST_MPS = min(Vehicle.MAX_SPEED, -Vehicle.MIN_SPEED)


class _OnRoute:
    """A vehicle that knows its lane from its route, without highway-env's search over all lanes."""

    spawn: Spawn
    braking = False

    def on_state_update(self: Any) -> None:
        self.lane_index = self.target_lane_index
        self.lane = self.road.network.get_lane(self.lane_index)

    def follow_road(self: Any) -> None:
        if self.road.network.get_lane(self.target_lane_index).after_end(self.position):
            rest = self.route[self.route.index(self.target_lane_index) + 1 :]
            if rest:
                self.route, self.target_lane_index = rest, rest[0]


class Traffic(_OnRoute, ControlledVehicle):  # type: ignore[misc]
    """Drive a vehicle that keeps route and speed, but brakes for a slower one ahead in its lane.

    It also brakes at a fixed time if its layout, the start situation, says so
    (`Spawn.brakes_at_s`).
    """

    braking_mps2 = 4.0  # how hard it brakes for who is ahead, m/s2
    standoff_m = 2.0  # gap that it leaves to who is ahead, m

    def speed_control(self, target_speed: float) -> float:
        if self.spawn.brakes_at_s is not None and self.road.time_s >= self.spawn.brakes_at_s:
            above = max(self.speed - self.spawn.brakes_to_mps, 0.0)
            if above > 0:
                return float(-min(self.spawn.brakes_mps2, above * BRAKES_OFF_HZ))
        for other in self.road.vehicles:
            if other.lane_index == self.lane_index and self.speed > other.speed:
                ahead = float(np.dot(other.position - self.position, self.direction))
                room = ahead - (self.LENGTH + other.LENGTH) / 2 - self.standoff_m
                if ahead > 0 and (self.speed - other.speed) ** 2 > 2 * self.braking_mps2 * room:
                    return -2 * self.braking_mps2
        return 0.0


class Van(Traffic):
    """Drive a van in traffic, high enough to hide the vehicles before or behind it."""

    LENGTH, WIDTH = SIZES_M["van"]


class Truck(Traffic):
    """Drive a truck in traffic, long and wide enough to hide a car behind it."""

    LENGTH, WIDTH = SIZES_M["truck"]


class Bicycle(Traffic):
    """Drive a bicycle in traffic, which keeps its route and speed as a car does."""

    LENGTH, WIDTH = SIZES_M["bicycle"]


class Motorcycle(Traffic):
    """Drive a motorcycle in traffic, which keeps its route and speed as a car does."""

    LENGTH, WIDTH = SIZES_M["motorcycle"]


class Pedestrian(Traffic):
    """Move a pedestrian, who keeps route and speed as a car does."""

    LENGTH, WIDTH = SIZES_M["pedestrian"]


KINDS = {
    "car": Traffic,
    "van": Van,
    "truck": Truck,
    "bicycle": Bicycle,
    "motorcycle": Motorcycle,
    "pedestrian": Pedestrian,
}


class Ego(_OnRoute, MDPVehicle):  # type: ignore[misc]
    """Drive a vehicle that decides: it follows a target speed within limits of acceleration.

    `ways` has the lanes between which it may change, by highway-env's index, with the route that
    its path has there.
    """

    limits_mps2 = (-8.0, 3.0)  # least and greatest acceleration, m/s2
    # the lanes that it may change between, by highway-env's index, and the route of each
    ways: Mapping[Lane, str] = MappingProxyType({})

    def act(self, action: str | None = None) -> None:
        """Take a meta-action, such as `SLOWER`, or just drive on if None.

        A lane change changes the route.
        """
        super().act(action)
        route = self.ways.get(self.target_lane_index, self.spawn.route)
        if route != self.spawn.route:
            self.spawn, self.route = replace(self.spawn, route=route), [self.target_lane_index]

    def on_state_update(self) -> None:
        """Set the vehicle's lane to the nearest one of those between which it may change.

        highway-env calls it after each frame.
        """
        super().on_state_update()
        if self.ways:
            self.lane_index = min(self.ways, key=self._off_m)
            self.lane = self.road.network.get_lane(self.lane_index)

    def _off_m(self, lane: Lane) -> float:
        return abs(float(self.road.network.get_lane(lane).local_coordinates(self.position)[1]))

    def speed_control(self, target_speed: float) -> float:
        least, most = self.limits_mps2
        return float(min(max(super().speed_control(target_speed), least), most))


def populated(scenario: Scenario, layout: Layout, agents: Collection[int] = (0,)) -> Any:
    """Return a `highway_env.road.road.Road` with a layout's vehicles on it, the ego first.

    `layout` is the start situation of an episode of `scenario`. `agents` are the indices among its
    vehicles of those that decide; all others are traffic, which keeps route and speed.
    """
    road, static = new_road(scenario), scenario.road()
    for n, spawn in enumerate(layout.spawns):
        path = static.paths[spawn.approach, spawn.route]
        section = path.section(spawn.arc_m)
        lane = road.network.get_lane(path.lanes[section])
        along = spawn.arc_m - (0.0, *path.ends_m)[section]
        road.vehicles.append(
            vehicle_on(
                road,
                scenario,
                spawn,
                section,
                lane.position(along, 0.0),
                lane.heading_at(along),
                n in agents,
            )
        )
    return road


def copied(road: Any) -> Any:
    """Return a copy of a `highway_env.road.road.Road` with its vehicles.

    To simulate the copy does not change the original.
    """
    new = copy(road)
    new.vehicles = [copy(v) for v in road.vehicles]
    for v in new.vehicles:
        v.road, v.position, v.action = new, v.position.copy(), dict(v.action)
    return new


def new_road(scenario: Scenario) -> Any:
    """Return the scenario's road without vehicles, a `highway_env.road.road.Road`."""
    return Road(network=scenario.road().network(), np_random=NOBODY_DRAWS)


def vehicle_on(
    road: Any,
    scenario: Scenario,
    spawn: Spawn,
    section: int,
    position: Sequence[float],
    heading: float,
    agent: bool,
) -> ControlledVehicle:
    """Create a highway-env vehicle on a road, at a position on its path.

    Args:
        road: a `highway_env.road.road.Road`; the vehicle is not yet among its vehicles.
        scenario: the scenario, with the paths and the ego's target speeds.
        spawn: the vehicle's id, class, path and speed.
        section: number from 0 of the section of the path, a lane, that it is in.
        position: x and y in highway-env's frame, m.
        heading: rad, from +x towards +y.
        agent: whether it decides: takes actions and follows a target speed; else it is traffic.
    """
    p, static = scenario.parameters, scenario.road()
    route = list(static.paths[spawn.approach, spawn.route].lanes)
    start = position, heading, spawn.speed_mps, route[section]
    vehicle: ControlledVehicle
    if agent:
        vehicle = Ego(None, *start, target_speeds=p.target_speeds_mps, route=route)
        vehicle.limits_mps2 = (-p.braking_mps2, p.acceleration_mps2)
        if spawn.part == "ego":
            vehicle.ways = {static.paths[key].lanes[0]: key[1] for key in static.ways}
    else:
        vehicle = KINDS[spawn.kind](None, *start, route=route)
    vehicle.road = road  # only now: a vehicle that is created with a road searches all of its lanes
    vehicle.spawn = spawn
    vehicle.on_state_update()
    return vehicle


def spawn_of(scenario: Scenario, layout: Layout, v: VehicleState) -> Spawn:
    """Return a vehicle as one that starts an episode at its present position and speed.

    `v` is the vehicle, and `layout` the start situation of its episode in `scenario`, which says
    when it brakes by itself.
    """
    arc = scenario.road().paths[v.approach, v.route].project(v.x_m, v.y_m)[0]
    start = next((spawn for spawn in layout.spawns if spawn.id == v.id), None)
    plans = (start.brakes_at_s, start.brakes_mps2, start.brakes_to_mps) if start else ()
    return Spawn(v.id, v.kind, v.part, v.approach, v.route, arc, v.speed_mps, *plans, radio=v.radio)


def state_of(
    v: ControlledVehicle, lamps: bool = False, origin_m: tuple[float, float] = (0.0, 0.0)
) -> VehicleState:
    """Return the state of highway-env's vehicle `v`, with positions from `origin_m`.

    `origin_m` is the origin of the scenario's road in highway-env's frame, m. Numbers are rounded
    to `DECIMALS`, since the last bits depend on the machine. Brake lamps are reported only if
    `lamps` is true.
    """
    s = v.spawn
    numbers = (*(v.position - origin_m), v.heading, v.speed)
    x_m, y_m, heading_rad, speed_mps = (round(float(number), DECIMALS) + 0.0 for number in numbers)
    pose = x_m, y_m, heading_rad, speed_mps
    lit = lamps and s.kind in WITH_LAMPS and bool(v.braking)
    return VehicleState(
        s.id, s.kind, s.part, *pose, s.approach, s.route, bool(v.crashed), lit, s.radio
    )
