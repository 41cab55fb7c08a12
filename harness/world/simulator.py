"""Vehicles on highway-env's roads, without its environments.

Other traffic keeps its route and speed; the ego is highway-env's `MDPVehicle` with physical limits.

What highway-env computes in every frame is computed here to the same last bit for less: its own NumPy
functions in its own order, with Python's comparisons in place of `np.clip` and `np.linalg.norm`, whose calls
cost more than all of its arithmetic. A test drives both side by side.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from harness.world.road import Lane
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import SIZES_M, VehicleState

NEAR_M = 1e-6  # more than rounding can add to a distance: farther apart, highway-env finds no collision
NOBODY_DRAWS = np.random.RandomState(0)  # highway-env wants one, and would seed it by the clock
DECIMALS = 6  # of a state's metres, radians and m/s
LAMPS_MPS2 = 1.0  # braking harder than this shows
BRAKES_OFF_HZ = 20.0  # how fast who brakes by itself lets go of the brake in the end
FAST_MPS = min(Vehicle.MAX_SPEED, -Vehicle.MIN_SPEED)  # above it highway-env limits the acceleration


class _Road(Road):  # type: ignore[misc]
    """Looks closer only at vehicles that are near enough to touch within the frame.

    Attributes:
        time_s: simulated time at the beginning of the frame.
    """

    time_s = 0.0

    def step(self, dt: float) -> None:
        """`Road.step`; no scenario has objects that are no vehicles."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        placed = [(v, *v.position.tolist(), v.diagonal / 2) for v in self.vehicles]
        for (v, x, y, reach), (other, other_x, other_y, other_reach) in combinations(placed, 2):
            within = reach + other_reach + v.speed * dt + NEAR_M
            dx, dy = other_x - x, other_y - y
            if dx * dx + dy * dy < within * within and not _apart(v, other, dx, dy, dt):
                v.handle_collisions(other, dt)


def _apart(v: Vehicle, other: Vehicle, dx_m: float, dy_m: float, dt: float) -> bool:
    """Whether an axis of either vehicle keeps their outlines farther apart than both can move in `dt`."""
    (cos, sin), (other_cos, other_sin) = v.direction.tolist(), other.direction.tolist()
    dot, cross = abs(cos * other_cos + sin * other_sin), abs(cos * other_sin - sin * other_cos)
    moves = (abs(v.speed) + abs(other.speed)) * dt + NEAR_M
    for a, b, c, s in ((v, other, cos, sin), (other, v, other_cos, other_sin)):
        along = abs(dx_m * c + dy_m * s) - (a.LENGTH + b.LENGTH * dot + b.WIDTH * cross) / 2
        across = abs(dy_m * c - dx_m * s) - (a.WIDTH + b.LENGTH * cross + b.WIDTH * dot) / 2
        if along > moves or across > moves:
            return True
    return False


class _OnRoute:
    """A vehicle knows its lane from its route; highway-env's search over all lanes is not needed."""

    spawn: Spawn
    braking = False
    towards: tuple[float, Any] = (np.nan, None)  # a heading and its direction

    def on_state_update(self: Any) -> None:
        self.lane_index = self.target_lane_index
        self.lane = self.road.network.get_lane(self.lane_index)

    def act(self: Any, action: str | None = None) -> None:
        """Steer and keep the target speed; a meta-action is highway-env's own affair."""
        if action is not None:
            super().act(action)  # type: ignore[misc]
            return
        lane = self.road.network.get_lane(self.target_lane_index)
        along, lateral = lane.local_coordinates(self.position)
        if along > lane.length - lane.VEHICLE_LENGTH / 2:
            self.follow_road()
            lane = self.road.network.get_lane(self.target_lane_index)
            along, lateral = lane.local_coordinates(self.position)
        self.action = {
            "steering": self._steering(lane, along, lateral),
            "acceleration": self.speed_control(self.target_speed),
        }
        self.braking = self.action["acceleration"] < -LAMPS_MPS2

    def follow_road(self: Any) -> None:
        """Near the end of its lane it takes the next of its route, wherever on the route it began."""
        if self.road.network.get_lane(self.target_lane_index).after_end(self.position):
            rest = self.route[self.route.index(self.target_lane_index) + 1 :]
            if rest:
                self.route, self.target_lane_index = rest, rest[0]

    def _steering(self: Any, lane: Any, along: float, lateral: float) -> float:
        """`ControlledVehicle.steering_control`, where the vehicle's place in its lane is known."""
        speed = utils.not_zero(self.speed)
        ahead = lane.heading_at(along + self.speed * self.TAU_PURSUIT)
        turn = -self.KP_LATERAL * lateral / speed
        if turn:  # the functions of 0 are 0
            turn = _within(np.pi / 4, np.arcsin(_within(1.0, turn)))
        rate = self.KP_HEADING * utils.wrap_to_pi(ahead + turn - self.heading)
        slip = self.LENGTH / 2 / speed * rate
        if slip:
            slip = np.arctan(2 * np.tan(np.arcsin(_within(1.0, slip))))
        return float(_within(self.MAX_STEERING_ANGLE, slip))

    def step(self: Any, dt: float) -> None:
        """`Vehicle.step`, which most vehicles take straight on and in the direction of the frame before."""
        if self.action["steering"] or self.impact is not None or self.crashed or abs(self.speed) > FAST_MPS:
            super().step(dt)  # type: ignore[misc]
            return
        if self.heading != self.towards[0]:
            self.towards = self.heading, self.direction
        self.position += self.speed * self.towards[1] * dt
        self.speed += self.action["acceleration"] * dt
        self.on_state_update()


def _within(limit: float, value: float) -> float:
    return min(max(value, -limit), limit)


class Traffic(_OnRoute, ControlledVehicle):  # type: ignore[misc]
    """Keeps its route, and its speed unless it would run into the vehicle ahead in its lane.

    Where its layout says so it brakes by itself.
    """

    braking_mps2 = 4.0
    standoff_m = 2.0

    def speed_control(self, target_speed: float) -> float:
        """Acceleration in m/s²: brakes once the room left calls for its braking; never speeds up."""
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
    """High enough to hide what is before it, or behind it."""

    LENGTH, WIDTH = SIZES_M["van"]


class Truck(Traffic):
    """Long and wide enough to hide a car behind it."""

    LENGTH, WIDTH = SIZES_M["truck"]


KINDS = {"car": Traffic, "van": Van, "truck": Truck}


class Ego(_OnRoute, MDPVehicle):  # type: ignore[misc]
    """Follows a target speed within physical limits (highway-env's own controller brakes without bound)."""

    limits_mps2 = (-8.0, 3.0)
    ways: Mapping[Lane, str] = MappingProxyType({})  # routes of the lanes that it may change between

    def act(self, action: str | None = None) -> None:
        """Drive on, or take a meta-action; a change of lane is a change of route."""
        super().act(action)
        route = self.ways.get(self.target_lane_index, self.spawn.route)
        if route != self.spawn.route:
            self.spawn, self.route = replace(self.spawn, route=route), [self.target_lane_index]

    def on_state_update(self) -> None:
        """It is in the nearest of its lanes."""
        super().on_state_update()
        if self.ways:
            self.lane_index = min(self.ways, key=self._off_m)
            self.lane = self.road.network.get_lane(self.lane_index)

    def _off_m(self, lane: Lane) -> float:
        return abs(float(self.road.network.get_lane(lane).local_coordinates(self.position)[1]))

    def speed_control(self, target_speed: float) -> float:
        """Acceleration in m/s²."""
        least, most = self.limits_mps2
        return float(min(max(super().speed_control(target_speed), least), most))


def populated(scenario: Scenario, layout: Layout) -> Any:
    """highway-env's road with a layout's vehicles on it, the ego first."""
    road, static = new_road(scenario), scenario.road()
    for spawn in layout.spawns:
        path = static.paths[spawn.approach, spawn.route]
        section = path.section(spawn.arc_m)
        lane = road.network.get_lane(path.lanes[section])
        along = spawn.arc_m - (0.0, *path.ends_m)[section]
        road.vehicles.append(
            vehicle_on(road, scenario, spawn, section, lane.position(along, 0.0), lane.heading_at(along))
        )
    return road


def copied(road: Any) -> Any:
    """A road with copies of its vehicles; of what they hold, that which is written to is copied too."""
    new = copy(road)
    new.vehicles = [copy(v) for v in road.vehicles]
    for v in new.vehicles:
        v.road, v.position, v.action = new, v.position.copy(), dict(v.action)
    return new


def new_road(scenario: Scenario) -> Any:
    """highway-env's road, empty."""
    return _Road(network=scenario.road().network(), np_random=NOBODY_DRAWS)


def vehicle_on(
    road: Any, scenario: Scenario, spawn: Spawn, section: int, position: Sequence[float], heading: float
) -> ControlledVehicle:
    """A vehicle on the given section of its path."""
    p = scenario.parameters
    route = list(scenario.road().paths[spawn.approach, spawn.route].lanes)
    arguments = {
        "heading": heading,
        "speed": spawn.speed_mps,
        "target_lane_index": route[section],
        "route": route,
    }
    vehicle: ControlledVehicle
    if spawn.part == "ego":
        vehicle = Ego(None, position, target_speeds=p.target_speeds_mps, **arguments)
        vehicle.limits_mps2 = (-p.braking_mps2, p.acceleration_mps2)
        static = scenario.road()
        vehicle.ways = {static.paths[key].lanes[0]: key[1] for key in static.ways}
    else:
        vehicle = KINDS[spawn.kind](None, position, **arguments)
    vehicle.road = road  # only now: a vehicle that is made on a road first searches all of its lanes
    vehicle.spawn = spawn
    vehicle.on_state_update()
    return vehicle


def spawn_of(scenario: Scenario, layout: Layout, v: VehicleState) -> Spawn:
    """A vehicle in the midst of an episode, as if it began there."""
    arc = scenario.road().paths[v.approach, v.route].project(v.x_m, v.y_m)[0]
    begun = next((spawn for spawn in layout.spawns if spawn.id == v.id), None)
    plans = (begun.brakes_at_s, begun.brakes_mps2, begun.brakes_to_mps) if begun else ()
    return Spawn(v.id, v.kind, v.part, v.approach, v.route, arc, v.speed_mps, *plans)


def state_of(
    v: ControlledVehicle, lamps: bool = False, origin_m: tuple[float, float] = (0.0, 0.0)
) -> VehicleState:
    """A vehicle as the rest of the program knows it, to the micrometre: the last bits are the machine's."""
    s = v.spawn
    x_m, y_m, heading_rad, speed_mps = (
        round(float(number), DECIMALS) + 0.0 for number in (*(v.position - origin_m), v.heading, v.speed)
    )
    return VehicleState(
        s.id, s.kind, s.part, x_m, y_m, heading_rad, speed_mps, s.approach, s.route, bool(v.crashed),
        lamps and bool(v.braking),
    )  # fmt: skip
