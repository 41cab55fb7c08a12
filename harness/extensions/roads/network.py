"""Lay out the road around a moment of a recording as a road network of highway-env.

Lanes that lie side by side are one street; streets that lead on to each other share a node. Here y
is mirrored: recordings have it to the north, and the harness to the south.
"""

import logging
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import RoadNetwork

from harness.core.arrays import Floats
from harness.extensions.roads.scene import Lane as Recorded
from harness.extensions.roads.scene import Scene
from harness.world.road import Lane

# It warns in each frame of who is off the route, as vehicles on recorded maps often are.
logging.getLogger("highway_env.road.road").setLevel(logging.ERROR)

MIRROR = np.array([1.0, -1.0])  # from the frame of recordings to the harness's
LIMIT_MPS = 20.0  # of a lane whose limit is not stated: highway-env's own
SPACING_M = 2.0  # at most between two points of a lane
SHORTEST_M = 2.0  # of a lane that the window's edge cuts
# A pose is on a lane if it is at most so far beside its edge, and turned by no more than that.
BESIDE_M, TURN_RAD = 0.5, np.pi / 3
# Costs of a drive from one lane to another, in m^2 of offsets: to a neighbour, and to any other.
CHANGE, LEAP = 1.0, 100.0


class Line(AbstractLane):  # type: ignore[misc]
    """Describe a lane of highway-env by points along its middle, as fast as arrays are.

    Before its first point and beyond its last it goes straight on.
    """

    def __init__(
        self,
        points: Floats,
        width_m: float,
        line_types: tuple[int, int],
        limit_mps: float = LIMIT_MPS,
    ) -> None:
        steps = np.diff(points, axis=0)
        lengths = np.hypot(*steps.T)
        self.points, self.width, self.line_types = points, width_m, line_types
        self.forbidden, self.priority, self.speed_limit = False, 0, limit_mps
        self.arc_m = np.concatenate([[0.0], lengths.cumsum()])
        self.length = float(self.arc_m[-1])
        self._ways = steps / lengths[:, None]
        turned = np.unwrap(np.arctan2(*self._ways.T[::-1]))
        # at each point that between its two sides, so that headings change steadily
        inner = (turned[1:] + turned[:-1]) / 2
        self._headings = np.concatenate([turned[:1], inner, turned[-1:]])
        # as plain numbers, which are read one at a time: where each side begins, and where it leads
        self._arcs = self.arc_m.tolist()
        self._sides = list(zip(points.tolist(), self._ways.tolist(), strict=False))
        self._columns = points[:-1].T.copy(), self._ways.T.copy()
        self._least = np.concatenate([[-np.inf], np.zeros(len(steps) - 1)])
        self._most = np.concatenate([lengths[:-1], [np.inf]])
        # the place that was asked for last, and what it was: one is asked for several times a frame
        self._asked: tuple[tuple[float, float], tuple[float, float]] = (np.nan, np.nan), (0.0, 0.0)

    def position(self, longitudinal: float, lateral: float) -> Floats:
        n = min(max(bisect_left(self._arcs, longitudinal) - 1, 0), len(self._sides) - 1)
        (x, y), (east, south) = self._sides[n]
        along = longitudinal - self._arcs[n]
        return np.array(
            [x + along * east - lateral * south, y + along * south + lateral * east], dtype=float
        )

    def heading_at(self, longitudinal: float) -> float:
        return float(np.interp(longitudinal, self.arc_m, self._headings))

    def width_at(self, longitudinal: float) -> float:
        return self.width

    def local_coordinates(self, position: Floats) -> tuple[float, float]:
        place = float(position[0]), float(position[1])
        if self._asked[0] != place:
            (begin_x, begin_y), (east, south) = self._columns
            x, y = place[0] - begin_x, place[1] - begin_y
            along = np.minimum(np.maximum(x * east + y * south, self._least), self._most)
            n = int(((x - along * east) ** 2 + (y - along * south) ** 2).argmin())
            lateral = y[n] * east[n] - x[n] * south[n]
            self._asked = place, (float(self.arc_m[n] + along[n]), float(lateral))
        return self._asked[1]

    def places(self, positions: Floats) -> tuple[Floats, Floats]:
        """Return how far along the lane and to its right n positions (n, 2) are, each (n,) m."""
        x, y = (positions[:, None] - self.points[:-1]).transpose(2, 0, 1)
        ways = self._ways.T
        along = np.minimum(np.maximum(x * ways[0] + y * ways[1], self._least), self._most)
        lateral = y * ways[0] - x * ways[1]
        away = (x - along * ways[0]) ** 2 + (y - along * ways[1]) ** 2
        rows, nearest = np.arange(len(positions)), away.argmin(axis=1)
        return self.arc_m[nearest] + along[rows, nearest], lateral[rows, nearest]


@dataclass(frozen=True)
class Street:
    """Name a street of a map: its lanes from left to right, and the nodes that it joins."""

    lanes: tuple[str, ...]  # ids of the recording
    nodes: tuple[int, ...]  # numbers of the nodes where it begins, ends and, rarely, is divided


@lru_cache(maxsize=8)
def streets(scene: Scene) -> tuple[Street, ...]:
    """Return the streets of a scene's map, in the order of their first lanes there."""
    rows = list(_rows(scene.lanes))
    place = {lane: n for n, row in enumerate(rows) for lane in row}
    # The begin of street n is 2 n, and its end 2 n + 1; ends that meet have one root.
    roots = list(range(2 * len(rows)))

    def root(end: int) -> int:
        while roots[end] != end:
            roots[end] = roots[roots[end]]
            end = roots[end]
        return end

    for n, row in enumerate(rows):
        for lane in row:
            for successor in scene.lanes[lane].successors:
                after = place.get(successor, n)
                if after != n:
                    first, second = sorted((root(2 * n + 1), root(2 * after)))
                    roots[second] = first
    joined = []
    taken: set[tuple[int, ...]] = set()
    for n, row in enumerate(rows):
        nodes: tuple[int, ...] = root(2 * n), root(2 * n + 1)
        if nodes in taken or nodes[0] == nodes[1]:
            # for highway-env two streets between the same nodes are one
            nodes = nodes[0], 2 * len(rows) + n, nodes[1]
        taken.add(nodes)
        joined.append(Street(row, nodes))
    return tuple(joined)


def _rows(lanes: Mapping[str, Recorded]) -> Iterator[tuple[str, ...]]:
    """Yield the lanes that lie side by side, from left to right."""
    seen: set[str] = set()

    def beside(name: str, side: str) -> Iterator[str]:
        other = getattr(lanes[name], side)
        while other in lanes and other not in seen:
            seen.add(other)
            yield other
            other = getattr(lanes[other], side)

    for name in lanes:
        if name not in seen:
            seen.add(name)
            left = list(beside(name, "left"))
            yield (*reversed(left), name, *beside(name, "right"))


@dataclass(frozen=True, eq=False)
class Ground:
    """Hold the roads within a window of a scene: highway-env's network, and which lane is which."""

    network: Any  # highway-env's `RoadNetwork`
    lanes: Mapping[Lane, Line]  # by highway-env's index
    after: Mapping[Lane, set[Lane]]  # the lanes that a vehicle may be on after each

    def matched(self, poses: Floats) -> list[Lane | None]:
        """Return the lane of each of n poses of one road user, None where it is on none.

        Poses (n, >=3) are in the harness's frame, in the order of time. Where lanes lie above each
        other, as in a junction, that is taken to which the others lead.
        """
        on_lane = self._offsets(poses)
        costs: dict[Lane | None, float] = {None: 0.0}
        steps: list[dict[Lane | None, Lane | None]] = []
        for offsets in on_lane:
            here: dict[Lane | None, float] = {}
            step: dict[Lane | None, Lane | None] = {}
            for lane, offset in (offsets or {None: 0.0}).items():
                before = min(costs, key=lambda each: costs[each] + self._cost(each, lane))
                here[lane] = costs[before] + self._cost(before, lane) + offset**2
                step[lane] = before
            costs = here
            steps.append(step)
        lane = min(costs, key=lambda each: costs[each])
        lanes = []
        for step in reversed(steps):
            lanes.append(lane)
            lane = step[lane]
        return lanes[::-1]

    def _cost(self, lane: Lane | None, following: Lane | None) -> float:
        if lane is None or following is None or lane == following or following in self.after[lane]:
            return 0.0
        return CHANGE if lane[:2] == following[:2] else LEAP

    def _offsets(self, poses: Floats) -> list[dict[Lane | None, float]]:
        """Return the offset from each lane that each of n poses may be on, m."""
        offsets: list[dict[Lane | None, float]] = [{} for _ in poses]
        for index, lane in self.lanes.items():
            along, lateral = lane.places(poses[:, :2])
            headings = np.interp(along, lane.arc_m, lane._headings)
            inside = np.abs(lateral) <= lane.width / 2 + BESIDE_M
            inside &= (along >= 0) & (along <= lane.length)
            inside &= np.cos(headings - poses[:, 2]) > np.cos(TURN_RAD)
            for n in np.flatnonzero(inside).tolist():
                offsets[n][index] = float(lateral[n])
        return offsets


def ground(scene: Scene, middle_m: Floats, window_m: float) -> Ground:
    """Return the roads of a scene within `window_m` m of a point, in the harness's frame.

    `middle_m` (2,) is the point, in that frame.
    """
    network = RoadNetwork()
    lanes: dict[Lane, Line] = {}
    of_lane: dict[str, list[Lane]] = {}
    names: dict[int, str] = {}
    for street in streets(scene):
        lines = [_points(scene.lanes[name]) for name in street.lanes]
        inside = _inside(lines, middle_m, window_m)
        if inside is None:
            continue
        nodes = [names.setdefault(node, f"n{len(names) + 1}") for node in street.nodes]
        shares = np.linspace(*inside, len(nodes)).tolist()
        for n, (name, line) in enumerate(zip(street.lanes, lines, strict=True)):
            recorded = scene.lanes[name]
            limit_mps, marks = recorded.limit_mps or LIMIT_MPS, _marks(n, len(lines))
            for ends, part in zip(pairwise(nodes), pairwise(shares), strict=True):
                lane = Line(_cut(line, *part), recorded.width_m, marks, limit_mps)
                network.add_lane(*ends, lane)
                lanes[*ends, n] = lane
                of_lane.setdefault(name, []).append((*ends, n))
    after: dict[Lane, set[Lane]] = {lane: set() for lane in lanes}
    for name, parts in of_lane.items():
        for lane_index, following in pairwise(parts):
            after[lane_index].add(following)
        successors = [of_lane[each] for each in scene.lanes[name].successors if each in of_lane]
        after[parts[-1]].update(each[0] for each in successors)
    return Ground(network, lanes, after)


def _marks(number: int, lanes: int) -> tuple[int, int]:
    """Return the lines to the left and right of a lane; one between two lanes is of the right."""
    left = LineType.STRIPED if number else LineType.CONTINUOUS_LINE
    return left, LineType.NONE if number < lanes - 1 else LineType.CONTINUOUS_LINE


@lru_cache(maxsize=4096)
def _points(lane: Recorded) -> Floats:
    """Return points along the middle of a lane, at most `SPACING_M` apart, in the harness's frame.

    (n, 2) m; shared, do not write to it.
    """
    points = lane.points * MIRROR
    apart = np.hypot(*np.diff(points, axis=0).T)
    points = points[np.concatenate([[True], apart > 1e-6])]
    arc = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    even = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / SPACING_M)) + 1)
    return np.stack([np.interp(even, arc, along) for along in points.T], axis=-1)


def _inside(
    lines: Sequence[Floats], middle_m: Floats, window_m: float
) -> tuple[float, float] | None:
    """Return the shares of a street's length between which it lies in the window; None if not."""
    begins, ends = [], []
    for line in lines:
        near = np.flatnonzero(np.hypot(*(line - middle_m).T) <= window_m)
        if near.size:
            begins.append(near[0] / (len(line) - 1))
            ends.append(near[-1] / (len(line) - 1))
    return (min(begins), max(ends)) if begins else None


def _cut(line: Floats, begin: float, end: float) -> Floats:
    """Return the points of a lane between two shares of its length, both ends among them."""
    arc = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    first, last = begin * arc[-1], end * arc[-1]
    if last - first < SHORTEST_M:
        first, last = max(0.0, last - SHORTEST_M), min(arc[-1], first + SHORTEST_M)
    inner = arc[(arc > first + 1e-6) & (arc < last - 1e-6)]
    at = np.concatenate([[first], inner, [last]])
    return np.stack([np.interp(at, arc, along) for along in line.T], axis=-1)
