"""The live world: an occluded intersection inside highway-env. The only importer of highway_env.

Other traffic keeps its route and speed; the ego is highway-env's `MDPVehicle` with physical limits. Frames
are stepped here rather than by `env.step`, so that an episode ends in the frame in which it is decided.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from harness.outcome import Outcome, fault, outline, striker
from harness.road import APPROACHES, JUNCTION_M, Path, paths
from harness.scenarios.occluded_intersection import NAME as NAME
from harness.scenarios.occluded_intersection import Layout, Parameters, Spawn, layout
from harness.scene import SIZES_M, VehicleState, WorldState

Snapshot = Mapping[str, Any]
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
    return _vehicle(road, spawn, p, section, lane.position(arc_in_lane, 0.0), lane.heading_at(arc_in_lane))


def _vehicle(
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


def _spawn(v: VehicleState) -> Spawn:
    arc = paths()[v.approach, v.route].project(v.x_m, v.y_m)[0]
    return Spawn(v.id, v.kind, v.part, v.approach, v.route, arc, v.speed_mps)


def _lanes(path: Path) -> list[tuple[str, str, int]]:
    start = NODES[path.approach]
    end = (start + (2 if path.route == "straight" else 1)) % 4
    return [(f"o{start}", f"ir{start}", 0), (f"ir{start}", f"il{end}", 0), (f"il{end}", f"o{end}", 0)]


@dataclass
class World:
    """One live episode.

    Attributes:
        env: the highway-env environment.
        seed: seed of the episode's layout.
        step: decisions taken so far.
        frame: frames simulated so far.
        outcome: what has happened so far; its `ended` says whether the episode is decided.
    """

    env: OccludedIntersectionEnv
    seed: int
    step: int = 0
    frame: int = 0
    outcome: Outcome = field(default_factory=Outcome)

    @classmethod
    def start(cls, seed: int) -> "World":
        """The first moment of an episode."""
        env = OccludedIntersectionEnv(config={"episode_seed": seed})
        return cls(env, seed)

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions by name, in the environment's order."""
        return tuple(self.env.action_type.actions[n] for n in sorted(self.env.action_type.actions))

    @property
    def time_s(self) -> float:
        """Simulated time, counted in frames (highway-env's own clock drifts)."""
        return self.frame / self.env.parameters.simulation_hz

    def branch(self) -> "World":
        """A copy that goes its own way."""
        return copy.deepcopy(self)

    def snapshot(self) -> Snapshot:
        """What `thaw` needs besides `state()` to go on exactly as this world would."""
        vehicles = self.env.road.vehicles
        sections = [v.route.index(v.target_lane_index) for v in vehicles]
        return {"frame": self.frame, "sections": sections, "speed_index": int(vehicles[0].speed_index)}

    @classmethod
    def thaw(cls, state: WorldState, snapshot: Snapshot) -> "World":
        """The world that `state` and `snapshot` were taken from, before its episode was decided."""
        env = OccludedIntersectionEnv(config={"episode_seed": state.episode_seed})
        vehicles = []
        for v, section in zip(state.vehicles, snapshot["sections"], strict=True):
            vehicle = _vehicle(env.road, _spawn(v), env.parameters, section, (v.x_m, v.y_m), v.heading_rad)
            vehicle.crashed = v.crashed
            vehicles.append(vehicle)
        ego = vehicles[0]
        ego.speed_index = snapshot["speed_index"]
        ego.target_speed = ego.index_to_speed(ego.speed_index)
        env.layout = replace(env.layout, buildings=state.buildings)
        env.road.vehicles = vehicles
        env.controlled_vehicles = vehicles[:1]
        env.define_spaces()  # binds the action type to the ego
        if snapshot["frame"]:
            # What touches is pushed apart in the next frame: highway-env's last act in every frame.
            for n, vehicle in enumerate(vehicles):
                for other in vehicles[n + 1 :]:
                    vehicle.handle_collisions(other, 1 / env.parameters.simulation_hz)
        return cls(env, state.episode_seed, state.step, snapshot["frame"])

    def state(self) -> WorldState:
        """What is where, now."""
        layout = self.env.layout
        ego = self.env.road.vehicles[0]
        return WorldState(
            NAME, self.seed, self.step, self.time_s, float(ego.target_speed),
            tuple(_state(v) for v in self.env.road.vehicles), layout.buildings,
        )  # fmt: skip

    def act(self, action: str) -> None:
        """Take a decision by name and live through the time until the next one is due.

        After the scenario's last decision the action is held until the episode is decided.
        """
        p = self.env.parameters
        self.env.action_type.act(self.env.action_type.actions_indexes[action])
        self.step += 1
        last = self.step >= p.decisions
        until = p.time_limit_s if last else self.step * p.decision_period_s
        while self.frame < round(until * p.simulation_hz) and not self.outcome.ended:
            self._advance()

    def _advance(self) -> None:
        p, road = self.env.parameters, self.env.road
        standing = {v.spawn.id for v in road.vehicles if v.crashed}
        road.act()
        road.step(1 / p.simulation_hz)
        self.frame += 1
        ego, others = road.vehicles[0], road.vehicles[1:]
        crashed = {v.spawn.id for v in others if v.crashed and v.spawn.id not in standing}
        if ego.crashed:
            mine = _state(ego)
            partner = min(map(_state, others), key=lambda v: float(outline(mine).distance(outline(v))))
            crashed.discard(partner.id)
            how = {"partner": partner.id, "striker": striker(mine, partner), "fault": fault(mine, partner)}
            self.outcome = self.outcome.ending("collision", self.time_s, **how)
        elif not ego.on_road:
            self.outcome = self.outcome.ending("off_road", self.time_s)
        elif JUNCTION_M + p.cleared_m <= -ego.position[1]:
            self.outcome = self.outcome.ending("cleared", self.time_s)
        elif self.frame >= round(p.time_limit_s * p.simulation_hz):
            self.outcome = self.outcome.ending("time_out", self.time_s)
        self.outcome = replace(
            self.outcome,
            least_gap_m=_least_gap_m(ego, others, self.outcome.least_gap_m),
            other_crashes=self.outcome.other_crashes + len(crashed),
        )


def _least_gap_m(ego: ControlledVehicle, others: list[ControlledVehicle], least_m: float) -> float:
    """The smaller of `least_m` and the gap now; outlines are only built for vehicles that could matter."""
    mine = None
    for v in others:
        reach = (ego.diagonal + v.diagonal) / 2
        if float(np.hypot(*(v.position - ego.position))) - reach < least_m:
            mine = mine or outline(_state(ego))
            least_m = min(least_m, float(mine.distance(outline(_state(v)))))
    return least_m


def _state(v: ControlledVehicle) -> VehicleState:
    s = v.spawn
    return VehicleState(
        s.id, s.kind, s.part, float(v.position[0]), float(v.position[1]), float(v.heading), float(v.speed),
        s.approach, s.route, bool(v.crashed),
    )  # fmt: skip
