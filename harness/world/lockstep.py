"""Simulate worlds of one scenario together: a frame of all of them is one pass over arrays.

Other traffic keeps its route and speed; the ego follows its target within physical limits. The
arithmetic is that of highway-env, operation by operation, with the rules of `simulator`, so worlds
end up the same to the last bit: NumPy computes a number in an array as it does alone, and `vecdot`
sums as `dot` does. A test drives both side by side. Environments, and two vehicles that touch, are
left to highway-env, and how an episode ends to `World`.

Arrays are (B, V): worlds, and the vehicles of each by number, the ego first. If a world has fewer
vehicles, the other columns stand for vehicles in lanes of their own, which affect nobody.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.world.conflict_measures import observe
from harness.world.gaps import least_gaps_m
from harness.world.highway import AbstractLane, CircularLane, ControlledVehicle, StraightLane
from harness.world.perception.rays import turned
from harness.world.road import Lane, Road, lanes_of
from harness.world.seats import seats_of
from harness.world.simulator import BRAKES_OFF_HZ, FAST_MPS, LAMPS_MPS2, NEAR_M, Traffic
from harness.world.state import separation_m

if TYPE_CHECKING:
    from harness.world.world import World

SLOW_MPS = 1e-2  # least speed to divide by, as in highway-env's `not_zero`
AT_ONCE = 128  # more worlds do not fit into the processor's cache


def advance(worlds: "Sequence[World]", until_frames: Sequence[int]) -> None:
    """Simulate several episodes of one scenario together, in place.

    Each of `worlds` goes on until its frame number in `until_frames`, counted from the start of its
    episode, or until all of its outcomes are decided.
    """
    pairs = [
        (world, until)
        for world, until in zip(worlds, until_frames, strict=True)
        if world.frame < until and not world.ended
    ]
    if pairs and pairs[0][0].scenario.has_own_world:
        for world, until in pairs:
            world.advance(until)
        return
    # Worlds with similar numbers of frames are simulated together, so that arrays stay full.
    pairs.sort(key=lambda pair: pair[1] - pair[0].frame)
    bounds = [*range(0, len(pairs), AT_ONCE), len(pairs)]
    for begin, end in pairwise(bounds if pairs else ()):
        _together(*zip(*pairs[begin:end], strict=True))


def _together(worlds: "Sequence[World]", until_frames: Sequence[int]) -> None:
    starts = np.array([world.frame for world in worlds])
    until = np.array(until_frames)
    fleet = Fleet(worlds)
    sizes_m, there, pairs = fleet.size, fleet.there, fleet.agents
    before_mps = fleet.speed[pairs]
    poses = np.full((len(worlds), int((until - starts).max()), *fleet.speed.shape[1:], 4), np.nan)
    live_rows = np.arange(len(worlds))
    passed = 0
    while live_rows.size:
        happened = fleet.step()
        poses[live_rows, passed, :, :2] = fleet.xy
        poses[live_rows, passed, :, 2] = fleet.heading
        poses[live_rows, passed, :, 3] = fleet.speed
        passed += 1
        over = fleet.frame >= until[live_rows]
        for row in np.flatnonzero(over | happened).tolist():
            world = worlds[live_rows[row]]
            standing = fleet.write(row, world)
            if happened[row]:
                world.judge(standing)
                fleet.going[row, [n for n, j in world.journeys.items() if j.outcome.ended]] = False
                over[row] |= world.ended
        if happened.any() or over.any():
            live_rows = live_rows[~over]
            fleet.keep(~over)
    poses = poses[:, :passed]
    poses[..., :2] -= worlds[0].scenario.road().origin_m
    np.copyto(poses, np.nan, where=~there[:, None, :, None])
    for world, frames, first in zip(worlds, poses, starts.tolist(), strict=True):
        world.passed(frames[: world.frame - first, : len(world.vehicles)])
    _measure(worlds, pairs, starts, poses, sizes_m, before_mps)


def _measure(
    worlds: "Sequence[World]",
    agents: tuple[Ints, ...],
    starts: Ints,
    poses: Floats,
    sizes_m: Floats,
    before_mps: Floats,
) -> None:
    """Record what some frames were for each agent, (n,), that was under way when they began.

    `poses` (B, F, V, 4) are of frames after `starts`, (B,);
    `before_mps` (n,) are the agents' speeds before.
    """
    rows, places = agents
    hz = worlds[0].scenario.parameters.simulation_hz
    journeys = [worlds[b].journeys[n] for b, n in zip(rows.tolist(), places.tolist(), strict=True)]
    ends = np.array([worlds[b].frame for b in rows.tolist()]) - starts[rows]  # frames that count
    if places.any():  # each agent comes first in its own
        order = np.tile(np.arange(poses.shape[2]), (len(rows), 1))
        order[np.arange(len(rows)), places], order[:, 0] = 0, places
        poses = poses[rows[:, None], :, order].swapaxes(1, 2)
        sizes_m = sizes_m[rows[:, None], order]
        ended_s = [np.inf if j.outcome.time_s is None else j.outcome.time_s for j in journeys]
        ends = np.minimum(ends, np.rint(np.array(ended_s) * hz) - starts[rows]).astype(int)
        after = np.arange(poses.shape[1]) >= ends[:, None]
        np.copyto(poses, np.nan, where=after[..., None, None])
    before_m = np.array([journey.outcome.least_gap_m for journey in journeys])
    gaps_m = least_gaps_m(poses, sizes_m, before_m).tolist()
    conflicts = observe([j.conflicts for j in journeys], poses, sizes_m, starts[rows] + 1, hz)
    speeds_mps = np.concatenate([before_mps[:, None], poses[:, :, 0, 3]], axis=1)
    for n, journey in enumerate(journeys):
        journey.passed(speeds_mps[n, : ends[n] + 1], gaps_m[n], conflicts[n], hz)


@dataclass(frozen=True)
class Lanes:
    """Hold the L lanes of a road network as arrays, so that many vehicles are located at once.

    A lane has a number from 0, its index in the arrays, and a name, highway-env's index of it: the
    two nodes of its road, and its place from the left. It is straight or an arc of a circle; what
    is of the other kind means nothing for it. x is to the east and y to the south.
    """

    number: dict[Lane, int]  # number of each lane by highway-env's index
    names: list[Lane]  # highway-env's index of each lane, by number
    base: Floats  # beginning of a straight lane, or centre of an arc, m, (L, 2)
    along: Floats  # direction of a straight lane, a vector of length 1, (L, 2)
    across: Floats  # direction to its right, a vector of length 1, (L, 2)
    heading: Floats  # heading of a straight lane, radians, (L,)
    length: Floats  # length of each lane, m, (L,)
    width: Floats  # width of each lane, m, (L,)
    arc: Bools  # whether each lane is an arc, (L,)
    radius: Floats  # radius of an arc, m, (L,)
    phase: Floats  # angle on its circle at which an arc begins, radians, (L,)
    sign: Floats  # 1 if an arc turns clockwise as pictures show it, else -1, (L,)
    # by number each lane that is neither, a `highway_env.road.lane.AbstractLane`
    others: dict[int, Any]

    def coordinates(self, xy: Floats, lane: Ints) -> tuple[Floats, Floats]:
        """Return how far positions are along lanes, and how far to the right of their middle, m.

        `xy` are positions in highway-env's frame, (..., 2) m, and `lane` is the number of each
        one's lane, (...). Both results are (...).
        """
        away = xy - self.base.take(lane, axis=0)
        along = np.vecdot(away, self.along.take(lane, axis=0))
        lateral = np.vecdot(away, self.across.take(lane, axis=0))
        arcs = self.arc.take(lane)
        if arcs.any():
            k, d = lane[arcs], away[arcs]
            sign, phase, radius = self.sign[k], self.phase[k], self.radius[k]
            phi = phase + turned(np.arctan2(d[:, 1], d[:, 0]) - phase)
            along[arcs] = sign * (phi - phase) * radius
            lateral[arcs] = sign * (radius - np.sqrt(np.vecdot(d, d)))
        for at in self._of_others(lane):
            along[at], lateral[at] = self.others[int(lane[at])].local_coordinates(xy[at])
        return along, lateral

    def _of_others(self, lane: Ints) -> Iterator[tuple[int, ...]]:
        """Yield the places in an array where a lane is neither straight nor an arc."""
        if self.others:
            yield from zip(*np.nonzero(np.isin(lane, list(self.others))), strict=True)

    def heading_at(self, along: Floats, lane: Ints) -> Floats:
        """Return the heading of lanes at distances along them, rad from +x towards +y, (...).

        `along` are the distances, m, (...), and `lane` the lanes' numbers, (...).
        """
        heading = self.heading.take(lane)
        arcs = self.arc.take(lane)
        if arcs.any():
            k = lane[arcs]
            heading[arcs] = self.sign[k] * along[arcs] / self.radius[k] + self.phase[k]
            heading[arcs] += np.pi / 2 * self.sign[k]
        for at in self._of_others(lane):
            heading[at] = self.others[int(lane[at])].heading_at(along[at])
        return heading


@lru_cache(maxsize=64)
def _lanes(road: Callable[[], Road]) -> Lanes:
    """Return the lanes of a road."""
    named = lanes_of(road().network())
    lanes = list(named.values())
    kinds = [type(lane) for lane in lanes]

    def each(name: str, blank: Any, kind: type) -> Floats:
        values = [
            getattr(lane, name) if lane_kind is kind else blank
            for lane, lane_kind in zip(lanes, kinds, strict=True)
        ]
        return np.array(values, dtype=float)

    nowhere = np.zeros(2)
    return Lanes(
        {name: n for n, name in enumerate(named)},
        list(named),
        each("start", nowhere, StraightLane) + each("center", nowhere, CircularLane),
        each("direction", nowhere, StraightLane),
        each("direction_lateral", nowhere, StraightLane),
        each("heading", 0.0, StraightLane),
        np.array([lane.length for lane in lanes], dtype=float),
        np.array([lane.width for lane in lanes], dtype=float),
        np.array([k is CircularLane for k in kinds]),
        each("radius", 1.0, CircularLane),
        each("start_phase", 0.0, CircularLane),
        each("direction", 1.0, CircularLane),
        {n: lanes[n] for n, kind in enumerate(kinds) if kind not in (StraightLane, CircularLane)},
    )


def _within(least: float, values: Floats, most: float) -> Floats:
    """Return values within bounds, as `np.clip` does, which takes several times as long."""
    return np.minimum(np.maximum(values, least), most)


class Fleet:
    """Hold the vehicles of B episodes, at most V each, as arrays that are simulated together.

    Arrays are (B, V), a row an episode, with its ego first; those of two components, such as the
    positions `xy`, m, are (B, V, 2). Headings are in rad and speeds in m/s. `frame`, (B,), counts
    each episode's frames. Where an episode has fewer than V vehicles, `there` is false.
    """

    def __init__(self, worlds: "Sequence[World]") -> None:
        scenario = worlds[0].scenario
        p, lanes = scenario.parameters, _lanes(scenario.road)
        self.lanes, self.scenario, self.dt = lanes, scenario, 1 / p.simulation_hz
        self.last_frame = round(p.time_limit_s * p.simulation_hz)
        self.worlds = list(worlds)
        most = max(len(world.vehicles) for world in worlds)
        shape = len(worlds), most
        ways = [lanes.number[scenario.road().paths[key].lanes[0]] for key in scenario.road().ways]
        self.ways = np.array(ways, dtype=int)
        self.frame = np.array([world.frame for world in worlds])
        self.there = np.zeros(shape, dtype=bool)
        self.approach = np.full(shape, "", dtype="U32")
        self.lane = np.zeros(shape, dtype=int)
        self.lane_now = np.tile(-1 - np.arange(most), (len(worlds), 1))  # lanes of no other vehicle
        self.xy, self.impact = np.zeros((*shape, 2)), np.zeros((*shape, 2))
        self.pushed, self.crashed, self.stood, self.braking = (
            np.zeros(shape, bool) for _ in range(4)
        )
        self.drives, self.going = (np.zeros(shape, bool) for _ in range(2))
        self.heading, self.speed, self.target = (np.zeros(shape) for _ in range(3))
        self.steering, self.acceleration = np.zeros(shape), np.zeros(shape)
        self.size = np.ones((*shape, 2))
        self.reach = np.zeros(shape)
        self.brakes_at = np.full(shape, np.inf)
        self.brakes_mps2, self.brakes_to = np.zeros(shape), np.zeros(shape)
        longest = max(len(v.route) for world in worlds for v in world.vehicles)
        self.route = np.full((*shape, longest + 1), -1)
        self.section = np.zeros(shape, dtype=int)
        self.seat = np.full(shape, -1)  # number of each agent's seat; -1 for an ego
        self.seats = seats_of(scenario)
        seats = list(self.seats)
        for b, world in enumerate(worlds):
            for n, v in enumerate(world.vehicles):
                self._read(b, n, v)
            for n in world.journeys:
                spawn = world.vehicles[n].spawn
                self.drives[b, n] = True
                self.seat[b, n] = seats.index((spawn.approach, spawn.route)) if n else -1
            self.going[
                b, [n for n, journey in world.journeys.items() if not journey.outcome.ended]
            ] = True
        # numbers of the one and the other of each two vehicles, (P,)
        self.pairs = np.triu_indices(most, 1)
        first, second = self.pairs
        self.reaches = self.reach[:, first] + self.reach[:, second]  # of both, m, (B, P)
        self.both_there = self.there[:, first] & self.there[:, second]
        self._index()
        ego = worlds[0].vehicles[0]
        self.limits, self.most_steering = ego.limits_mps2, ego.MAX_STEERING_ANGLE

    def _index(self) -> None:
        """List who follows a target, and of these the agents that are under way:
        rows and places, (n,).
        """
        self.driven, self.agents = np.nonzero(self.drives), np.nonzero(self.going)
        self.is_full = bool(self.there.all())

    def _read(self, b: int, n: int, v: Any) -> None:
        at, number = (b, n), self.lanes.number
        self.there[at], self.approach[at] = True, v.spawn.approach
        self.lane[at], self.lane_now[at] = number[v.target_lane_index], number[v.lane_index]
        self.xy[at], self.heading[at], self.speed[at] = v.position, v.heading, v.speed
        self.target[at], self.crashed[at] = v.target_speed, v.crashed
        if v.impact is not None:
            self.impact[at], self.pushed[at] = v.impact, True
        self.size[at], self.reach[at] = (v.LENGTH, v.WIDTH), v.diagonal / 2
        if v.spawn.brakes_at_s is not None:
            self.brakes_at[at], self.brakes_mps2[at] = v.spawn.brakes_at_s, v.spawn.brakes_mps2
            self.brakes_to[at] = v.spawn.brakes_to_mps
        self.route[b, n, : len(v.route)] = [number[lane] for lane in v.route]
        self.section[at] = v.route.index(v.target_lane_index)

    def keep(self, rows: Bools) -> None:
        """Drop the episodes that are simulated no more, rows for which `rows` is false.

        The mask is (B,), one of each of the B episodes.
        """
        self.worlds = [
            world for world, kept in zip(self.worlds, rows.tolist(), strict=True) if kept
        ]
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray) and name != "ways":
                setattr(self, name, value[rows])
        self._index()

    def write(self, row: int, world: "World") -> set[str]:
        """Copy the vehicles of one row of the arrays back into the object of its episode, `world`.

        `row` is the episode's index among the B. Returns the ids of vehicles that had crashed
        before the last frame.
        """
        world.frame = int(self.frame[row])
        names = self.lanes.names
        for n, v in enumerate(world.vehicles):
            at = row, n
            v.position = self.xy[at].copy()
            v.heading, v.speed = float(self.heading[at]), float(self.speed[at])
            v.crashed, v.braking = bool(self.crashed[at]), bool(self.braking[at])
            v.impact = self.impact[at].copy() if self.pushed[at] else None
            v.action = {
                "steering": float(self.steering[at]),
                "acceleration": float(self.acceleration[at]),
            }
            lane = names[self.lane[at]]
            if lane != v.target_lane_index:
                behind = v.route.index(v.target_lane_index)
                v.route = v.route[v.route.index(lane, behind + 1) :]
                v.target_lane_index = lane
            v.on_state_update()
        return {v.spawn.id for n, v in enumerate(world.vehicles) if self.stood[row, n]}

    def step(self) -> Bools:
        """Simulate one frame; return in which episodes something may decide an outcome, (B,).

        These are those with a new crash, an agent at its goal or off the road, or the time limit.
        """
        self.stood = self.crashed.copy()
        self._act()
        self._move()
        on_road = self._place_agents()
        self.frame = self.frame + 1
        self._collide()
        happened = (self.crashed != self.stood).any(axis=1) | (self.frame >= self.last_frame)
        happened[self.agents[0][~on_road | self._cleared() | self.crashed[self.agents]]] = True
        return np.asarray(happened)

    def _cleared(self) -> Bools:
        """Return which agents that are under way have reached their goal, (n,)."""
        p, seat = self.scenario.parameters, self.seat[self.agents]
        cleared = np.zeros(len(seat), dtype=bool)
        if (egos := seat < 0).any():
            xy = self.xy if self.is_full else np.where(self.there[..., None], self.xy, np.nan)
            cleared[egos] = self.scenario.cleared(xy, self.approach, p)[self.agents[0][egos]]
        for n, (key, agent_seat) in enumerate(self.seats.items()):
            if (at := seat == n).any():
                xy = self.xy[self.agents][at][:, None]
                names = np.full(xy.shape[:2], agent_seat.names[key][0])
                cleared[at] = agent_seat.scenario.cleared(xy, names, p)
        return cleared

    def _act(self) -> None:
        """Steer, and keep the target speed, as `ControlledVehicle.act` does."""
        lanes = self.lanes
        along, lateral = lanes.coordinates(self.xy, self.lane)
        ends = along > lanes.length[self.lane] - AbstractLane.VEHICLE_LENGTH / 2
        if ends.any():
            b, n = np.nonzero(ends)
            following = self.route[b, n, self.section[b, n] + 1]
            b, n, following = b[following >= 0], n[following >= 0], following[following >= 0]
            self.section[b, n] += 1
            self.lane[b, n] = following
            along[b, n], lateral[b, n] = lanes.coordinates(self.xy[b, n], following)
        self.steering = self._steering(along, lateral)
        self.acceleration = self._acceleration()
        self.braking = self.acceleration < -LAMPS_MPS2

    def _steering(self, along: Floats, lateral: Floats) -> Floats:
        speed, slow = self.speed, np.abs(self.speed) <= SLOW_MPS
        if slow.any():
            speed = np.where(slow, np.where(speed >= 0, SLOW_MPS, -SLOW_MPS), speed)
        control = ControlledVehicle
        heading = self.lanes.heading_at(along + self.speed * control.TAU_PURSUIT, self.lane)
        turn = _within(-1.0, -control.KP_LATERAL * lateral / speed, 1.0)
        turn = _within(-np.pi / 4, np.arcsin(turn), np.pi / 4)
        rate: Floats = control.KP_HEADING * turned(heading + turn - self.heading)
        slip = _within(-1.0, self.size[..., 0] / 2 / speed * rate, 1.0)
        steering: Floats = np.arctan(2 * np.tan(np.arcsin(slip)))
        return _within(-self.most_steering, steering, self.most_steering)

    def _acceleration(self) -> Floats:
        acceleration, speed = np.zeros_like(self.speed), self.speed
        first, second = self.pairs
        in_lane = self.lane_now.take(first, axis=1) == self.lane_now.take(second, axis=1)
        b, pair = np.nonzero(in_lane)
        if b.size:
            n, other = first[pair], second[pair]
            is_slower = speed[b, n] < speed[b, other]
            n, other = np.where(is_slower, other, n), np.where(is_slower, n, other)
            is_faster = speed[b, n] > speed[b, other]
            b, n, other = b[is_faster], n[is_faster], other[is_faster]
        if b.size:
            heading, ways = self.heading[b, n], np.empty((len(b), 2))
            ways[:, 0], ways[:, 1] = np.cos(heading), np.sin(heading)
            ahead = np.vecdot(self.xy[b, other] - self.xy[b, n], ways)
            room = ahead - (self.size[b, n, 0] + self.size[b, other, 0]) / 2 - Traffic.standoff_m
            closing = speed[b, n] - speed[b, other]
            brakes = (ahead > 0) & (closing**2 > 2 * Traffic.braking_mps2 * room)
            acceleration[b[brakes], n[brakes]] = -2 * Traffic.braking_mps2
        by_itself = self.frame[:, None] / self.scenario.parameters.simulation_hz >= self.brakes_at
        if by_itself.any():
            above = np.maximum(self.speed - self.brakes_to, 0.0)
            by_itself &= above > 0
            acceleration = np.where(
                by_itself, -np.minimum(self.brakes_mps2, above * BRAKES_OFF_HZ), acceleration
            )
        wanted = ControlledVehicle.KP_A * (self.target[self.driven] - self.speed[self.driven])
        least, most = self.limits
        acceleration[self.driven] = _within(least, wanted, most)
        return acceleration

    def _move(self) -> None:
        steering, acceleration = self.steering, self.acceleration
        if self.crashed.any():
            steering = np.where(self.crashed, 0.0, steering)
            acceleration = np.where(self.crashed, -1.0 * self.speed, acceleration)
        if (np.abs(self.speed) > FAST_MPS).any():
            fastest, slowest = ControlledVehicle.MAX_SPEED, ControlledVehicle.MIN_SPEED
            most = np.minimum(acceleration, 1.0 * (fastest - self.speed))
            least = np.maximum(acceleration, 1.0 * (slowest - self.speed))
            acceleration = np.where(self.speed > fastest, most, acceleration)
            acceleration = np.where(self.speed < slowest, least, acceleration)
        self.steering, self.acceleration = steering, acceleration
        slip = np.arctan(1 / 2 * np.tan(steering))
        way = self.heading + slip
        moves = np.empty_like(self.xy)
        np.multiply(self.speed, np.cos(way), out=moves[..., 0])
        np.multiply(self.speed, np.sin(way), out=moves[..., 1])
        self.xy = self.xy + moves * self.dt
        if self.pushed.any():
            self.xy[self.pushed] += self.impact[self.pushed]
            self.crashed = self.crashed | self.pushed
            self.pushed = np.zeros_like(self.pushed)
        self.heading = self.heading + self.speed * np.sin(slip) / (self.size[..., 0] / 2) * self.dt
        self.speed = self.speed + acceleration * self.dt
        np.copyto(self.lane_now, self.lane, where=self.there)

    def _place_agents(self) -> Bools:
        """Set the egos' lanes to the nearest of their ways;
        return which agents have road below, (n,).
        """
        if self.ways.size:
            places = np.broadcast_to(self.xy[:, None, 0], (len(self.xy), len(self.ways), 2))
            _, off_m = self.lanes.coordinates(places, np.broadcast_to(self.ways, places.shape[:-1]))
            self.lane_now[:, 0] = self.ways[np.abs(off_m).argmin(axis=1)]
        lane = self.lane_now[self.agents]
        along, lateral = self.lanes.coordinates(self.xy[self.agents], lane)
        room_m, length_m = AbstractLane.VEHICLE_LENGTH, self.lanes.length[lane]
        return np.asarray(
            (np.abs(lateral) <= self.lanes.width[lane] / 2)
            & (-room_m <= along)
            & (along < length_m + room_m)
        )

    def _near(self) -> Ints:
        """Return pairs of vehicles that may touch within the frame:
        world, number and number, (n, 3).
        """
        first, second = self.pairs
        apart = self.xy.take(second, axis=1) - self.xy.take(first, axis=1)
        dx, dy = apart[..., 0], apart[..., 1]
        within = self.reaches + (self.speed * self.dt).take(first, axis=1) + NEAR_M
        near = (dx * dx + dy * dy < within * within) & self.both_there
        b, pair = np.nonzero(near)
        if not b.size:
            return np.empty((0, 3), dtype=int)
        n, other = first[pair], second[pair]
        poses = np.concatenate([self.xy, self.heading[..., None]], axis=-1)
        apart_m = separation_m(poses[b, n], self.size[b, n], poses[b, other], self.size[b, other])
        moves_m = (np.abs(self.speed[b, n]) + np.abs(self.speed[b, other])) * self.dt + NEAR_M
        return np.stack([b, n, other], axis=-1)[apart_m <= moves_m]

    def _collide(self) -> None:
        """Let highway-env check the pairs that may touch."""
        for row, first, second in self._near().tolist():
            vehicles = self.worlds[row].vehicles
            for k in (first, second):
                v, at = vehicles[k], (row, k)
                v.position = self.xy[at]
                v.heading, v.speed = float(self.heading[at]), float(self.speed[at])
                v.impact, v.crashed = None, False
            vehicles[first].handle_collisions(vehicles[second], self.dt)
            for k in (first, second):
                v, at = vehicles[k], (row, k)
                self.crashed[at] |= v.crashed
                if v.impact is not None:
                    self.impact[at], self.pushed[at] = v.impact, True
