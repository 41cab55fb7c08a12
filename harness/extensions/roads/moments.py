"""Choose the moments of recorded traffic at which episodes begin, by a rule that can be stated.

Most of traffic decides nothing: cars follow each other. A moment is *decisive* if somebody whom the
ego cannot see comes into conflict with it soon. As many moments without such a conflict are chosen,
by a draw that no order of files moves, and whatever is left out is counted by its reason.

A conflict is an encroachment with a post-encroachment time of at most `SHORT_PET_S` (sources:
`harness.world.conflict_measures`): one road user is where the other was so short a time before.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from msgspec import structs

from harness.core.arrays import Bools, Floats, Ints
from harness.core.seeds import FIRST
from harness.extensions.roads.scene import BASE_M, HEADING_SLACK, STILL_M, Scene, Track
from harness.extensions.roads.sessions import APART, FEW, SHARED, Sessions, Traffic, digest_of
from harness.extensions.roads.tables import Moment
from harness.world.conflict_measures import MOMENTS_HZ, SHORT_PET_S
from harness.world.state import separation_m

EGOS = ("car", "van", "truck", "motorcycle")  # kinds that may be the ego
OPAQUE = ("car", "van", "truck")  # kinds that nobody sees through
EVERY_S = 1.0  # from one candidate of a vehicle to the next
APART_S = 5.0  # least time from one moment of a vehicle to the next
AROUND_S = np.arange(1 - APART_S, APART_S, EVERY_S).tolist()  # of times that are nearer
HARD_MPS2 = 4.0  # mean deceleration over a second that is hard braking, as metrics have it
ALIKE_RAD = math.pi / 4  # headings that differ by less are of one direction
CALM = 20  # most moments of a purpose in which nobody hidden comes into conflict
EVERY = round(EVERY_S * MOMENTS_HZ)  # frames from one candidate to the next
# By how much a speed may differ from its movement, m/s and of what it moves at, within so many
# frames of a moment: twice by how much one of SUMO's does, that of a truck that turns.
SPEED_SLACK_MPS, SPEED_SLACK, HELD = 2.0, 0.1, MOMENTS_HZ
BESIDE = 3  # frames from a pose to those between which it moves
NEVER = np.iinfo(np.int64).max  # a frame that does not come
LAYERS = 64  # stretches of time in which those who come near each other are looked for at once
STRETCHES = 2000  # pairs of road users whose places are compared at once, all of a stretch
LOOSE_M = 0.001  # more than the places of stretches are rounded off by
TRIPLES = 4000  # pairs of road users whose paths are compared at once

LIGHTS = "its scene has a traffic light"
STILL = "it stands still"
LEAVES = "it leaves the recording within the horizon"
OFF_LANE = "it is on no lane"
STRAYS = "it, or who is hidden, has another speed or heading there than it moves with"
NEAR = "another moment of it is too near in time"
GAP = "it is in a gap between two purposes"
NOT_REACHED = "its recorded driver does not reach the goal"  # of who looks for it, and drops it
TWICE = "its scene is there twice"
NO_CONFLICT = "no moment of its scene is decisive"
NOT_DRAWN = "it was not drawn"


Key = tuple[str, str, float]  # scene, vehicle and time of a moment


def key_of(moment: Moment) -> Key:
    """Return what tells a moment from all others of a recording."""
    return moment.scene, moment.vehicle, moment.time_s


@dataclass(frozen=True)
class Choice:
    """Hold the chosen moments, those of one purpose together, and how they were chosen.

    Of each purpose, every other moment is decisive, and all are in the order of a draw: so any
    number of them from the first is a fair part.
    """

    rule: str  # what was done, in words
    moments: tuple[Moment, ...]
    candidates: int  # how many there were: seconds of motor vehicles
    left_out: Mapping[str, int]  # how many of these were not taken, by the reason
    shared: int = 0  # how many scenes share traffic with another

    @property
    def record(self) -> dict[str, Any]:
        """Return what a recording states of the choice."""
        counts = {"candidates": self.candidates, "left_out": dict(self.left_out)}
        return {"rule": self.rule, **counts, "shared": self.shared}


@dataclass(frozen=True)
class _Fit:
    """A candidate that is left after all that its own scene says."""

    draw: str  # digest of the candidate, which orders the draw
    scene: str
    moment: Moment  # without its purpose


@dataclass
class Chooser:
    """Choose moments of scenes that come one after the other; none of them is kept.

    Attributes:
        window_m: radius around the ego in which others count, m.
        horizon_s: length of an episode, s.
        gap_s: greatest post-encroachment time of a conflict, s.
        most: how many moments of a purpose are chosen; None for all that can be.
        by_file: whether the draw goes by the digest that scenes state of their files, else by how
            each candidate drives.
    """

    window_m: float
    horizon_s: float
    gap_s: float = SHORT_PET_S
    most: int | None = None
    by_file: bool = False
    candidates: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    _fit: list[_Fit] = field(default_factory=list)
    _traffic: dict[str, Traffic] = field(default_factory=dict)  # by the name of the scene

    def look(self, scene: Scene) -> None:
        """Count a scene's candidates, and note those at which an episode may begin."""
        traffic = self._traffic[scene.name] = Traffic.of(scene)
        frames = _Frames.of(scene)
        egos = np.array([track.kind in EGOS for track in frames.tracks], dtype=bool)
        rows = np.flatnonzero((frames.frame % EVERY == 0) & egos[frames.track])
        self.candidates += len(rows)
        if scene.lights:
            self.left_out[LIGHTS] += len(rows)
            return
        horizon = round(self.horizon_s * MOMENTS_HZ)
        rows = self._without(rows, frames.leaves(rows, horizon), LEAVES)
        rows = self._without(rows, frames.stands(rows, horizon), STILL)
        rows = self._without(rows, ~_on_lane(scene, frames.poses[rows]), OFF_LANE)
        rows = self._without(rows, frames.strays[rows], STRAYS)
        gap = round(self.gap_s * MOMENTS_HZ)
        conflicts = _hidden_conflicts(scene, frames, rows, self.window_m, horizon, gap)
        fit = []
        for row in rows.tolist():
            track = frames.tracks[int(frames.track[row])]
            hidden, conflict_s = conflicts.get(row, (None, None))
            if hidden is not None and frames.strays_at(hidden, int(frames.frame[row])):
                self.left_out[STRAYS] += 1
                continue
            moment = Moment(
                scene.name, track.id, float(frames.frame[row] / MOMENTS_HZ), hidden, conflict_s, ""
            )
            if self.by_file:
                draw = _digest(scene.sha256, track.id, f"{moment.time_s:.3f}")
            else:
                draw = _draw(track, moment.time_s) + traffic.content
            fit.append(_Fit(draw, scene.name, moment))
        self._fit += self._apart(fit)

    def drop(self, keys: Container[Key], reason: str) -> None:
        """Leave out, for a reason, moments that nothing else speaks against, by their keys."""
        kept = [each for each in self._fit if key_of(each.moment) not in keys]
        self.left_out[reason] += len(self._fit) - len(kept)
        self._fit = kept

    @property
    def moments(self) -> list[Moment]:
        """Return the moments at which an episode may begin, in the order of the draw."""
        return [each.moment for each in sorted(self._fit, key=lambda each: each.draw)]

    def choice(self) -> Choice:
        """Deal what is left to the purposes, and draw as many moments with a conflict as without.

        What is not taken is counted by its reason.
        """
        left_out = Counter(self.left_out)
        sessions = Sessions.of(self._traffic)
        decisive = {each.scene for each in self._fit if each.moment.hidden is not None}
        by_purpose: dict[str, list[_Fit]] = {purpose: [] for purpose in FIRST}
        calm: dict[str, list[_Fit]] = {purpose: [] for purpose in FIRST}
        for candidate in self._fit:
            scene, time_s = candidate.scene, candidate.moment.time_s
            purpose = sessions.purpose(scene, time_s, self.horizon_s)
            if sessions.first[scene] != scene:
                left_out[TWICE] += 1
            elif purpose is None:
                left_out[GAP] += 1
            else:
                (by_purpose if scene in decisive else calm)[purpose].append(candidate)
        moments: list[Moment] = []
        for purpose, dealt in by_purpose.items():
            drawn = self._drawn(dealt)
            left_out[NOT_DRAWN] += len(dealt) - len(drawn)
            spare = sorted(calm[purpose], key=lambda each: each.draw)
            taken = [] if drawn else spare[: min(CALM, self.most or CALM)]
            left_out[NO_CONFLICT] += len(spare) - len(taken)
            drawn += taken
            moments += [structs.replace(each.moment, purpose=purpose) for each in drawn]
        counts = {reason: count for reason, count in sorted(left_out.items()) if count}
        return Choice(self.rule(sessions), tuple(moments), self.candidates, counts, sessions.shared)

    def rule(self, sessions: Sessions) -> str:
        """Return the rule in words, as it is for a recording of these sessions."""
        dealt = (
            "By the digest of what moves in it each scene is for report (half of all digests), "
            "tune or train (a quarter each)"
        )
        if len(sessions.contents) <= FEW:
            dealt = (
                "Each scene is cut in three by time, for tune, train and report, with gaps of "
                f"{APART * self.horizon_s:g} s, so that no second is in two; one that is too short "
                "is for report"
            )
        dealt += f"; scenes with more than 1 in {SHARED} places in common are dealt as one."
        most = "" if self.most is None else f", at most {self.most} of a purpose"
        return (
            f"Candidates: each whole second of a motor vehicle that is recorded for "
            f"{self.horizon_s:g} s more, moves {STILL_M:g} m or more in these, and is on a lane, "
            f"in scenes without traffic lights; two of one vehicle are {APART_S:g} s apart. One is "
            "decisive if a road user whom the ego does not see (no line from its centre to the "
            "other's centre or corners is free of buildings, cars, vans and trucks), at most "
            f"{self.window_m:g} m away, comes into conflict with it in these {self.horizon_s:g} s: "
            f"by their recorded paths, one is where the other was at most {self.gap_s:g} s before. "
            "Who follows the other, driving in its direction over the place where it is now, is in "
            "no conflict, unless the ego follows so near and the other slows down by "
            f"{HARD_MPS2:g} m/s within a second. As many with such a conflict are drawn as "
            f"without, by digest{most}; a purpose that has none with one takes up to {CALM} of "
            f"scenes without any. {dealt}"
        )

    def _without(self, rows: Ints, falls: Bools, reason: str) -> Ints:
        """Return the candidates that do not fall for a reason, and count those that do."""
        self.left_out[reason] += int(falls.sum())
        return rows[~falls]

    def _apart(self, fit: Sequence[_Fit]) -> list[_Fit]:
        """Return candidates of which no two of a vehicle are nearer than `APART_S`.

        Decisive ones go first, and then the draw decides.
        """
        order = sorted(fit, key=lambda each: (each.moment.hidden is None, each.draw))
        near: dict[str, set[float]] = {}  # seconds of a vehicle that are too near to one's taken
        apart = []
        for candidate in order:
            time_s = candidate.moment.time_s
            of_vehicle = near.setdefault(candidate.moment.vehicle, set())
            if time_s not in of_vehicle:
                of_vehicle.update(time_s + each for each in AROUND_S)
                apart.append(candidate)
        self.left_out[NEAR] += len(fit) - len(apart)
        return apart

    def _drawn(self, dealt: Sequence[_Fit]) -> list[_Fit]:
        """Return as many candidates with a hidden conflict as without, in turn, as drawn."""
        order = sorted(dealt, key=lambda each: each.draw)
        decisive = [each for each in order if each.moment.hidden is not None]
        others = [each for each in order if each.moment.hidden is None]
        drawn: list[_Fit] = []
        for pair in zip(decisive, others, strict=False):
            drawn += pair
        return drawn[: self.most]


def _draw(track: Track, time_s: float) -> str:
    """Return what orders a moment of a track, whatever it and its file are called.

    Whoever is far away does not move it, either.
    """
    driven = digest_of(track, track.begin_s).hex()
    return _digest(driven, f"{time_s - track.begin_s:.3f}")


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


@dataclass(frozen=True)
class _Frames:
    """All tracks of a scene at frames, `MOMENTS_HZ` a second, one track after the other: P rows.

    Frames are counted from second 0 of the scene's clock. Tracks are in the order of their ids.
    """

    tracks: Sequence[Track]
    first: Ints  # each track's first frame, (N,)
    last: Ints  # and its last
    start: Ints  # row of its first frame
    track: Ints  # of each row, the place of its track, (P,)
    frame: Ints  # and its frame
    poses: Floats  # x_m, y_m, heading_rad, speed_mps, (P, 4)

    @classmethod
    def of(cls, scene: Scene) -> "_Frames":
        tracks, first, last, parts = list[Track](), list[int](), list[int](), list[Floats]()
        for key in sorted(scene.tracks):
            track = scene.tracks[key]
            begin = math.ceil(track.begin_s * MOMENTS_HZ - 1e-6)
            end = math.floor(track.end_s * MOMENTS_HZ + 1e-6)
            if begin > end:
                continue
            times_s = np.arange(begin, end + 1) / MOMENTS_HZ
            unwrapped = np.array(track.poses)
            unwrapped[:, 2] = np.unwrap(unwrapped[:, 2])
            columns = [np.interp(times_s, track.time_s, column) for column in unwrapped.T]
            tracks.append(track)
            first.append(begin)
            last.append(end)
            parts.append(np.stack(columns, axis=-1))
        counts = np.array([len(part) for part in parts], dtype=np.int64)
        start = np.cumsum(counts) - counts
        place = np.repeat(np.arange(len(tracks)), counts)
        begins = np.array(first, dtype=np.int64)
        frame = np.arange(int(counts.sum())) - start[place] + begins[place]
        poses = np.concatenate(parts) if parts else np.empty((0, 4))
        return cls(tracks, begins, np.array(last, dtype=np.int64), start, place, frame, poses)

    @cached_property
    def sizes_m(self) -> Floats:
        """Return each track's length and width, (N, 2)."""
        sizes = [(track.length_m, track.width_m) for track in self.tracks]
        return np.array(sizes, dtype=float).reshape(-1, 2)

    def rows(self, track: Ints, frame: Ints) -> Ints:
        """Return the rows of tracks at frames; of a track that is gone, its last."""
        return self.start[track] + np.minimum(frame, self.last[track]) - self.first[track]

    def leaves(self, rows: Ints, horizon: int) -> Bools:
        """Return whether the tracks of rows end before so many more frames."""
        return np.asarray(self.frame[rows] + horizon > self.last[self.track[rows]])

    def stands(self, rows: Ints, horizon: int) -> Bools:
        """Return whether the tracks of rows get no farther than `STILL_M` in so many frames."""
        farthest_m = np.zeros(len(rows))
        for later in range(EVERY, horizon + EVERY, EVERY):
            there = rows + min(later, horizon)
            way = self.poses[there, :2] - self.poses[rows, :2]
            farthest_m = np.maximum(farthest_m, np.hypot(way[:, 0], way[:, 1]))
        return farthest_m < STILL_M

    @cached_property
    def strays(self) -> Bools:
        """Return near which rows a speed or heading is not that of the movement there, (P,)."""
        before, after = self._beside(BESIDE)
        way = self.poses[after, :2] - self.poses[before, :2]
        way_m = np.hypot(way[:, 0], way[:, 1])
        moved_mps = way_m / np.maximum(after - before, 1) * MOMENTS_HZ
        speed_mps, heading = self.poses[:, 3], self.poses[:, 2]
        off_mps = np.abs(np.abs(speed_mps) - moved_mps)
        course = np.arctan2(way[:, 1], way[:, 0]) + np.pi * (speed_mps < 0)
        off = off_mps > SPEED_SLACK_MPS + SPEED_SLACK * moved_mps
        off |= (way_m > BASE_M) & (_turn_rad(course, heading) > HEADING_SLACK)
        before, after = self._beside(HELD)
        many = np.append(0, np.cumsum(off & (self.first[self.track] < self.last[self.track])))
        return np.asarray(many[after + 1] > many[before])

    def _beside(self, frames: int) -> tuple[Ints, Ints]:
        """Return the rows of each one's track so many frames before and after, or its ends."""
        rows, start = np.arange(len(self.frame)), self.start[self.track]
        end = start + self.last[self.track] - self.first[self.track]
        return np.maximum(rows - frames, start), np.minimum(rows + frames, end)

    def strays_at(self, track_id: str, frame: int) -> bool:
        """Return `strays` of somebody who is there in a frame."""
        track = self.numbers[track_id]
        return bool(self.strays[self.start[track] + frame - self.first[track]])

    @cached_property
    def numbers(self) -> dict[str, int]:
        return {track.id: number for number, track in enumerate(self.tracks)}

    def brakings(self, track: int) -> Ints:
        """Return the frames at which a track begins to slow down by `HARD_MPS2` in a second."""
        start, count = self.start[track], self.last[track] - self.first[track] + 1
        speeds = self.poses[start : start + count, 3]
        drops = speeds[:-MOMENTS_HZ] - speeds[MOMENTS_HZ:]
        return np.asarray(np.flatnonzero(drops >= HARD_MPS2) + self.first[track])


def _on_lane(scene: Scene, poses: Floats) -> Bools:
    """Return whether vehicles (n, >=3) are on a lane and drive in its direction, (n,)."""
    lanes = list(scene.lanes.values())
    lines = np.array([shapely.LineString(lane.points) for lane in lanes])
    half_m = np.array([lane.width_m / 2 for lane in lanes])
    points = shapely.points(poses[:, :2])
    which, lane = shapely.STRtree(lines).query(points, "dwithin", float(half_m.max(initial=0.0)))
    near = shapely.distance(points[which], lines[lane]) <= half_m[lane]
    which, lane = which[near], lane[near]
    along_m = shapely.line_locate_point(lines[lane], points[which])
    # a negative place would be counted from the end
    before_m = np.maximum(along_m - 0.5, 0.0)
    behind = shapely.get_coordinates(shapely.line_interpolate_point(lines[lane], before_m))
    ahead = shapely.get_coordinates(shapely.line_interpolate_point(lines[lane], along_m + 0.5))
    way = ahead - behind
    turned = _turn_rad(np.arctan2(way[:, 1], way[:, 0]), poses[which, 2])
    on_lane = np.zeros(len(poses), dtype=bool)
    on_lane[which[turned < ALIKE_RAD]] = True
    return on_lane


def _turn_rad(one: Floats, other: Floats) -> Floats:
    """Return the angle between headings, from 0 to pi."""
    return np.asarray(np.abs((one - other + np.pi) % (2 * np.pi) - np.pi))


Pairs = dict[tuple[int, int], tuple[Ints, Ints]]


def _encroachments(frames: _Frames, counts: Bools, gap: int) -> Pairs:
    """Return where one track is where another was at most `gap` frames before.

    The key is the first and the second track, of which one `counts` at least, (N,). The value is
    each frame at which the first was there, rising, and the earliest frame at which the second is
    where the first was then or later.
    """
    reach_m = np.hypot(frames.sizes_m[:, 0], frames.sizes_m[:, 1]) / 2
    stretches = _Stretches.of(frames, max(gap, EVERY), reach_m)
    parts = [np.empty((0, 4), dtype=np.int64)]
    for first, second in stretches.near():
        one, other = stretches.track[first], stretches.track[second]
        may = (one != other) & (counts[one] | counts[other])
        first, second = first[may], second[may]
        for start in range(0, len(first), STRETCHES):
            part = slice(start, start + STRETCHES)
            parts.append(_meetings(frames, stretches, first[part], second[part], gap, reach_m))
    return dict(_by_pair(np.concatenate(parts)))


@dataclass(frozen=True)
class _Stretches:
    """All tracks cut into stretches of so many frames, in the order of time: S of them."""

    length: int  # frames of a whole one; a track's first and last may be shorter
    number: Ints  # of each: of its first frame, if it is whole, by the length, (S,)
    track: Ints  # whose it is, (S,)
    low_m: Floats  # least x and y of outlines in it, (S, 2)
    high_m: Floats  # and greatest

    @classmethod
    def of(cls, frames: _Frames, length: int, reach_m: Floats) -> "_Stretches":
        """Cut tracks whose outlines reach so far from their centres, (N,) m."""
        number = frames.frame // length
        changes = (np.diff(number) != 0) | (np.diff(frames.track) != 0)
        begins = np.concatenate([[0], np.flatnonzero(changes) + 1])
        around_m = reach_m[frames.track[begins], None]
        low_m = np.minimum.reduceat(frames.poses[:, :2], begins) - around_m
        high_m = np.maximum.reduceat(frames.poses[:, :2], begins) + around_m
        order = np.argsort(number[begins], kind="stable")
        begins = begins[order]
        return cls(length, number[begins], frames.track[begins], low_m[order], high_m[order])

    def near(self) -> Iterator[tuple[Ints, Ints]]:
        """Yield pairs of stretches that overlap: of one number, or the second of the next."""
        span_m = float(np.ptp([self.low_m[:, 0].min(), self.high_m[:, 0].max()])) + 1
        for begin in np.unique(self.number // LAYERS) * LAYERS:
            bounds = np.searchsorted(self.number, (begin, begin + LAYERS, begin + LAYERS + 1))
            firsts, laters = np.arange(*bounds[:2]), np.arange(bounds[0], bounds[2])
            boxes = self._boxes(firsts, begin, span_m)
            for lag in (0, 1):
                tree = shapely.STRtree(self._boxes(laters, begin + lag, span_m))
                first, second = tree.query(boxes)
                yield firsts[first], laters[second]

    def _boxes(self, which: Ints, begin: int, span_m: float) -> Any:
        """Return boxes (n,) of stretches, beside each other so that only those of one number meet.

        `begin` is the number of those that stay where they are.
        """
        aside_m = (self.number[which] - begin) * span_m - self.low_m[:, 0].min()
        (west, south), (east, north) = self.low_m[which].T, self.high_m[which].T
        return shapely.box(west + aside_m - LOOSE_M, south, east + aside_m + LOOSE_M, north)


def _meetings(
    frames: _Frames, stretches: _Stretches, first: Ints, second: Ints, gap: int, reach_m: Floats
) -> Ints:
    """Return where tracks of pairs of stretches are one place within `gap` frames, (m, 4).

    Rows have the first and the second track, and the frame in which each is there.
    """
    every = np.arange(stretches.length)
    one, other = stretches.track[first], stretches.track[second]
    here = stretches.number[first, None, None] * stretches.length + every[:, None]
    there = stretches.number[second, None, None] * stretches.length + every
    both = (here <= there) & (there <= here + gap)
    both &= _is_there(frames, one[:, None, None], here)
    both &= _is_there(frames, other[:, None, None], there)
    pair, a, b = both.nonzero()
    one, other = one[pair], other[pair]
    here, there = here[pair, a, 0], there[pair, 0, b]
    one_rows, other_rows = frames.rows(one, here), frames.rows(other, there)
    way_m = frames.poses[one_rows, :2] - frames.poses[other_rows, :2]
    near = np.sqrt((way_m**2).sum(axis=1)) <= reach_m[one] + reach_m[other]
    events = np.stack([one, other, here, there], axis=-1)[near]
    apart_m = separation_m(
        frames.poses[one_rows[near], :3],
        frames.sizes_m[events[:, 0]],
        frames.poses[other_rows[near], :3],
        frames.sizes_m[events[:, 1]],
    )
    return np.asarray(events[apart_m <= 0])


def _is_there(frames: _Frames, track: Ints, frame: Ints) -> Bools:
    return np.asarray((frames.first[track] <= frame) & (frame <= frames.last[track]))


def _by_pair(events: Ints) -> Iterator[tuple[tuple[int, int], tuple[Ints, Ints]]]:
    """Yield the entries of `_encroachments` from rows of first, second and both their frames."""
    if not len(events):
        return
    events = events[np.lexsort(events.T[::-1])]
    changes = np.flatnonzero((np.diff(events[:, :2], axis=0) != 0).any(axis=1)) + 1
    for part in np.split(events, changes):
        earliest = np.minimum.accumulate(part[::-1, 3])[::-1]
        yield (int(part[0, 0]), int(part[0, 1])), (part[:, 2], earliest)


@dataclass(frozen=True)
class _Meetings:
    """Conflicts, n of them: of candidates with others, by what is recorded."""

    row: Ints  # row of the candidate, (n,)
    other: Ints  # track of the other, (n,)
    arrival: Ints  # frame at which the second of both comes to a place where the first was, (n,)

    def those(self, which: Bools) -> "_Meetings":
        return _Meetings(self.row[which], self.other[which], self.arrival[which])


def conflicts_at(
    scene: Scene, moments: Sequence[Moment], window_m: float, horizon_s: float
) -> list[tuple[str | None, float | None]]:
    """Return for moments of a scene who is hidden, and after how many seconds both meet, or None.

    Their vehicles must be there then.
    """
    frames = _Frames.of(scene)
    track = np.array([frames.numbers[moment.vehicle] for moment in moments], dtype=np.int64)
    frame = np.array([round(moment.time_s * MOMENTS_HZ) for moment in moments], dtype=np.int64)
    rows = frames.rows(track, frame)
    horizon, gap = round(horizon_s * MOMENTS_HZ), round(SHORT_PET_S * MOMENTS_HZ)
    conflicts = _hidden_conflicts(scene, frames, rows, window_m, horizon, gap)
    return [conflicts.get(row, (None, None)) for row in rows.tolist()]


def _hidden_conflicts(
    scene: Scene, frames: _Frames, rows: Ints, window_m: float, horizon: int, gap: int
) -> dict[int, tuple[str, float]]:
    """Return for rows that are decisive who is hidden, and after how many seconds both meet.

    Of several the first to meet is taken.
    """
    if not len(rows):
        return {}
    meetings = _conflicts(frames, rows, window_m, horizon, gap)
    meetings = meetings.those(~_visible(scene, frames, meetings))
    first_of: dict[int, tuple[str, float]] = {}
    for place in np.lexsort((meetings.other, meetings.arrival)).tolist():
        row = int(meetings.row[place])
        wait_s = float((meetings.arrival[place] - frames.frame[row]) / MOMENTS_HZ)
        first_of.setdefault(row, (frames.tracks[int(meetings.other[place])].id, wait_s))
    return first_of


def _conflicts(frames: _Frames, rows: Ints, window_m: float, horizon: int, gap: int) -> _Meetings:
    """Return all conflicts of candidates within so many frames, of which none only follows."""
    counts = np.zeros(len(frames.tracks), dtype=bool)
    counts[frames.track[rows]] = True
    pairs = _encroachments(frames, counts, gap)
    of_track: dict[int, Ints] = {}
    for track in np.unique(frames.track[rows]).tolist():
        of_track[track] = rows[frames.track[rows] == track]
    nobody = np.empty(0, dtype=np.int64)
    parts: list[Ints] = []
    for (first, second), (frame, arrival) in pairs.items():
        for ego, other in ((first, second), (second, first)):
            ego_rows = of_track.get(ego, nobody)
            now = frames.frame[ego_rows]
            meets = np.append(arrival, NEVER)[np.searchsorted(frame, now)]
            meet = (frames.first[other] <= now) & (now <= frames.last[other])
            meet &= meets <= now + horizon
            rows_here = ego_rows[meet]
            columns = [np.full(len(rows_here), track) for track in (other, first, second)]
            parts.append(np.stack([rows_here, *columns, meets[meet]], axis=-1))
    if not parts:
        return _Meetings(nobody, nobody, nobody)
    triples = np.concatenate(parts)
    their_rows = frames.rows(triples[:, 1], frames.frame[triples[:, 0]])
    way = frames.poses[triples[:, 0], :2] - frames.poses[their_rows, :2]
    triples = triples[np.hypot(way[:, 0], way[:, 1]) <= window_m]
    follows = np.zeros(len(triples), dtype=bool)
    for start in range(0, len(triples), TRIPLES):
        part = triples[start : start + TRIPLES]
        follows[start : start + TRIPLES] = _follows(frames, part, horizon)
    for number in np.flatnonzero(follows).tolist():
        meets_later = _meets_braking(frames, pairs, triples[number], horizon)
        if meets_later is not None:
            triples[number, 4] = meets_later
            follows[number] = False
    triples = triples[~follows]
    return _Meetings(triples[:, 0], triples[:, 1], triples[:, 4])


def _follows(frames: _Frames, triples: Ints, horizon: int) -> Bools:
    """Return whether the second of both drives over the place where the first is now, (n,).

    It counts if both drive in one direction there. `triples` have the candidate's row, the other's
    track, and the first's and the second's track, (n, >=4).
    """
    now = frames.frame[triples[:, 0]]
    first, second = triples[:, 2], triples[:, 3]
    leader = np.repeat(frames.poses[frames.rows(first, now), :3], horizon + 1, axis=0)
    later = now[:, None] + np.arange(horizon + 1)
    rows = frames.rows(np.repeat(second, horizon + 1), later.ravel())
    follower = frames.poses[rows, :3]
    apart_m = separation_m(
        leader,
        np.repeat(frames.sizes_m[first], horizon + 1, axis=0),
        follower,
        np.repeat(frames.sizes_m[second], horizon + 1, axis=0),
    )
    over = (apart_m <= 0) & (_turn_rad(leader[:, 2], follower[:, 2]) < ALIKE_RAD)
    return np.asarray(over.reshape(len(triples), -1).any(axis=1))


def _meets_braking(frames: _Frames, pairs: Pairs, triple: Ints, horizon: int) -> int | None:
    """Return when somebody whom the ego follows begins to brake hard; None if not in time.

    The ego must be near behind in the second before: as near as in a conflict.
    """
    row, other, first, second, _ = triple.tolist()
    if other != first:
        return None
    now = int(frames.frame[row])
    frame, _ = pairs[first, second]
    for braking in frames.brakings(other).tolist():
        if now <= braking <= now + horizon - MOMENTS_HZ:
            near = (max(now, braking - MOMENTS_HZ) <= frame) & (frame <= braking)
            if near.any():
                return int(braking)
    return None


def _visible(scene: Scene, frames: _Frames, meetings: _Meetings) -> Bools:
    """Return whether the ego of each conflict sees the other at its beginning, (n,).

    It sees it if a straight line from its centre to the other's centre or one of its corners meets
    no building, and no vehicle of `OPAQUE` kinds beside both.
    """
    visible = np.zeros(len(meetings.row), dtype=bool)
    if not len(visible):
        return visible
    houses = [shapely.make_valid(shapely.Polygon(house.outline)) for house in scene.houses]
    walls = shapely.STRtree(houses)
    is_opaque = np.array([track.kind in OPAQUE for track in frames.tracks])
    now = frames.frame[meetings.row]
    for frame in np.unique(now).tolist():
        here = np.flatnonzero(now == frame)
        there = (frames.first <= frame) & (frame <= frames.last) & is_opaque
        blockers = np.flatnonzero(there)
        rows = frames.rows(blockers, np.full(len(blockers), frame))
        outlines = shapely.polygons(_corners(frames.poses[rows], frames.sizes_m[blockers]))
        egos, others = frames.track[meetings.row[here]], meetings.other[here]
        target = frames.poses[frames.rows(others, np.full(len(others), frame))]
        corners = _corners(target, frames.sizes_m[others])
        ends = np.concatenate([target[:, None, :2], corners], axis=1)
        starts = np.broadcast_to(frames.poses[meetings.row[here], None, :2], ends.shape)
        lines = shapely.linestrings(np.stack([starts, ends], axis=2).reshape(-1, 2, 2))
        blocked = np.zeros(len(lines), dtype=bool)
        blocked[walls.query(lines, "intersects")[0]] = True
        line, blocker = shapely.STRtree(outlines).query(lines, "intersects")
        of_line, who = line // ends.shape[1], blockers[blocker]
        blocked[line[(who != egos[of_line]) & (who != others[of_line])]] = True
        visible[here] = ~blocked.reshape(len(here), -1).all(axis=1)
    return visible


def _corners(poses: Floats, sizes_m: Floats) -> Floats:
    """Return the corners of outlines, (n, 4, 2) m, of poses (n, >=3) and sizes (n, 2)."""
    half = sizes_m[:, None, :] / 2 * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x_m = poses[:, 0, None] + half[..., 0] * cos - half[..., 1] * sin
    y_m = poses[:, 1, None] + half[..., 0] * sin + half[..., 1] * cos
    return np.stack([x_m, y_m], axis=-1)
