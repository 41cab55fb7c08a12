"""Let a moment of a recording be an environment of highway-env.

The ego takes the place of a recorded vehicle; around it those drive who were recorded there.
"""

from bisect import bisect_right
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.objects import Obstacle

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.seeds import FIRST
from harness.extensions.environments.place import AFTER, LIMIT
from harness.extensions.roads.network import MIRROR, Ground, ground
from harness.extensions.roads.replay import AHEAD_S, Cast, Play, Puppet, touching
from harness.extensions.roads.scene import House, Scene, Track
from harness.extensions.roads.tables import Moment, Recording
from harness.world.road import Lane, PathKey
from harness.world.scenario import LAYOUTS_KEPT

MOST_OTHERS = 98  # ids of vehicles end with v99
LIMITS_MPS2 = (-8.0, 3.0)  # least and greatest acceleration of the ego, as of the harness's own
LEAST_HZ, MOST_HZ = 10, 20  # frames a second
MATCHED_S = 0.5  # between two looks at the lane of a recorded vehicle
BEYOND_M = 60.0  # roads reach so far beyond the ego's recorded drive, so that it can be farther
MOVES_M = 2.0  # a recorded driver who gets less far waits
HELPING = ("car", "van", "truck")  # kinds of road users who can be asked
NEAR_END_M = 10.0  # of a lane, where a vehicle may be on the next one, m
FILLS = 0.9  # a house that fills this share of its bounding box is that box
GRID = 12  # else the largest box inside it is looked for between so many lines


@dataclass(frozen=True, eq=False)
class Setting:
    """Say what an environment shows of a recording: a moment of one of its scenes.

    Poses that it returns are in the harness's frame, with y to the south.
    """

    scene: Scene
    moment: Moment
    window_m: float  # what is farther from the middle of the ego's recorded drive is not there
    hz: int  # frames a second
    goal_s: float  # time from the moment on at which the ego is to be where it was recorded
    limit_s: float  # the longest time that an episode takes

    @property
    def track(self) -> Track:
        """Return the track of the vehicle whose place the ego takes."""
        return self.scene.tracks[self.moment.vehicle]

    @cached_property
    def middle_m(self) -> Floats:
        """Return the middle of the window, (2,) m: of the ego's recorded drive."""
        return self.pose(self.goal_s / 2)[:2]

    @cached_property
    def reach_m(self) -> float:
        """Return how far roads reach from the middle, m: to the window's edge, or farther.

        The ego has road beyond its recorded drive.
        """
        ends = np.stack([self.pose(0.0), self.pose(self.goal_s)])
        away_m = np.hypot(*(ends[:, :2] - self.middle_m).T).max()
        return max(self.window_m, float(away_m) + BEYOND_M)

    def pose(self, time_s: float) -> Floats:
        """Return the recorded pose of the ego so long after the moment, or the last one, (4,)."""
        until_s = min(self.moment.time_s + time_s, self.track.end_s)
        pose = self.track.at(until_s)
        assert pose is not None
        return mirrored(pose)

    @cached_property
    def ground(self) -> Ground:
        """Return the roads of the moment."""
        return ground(self.scene, self.middle_m, self.reach_m)

    @cached_property
    def cast(self) -> Cast:
        """Return the road users within the window, the ego first."""
        return _cast(self)

    @cached_property
    def boxes(self) -> list[tuple[Floats, Floats]]:
        """Return the houses within the window as boxes: least x and y, and greatest, m."""
        boxes = []
        for house in self.scene.houses:
            low, high = box(house)
            nearest = np.clip(self.middle_m, low, high)
            if np.hypot(*(nearest - self.middle_m)) <= self.window_m:
                boxes.append((low, high))
        return boxes

    def lanes(self, number: int) -> dict[int, Lane | None]:
        """Return the lanes of a road user, by the frames in which they are looked for."""
        return self._lanes[number]

    @cached_property
    def _lanes(self) -> list[dict[int, Lane | None]]:
        cast, every = self.cast, round(MATCHED_S * self.hz)
        lanes = []
        for n, poses in enumerate(cast.poses):
            step = 1 if n == 0 else every
            there = np.flatnonzero(~np.isnan(poses[:, 0]))
            frames = sorted({*there[::step].tolist(), int(there[-1])})
            lanes.append(dict(zip(frames, self.ground.matched(poses[frames]), strict=True)))
        return lanes

    def looked_at(self, number: int, frame: int) -> int:
        """Return the last frame in which the lane of a road user was looked for, up to a frame."""
        frames = list(self.lanes(number))
        return frames[max(bisect_right(frames, frame) - 1, 0)]

    def plan(self, number: int, frame: int) -> list[tuple[str, str, None]]:
        """Return the streets that a road user takes from a frame on, as highway-env plans them."""
        return [(*street, None) for street in joined(self, self.route(number, frame))]

    @cached_property
    def keys(self) -> dict[tuple[int, int], PathKey]:
        """Return the path of each road user by its number and frame, as far as it was needed."""
        return {}

    def route(self, number: int, frame: int) -> tuple[Lane, ...]:
        """Return the lanes that a road user takes from a frame on, one of each street."""
        rest = [lane for at, lane in self.lanes(number).items() if at >= frame and lane]
        streets = dict.fromkeys(lane[:2] for lane in rest)
        last = {lane[:2]: lane for lane in rest}
        return tuple(last[street] for street in streets)


@lru_cache(maxsize=LAYOUTS_KEPT)
def setting(recording: Recording, moment: Moment, hz: int, limit_s: float) -> Setting:
    """Return what there is at a moment of a recording; the same object for the same moment.

    `hz` is the number of frames a second, and `limit_s` the longest time that an episode takes.
    """
    scene = recording.scene(moment.scene)
    return Setting(scene, moment, recording.window_m, hz, goal_s(recording), limit_s)


def goal_s(recording: Recording) -> float:
    """Return the time in which the ego is to come as far as its recorded driver, s."""
    return (recording.facts.decisions + AFTER) * recording.facts.period_s


def nth(recording: Recording, seed: int) -> Moment:
    """Return the moment of a layout seed: the n-th of the purpose that the seed has.

    Seeds of a purpose count from `FIRST` on. Raises UserError where there are not so many.
    """
    purpose = next(name for name in reversed(FIRST) if seed >= FIRST[name])
    moments = [moment for moment in recording.moments if moment.purpose == purpose]
    n = seed - FIRST[purpose]
    if n >= len(moments):
        begin = FIRST[purpose]
        there = f"seeds {begin} to {begin + len(moments) - 1}" if moments else "none"
        raise UserError(
            f"recording {printable(recording.name)} has {len(moments)} moments to {purpose} "
            f"({there}), and no more are to be had; give a first seed and a number of layouts "
            "within them"
        )
    return moments[n]


def first(recording: Recording) -> Moment:
    """Return the first moment of a recording. Raises UserError if it has none."""
    if not recording.moments:
        raise UserError(
            f"recording {printable(recording.name)} has no moments; import a longer one, or with "
            "another --window"
        )
    return recording.moments[0]


def mirrored(poses: Floats) -> Floats:
    """Return poses (..., >=3) of a recording in the harness's frame, and the other way round."""
    moved = np.array(poses, dtype=float)
    moved[..., :2] *= MIRROR
    moved[..., 2] *= -1
    return moved


def frames_a_second(step_s: float) -> int:
    """Return the frames a second of a simulation, so that recorded times are frames if they can be.

    They are a multiple or a whole part of 1 / `step_s`, the recording's own; else `LEAST_HZ`.
    """
    for hz in range(LEAST_HZ, MOST_HZ + 1):
        ratio = max(hz * step_s, 1 / (hz * step_s))
        if abs(ratio - round(ratio)) < 1e-6:
            return hz
    return LEAST_HZ


def _cast(setting: Setting) -> Cast:
    """Return who is within the window at some time of an episode, the ego first."""
    moment, hz = setting.moment, setting.hz
    last = round(setting.limit_s * hz)
    frames = last + round(AHEAD_S * hz) + 1
    times = moment.time_s + np.arange(frames) / hz
    ego = setting.track
    cast = []
    for track in setting.scene.tracks.values():
        if track is ego or track.end_s < times[0] or track.begin_s > times[last]:
            continue
        poses = sampled(track, times)
        away_m = np.hypot(*(poses[: last + 1, :2] - setting.middle_m).T)
        inside = np.flatnonzero(away_m <= setting.window_m)
        if inside.size:
            cast.append((track, poses, int(inside[0]), int(inside[-1])))
    drive = sampled(ego, times)
    cast.sort(key=lambda each: _apart_m(each[1][: last + 1], drive[: last + 1]))
    # the order of their ids is that in which they come, and then of their distance
    kept = sorted(cast[:MOST_OTHERS], key=lambda each: (each[2], _away_m(each[1], drive, each[2])))
    cast = [(ego, drive, 0, last), *kept]
    tracks, every, enters, leaves = zip(*cast, strict=True)
    return Cast(hz, tracks, np.stack(every), np.array(enters), np.array(leaves))


def _apart_m(poses: Floats, others: Floats) -> float:
    """Return the least distance of two at one time; inf if they are not there together."""
    away_m = np.hypot(*(poses[:, :2] - others[:, :2]).T)
    return float(np.nanmin(away_m)) if not np.isnan(away_m).all() else np.inf


def _away_m(poses: Floats, others: Floats, frame: int) -> float:
    """Return the distance of one in a frame from where another begins, m."""
    return float(np.hypot(*(poses[frame, :2] - others[0, :2])))


def sampled(track: Track, times: Floats) -> Floats:
    """Return the poses of a track at n times in the harness's frame, NaN where there are none.

    They are (n, 4), and headings go on steadily.
    """
    headings = np.unwrap(track.poses[:, 2])
    columns = [*track.poses.T[:2], headings, track.poses[:, 3]]
    poses = np.stack([np.interp(times, track.time_s, column) for column in columns], axis=-1)
    poses[(times < track.begin_s - 1e-6) | (times > track.end_s + 1e-6)] = np.nan
    return mirrored(poses)


@lru_cache(maxsize=1024)
def box(house: House) -> tuple[Floats, Floats]:
    """Return the axis-parallel box that stands for a house: its least x and y, and its greatest, m.

    It is the outline's bounding box if that is nearly full, else the largest box inside it, so that
    nothing blocks sight where the house is not.
    """
    outline = shapely.Polygon(house.outline * MIRROR)
    west, north, east, south = outline.bounds
    if outline.area >= FILLS * (east - west) * (south - north):
        return np.array([west, north]), np.array([east, south])
    first, last = np.triu_indices(GRID, 1)
    columns, rows = np.linspace(west, east, GRID), np.linspace(north, south, GRID)
    x, y = np.meshgrid(np.arange(len(first)), np.arange(len(first)), indexing="ij")
    lines = np.stack([columns[first][x], rows[first][y], columns[last][x], rows[last][y]])
    lines = lines.reshape(4, -1)
    inside = shapely.covers(outline, shapely.box(*lines))
    areas = (lines[2] - lines[0]) * (lines[3] - lines[1]) * inside
    best = lines[:, areas.argmax()]
    return best[:2], best[2:]


class Ego(MDPVehicle):  # type: ignore[misc]
    """Drive the vehicle that decides, within limits of acceleration, by the lanes near to it."""

    lane_index: Lane

    def speed_control(self, target_speed: float) -> float:
        least, most = LIMITS_MPS2
        return float(min(max(super().speed_control(target_speed), least), most))

    def on_state_update(self) -> None:
        """Set the vehicle's lane to the nearest of those that it can have reached in a frame."""
        if self.road is None:
            return
        network = self.road.network
        near: dict[Lane, None] = {}
        for lane in (self.lane_index, self.target_lane_index):
            begin, end, number = lane
            beside = range(max(number - 1, 0), min(number + 2, len(network.graph[begin][end])))
            near |= {(begin, end, n): None for n in beside}
            middle = network.get_lane(lane)
            if middle.local_coordinates(self.position)[0] > middle.length - NEAR_END_M:
                for following, lanes in network.graph.get(end, {}).items():
                    near |= {(end, following, n): None for n in range(len(lanes))}
        self.lane_index = min(near, key=self._away)
        self.lane = network.get_lane(self.lane_index)

    def _away(self, lane: Lane) -> float:
        away: float = self.road.network.get_lane(lane).distance_with_heading(
            self.position, self.heading
        )
        return away


class Stage(Road):  # type: ignore[misc]
    """Move an ego, by its actions, and recorded road users, frame by frame."""

    def __init__(self, network: Any, play: Play) -> None:
        super().__init__(network, np_random=np.random.RandomState(0))
        self.play = play
        # everybody by number, those included who are not there; the first stands for the ego
        self.puppets: list[Puppet] = []

    @property
    def ego(self) -> Any:
        """Return the vehicle that decides."""
        return self.vehicles[0]

    def act(self) -> None:
        self.ego.act()

    def step(self, dt: float) -> None:
        play, ego = self.play, self.ego
        before = play.poses.copy()
        before[0] = self._pose(ego)
        there = play.there.copy()
        play.move(before[0])
        ego.step(dt)
        play.poses[0] = self._pose(ego)
        if not np.array_equal(there, play.there):
            self.show()
        self._collide(before)

    def _pose(self, ego: Any) -> Floats:
        return np.array([*ego.position, ego.heading, ego.speed])

    def show(self) -> None:
        """Put on the road who is there now."""
        present = np.flatnonzero(self.play.there).tolist()[1:]
        self.vehicles = [self.ego, *[self.puppets[n] for n in present]]

    def _collide(self, before: Floats) -> None:
        """Let those crash that touch, of whom one is off the recording.

        `before` are the poses of the frame before. Those who touch in the recording, too, err.
        """
        play, cast, ego = self.play, self.play.cast, self.ego
        is_off = play.off()
        is_off[0] = True
        off, present = np.flatnonzero(is_off), np.flatnonzero(play.there)
        x, y = play.poses[off, :2].T[..., None] - play.poses[present, :2].T[:, None]
        moved_m = np.hypot(*(play.poses - before)[:, :2].T)
        reach_m = cast.reach_m + np.fmax(moved_m, 0.0)
        near = x * x + y * y < (reach_m[off][:, None] + reach_m[present]) ** 2
        lines, columns = near.nonzero()
        pairs = np.stack([off[lines], present[columns]], axis=-1)
        once = (pairs[:, 0] < pairs[:, 1]) | ~is_off[pairs[:, 1]]
        pairs = pairs[once & ~np.isnan(before[pairs[:, 1], 0])]
        if not len(pairs):
            return
        sizes_m = cast.sizes_m.copy()
        sizes_m[0] = ego.LENGTH, ego.WIDTH
        met = touching(play.poses, before, sizes_m, pairs)
        if not met.any():
            return
        recorded = cast.poses[:, min(play.frame, cast.poses.shape[1] - 1)]
        met &= ~(touching(recorded, recorded, sizes_m, pairs) & (pairs[:, 0] != 0))
        for first, second in pairs[met].tolist():
            for n in (first, second):
                play.crashed[n] = True
        ego.crashed |= bool(play.crashed[0])

    def branch(self) -> "Stage":
        """Return a copy that goes on by itself."""
        new = copy(self)
        new.play = self.play.branch()
        new.puppets = [copy(puppet) for puppet in self.puppets]
        for puppet in new.puppets:
            puppet.road = puppet.stage = new
        ego = copy(self.ego)
        ego.position, ego.action, ego.road = ego.position.copy(), dict(ego.action), new
        ego.route = list(ego.route or ())
        new.vehicles = [ego, *[new.puppets[v.number] for v in self.vehicles[1:]]]
        return new


class Wall(Obstacle):  # type: ignore[misc]
    """Show a house as an object of highway-env, by a box."""

    def __init__(self, low: Floats, high: Floats) -> None:
        super().__init__(None, (low + high) / 2)
        self.LENGTH, self.WIDTH = (high - low).tolist()
        self.diagonal = float(np.hypot(self.LENGTH, self.WIDTH))


class Recorded(AbstractEnv):  # type: ignore[misc]
    """Play moments of a recording: their roads, houses and road users, and an ego that decides.

    The seed of a reset says which moment (`nth`). `react` says whether the others react to who is
    off the recording, the ego first; `limit_s` is the longest time that an episode takes.
    """

    several_roads = True  # each moment has its own
    setting: Setting  # of the moment

    def __init__(
        self, recording: Recording, react: bool = True, limit_s: float | None = None
    ) -> None:
        facts = recording.facts
        self.recording, self.react = recording, react
        self.limit_s = limit_s or (facts.decisions + LIMIT) * facts.period_s
        super().__init__(
            {
                "action": {
                    "type": "DiscreteMetaAction",
                    "target_speeds": list(recording.speeds_mps),
                },
                # which nobody reads, and highway-env's own is as slow as a second of driving
                "observation": {"type": "AttributesObservation", "attributes": []},
                "simulation_frequency": frames_a_second(recording.scenes_stated[0].step_s),
                "policy_frequency": 1 / facts.period_s,
            }
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the moment of a layout seed; without one, nothing is there yet."""
        if seed is None:
            return None, {}
        moment = nth(self.recording, seed) if seed else first(self.recording)
        hz = self.config["simulation_frequency"]
        self.setting = setting(self.recording, moment, hz, self.limit_s)
        return super().reset(seed=seed, options=options)

    @property
    def goal(self) -> str | tuple[float, float]:
        """Return the ego's goal: where its recorded driver comes, or the time if that waits."""
        until_s = self.setting.goal_s
        begin, end = self.setting.pose(0.0), self.setting.pose(until_s)
        if np.hypot(*(end - begin)[:2]) < MOVES_M:
            return f"{until_s:g}s"
        return float(end[0]), float(end[1])

    def helpers(self, count: int) -> set[int]:
        """Return the numbers of those who can be asked: who moves, is a car, and is nearest."""
        cast = self.setting.cast
        able = [
            n
            for n, track in enumerate(cast.tracks)
            if n and cast.enters[n] <= 0 and cast.moves[n] and track.kind in HELPING
        ]
        return set(able[:count])

    def _reset(self) -> None:
        setting = self.setting
        cast, play = setting.cast, Play.start(setting.cast, self.react)
        self.road = Stage(setting.ground.network, play)
        self.road.puppets = [Puppet(self.road, n, track) for n, track in enumerate(cast.tracks)]
        self.vehicle = self._ego()
        self.road.vehicles = [self.vehicle]
        self.road.show()
        self.road.objects = [Wall(low, high) for low, high in setting.boxes]

    def _ego(self, kind: type[Ego] = Ego) -> Ego:
        """Return the ego at the recorded place, with the recorded route."""
        setting = self.setting
        x_m, y_m, heading, speed_mps = setting.cast.poses[0, 0].tolist()
        lane = setting.lanes(0)[0]
        if lane is None:
            raise UserError(
                f"moment of {printable(setting.moment.vehicle)} at {setting.moment.time_s:g} s in "
                f"scene {printable(setting.moment.scene)}: it is on no lane; import the recording "
                "again"
            )
        ego = kind(
            None,
            (x_m, y_m),
            heading,
            speed_mps,
            lane,
            speed_mps,
            np.array(self.recording.speeds_mps),
            setting.plan(0, 0),
        )
        size = setting.track.length_m, setting.track.width_m
        ego.LENGTH, ego.WIDTH = size
        ego.diagonal, ego.kind = float(np.hypot(*size)), setting.track.kind
        ego.lane_index = lane
        ego.road = self.road
        ego.on_state_update()
        return ego

    def branch(self) -> "Recorded":
        """Return a copy that goes on by itself."""
        new = copy(self)
        new.road = self.road.branch()
        new.controlled_vehicles = [new.road.ego]
        new.action_type = copy(self.action_type)
        new.action_type.env = new
        return new

    def _reward(self, action: Any) -> float:
        return float(not self.vehicle.crashed)

    def _is_terminated(self) -> bool:
        return bool(self.vehicle.crashed)

    def _is_truncated(self) -> bool:
        return bool(self.time >= self.limit_s)


def joined(setting: Setting, lanes: Sequence[Lane]) -> list[tuple[str, str]]:
    """Return the streets of lanes in the order in which they are taken, with those in between."""
    streets = [lane[:2] for lane in lanes]
    whole = streets[:1]
    for before, after in pairwise(streets):
        nodes = setting.ground.network.shortest_path(before[1], after[0])
        whole += [*pairwise(nodes or [before[1]]), after]
    return whole
