"""One scene of traffic: who moved there, on which lanes, among which buildings, as sources have it.

x is to the east, y to the north and headings run counter-clockwise from +x; positions are vehicles'
centres. Worlds mirror them, and nothing else does. What cannot be is refused (`checked`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.world.state import separation_m

KINDS = ("car", "van", "truck", "bicycle", "motorcycle", "pedestrian")
STILL_M = 0.5  # what moves less than this in all its time stands
# Of one scene; what is beyond these is no traffic of one place.
MOST_ROWS, MOST_TRACKS, MOST_LANES, MOST_HOUSES = 10_000_000, 50_000, 100_000, 100_000
MOST_POINTS = 5_000_000  # of all its lanes
CELL_M, MOST_OF_CELL = 100.0, 1000  # lanes that begin in one square: what roads are made of
LONGEST_S, LONGEST_ALL_S = 1e6, 3e6  # from its begin to its end, and of all its road users together
FARTHEST_M = 1e8  # of a coordinate: maps have them in metres from an equator and a meridian
LENGTHS_M, WIDTHS_M = (0.1, 60.0), (0.1, 10.0)  # of road users
FASTEST_MPS = 120.0
LANE_WIDTHS_M = (0.5, 50.0)
LONGEST_ID = 200  # characters
# By how much the median of a track's speeds, m/s and of what it moves at, and of its headings, rad,
# may differ from its movement: far more than sensors err, and less than other units do.
SPEED_SLACK_MPS, SPEED_SLACK, HEADING_SLACK = 1.0, 0.25, np.pi / 3
BASE_S, BASE_M = 1.0, 2.0  # time between positions that are compared, and least way for a course
SLACK_M = 0.3  # by which road users may overlap: sensors err by so much
EARLY_S = 1e-6  # sums of steps miss a time by rounding


def _spread(poses: Floats) -> Floats:
    """Return how far x and y reach over n poses (n, >=2), m, (2,)."""
    return np.asarray(np.ptp(poses[:, :2], axis=0))


@dataclass(frozen=True, eq=False)
class Track:
    """Hold one road user over time: n poses of its centre, at rising times.

    Nothing is known outside its time, and in between poses are linear.
    """

    id: str
    kind: str  # one of `KINDS`
    length_m: float
    width_m: float
    time_s: Floats  # (n,), rising
    poses: Floats  # (n, 4): x_m, y_m, heading_rad, speed_mps

    @property
    def begin_s(self) -> float:
        return float(self.time_s[0])

    @property
    def end_s(self) -> float:
        return float(self.time_s[-1])

    @cached_property
    def still(self) -> bool:
        """Return whether it moves less than half a metre in all, as a parked car does."""
        return bool(np.hypot(*_spread(self.poses)) < STILL_M)

    def at(self, time_s: float) -> Floats | None:
        """Return x_m, y_m, heading_rad and speed_mps at a time, (4,); None outside its time.

        Between two poses the heading turns the short way.
        """
        times = self.time_s
        if not times[0] - EARLY_S <= time_s <= times[-1] + EARLY_S:
            return None
        after = int(np.searchsorted(times, time_s, side="right"))
        if after == 0 or after == len(times):
            return np.array(self.poses[min(after, len(times) - 1)])
        before = after - 1
        share = (time_s - times[before]) / (times[after] - times[before])
        step = self.poses[after] - self.poses[before]
        step[2] = (step[2] + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(self.poses[before] + share * step)


@dataclass(frozen=True, eq=False)
class Lane:
    """Hold one lane: its centre line from begin to end, and what lies beside and after it."""

    id: str
    points: Floats  # (n, 2) m
    width_m: float
    limit_mps: float | None  # speed limit; None where none is stated
    successors: tuple[str, ...]  # ids of the lanes that it leads on to
    left: str | None  # id of the next lane of equal direction, to the left
    right: str | None


@dataclass(frozen=True, eq=False)
class House:
    """Hold what blocks sight and does not move."""

    id: str
    outline: Floats  # (n, 2) m, without the first point again


def step_of(steps_s: Floats) -> float:
    """Return the usual time from one pose to the next, s, without what differences round off."""
    return round(float(np.median(steps_s)), 6)


@dataclass(frozen=True, eq=False)
class Scene:
    """Hold what one source file has: one map, one clock, and who moved there."""

    name: str
    file: str  # name of the source file
    sha256: str  # its hex digest
    lights: bool  # whether traffic lights stand there
    tracks: Mapping[str, Track]
    lanes: Mapping[str, Lane]
    houses: tuple[House, ...] = ()
    # how many things a reader left out, by the reason; no table keeps it
    left_out: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def step_s(self) -> float:
        """Return the usual time from one pose of a mover to the next, s; 1 if none has two."""
        times = [track.time_s for track in self.tracks.values() if not track.still]
        steps = [np.diff(each) for each in times]
        steps_s = np.concatenate([*steps, np.empty(0)])
        return step_of(steps_s) if len(steps_s) else 1.0

    @property
    def begin_s(self) -> float:
        return min(track.begin_s for track in self.tracks.values())

    @property
    def end_s(self) -> float:
        return max(track.end_s for track in self.tracks.values())


def checked(scene: Scene) -> None:
    """Raise UserError, which names the scene and the first thing in it that cannot be.

    Such are positions that are no numbers, times that run back, road users of an unknown kind or
    of no size, two in one place as one of them appears, lanes without length, or too much.
    """
    where = f"scene {printable(scene.name, 60)} of {printable(scene.file, 60)}"
    problem = next(_problems(scene), None)
    if problem:
        raise UserError(f"{where}: {problem}; correct the file, or leave it out")


def _problems(scene: Scene) -> Iterator[str]:
    yield from _problems_of_numbers(scene)
    for track in scene.tracks.values():
        yield from _problems_of_track(track)
    if not 0.001 <= scene.step_s <= 10:
        yield f"a step of {scene.step_s:g} s; allowed: 0.001 to 10"
    for lane in scene.lanes.values():
        yield from _problems_of_lane(lane, scene.lanes)
    for house in scene.houses:
        yield from _problems_of_id(f"building {printable(house.id)}", house.id)
        if len(house.outline) < 3 or not _is_place(house.outline):
            yield f"building {printable(house.id)} has no outline of three points or more"
    for late, early in overlaps(list(scene.tracks.values())):
        yield (
            f"{printable(late.id)} appears at {late.begin_s:g} s "
            f"where {printable(early.id)} is already"
        )


def _problems_of_numbers(scene: Scene) -> Iterator[str]:
    if not scene.tracks:
        left_out = ", ".join(printable(reason, 80) for reason in list(scene.left_out)[:3])
        others = f"; left out: {left_out}; kinds: {', '.join(KINDS)}" if left_out else ""
        yield f"nobody moves or stands there{others or '; it needs a track'}"
    if not scene.lanes:
        yield "it has no lanes; give a map"
    rows = sum(len(track.time_s) for track in scene.tracks.values())
    points = sum(len(lane.points) for lane in scene.lanes.values())
    for amount, most, what in (
        (len(scene.tracks), MOST_TRACKS, "tracks"),
        (rows, MOST_ROWS, "poses"),
        (len(scene.lanes), MOST_LANES, "lanes"),
        (points, MOST_POINTS, "points of lanes"),
        (len(scene.houses), MOST_HOUSES, "buildings"),
    ):
        if amount > most:
            yield f"{amount} {what}; allowed: at most {most}: cut it"
    yield from _problems_of_density(scene)


def _problems_of_density(scene: Scene) -> Iterator[str]:
    """Yield what makes a scene that no machine simulates: times far apart, or a heap of lanes."""
    spans = [track.time_s[[0, -1]] for track in scene.tracks.values() if len(track.time_s)]
    ends = np.array(spans).reshape(-1, 2)
    if np.isfinite(ends).all() and len(ends):
        begin_s, end_s = float(ends.min()), float(ends.max())
        all_s = float(np.ptp(ends, axis=1).sum())
        if end_s - begin_s > LONGEST_S:
            yield (
                f"its times are from {begin_s:.10g} to {end_s:.10g} s; allowed: {LONGEST_S:g} s "
                "in all: mend a time that is unknown, or cut it into scenes"
            )
        elif all_s > LONGEST_ALL_S:
            yield f"{all_s:g} s of road users; allowed: {LONGEST_ALL_S:g}: cut it"
    begins = np.array([lane.points[0] for lane in scene.lanes.values() if len(lane.points)])
    if len(begins) > MOST_OF_CELL and _is_place(begins):
        _, counts = np.unique(np.floor(begins / CELL_M), axis=0, return_counts=True)
        if counts.max() > MOST_OF_CELL:
            yield (
                f"{counts.max()} lanes begin in a square of {CELL_M:g} m; allowed: "
                f"{MOST_OF_CELL}: leave out what are no lanes"
            )


def _is_place(points: Floats) -> bool:
    """Return whether points (n, 2) are finite, and no farther than maps have them."""
    return bool((np.abs(points) <= FARTHEST_M).all())


def _problems_of_id(which: str, text: str) -> Iterator[str]:
    if not 0 < len(text) <= LONGEST_ID:
        yield f"{which}: its id has {len(text)} characters; allowed: 1 to {LONGEST_ID}"
    if not text.isprintable():
        yield f"{which}: its id has characters that nothing can show"


def _problems_of_track(track: Track) -> Iterator[str]:
    who, times, poses = f"track {printable(track.id)}", track.time_s, track.poses
    yield from _problems_of_id(who, track.id)
    if track.kind not in KINDS:
        yield f"{who}: kind {printable(track.kind)!r}; allowed: {', '.join(KINDS)}"
    sizes = (("length_m", track.length_m, LENGTHS_M), ("width_m", track.width_m, WIDTHS_M))
    for name, value, (least, most) in sizes:
        if not least <= value <= most:
            yield f"{who}: {name} {value:g}; allowed: {least:g} to {most:g}"
    if not len(times) or poses.shape != (len(times), 4):
        yield f"{who} has no poses, or not one for each time"
        return
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        yield f"{who}: a time or pose is no number"
    elif not _is_place(poses[:, :2]):
        yield f"{who} is more than {FARTHEST_M:g} m from the origin"
    if (np.diff(times) <= 0).any():
        back = int(np.flatnonzero(np.diff(times) <= 0)[0])
        yield f"{who}: time does not rise after {times[back]:g} s"
    elif (np.abs(poses[:, 3]) > FASTEST_MPS).any():
        yield f"{who}: a speed is above {FASTEST_MPS:g} m/s"
    else:
        yield from other_movement(track)


def other_movement(track: Track) -> Iterator[str]:
    """Yield which speeds and headings of a track are not those of its movement.

    Each position is compared with that a second later. Poses are finite, and times rise.
    """
    if len(track.time_s) < 2:
        return
    who, times, poses = f"track {printable(track.id)}", track.time_s, track.poses
    beyond = np.abs(poses[:, 2]) > 2 * np.pi + EARLY_S
    if beyond.any():
        yield (
            f"{who}: heading_rad {poses[beyond, 2][0]:g}; allowed: -2 pi to 2 pi; degrees are "
            "COLUMN*0.0174533"
        )
    rows = round(BASE_S * (len(times) - 1) / (times[-1] - times[0]))
    rows = min(max(rows, 1), len(times) - 1)
    length_s = times[rows:] - times[:-rows]
    way = poses[rows:, :2] - poses[:-rows, :2]
    way_m = np.hypot(way[:, 0], way[:, 1])
    speeds = np.abs(poses[:, 3])
    driven_m = np.zeros(len(times))
    np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2, out=driven_m[1:])
    stated_mps = (driven_m[rows:] - driven_m[:-rows]) / length_s
    moved_mps = way_m / length_s
    moved = _middle(moved_mps)
    off_mps = _middle(np.abs(stated_mps - moved_mps))
    if off_mps > SPEED_SLACK_MPS + SPEED_SLACK * moved:
        yield (
            f"{who}: speed_mps {_middle(stated_mps):.3g} where its positions move at "
            f"{moved:.3g} m/s; units are likely others: km/h are COLUMN/3.6"
        )
    middle, is_course = poses[rows // 2 :][: len(way)], way_m > BASE_M
    if is_course.any():
        along = np.arctan2(way[:, 1], way[:, 0]) + np.pi * (middle[:, 3] < 0)
        turn = (along - middle[:, 2] + np.pi) % (2 * np.pi) - np.pi
        off_rad = _middle(np.abs(turn[is_course]))
        if off_rad > HEADING_SLACK:
            yield (
                f"{who}: heading_rad is {off_rad:.3g} rad off the course of its positions; units "
                "are likely others: degrees are COLUMN*0.0174533, counter-clockwise from +x"
            )


def _middle(values: Floats) -> float:
    """Return the median of values, of two middle ones the greater; NumPy's is far slower."""
    return float(np.sort(values)[len(values) // 2])


def _problems_of_lane(lane: Lane, lanes: Mapping[str, Lane]) -> Iterator[str]:
    which = f"lane {printable(lane.id)}"
    yield from _problems_of_id(which, lane.id)
    if len(lane.points) < 2 or not _is_place(lane.points):
        yield f"{which} has no centre line of two points or more"
    elif not (np.diff(lane.points, axis=0) ** 2).sum() > 1e-6:
        yield f"{which} has no length"
    if not LANE_WIDTHS_M[0] <= lane.width_m <= LANE_WIDTHS_M[1]:
        least, most = LANE_WIDTHS_M
        yield f"{which}: width_m {lane.width_m:g}; allowed: {least:g} to {most:g}"
    if lane.limit_mps is not None and not 0 < lane.limit_mps <= FASTEST_MPS:
        yield f"{which}: limit_mps {lane.limit_mps:g}; allowed: above 0 to {FASTEST_MPS:g}"
    beside = [other for other in (lane.left, lane.right) if other is not None]
    for other in (*lane.successors, *beside):
        if other == lane.id:
            yield f"{which} names itself as what is after or beside it"
        elif other not in lanes:
            yield f"{which} names lane {printable(other)}, which is not there"


def overlaps(tracks: Sequence[Track]) -> Iterator[tuple[Track, Track]]:
    """Yield each track that appears where another is at that time, by more than sensors err.

    Only its first moment is looked at. The track that began later comes first.
    """
    if not tracks:
        return
    by_begin = sorted(tracks, key=lambda track: track.begin_s)
    there = _Positions(by_begin)
    sizes = np.array([(track.length_m, track.width_m) for track in by_begin])
    for place, track in enumerate(by_begin):
        others = np.flatnonzero(there.ends_s[:place] >= track.begin_s)
        poses = there.at(others, track.begin_s)
        mine = np.repeat(track.poses[:1, :3], len(others), axis=0)
        my_sizes = np.repeat(sizes[place : place + 1], len(others), axis=0)
        apart_m = separation_m(mine, my_sizes, poses, sizes[others])
        for other in others[apart_m < -SLACK_M]:
            yield track, by_begin[other]


class _Positions:
    """Look many tracks up at one time, which `Track.at` does for one."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.begins_s = np.array([track.begin_s for track in tracks])
        self.ends_s = np.array([track.end_s for track in tracks])
        stops = np.cumsum([len(track.time_s) for track in tracks], dtype=np.int64)
        self.stops, self.starts = stops, np.append(0, stops[:-1])
        self.poses = np.concatenate([track.poses[:, :3] for track in tracks])
        # Times of one track after those of another, so that one search has its rows.
        span_s = self.ends_s.max(initial=0) - self.begins_s.min(initial=0) + 1
        self.shifts_s = np.arange(len(tracks)) * span_s
        times = [track.time_s for track in tracks]
        self.times_s = np.concatenate(times) + np.repeat(self.shifts_s, stops - self.starts)

    def at(self, which: Ints, time_s: float) -> Floats:
        """Return x_m, y_m and heading_rad at a time, (n, 3), of n tracks that are there then."""
        times_s = self.shifts_s[which] + time_s
        after = np.searchsorted(self.times_s, times_s, side="right")
        after = after.clip(self.starts[which], self.stops[which] - 1)
        before = (after - 1).clip(self.starts[which])
        length_s = self.times_s[after] - self.times_s[before]
        share = (times_s - self.times_s[before]) / np.where(length_s > 0, length_s, 1)
        step = self.poses[after] - self.poses[before]
        step[:, 2] = (step[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(self.poses[before] + share.clip(0, 1)[:, None] * step)
