"""Replay the road users of a recording, or let them react to who is off it.

Who replays is where the recording says, whatever happens. Who reacts follows the recorded path and
is never ahead of the recorded self. As long as nobody is off the recording, both are the same.

A road user that reacts brakes by the Intelligent Driver Model of Treiber, Hennecke and Helbing
(2000, Congested traffic states in empirical observations and microscopic simulations, Physical
Review E 62, 1805-1824), with the parameters of its table I, for whoever is off the recording and
stands with its outline on the path ahead, be it in front or across. Of the model's interaction that
part counts which goes beyond the recording's own: who followed closely there does so here. Who is
late minds everybody, and goes on at the speeds that were recorded around its place until it is
where the recording has it. Nobody brakes harder for others than `HARDEST_MPS2`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from highway_env.vehicle.kinematics import Vehicle

from harness.core.arrays import Bools, Floats, Ints
from harness.extensions.roads.scene import Track
from harness.world.state import separation_m

# Treiber and others 2000, table I
STANDOFF_M = 2.0  # jam distance s0
HEADWAY_S = 1.6  # safe time headway T
GAIN_MPS2 = 0.73  # maximum acceleration a
COMFORT_MPS2 = 1.67  # desired deceleration b
EXPONENT = 4  # acceleration exponent delta
HARDEST_MPS2 = 8.0  # braking of a car on a dry road, as of the harness's own cars

ACCEPTED = 16.0  # at most: an interaction of the recording, of a gap a quarter of the desired one
TOUCHING_M = 0.01  # a gap is at least this, so that interactions are finite
SPACING_M = 1.0  # between two places of a path at which an outline is looked for
AHEAD_S = 4.0  # paths go on so long after the last frame, so that its road users look ahead
OFF_M = 0.01  # who is farther than this from the recording is off it
CREEP_MPS = 0.1  # recorded places of who stands tremble by so much
AROUND_S = 1.5  # a late one goes at the greatest speed recorded within this time of its place,
LEAST_MPS = 3.0  # and at least at this one
LAMPS_S = 0.5  # over which brake lamps look at recorded speeds, which tremble
SWEEPS = 4  # places between two frames at which outlines are compared


@dataclass(frozen=True, eq=False)
class Cast:
    """Hold who is recorded around a moment: N road users in F frames from it on, the ego first.

    Arrays are in the harness's frame, and NaN where a road user is not recorded.
    """

    hz: int  # frames a second
    tracks: tuple[Track, ...]
    poses: Floats  # x, y, heading and speed, (N, F, 4)
    enters: Ints  # frame in which each is first there, (N,)
    leaves: Ints  # last frame in which each is there, (N,)
    # interactions of the recording by road user, whom it minds, and frame
    kept: dict[tuple[int, int, int], float] = field(default_factory=dict, repr=False)

    @cached_property
    def sizes_m(self) -> Floats:
        """Return the length and width of each road user, (N, 2) m."""
        return np.array([(track.length_m, track.width_m) for track in self.tracks])

    @cached_property
    def reach_m(self) -> Floats:
        """Return the distance of each one's corners from its centre, (N,) m."""
        return np.asarray(np.hypot(*self.sizes_m.T) / 2)

    @cached_property
    def moves(self) -> Bools:
        """Return who moves at all, (N,)."""
        return np.array([not track.still for track in self.tracks])

    @cached_property
    def arc_m(self) -> Floats:
        """Return how far each has gone on its own path in each frame, (N, F) m; it never falls."""
        steps = np.diff(self.poses[..., :2], axis=1)
        way = self.poses[:, :-1, 2]
        forward = steps[..., 0] * np.cos(way) + steps[..., 1] * np.sin(way)
        forward = np.where(forward * self.hz < CREEP_MPS, 0.0, np.hypot(*np.moveaxis(steps, -1, 0)))
        gone = np.nan_to_num(forward).cumsum(axis=1)
        return np.concatenate([np.zeros((len(gone), 1)), gone], axis=1)

    @cached_property
    def speeds_mps(self) -> Floats:
        """Return the speed with which each reaches its place in each frame, (N, F) m/s."""
        steps = np.diff(self.arc_m, axis=1) * self.hz
        speeds = np.concatenate([steps[:, :1], steps], axis=1)
        for row, frames in zip(speeds, self._frames, strict=True):
            row[: frames[0] + 1] = row[min(frames[0] + 1, frames[-1])]
            row[frames[-1] :] = row[frames[-1]]
        return speeds

    @cached_property
    def usual_mps(self) -> Floats:
        """Return the greatest speed that each has around each frame, (N, F) m/s."""
        around = round(AROUND_S * self.hz)
        padded = np.pad(self.speeds_mps, ((0, 0), (around, around)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * around + 1, axis=1)
        return np.asarray(np.maximum(windows.max(axis=-1), LEAST_MPS))

    @cached_property
    def braking(self) -> Bools:
        """Return whose brake lamps are on in each frame, (N, F)."""
        before = round(LAMPS_S * self.hz)
        speeds = np.pad(self.poses[..., 3], ((0, 0), (before, 0)), mode="edge")
        change = (speeds[:, before:] - speeds[:, :-before]) / LAMPS_S
        return np.asarray(np.nan_to_num(change) < -1.0)

    @cached_property
    def paths(self) -> "Paths":
        """Return places along the paths of all, `SPACING_M` apart; of who does not move, one."""
        arcs, poses = [], []
        for n, frames in enumerate(self._frames):
            most_m = self.arc_m[n, frames[-1]] if self.moves[n] else 0.0
            even = np.arange(0.0, most_m + SPACING_M, SPACING_M).clip(max=most_m)
            at = np.interp(even, *self._rises[n])
            columns = self.poses[n, frames, :3].T
            arcs.append(even)
            poses.append(np.stack([np.interp(at, frames, each) for each in columns], axis=-1))
        sizes = [len(each) for each in arcs]
        owners = np.repeat(np.arange(len(arcs)), sizes)
        begins = np.concatenate([[0], np.cumsum(sizes)])
        return Paths(np.concatenate(arcs), np.concatenate(poses), owners, begins)

    def frame_at(self, n: int, arc_m: float) -> float:
        """Return the frame, with its fraction, in which one has gone so far on its path."""
        return float(np.interp(arc_m, *self._rises[n]))

    def pose_at(self, n: int, frame: float) -> Floats:
        """Return the pose of one in a frame with a fraction, (4,)."""
        last = int(self._frames[n][-1])
        before = min(int(frame), last)
        after, share = min(before + 1, last), frame - before
        return np.asarray((1 - share) * self.poses[n, before] + share * self.poses[n, after])

    @cached_property
    def _frames(self) -> list[Ints]:
        """Return the frames in which each is recorded."""
        return [np.flatnonzero(~np.isnan(poses[:, 0])) for poses in self.poses]

    @cached_property
    def _rises(self) -> list[tuple[Floats, Ints]]:
        """Return the places of each one's path at which it moves on, and the frames then."""
        rises = []
        for n, frames in enumerate(self._frames):
            arcs = self.arc_m[n, frames]
            moves = np.concatenate([[True], np.diff(arcs) > 0])
            rises.append((arcs[moves], frames[moves]))
        return rises

    def interactions(self, owners: Ints, whom: Ints, frame: int) -> Floats:
        """Return the interactions of some road users with others in a frame of the recording, (k,).

        It is 0 with who is not ahead.
        """
        keys = list(zip(owners.tolist(), whom.tolist(), [frame] * len(owners), strict=True))
        if missing := [key for key in keys if key not in self.kept]:
            self.kept.update(dict.fromkeys(missing, 0.0))
            poses, arc_m = self.poses[:, frame], self.arc_m[:, frame]
            first, other, _ = np.array(missing).T
            here = ~np.isnan(poses[first, 0]) & ~np.isnan(poses[other, 0])
            first, other, speeds = first[here], other[here], self.speeds_mps[:, frame]
            looks_m = STANDOFF_M + speeds * AHEAD_S
            places = [self.paths.ahead(n[None], arc_m, looks_m) for n in first]
            at = np.concatenate([np.empty(0, dtype=int), *places])
            whose = np.repeat(other, [len(each) for each in places])
            n, k, gaps, along = self.contacts(at, whose, arc_m, poses)
            values = interaction(speeds[n], poses[k, 3] * along, gaps)
            for key in zip(n.tolist(), k.tolist(), values.tolist(), strict=True):
                self.kept[*key[:2], frame] = min(key[2], ACCEPTED)
        return np.array([self.kept[key] for key in keys])

    def contacts(
        self, at: Ints, whom: Ints, arc_m: Floats, poses: Floats
    ) -> tuple[Ints, Ints, Floats, Floats]:
        """Return who touches whom when it goes on along its path, and how far it may go until then.

        Args:
            at: places of paths, (p,).
            whom: for each of these, the number of another who may be there, (p,).
            arc_m: how far everybody is on its path, (N,).
            poses: where everybody is, (N, >=3).

        The results, (k,) each, are the numbers of the two, the distance in m, and how much the
        other goes along the path there: 1 if it goes the same way, 0 if across or against it.
        """
        paths = self.paths
        owners, places, there = paths.owners[at], paths.poses[at], poses[whom, :3]
        x, y, way = poses[owners, :3].T
        front = (there[:, 0] - x) * np.cos(way) + (there[:, 1] - y) * np.sin(way)
        reach_m = self.reach_m[owners] + self.reach_m[whom] + SPACING_M
        apart = (places[:, 0] - there[:, 0]) ** 2 + (places[:, 1] - there[:, 1]) ** 2
        kept = np.flatnonzero((front > 0) & (apart < reach_m**2) & (owners != whom))
        if not kept.size:
            return kept, kept, np.empty(0), np.empty(0)
        kept = kept[np.lexsort((at[kept], whom[kept], owners[kept]))]
        at, whom, owners = at[kept], whom[kept], owners[kept]
        apart_m = separation_m(places[kept], self.sizes_m[owners], there[kept], self.sizes_m[whom])
        touch = np.flatnonzero(apart_m < 0)
        pair = owners[touch] * len(poses) + whom[touch]
        first = touch[np.flatnonzero(np.diff(pair, prepend=-1))]
        before = np.maximum(first - 1, 0)
        free = (at[before] == at[first] - 1) & (whom[before] == whom[first]) & (first > 0)
        past = np.zeros(len(first))
        np.divide(apart_m[first], apart_m[first] - apart_m[before], out=past, where=free)
        steps = paths.arc_m[at[first]] - paths.arc_m[at[before]]
        gaps = paths.arc_m[at[first]] - past * steps - arc_m[owners[first]]
        turned = there[kept][first, 2] - places[kept][first, 2]
        along = np.maximum(np.cos(turned), 0.0)
        return owners[first], whom[first], np.maximum(gaps, 0.0), along


@dataclass(frozen=True, eq=False)
class Paths:
    """Hold places along the paths of N road users, those of one together and in order, (p,) all."""

    arc_m: Floats  # how far along its path
    poses: Floats  # x, y and heading there, (p, 3)
    owners: Ints  # whose path it is
    begins: Ints  # the first place of each, and the number of all, (N + 1,)

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.points(self.poses[:, :2]))

    def near(self, others: Ints, poses: Floats, reach_m: Floats) -> tuple[Ints, Ints]:
        """Return all places near to some others, and the number of the other at each.

        `others` are their numbers, `poses` (N, >=3) where everybody is, and `reach_m` (N,) how far
        from each counts, m.
        """
        x, y, far_m = poses[others, 0], poses[others, 1], reach_m[others]
        boxes = shapely.box(x - far_m, y - far_m, x + far_m, y + far_m)
        whom, at = self._tree.query(boxes)
        return at, others[whom]

    def ahead(self, owners: Ints, arc_m: Floats, looks_m: Floats) -> Ints:
        """Return the places ahead of some road users, whose numbers are `owners`.

        `arc_m` and `looks_m` (N,) are how far everybody is on its path, and how far it looks.
        """
        places = [np.empty(0, dtype=int)]
        for owner in owners.tolist():
            begin, end = self.begins[owner], self.begins[owner + 1]
            arcs = self.arc_m[begin:end]
            first = begin + arcs.searchsorted(arc_m[owner] - SPACING_M)
            last = begin + arcs.searchsorted(arc_m[owner] + looks_m[owner])
            places.append(np.arange(first, min(last + 1, end)))
        return np.concatenate(places)

    def reached(self, at: Ints, others: Ints, poses: Floats, reach_m: Floats) -> Bools:
        """Return at which of p places which of k others may be touched, (p, k).

        `others` are their numbers, `poses` (N, >=3) where everybody is, and `reach_m` (k,) the
        distances from their centres within which that is so, m.
        """
        x = self.poses[at, :1] - poses[others, 0]
        y = self.poses[at, 1:2] - poses[others, 1]
        return np.asarray(x * x + y * y < reach_m**2)


def interaction(speed_mps: Floats, ahead_mps: Floats, gap_m: Floats) -> Floats:
    """Return the IDM's interactions: the squares of the desired gaps by the gaps, (k,).

    `speed_mps` are the speeds of who goes, `ahead_mps` those of who is ahead.
    """
    closing = speed_mps * (speed_mps - ahead_mps) / (2 * np.sqrt(GAIN_MPS2 * COMFORT_MPS2))
    desired_m = STANDOFF_M + np.maximum(speed_mps * HEADWAY_S + closing, 0.0)
    return np.asarray((desired_m / np.maximum(gap_m, TOUCHING_M)) ** 2)


class Puppet(Vehicle):  # type: ignore[misc]
    """Show a recorded road user as a vehicle of highway-env: it is where `stage.play` has it."""

    def __init__(self, stage: Any, number: int, track: Track) -> None:
        self.stage, self.number = stage, number
        self.track, self.kind = track, track.kind
        super().__init__(None, (0.0, 0.0))  # with a road it would search all lanes
        self.road = stage
        self.LENGTH, self.WIDTH = track.length_m, track.width_m
        self.diagonal = float(np.hypot(track.length_m, track.width_m))

    def act(self, action: Any = None) -> None:
        """Take no action: it is moved."""

    def step(self, dt: float) -> None:
        """Stay: it is moved."""

    def _of_play(name: str, of_pose: int | slice | None = None) -> Any:
        """Return a property that is read from the play, and never written to."""

        def value(self: Any) -> Any:
            values = getattr(self.stage.play, name)[self.number]
            return values if of_pose is None else values[of_pose]

        return property(value, lambda self, value: None)

    position = _of_play("poses", slice(0, 2))
    heading, speed = _of_play("poses", 2), _of_play("poses", 3)
    crashed, braking = _of_play("crashed"), _of_play("braking")


@dataclass(eq=False)
class Play:
    """Move the road users of a cast, frame by frame; the ego, number 0, moves by itself.

    Arrays are of N road users. Who is late is off its recording, behind it.
    """

    cast: Cast
    react: bool  # whether they react, or replay whatever happens
    frame: int
    arc_m: Floats  # how far each is on its path
    speed_mps: Floats
    late: Bools
    there: Bools  # who is there
    crashed: Bools
    poses: Floats  # x, y, heading and speed of each, (N, 4)
    braking: Bools
    waits: Bools  # who had no room when it was to enter
    place: Floats  # frame, with its fraction, in which each was recorded where it is

    @classmethod
    def start(cls, cast: Cast, react: bool) -> "Play":
        """Start at the first frame of a cast, where everybody is as recorded."""
        nobody = np.zeros(len(cast.tracks), dtype=bool)
        return cls(
            cast,
            react,
            0,
            cast.arc_m[:, 0].copy(),
            cast.speeds_mps[:, 0].copy(),
            nobody.copy(),
            cast.enters <= 0,
            nobody.copy(),
            cast.poses[:, 0].copy(),
            cast.braking[:, 0].copy(),
            nobody.copy(),
            np.zeros(len(cast.tracks)),
        )

    def branch(self) -> "Play":
        """Return a copy that goes on by itself."""
        return replace(
            self,
            arc_m=self.arc_m.copy(),
            speed_mps=self.speed_mps.copy(),
            late=self.late.copy(),
            there=self.there.copy(),
            crashed=self.crashed.copy(),
            poses=self.poses.copy(),
            braking=self.braking.copy(),
            waits=self.waits.copy(),
        )

    def move(self, ego: Floats) -> None:
        """Move everybody but the ego to the next frame.

        `ego` is where the ego is now: x, y, heading and speed, (4,).
        """
        cast = self.cast
        self.poses[0] = ego
        off = self.off()
        excess = self._excess(off)
        self.frame += 1
        frame = min(self.frame, cast.poses.shape[1] - 1)
        before = self.speed_mps
        recorded, usual = cast.speeds_mps[:, frame], cast.arc_m[:, frame]
        free = np.where(self.late, self._free(), recorded)
        wanted = free - GAIN_MPS2 * excess / cast.hz
        wanted = np.where(self.crashed, 0.0, wanted)
        least = np.maximum(before - HARDEST_MPS2 / cast.hz, 0.0)
        brakes = (wanted < recorded - 1e-9) | self.late | self.crashed
        speed = np.where(brakes, np.maximum(wanted, least), recorded)
        arc = self.arc_m + speed / cast.hz
        late = brakes & cast.moves & (arc < usual) & self.there
        self.late = late
        self.arc_m = np.where(late, arc, usual)
        self.speed_mps = np.where(late, speed, recorded)
        self.braking = np.where(late, (before - speed) * cast.hz > 1.0, cast.braking[:, frame])
        poses = cast.poses[:, frame].copy()
        poses[0] = ego
        self.place = np.full(len(poses), float(frame))
        for n in np.flatnonzero(late).tolist():
            self.place[n] = cast.frame_at(n, float(arc[n]))
            poses[n] = cast.pose_at(n, float(self.place[n]))
            poses[n, 3] = speed[n]
        before_m, self.poses = self.poses, poses
        self._come_and_go(frame, np.flatnonzero(off))
        gone = ~self.there
        self.poses[gone] = before_m[gone]  # who has left stays where it was, for who still looks

    def _free(self) -> Floats:
        """Return the speeds in the next frame of who is late, if nobody were in the way, (N,)."""
        cast, speed = self.cast, self.speed_mps
        usual = cast.usual_mps[np.arange(len(speed)), self.place.astype(int)]
        gained = GAIN_MPS2 * (1 - (speed / usual) ** EXPONENT) / cast.hz
        frame = min(self.frame + 1, cast.poses.shape[1] - 1)
        behind_m = np.maximum(cast.arc_m[:, frame] - self.arc_m, 0.0)
        arrives = cast.speeds_mps[:, frame] + np.sqrt(2 * COMFORT_MPS2 * behind_m)
        return np.asarray(np.minimum(speed + gained, arrives))

    def _excess(self, off: Bools) -> Floats:
        """Return by how much the interaction of each goes beyond the recording's, (N,).

        `off` says who is off the recording, (N,).
        """
        cast = self.cast
        excess = np.zeros(len(self.arc_m))
        minds = self.there & cast.moves & ~self.crashed
        minds[0] = False
        if not self.react or not (off.any() and minds.any()):
            return excess
        looks_m = STANDOFF_M + self.speed_mps * AHEAD_S
        reach_m = cast.reach_m + cast.reach_m.max() + SPACING_M
        at, whom = cast.paths.near(np.flatnonzero(off), self.poses, reach_m)
        if (late := np.flatnonzero(self.late & minds)).size:
            more = cast.paths.ahead(late, self.arc_m, looks_m)
            others = np.flatnonzero(self.there & ~off)
            lines, columns = cast.paths.reached(more, others, self.poses, reach_m[others]).nonzero()
            at = np.concatenate([at, more[lines]])
            whom = np.concatenate([whom, others[columns]])
        owners = cast.paths.owners[at]
        way_m = cast.paths.arc_m[at] - self.arc_m[owners]
        sees = minds[owners] & (way_m >= -SPACING_M) & (way_m <= looks_m[owners])
        n, k, gaps, along = cast.contacts(at[sees], whom[sees], self.arc_m, self.poses)
        if n.size:
            values = interaction(self.speed_mps[n], self.poses[k, 3] * along, gaps)
            frame = min(self.frame, cast.poses.shape[1] - 1)
            np.maximum.at(excess, n, values - cast.interactions(n, k, frame))
        return excess

    def off(self) -> Bools:
        """Return who is off the recording, (N,): late, crashed, or the ego elsewhere."""
        off = self.late | self.crashed
        frame = min(self.frame, self.cast.poses.shape[1] - 1)
        recorded = self.cast.poses[0, frame, :2]
        off[0] = not np.hypot(*(self.poses[0, :2] - recorded)) <= OFF_M
        return np.asarray(off & self.there)

    def _come_and_go(self, frame: int, off: Ints) -> None:
        """Let those leave that are out, and those enter whose time has come, where there is room.

        `frame` is the frame of the cast that begins, and `off` the numbers of who was off the
        recording before it.
        """
        cast = self.cast
        out = self.arc_m >= cast.arc_m[np.arange(len(self.arc_m)), cast.leaves] - 1e-9
        out &= (self.frame > cast.leaves) & ~self.crashed
        out[0] = False
        self.there &= ~out
        due = ~self.there & (cast.enters <= self.frame) & (self.frame <= cast.leaves)
        for n in np.flatnonzero(due).tolist():
            on_time = not self.waits[n]
            at = frame if on_time or not cast.moves[n] else cast.enters[n]
            if self.react and not self._room(n, at, off):
                self.waits[n] = True
                continue
            self.there[n] = True
            self.arc_m[n], self.speed_mps[n] = cast.arc_m[n, at], cast.speeds_mps[n, at]
            self.poses[n] = cast.poses[n, at]
            self.late[n] = at != frame

    def _room(self, n: int, frame: int, others: Ints) -> bool:
        """Return whether one may enter where it is in a frame, for all of some others."""
        cast, pose = self.cast, self.cast.poses[n, frame]
        arc_m, poses = self.arc_m.copy(), self.poses.copy()
        arc_m[n], poses[n] = cast.arc_m[n, frame], pose
        mine = np.broadcast_to(pose[:3], (len(others), 3))
        size = np.broadcast_to(cast.sizes_m[n], (len(others), 2))
        if (separation_m(mine, size, poses[others, :3], cast.sizes_m[others]) < 0).any():
            return False
        at = cast.paths.ahead(np.array([n]), arc_m, np.full(len(poses), np.inf))
        whom = np.tile(others, len(at))
        _, k, gaps, along = cast.contacts(np.repeat(at, len(others)), whom, arc_m, poses)
        stops_m = (pose[3] ** 2 - (poses[k, 3] * along) ** 2) / (2 * HARDEST_MPS2)
        return bool((gaps >= STANDOFF_M + np.maximum(stops_m, 0.0)).all())


def touching(poses: Floats, before: Floats, sizes_m: Floats, pairs: Ints) -> Bools:
    """Return which of P pairs touch at some time since the frame before, (P,).

    `poses` and `before` are x, y and heading of N road users now and then, (N, >=3), `sizes_m`
    their sizes, (N, 2) m, and `pairs` the numbers of two each, (P, 2).
    """
    sizes, its_sizes = sizes_m[pairs[:, 0]], sizes_m[pairs[:, 1]]
    moves = poses[:, :3] - before[:, :3]
    gaps_m = separation_m(poses[pairs[:, 0], :3], sizes, poses[pairs[:, 1], :3], its_sizes)
    touch = np.asarray(gaps_m < 0)
    steps_m = np.hypot(*moves[:, :2].T) + np.abs(moves[:, 2]) * np.hypot(*sizes_m.T) / 2
    # who is farther apart than both have moved cannot have touched
    may = np.flatnonzero((gaps_m >= 0) & (gaps_m <= steps_m[pairs].sum(axis=1)))
    if may.size:
        shares = np.linspace(0, 1, SWEEPS + 1)[1:-1, None, None]
        at = (before[:, :3] + shares * moves)[:, pairs[may]].reshape(-1, 2, 3)
        both = np.tile(may, SWEEPS - 1)
        apart_m = separation_m(at[:, 0], sizes[both], at[:, 1], its_sizes[both])
        touch[may] |= (apart_m.reshape(SWEEPS - 1, -1) < 0).any(axis=0)
    return touch
