"""One simulated episode, from its start to its outcome: what there is of it between two frames.

`lockstep` simulates its frames, and those of other worlds with them.
"""

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.world import beacons, lockstep
from harness.world.conflict_measures import Conflicts
from harness.world.outcome import Outcome, fault, outline, striker
from harness.world.scenario import Layout, Scenario
from harness.world.simulator import copied, new_road, populated, spawn_of, state_of, vehicle_on
from harness.world.state import (
    ActionsTaken,
    Beacon,
    Snapshot,
    VehicleState,
    WorldState,
)

Target = tuple[str, int]  # route, and index of the scenario's target speeds
TOUCHING_M = 1.0  # two wrecks farther apart than this did not meet in this frame
HARD_BRAKING_MPS2 = 4.0  # about 0.4 g, where passengers begin to notice


@dataclass
class World:
    """One episode in the simulator."""

    scenario: Scenario  # the episode's scenario
    seed: int  # seed of the episode's layout
    layout: Layout  # its start
    road: Any  # highway-env's road with its vehicles, the ego first
    step: int = 0  # number of decisions taken so far
    frame: int = 0  # number of frames simulated so far
    # the outcome so far; its `ended` says whether the episode is decided
    outcome: Outcome = field(default_factory=Outcome)
    hard_brakings: int = 0  # how often the ego began to brake harder than HARD_BRAKING_MPS2
    braking_hard: bool = False  # whether it braked so hard in the last frame
    conflicts: Conflicts = field(default_factory=Conflicts)  # how near others came to the ego in time
    beacons: tuple[Beacon, ...] = ()  # the beacons that still matter (`WorldState.beacons`)

    @classmethod
    def start(cls, scenario: Scenario, seed: int) -> "World":
        return (scenario.world or World).begun(scenario, seed)

    @classmethod
    def begun(cls, scenario: Scenario, seed: int) -> "World":
        """Start an episode in this kind of world."""
        layout = scenario.layout(seed, scenario.parameters)
        world = cls(scenario, seed, layout, populated(scenario, layout))
        poses = beacons.lead_in(scenario.parameters, world._in_road_frame(world._poses()))
        world._broadcast(poses, 1 - len(poses))
        return world

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions by name, the most careful first."""
        return self.scenario.actions

    @property
    def vehicles(self) -> Sequence[Any]:
        vehicles: Sequence[Any] = self.road.vehicles
        return vehicles

    @property
    def time_s(self) -> float:
        """Simulated time, counted in frames (highway-env's own clock drifts)."""
        return self.frame / self.scenario.parameters.simulation_hz

    def branch(self) -> "World":
        return replace(self, road=copied(self.road))

    def snapshot(self) -> Snapshot | ActionsTaken:
        """Return what `thaw` needs besides `state()` to continue exactly as this world would."""
        vehicles = self.road.vehicles
        return Snapshot(self.frame, tuple(map(self._section, vehicles)), int(vehicles[0].speed_index))

    def _section(self, v: Any) -> int:
        """Return the section of its path that a vehicle is in; its route has only the remaining lanes."""
        road, left = self.scenario.road(), v.route.index(v.target_lane_index)
        if road.form == 1:  # counted from where the route now begins; the next frame corrects it
            return int(left)
        return len(road.paths[v.spawn.approach, v.spawn.route].lanes) - len(v.route) + int(left)

    @classmethod
    def thaw(cls, scenario: Scenario, state: WorldState, snapshot: Snapshot | ActionsTaken) -> "World":
        """Restore the world that `state` and `snapshot` were taken from, if its episode was undecided."""
        return (scenario.world or World).resumed(scenario, state, snapshot)

    @classmethod
    def resumed(cls, scenario: Scenario, state: WorldState, snapshot: Any) -> "World":
        """Do what `thaw` says, in this kind of world."""
        layout, road = scenario.layout(state.episode_seed, scenario.parameters), new_road(scenario)
        for v, section in zip(state.vehicles, snapshot.sections, strict=True):
            spawn = spawn_of(scenario, layout, v)
            vehicle = vehicle_on(road, scenario, spawn, section, (v.x_m, v.y_m), v.heading_rad)
            vehicle.crashed, vehicle.braking = v.crashed, v.braking
            road.vehicles.append(vehicle)
        vehicles = road.vehicles
        ego = vehicles[0]
        ego.speed_index = snapshot.speed_index
        ego.target_speed = ego.index_to_speed(ego.speed_index)
        if snapshot.frame:
            # highway-env ends every frame with collisions, which push touching vehicles apart in the next.
            for n, vehicle in enumerate(vehicles):
                for other in vehicles[n + 1 :]:
                    vehicle.handle_collisions(other, 1 / scenario.parameters.simulation_hz)
        layout = replace(layout, buildings=state.buildings)
        return cls(
            scenario, state.episode_seed, layout, road, state.step, snapshot.frame, beacons=state.beacons
        )

    def state(self) -> WorldState:
        """Return the present state."""
        name, states = self.scenario.name, tuple(map(self._state_of, self.vehicles))
        target_mps, buildings = float(self.vehicles[0].target_speed), self.layout.buildings
        return WorldState(
            name, self.seed, self.step, self.time_s, target_mps, states, buildings, self.beacons
        )

    def _state_of(self, v: Any) -> VehicleState:
        return state_of(v, self.scenario.brake_lamps, self.scenario.road().origin_m)

    def act(self, action: str) -> None:
        """Take an action by name after the scenario's lag, and simulate until the next decision is due.

        After the scenario's last decision, the action is held until the episode is decided.
        """
        p = self.scenario.parameters
        self.advance(p.due_frame(self.step) + p.lag_frames)
        self.decide(action)
        self.advance(p.due_frame(self.step))

    def decide(self, action: str) -> None:
        """Take an action unless the episode is decided, and count the decision."""
        if not self.outcome.ended:
            self.take(action)
        self.step += 1

    def take(self, action: str) -> None:
        """Set the ego's target by a meta-action. Nothing moves until the world advances."""
        self.vehicles[0].act(action)

    @property
    def target(self) -> Target:
        """The ego's route and target speed level."""
        ego = self.vehicles[0]
        return ego.spawn.route, int(ego.speed_index)

    def target_after(self, action: str) -> Target:
        """Return the target that the ego would have if it took an action now."""
        ego = self.vehicles[0]
        kept = dict(vars(ego))
        self.take(action)
        target = self.target
        vars(ego).update(kept)
        return target

    def advance(self, until_frame: int) -> None:
        """Simulate until a frame, or until the episode is decided."""
        lockstep.advance([self], [until_frame])

    def passed(self, poses: Floats, speed_mps: float, gap_m: float, conflicts: Conflicts) -> None:
        """Record the last frames: beacons, the least gap so far, conflicts and hard braking.

        `poses` are x, y, heading and speed of each vehicle in each frame, (F, V, 4), from the origin of the
        scenario's road; `speed_mps` is the ego's before these frames.
        """
        self._broadcast(poses, self.frame + 1 - len(poses))
        self.outcome = replace(self.outcome, least_gap_m=gap_m)
        self.conflicts = conflicts.collided() if self.outcome.result == "collision" else conflicts
        speeds_mps = np.concatenate([[speed_mps], poses[:, 0, 3]])
        slows_mps2 = (speeds_mps[:-1] - speeds_mps[1:]) * self.scenario.parameters.simulation_hz
        hard = [self.braking_hard, *(slows_mps2 > HARD_BRAKING_MPS2).tolist()]
        self.hard_brakings += sum(now and not before for before, now in pairwise(hard))
        self.braking_hard = hard[-1]

    def _poses(self) -> list[tuple[float, ...]]:
        """Return x, y, heading and speed of each vehicle, in highway-env's own frame."""
        return [(*v.position.tolist(), float(v.heading), float(v.speed)) for v in self.vehicles]

    def _in_road_frame(self, poses: Sequence[Any]) -> Floats:
        """Convert poses (..., V, 4) to the frame of the scenario's road."""
        moved = np.array(poses)
        moved[..., :2] -= self.scenario.road().origin_m
        return moved

    def _broadcast(self, poses: Floats, first_frame: int) -> None:
        """Add the beacons of who has a radio in some frames, whose poses are (F, V, 4)."""
        p, target_mps = self.scenario.parameters, float(self.vehicles[0].target_speed)
        radios = [n for n, v in enumerate(self.vehicles) if v.spawn.part != "other"]
        ids = [self.vehicles[n].spawn.id for n in radios]
        loss = beacons.losses(p, self.state, ids, poses)
        sent = beacons.broadcast(
            p, self.seed, self.beacons, ids, target_mps, poses[:, radios], first_frame, loss
        )
        for n, sender in [(n, v.spawn.id) for n, v in enumerate(self.vehicles) if v.spawn.radio]:
            loss = beacons.losses(p, self.state, [sender, *ids], poses)
            sent += beacons.announced(p, self.seed, self.beacons, sender, ids, poses[:, n], first_frame, loss)
        self.beacons = sent

    def _collision(self, ego: Any, wrecks: Sequence[Any]) -> dict[str, str]:
        """Return whom the ego hit, and how; empty if it hit an object on the road."""
        mine = self._state_of(ego)
        hit = [(float(outline(mine).distance(outline(v))), v) for v in map(self._state_of, wrecks)]
        apart_m, partner = min(hit, key=lambda pair: pair[0], default=(math.inf, mine))
        if apart_m > TOUCHING_M:
            return {}
        blamed = fault(mine, partner, self.scenario.road().paths)
        return {"partner": partner.id, "striker": striker(mine, partner), "fault": blamed}

    def _cleared(self) -> bool:
        vehicles = self.vehicles
        xy_m, approaches = [v.position for v in vehicles], [v.spawn.approach for v in vehicles]
        return bool(self.scenario.cleared(np.array(xy_m), np.array(approaches), self.scenario.parameters))

    def judge(self, standing: Set[str]) -> None:
        """Decide the episode if the last frame has decided it; `standing` had crashed before, by id."""
        p = self.scenario.parameters
        ego, traffic = self.vehicles[0], self.vehicles[1:]
        crashed = {v.spawn.id for v in traffic if v.crashed and v.spawn.id not in standing}
        if ego.crashed:
            how = self._collision(ego, [v for v in traffic if v.crashed])
            crashed.discard(how.get("partner", ""))
            self.outcome = self.outcome.ending("collision", self.time_s, **how)
        elif not ego.on_road:
            self.outcome = self.outcome.ending("off_road", self.time_s)
        elif self._cleared():
            self.outcome = self.outcome.ending("cleared", self.time_s)
        elif self.frame >= round(p.time_limit_s * p.simulation_hz):
            self.outcome = self.outcome.ending("time_out", self.time_s)
        if crashed:
            self.outcome = replace(self.outcome, other_crashes=self.outcome.other_crashes + len(crashed))
