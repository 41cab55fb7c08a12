"""One simulated episode, from its start to its outcome: what there is of it between two frames.

`lockstep` simulates its frames, and those of other worlds with them.
"""

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from harness.core.arrays import Floats
from harness.world import beacons, lockstep
from harness.world.beacons import Stretch
from harness.world.conflict_measures import Conflicts
from harness.world.outcome import Outcome, fault, outline, striker
from harness.world.scenario import Layout, Scenario
from harness.world.seats import agents_of, seat_of, seated
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
class Journey:
    """Hold what has happened so far in an episode to one agent, a vehicle that decides."""

    outcome: Outcome = field(default_factory=Outcome)  # how its drive ended, or that it still runs
    hard_brakings: int = 0  # how often it began to brake harder than `HARD_BRAKING_MPS2`
    braking_hard: bool = False  # whether it braked so hard in the last frame
    conflicts: Conflicts = field(default_factory=Conflicts)  # how near others came to it in time

    def anew(self) -> "Journey":
        """Return a copy with outcome and counts reset, to count from the next decision on."""
        return replace(self, outcome=Outcome(), hard_brakings=0, conflicts=self.conflicts.anew())

    def passed(self, speeds_mps: Floats, gap_m: float, conflicts: Conflicts, hz: int) -> None:
        """Record F more frames of the agent's drive.

        `speeds_mps` are its speeds, m/s, (F + 1,), with that of the frame before first; `gap_m` is
        its least gap to another vehicle so far, m, `conflicts` how near in time others came so far,
        and `hz` frames a second.
        """
        self.outcome = replace(self.outcome, least_gap_m=gap_m)
        self.conflicts = conflicts.collided() if self.outcome.result == "collision" else conflicts
        slows_mps2 = (speeds_mps[:-1] - speeds_mps[1:]) * hz
        hard = [self.braking_hard, *(slows_mps2 > HARD_BRAKING_MPS2).tolist()]
        self.hard_brakings += sum(now and not before for before, now in pairwise(hard))
        self.braking_hard = hard[-1]


class Drive(NamedTuple):
    """Hold what V vehicles did in F frames: what their beacons say."""

    poses: Floats  # x and y (m), heading (rad) and speed (m/s) in each frame, (F, V, 4)
    first_frame: int  # number of the first one
    targets_mps: Mapping[int, float]  # target speed of each agent, by its index


@dataclass
class World:
    """Simulate one episode: its vehicles, its agents' records and its clock.

    An agent is a vehicle that decides for itself, known by its index among the vehicles; the ego
    has 0.
    """

    scenario: Scenario  # the episode's scenario
    seed: int  # seed of the episode's layout
    layout: Layout  # the start situation, drawn by that seed
    road: Any  # a `highway_env.road.road.Road` with the episode's vehicles, the ego first
    step: int = 0  # number of decisions taken so far
    frame: int = 0  # number of frames simulated so far
    # what has become of each agent so far, by its index
    journeys: dict[int, Journey] = field(default_factory=lambda: {0: Journey()})
    # the vehicles' broadcasts about themselves that mattered before the frames in `unsent`: the
    # last that each receiver has, and those on the air
    sent: tuple[Beacon, ...] = ()
    unsent: tuple[Drive, ...] = ()  # frames of which nobody has asked for the beacons yet

    @classmethod
    def start(cls, scenario: Scenario, seed: int) -> "World":
        of_layout = scenario.at(seed)
        return (of_layout.world or World).begun(of_layout, seed)

    @classmethod
    def begun(cls, scenario: Scenario, seed: int) -> "World":
        """Start the episode of a layout seed in this class of world.

        The seed fixes the start situation. Code outside calls `World.start`, which takes the class
        that the scenario names.
        """
        layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
        road = populated(scenario, layout, agents)
        world = cls(scenario, seed, layout, road, journeys={agent: Journey() for agent in agents})
        poses = beacons.lead_in(scenario.parameters, world._in_road_frame(world._poses()))
        world._drove(poses, 1 - len(poses))
        return world

    @property
    def actions(self) -> tuple[str, ...]:
        """Return the names of the meta-actions that the ego chooses from, the most careful first.

        They are highway-env's, such as `SLOWER`.
        """
        return self.scenario.actions

    @property
    def vehicles(self) -> Sequence[Any]:
        vehicles: Sequence[Any] = self.road.vehicles
        return vehicles

    @property
    def time_s(self) -> float:
        """Return the time since the start, s, by frames (highway-env's own clock drifts)."""
        return self.frame / self.scenario.parameters.simulation_hz

    @property
    def outcome(self) -> Outcome:
        """Return how the episode has ended for the ego, or that it still runs."""
        return self.journeys[0].outcome

    @property
    def journey(self) -> Journey:
        """Return the record of what has happened to the ego so far in the episode."""
        return self.journeys[0]

    @property
    def ended(self) -> bool:
        """Return whether the outcome of every agent, every vehicle that decides, is decided."""
        return all(journey.outcome.ended for journey in self.journeys.values())

    def branch(self) -> "World":
        journeys = {agent: replace(journey) for agent, journey in self.journeys.items()}
        return replace(self, road=copied(self.road), journeys=journeys)

    def snapshot(self) -> Snapshot | ActionsTaken:
        """Return what is needed beside `state()` to continue exactly as this world would.

        `thaw` takes both; they are what a dataset keeps of a scene.
        """
        vehicles = self.road.vehicles
        return Snapshot(
            self.frame, tuple(map(self._section, vehicles)), int(vehicles[0].speed_index)
        )

    def _section(self, v: Any) -> int:
        """Return the section of its path that a vehicle is in;
        its route has only the remaining lanes.
        """
        road, left = self.scenario.road(), v.route.index(v.target_lane_index)
        if road.form == 1:  # counted from where the route now begins; the next frame corrects it
            return int(left)
        return len(road.paths[v.spawn.approach, v.spawn.route].lanes) - len(v.route) + int(left)

    @classmethod
    def thaw(
        cls, scenario: Scenario, state: WorldState, snapshot: Snapshot | ActionsTaken
    ) -> "World":
        """Restore the world that `state()` and `snapshot()` were taken from.

        No outcome is decided in it, and what was counted until then starts at 0. The class is that
        of the scenario's worlds.
        """
        of_layout = scenario.at(state.episode_seed)
        return (of_layout.world or World).resumed(of_layout, state, snapshot)

    @classmethod
    def resumed(cls, scenario: Scenario, state: WorldState, snapshot: Any) -> "World":
        """Restore a world of this class from what `state()` and `snapshot()` returned.

        Code outside calls `thaw`, which takes the class that the scenario names.
        """
        layout, road = scenario.layout(state.episode_seed, scenario.parameters), new_road(scenario)
        for v, section in zip(state.vehicles, snapshot.sections, strict=True):
            spawn = spawn_of(scenario, layout, v)
            place, agent = (v.x_m, v.y_m), not road.vehicles
            vehicle = vehicle_on(road, scenario, spawn, section, place, v.heading_rad, agent)
            vehicle.crashed, vehicle.braking = v.crashed, v.braking
            road.vehicles.append(vehicle)
        vehicles = road.vehicles
        ego = vehicles[0]
        ego.speed_index = snapshot.speed_index
        ego.target_speed = ego.index_to_speed(ego.speed_index)
        if snapshot.frame:
            # highway-env ends every frame with collisions, which push touching vehicles apart in
            # the next.
            for n, vehicle in enumerate(vehicles):
                for other in vehicles[n + 1 :]:
                    vehicle.handle_collisions(other, 1 / scenario.parameters.simulation_hz)
        layout = replace(layout, buildings=state.buildings)
        return cls(
            scenario,
            state.episode_seed,
            layout,
            road,
            state.step,
            snapshot.frame,
            sent=state.beacons,
        )

    def state(self, agent: int = 0) -> WorldState:
        """Return the present state as one agent, a vehicle that decides, sees it: as the ego.

        `agent` is its index among the vehicles; 0 is the scenario's own ego.
        """
        state = self._now(agent, self.beacons)
        return seated(self.scenario, state, agent) if agent else state

    def truth(self, agent: int = 0) -> WorldState:
        """Return `state` without beacons, which who sees everything does not read."""
        state = self._now(agent)
        return seated(self.scenario, state, agent) if agent else state

    def _now(self, agent: int = 0, messages: tuple[Beacon, ...] = ()) -> WorldState:
        name, states = self.scenario.name, tuple(map(self._state_of, self.vehicles))
        target_mps, buildings = float(self.vehicles[agent].target_speed), self.layout.buildings
        return WorldState(
            name, self.seed, self.step, self.time_s, target_mps, states, buildings, messages
        )

    def _state_of(self, v: Any) -> VehicleState:
        return state_of(v, self.scenario.brake_lamps, self.scenario.road().origin_m)

    def act(self, action: str) -> None:
        """Take an action after the decision lag, and simulate to the time of the next decision.

        The lag is the time from seeing to acting, during which the ego keeps to its last action.
        After the last decision it simulates until the episode is decided.
        """
        p = self.scenario.parameters
        self.advance(p.due_frame(self.step) + p.lag_frames)
        self.decide(action)
        self.advance(p.due_frame(self.step))

    def decide(self, action: str) -> None:
        """Let the ego take an action unless its episode is decided, and count the decision.

        Nothing moves until the world advances.
        """
        if not self.outcome.ended:
            self.take(action)
        self.step += 1

    def take(self, action: str, agent: int = 0) -> None:
        """Set an agent's target speed or lane by a meta-action, such as `SLOWER`.

        `agent` is its index among the vehicles. Nothing moves until the world advances.
        """
        self.vehicles[agent].act(action)

    def target(self, agent: int = 0) -> Target:
        """Return an agent's route, such as `straight`, and its target speed.

        The speed is an index from 0 in the scenario's target speeds, which ascend. `agent` is the
        agent's index among the vehicles.
        """
        vehicle = self.vehicles[agent]
        return vehicle.spawn.route, int(vehicle.speed_index)

    def target_after(self, action: str, agent: int = 0) -> Target:
        """Return the route and target speed that a vehicle would have after an action.

        The action is not taken. The result is the route, such as `straight`, and an index from 0 in
        the scenario's target speeds, which ascend. `agent` is the vehicle's index.
        """
        vehicle = self.vehicles[agent]
        kept = dict(vars(vehicle))
        self.take(action, agent)
        target = self.target(agent)
        vars(vehicle).update(kept)
        return target

    def advance(self, until_frame: int) -> None:
        """Simulate until frame `until_frame`, or until the outcome of every agent is decided.

        Frames are counted from the start of the episode.
        """
        lockstep.advance([self], [until_frame])

    def passed(self, poses: Floats) -> None:
        """Add the beacons of the last F simulated frames to those that vehicles have received.

        A beacon is a vehicle's message about itself. It is called after each advance. `poses` are x
        and y (m from the origin of the scenario's road), heading (rad) and speed (m/s) of each of V
        vehicles in each frame, (F, V, 4).
        """
        self._drove(poses, self.frame + 1 - len(poses))

    def _poses(self) -> list[tuple[float, ...]]:
        """Return x, y, heading and speed of each vehicle, in highway-env's own frame."""
        return [(*v.position.tolist(), float(v.heading), float(v.speed)) for v in self.vehicles]

    def _in_road_frame(self, poses: Sequence[Any]) -> Floats:
        """Convert poses (..., V, 4) to the frame of the scenario's road."""
        moved = np.array(poses)
        moved[..., :2] -= self.scenario.road().origin_m
        return moved

    @property
    def beacons(self) -> tuple[Beacon, ...]:
        """Return the vehicles' broadcasts about themselves that still matter.

        These are the last one that each receiver has, and those on the air.
        """
        if self.unsent:
            self.sent, self.unsent = self._broadcast(), ()
        return self.sent

    def _drove(self, poses: Floats, first_frame: int) -> None:
        """Note what vehicles did in some frames, (F, V, 4), for the beacons of these frames."""
        targets = {n: float(self.vehicles[n].target_speed) for n in self.journeys}
        self.unsent = (*self.unsent, Drive(poses, first_frame, targets))
        # vehicles of other worlds may come and go
        if self.scenario.has_own_world or not beacons.waits(self.scenario.parameters):
            self.sent, self.unsent = self._broadcast(), ()

    def _broadcast(self) -> tuple[Beacon, ...]:
        """Return the beacons that matter after the frames in `unsent`."""
        p, radios = self.scenario.parameters, self.answering
        ids = [self.vehicles[n].spawn.id for n in radios]
        senders = [n for n, v in enumerate(self.vehicles) if v.spawn.radio]
        sent: tuple[Beacon, ...] = ()
        if len(self.journeys) > 1:  # everybody with a radio hears everybody
            senders = [*radios, *senders]
        else:
            stretches = [self._stretch(each, radios, ids, 0) for each in self.unsent]
            sent = beacons.broadcast(p, self.seed, self.sent, ids, stretches)
        for n in senders:
            sender = self.vehicles[n].spawn.id
            hearers = [id_ for id_ in ids if id_ != sender]
            stretches = [self._stretch(each, n, [sender, *hearers], n) for each in self.unsent]
            sent += beacons.announced(p, self.seed, self.sent, sender, hearers, stretches)
        return sent

    def _stretch(
        self, drive: Drive, senders: int | list[int], ids: Sequence[str], first: int
    ) -> Stretch:
        """Return what some senders did; links are from the first one of `ids` to each other one."""
        loss = beacons.losses(self.scenario.parameters, self._now, ids, drive.poses)
        target_mps = drive.targets_mps.get(first)
        return Stretch(drive.poses[:, senders], drive.first_frame, target_mps, loss)

    def _collision(self, ego: Any, wrecks: Sequence[Any]) -> dict[str, str]:
        """Return whom an agent hit, and how; empty if it hit an object on the road."""
        itself, others = self._state_of(ego), [self._state_of(wreck) for wreck in wrecks]
        distances_m = [float(outline(itself).distance(outline(other))) for other in others]
        if min(distances_m, default=math.inf) > TOUCHING_M:
            return {}
        partner = others[distances_m.index(min(distances_m))]
        at_fault = fault(itself, partner, self.scenario.road().paths)
        return {"partner": partner.id, "striker": striker(itself, partner), "fault": at_fault}

    def seat(self, agent: int) -> Scenario:
        """Return the scenario in which the agent with this index among the vehicles is the ego.

        An agent is a vehicle that decides; 0 is the ego of the scenario itself.
        """
        if not agent:
            return self.scenario
        return seat_of(self.scenario, self.vehicles[agent].spawn).scenario

    @property
    def answering(self) -> list[int]:
        """Return the indices of the vehicles that can be asked: the ego, helpers and agents.

        An agent is a vehicle that decides for itself; all others are traffic.
        """
        return [n for n, v in enumerate(self.vehicles) if v.spawn.part != "other"]

    def _cleared(self, agent: int) -> bool:
        """Return whether an agent has reached its goal."""
        p = self.scenario.parameters
        xy_m = np.array([v.position for v in self.vehicles])
        if not agent:
            approaches = np.array([v.spawn.approach for v in self.vehicles])
            return bool(self.scenario.cleared(xy_m, approaches, p))
        spawn = self.vehicles[agent].spawn
        seat = seat_of(self.scenario, spawn)
        approach, _ = seat.names[spawn.approach, spawn.route]
        return bool(seat.scenario.cleared(xy_m[[agent]], np.array([approach]), p))

    def judge(self, standing: Set[str]) -> None:
        """Set the outcome of each agent by what happened in the last frame.

        An agent is a vehicle that decides. `standing` has the ids of vehicles that had crashed
        before that frame. The simulation calls it after a crash, an arrival or the time limit.
        """
        p = self.scenario.parameters
        places = {n: v for n, v in enumerate(self.vehicles) if n not in self.journeys}
        crashed = {v.spawn.id for v in places.values() if v.crashed and v.spawn.id not in standing}
        for agent, journey in self.journeys.items():
            vehicle = self.vehicles[agent]
            if journey.outcome.ended:
                continue
            if vehicle.crashed:
                wrecks = [v for v in self.vehicles if v.crashed and v is not vehicle]
                how = self._collision(vehicle, wrecks)
                crashed.discard(how.get("partner", ""))
                journey.outcome = journey.outcome.ending("collision", self.time_s, **how)
            elif not vehicle.on_road:
                journey.outcome = journey.outcome.ending("off_road", self.time_s)
            elif self._cleared(agent):
                journey.outcome = journey.outcome.ending("cleared", self.time_s)
            elif self.frame >= round(p.time_limit_s * p.simulation_hz):
                journey.outcome = journey.outcome.ending("time_out", self.time_s)
        if crashed:
            crashes = self.outcome.other_crashes + len(crashed)
            self.journey.outcome = replace(self.outcome, other_crashes=crashes)
