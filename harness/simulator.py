"""The occluded intersection inside highway-env: its vehicles and its environment. The only importer.

Other traffic keeps its route and speed; the ego is highway-env's `MDPVehicle` with physical limits.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from harness.road import APPROACHES, Path, paths
from harness.scenarios.occluded_intersection import Layout, Parameters, Spawn, layout
from harness.scene import SIZES_M, VehicleState

NODES = {approach: n for n, approach in enumerate(APPROACHES)}


class _OnRoute:
    """A vehicle knows its lane from its route; highway-env's search over all lanes is not needed."""

    spawn: Spawn

    def on_state_update(self: Any) -> None:
        self.lane_index = self.target_lane_index
        self.lane = self.road.network.get_lane(self.lane_index)


class Traffic(_OnRoute, ControlledVehicle):  # type: ignore[misc]
    """Keeps its route, and its speed unless it would run into the vehicle ahead in its lane."""

    braking_mps2 = 4.0
    standoff_m = 2.0

    def speed_control(self, target_speed: float) -> float:
        """Acceleration in m/s²: brakes once the room left calls for its braking; never speeds up."""
        for other in self.road.vehicles:
            if other.lane_index == self.lane_index and self.speed > other.speed:
                ahead = float(np.dot(other.position - self.position, self.direction))
                room = ahead - (self.LENGTH + other.LENGTH) / 2 - self.standoff_m
                if ahead > 0 and (self.speed - other.speed) ** 2 > 2 * self.braking_mps2 * room:
                    return -2 * self.braking_mps2
        return 0.0


class Truck(Traffic):
    """Long and wide enough to hide a car behind it."""

    LENGTH, WIDTH = SIZES_M["truck"]


class Ego(_OnRoute, MDPVehicle):  # type: ignore[misc]
    """Follows a target speed within physical limits (highway-env's own controller brakes without bound)."""

    limits_mps2 = (-8.0, 3.0)

    def speed_control(self, target_speed: float) -> float:
        """Acceleration in m/s²."""
        return float(np.clip(super().speed_control(target_speed), *self.limits_mps2))


class OccludedIntersectionEnv(IntersectionEnv):  # type: ignore[misc]
    """highway-env's intersection with the scenario's vehicles, and no rule that makes anyone yield."""

    parameters = Parameters()
    layout: Layout
    road: Road

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """IntersectionEnv's configuration with the scenario's speeds and frequencies."""
        p = cls.parameters
        config: dict[str, Any] = super().default_config()
        utils.update_config(
            config,
            {
                "action": {
                    "type": "DiscreteMetaAction",
                    "longitudinal": True,
                    "lateral": False,
                    "target_speeds": list(p.target_speeds_mps),
                },
                "simulation_frequency": p.simulation_hz,
                "policy_frequency": round(1 / p.decision_period_s),
                "duration": p.time_limit_s,
                "spawn_probability": 0.0,
                "scaling": 4.0,
                "episode_seed": 0,
            },
        )
        return config

    def _make_road(self) -> None:
        super()._make_road()
        self.road = Road(network=self.road.network, np_random=self.np_random)

    def _make_vehicles(self, n_vehicles: int = 0) -> None:
        p = self.parameters
        self.layout = layout(self.config["episode_seed"], p)
        for spawn in self.layout.spawns:
            self.road.vehicles.append(_spawned(self.road, spawn, p))
        self.controlled_vehicles = self.road.vehicles[:1]


def _spawned(road: Road, spawn: Spawn, p: Parameters) -> ControlledVehicle:
    path = paths()[spawn.approach, spawn.route]
    section = int(np.searchsorted(path.junction_m, spawn.arc_m, side="right"))
    lane = road.network.get_lane(_lanes(path)[section])
    arc_in_lane = spawn.arc_m - (0.0, *path.junction_m)[section]
    return vehicle_on(road, spawn, p, section, lane.position(arc_in_lane, 0.0), lane.heading_at(arc_in_lane))


def vehicle_on(
    road: Road, spawn: Spawn, p: Parameters, section: int, position: Sequence[float], heading: float
) -> ControlledVehicle:
    """A vehicle on the given section of its route: approach, junction or exit."""
    route = _lanes(paths()[spawn.approach, spawn.route])
    arguments = {
        "heading": heading,
        "speed": spawn.speed_mps,
        "target_lane_index": route[section],
        "route": route,
    }
    vehicle: ControlledVehicle
    if spawn.part == "ego":
        vehicle = Ego(road, position, target_speeds=p.target_speeds_mps, **arguments)
        vehicle.limits_mps2 = (-p.braking_mps2, p.acceleration_mps2)
    else:
        vehicle = (Truck if spawn.kind == "truck" else Traffic)(road, position, **arguments)
    vehicle.spawn = spawn
    vehicle.on_state_update()
    return vehicle


def spawn_of(v: VehicleState) -> Spawn:
    """A vehicle in the midst of an episode, as if it began there."""
    arc = paths()[v.approach, v.route].project(v.x_m, v.y_m)[0]
    return Spawn(v.id, v.kind, v.part, v.approach, v.route, arc, v.speed_mps)


def _lanes(path: Path) -> list[tuple[str, str, int]]:
    start = NODES[path.approach]
    end = (start + (2 if path.route == "straight" else 1)) % 4
    return [(f"o{start}", f"ir{start}", 0), (f"ir{start}", f"il{end}", 0), (f"il{end}", f"o{end}", 0)]


def state_of(v: ControlledVehicle) -> VehicleState:
    """A vehicle as the rest of the program knows it."""
    s = v.spawn
    return VehicleState(
        s.id, s.kind, s.part, float(v.position[0]), float(v.position[1]), float(v.heading), float(v.speed),
        s.approach, s.route, bool(v.crashed),
    )  # fmt: skip
