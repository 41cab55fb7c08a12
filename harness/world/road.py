"""A road as a set of paths: where vehicles can drive, where paths cross, and what surrounds them.

Frame: metres, x to the east, y to the *south* (highway-env's screen frame),
headings in radians from +x towards +y.
"""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, Literal

import numpy as np
import shapely
from shapely import LineString, intersection

from harness.core.arrays import Floats
from harness.world.fields import Side

PathKey = tuple[str, str]  # approach and route
Lane = tuple[str, str, int]  # highway-env's lane index: two nodes, and a number from the left
STEP_M = 0.25  # distance between the points of a path
STRAIGHT_M = 1e-6  # a path is straight if no point is farther from the line through its first two
ONE_LANE_M = 1.0  # ways nearer to each other than this share a lane
KEPT = 1024  # results of a path's look-ups that stay in memory
BEND_M = 3.0  # distance before and after a point over which its curvature is measured
STRIPED = 1  # highway-env's LineType of a line that may be crossed
NORTH = np.array([1.0, -1.0])  # factors from this frame to that of pictures


@dataclass(frozen=True, eq=False)
class Path:
    """Describe one path along the road, in consecutive sections, each a lane of highway-env.

    An arc length is the distance along the path from its beginning, m.
    """

    approach: str  # where it comes from, such as `left`
    route: str  # what it does, such as `straight`; a vehicle on a route `left` or `right` indicates
    # n evenly spaced points, m to the east and to the south of the road's origin, (n, 2)
    points: Floats
    arc_m: Floats  # arc length of each point, m, (n,)
    # arc lengths at which a section ends and the next begins, m; paths of one approach share the
    # first section
    ends_m: tuple[float, ...]
    roles: tuple[str, ...]  # name of each section in a scene graph
    # highway-env's index of each section's lane: the two nodes of its road, and a number from the
    # left
    lanes: tuple[Lane, ...]
    priority: int  # right of way; the higher one goes first

    @classmethod
    def along(
        cls,
        network: Any,
        approach: str,
        route: str,
        lanes: Sequence[Lane],
        roles: Sequence[str],
        priority: int,
        origin_m: tuple[float, float] = (0.0, 0.0),
        reach_m: float = math.inf,
    ) -> "Path":
        """Build a path along the middle of consecutive lanes of a road network.

        `network` is a `highway_env.road.road.RoadNetwork`, and `lanes` are the lanes' indices in
        it; `approach` says where the path comes from and `route` what it does, `roles` names each
        lane as scene graphs do, and `priority` is the right of way, the higher one first. Only the
        part of a lane within `reach_m` of the origin (`origin_m` in highway-env's frame) counts,
        but at least one point.
        """
        middles = [_within(_middle(network.get_lane(lane), origin_m), reach_m) for lane in lanes]
        corners = np.concatenate(middles)
        arc = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        ends = arc[np.cumsum([len(middle) for middle in middles])[:-1]]
        even = np.linspace(0.0, arc[-1], math.ceil(arc[-1] / STEP_M) + 1)
        points = np.column_stack([np.interp(even, arc, along) for along in corners.T])
        return cls(
            approach,
            route,
            points,
            even,
            tuple(ends.tolist()),
            tuple(roles),
            tuple(lanes),
            priority,
        )

    @cached_property
    def columns(self) -> Floats:
        """Return the coordinates of the path's n points, x in row 0 and y in row 1, (2, n) m.

        Rows are contiguous in memory, which is faster to read.
        """
        return np.ascontiguousarray(self.points.T)

    @cached_property
    def headings_rad(self) -> Floats:
        """Return the path's direction at each of its n points, rad from +x towards +y, (n,)."""
        along = np.gradient(self.points, axis=0)
        heading: Floats = np.arctan2(along[:, 1], along[:, 0])
        return heading

    @cached_property
    def bends(self) -> Floats:
        """Return the path's absolute curvature at each of its n points, 1/m, (n,)."""
        reach = round(BEND_M / float(self.arc_m[1]))
        turned = np.unwrap(self.headings_rad)
        padded = np.pad(turned, reach, mode="edge")
        return np.asarray(np.abs(padded[2 * reach :] - padded[: -2 * reach]) / (2 * BEND_M))

    @cached_property
    def sharpest(self) -> float:
        return float(self.bends.max())

    @cached_property
    def uneven_m(self) -> float:
        """Return how far a point of the path is from its place in an even spacing, at most, m.

        It is along the path. Points count as evenly spaced if their arc lengths are whole multiples
        of the first spacing; then it is 0.
        """
        return float(np.abs(self.arc_m - self.arc_m[1] * np.arange(len(self.arc_m))).max())

    @cached_property
    def kink_rad(self) -> float:
        """Return the largest change of the path's heading (rad) from one point to the next.

        A large one shows that lanes do not join smoothly.
        """
        return float(np.abs(np.diff(np.unwrap(self.headings_rad))).max())

    # Cached, since every viewer of a scene looks at the same vehicles, and branches of a scene
    # share most; by path, so that a road that is let go takes its cache along.
    @cached_property
    def project(self) -> Callable[[float, float], tuple[float, float, float]]:
        """Return the function that projects a position on the path, which keeps its last results.

        It takes m to the east and south of the road's origin, and returns arc length (m), unsigned
        lateral offset (m) and heading. The arc length is the distance along the path from its
        beginning; the heading is that of the path there, rad from +x (east) towards +y (south).
        """
        return lru_cache(maxsize=KEPT)(self._project)

    def _project(self, x_m: float, y_m: float) -> tuple[float, float, float]:
        arc, lateral, heading = self.project_all(np.array([x_m]), np.array([y_m]))[:, 0].tolist()
        return arc, lateral, heading

    def project_all(self, x_m: Floats, y_m: Floats) -> Floats:
        """Project n positions on the path; return arc lengths, offsets and headings, (3, n).

        Arc lengths along the path and unsigned offsets from it are in m, and headings those of the
        path there, rad from +x (east) towards +y (south). `x_m` and `y_m`, (n,), are m to the east
        and south of the road's origin.
        """
        if self._step is None:
            nearest = self._tree.query_nearest(shapely.points(x_m, y_m), all_matches=False)[1]
        else:
            first, step = self.points[0], self._step
            steps = ((x_m - first[0]) * step[0] + (y_m - first[1]) * step[1]) / (step @ step)
            nearest = np.rint(np.clip(steps, 0, len(self.points) - 1)).astype(int)
        # Of equally near points the first counts, whichever the search's rounding takes.
        beside = np.clip(nearest[:, None] + [-1, 0, 1], 0, len(self.points) - 1)
        gaps = np.hypot(
            self.columns[0][beside] - x_m[:, None], self.columns[1][beside] - y_m[:, None]
        )
        at = np.arange(len(nearest)), gaps.argmin(axis=1)
        point, gap = beside[at], gaps[at]
        heading = self.headings_rad[point]
        along = (x_m - self.columns[0][point]) * np.cos(heading)
        along += (y_m - self.columns[1][point]) * np.sin(heading)
        # Python's squares are rounded alike on every machine.
        squares = [max(g**2 - a**2, 0.0) for g, a in zip(gap.tolist(), along.tolist(), strict=True)]
        return np.stack([self.arc_m[point] + along, np.sqrt(squares), heading])

    @cached_property
    def _step(self) -> Floats | None:
        """From one point of a straight path to the next, (2,) m; None of a path that bends."""
        step: Floats = self.points[1] - self.points[0]
        line = self.points[0] + step * np.arange(len(self.points))[:, None]
        return step if np.abs(self.points - line).max() < STRAIGHT_M else None

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.points(self.points))

    @cached_property
    def at(self) -> Callable[[float], tuple[float, float, float]]:
        """Return the function that gives x (m), y (m) and heading (rad) of the path somewhere.

        It takes an arc length, the distance from the path's beginning, m, and keeps its last
        results. x is to the east and y to the south of the road's origin.
        """
        return lru_cache(maxsize=KEPT)(self._at)

    def _at(self, arc_m: float) -> tuple[float, float, float]:
        x, y, heading = self.places(np.array(arc_m))
        return float(x), float(y), float(heading)

    def places(self, arc_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return x (m), y (m) and heading (rad) of the path at arc lengths, each (...).

        `arc_m`, (...), are distances from the path's beginning, m. x is to the east and y to the
        south of the road's origin.
        """
        x, y = (np.interp(arc_m, self.arc_m, along) for along in self.columns)
        return (
            x,
            y,
            self.headings_rad[np.searchsorted(self.arc_m, arc_m).clip(0, len(self.arc_m) - 1)],
        )

    def points_at(self, arc_m: Floats) -> Floats:
        """Return positions on the path at some distances from its beginning, (n, 2) m.

        The distances are `arc_m`, (n,), m; positions are m to the east and south of the road's
        origin.
        """
        return np.stack(self.places(arc_m)[:2], axis=-1)

    def section(self, arc_m: float) -> int:
        return bisect_right(self.ends_m, arc_m)

    def lane_role(self, arc_m: float) -> str:
        return self.roles[self.section(arc_m)]


def _middle(lane: Any, origin_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return points along the middle of a lane of highway-env, its ends included, (n, 2) m."""
    along = np.linspace(0, lane.length, math.ceil(lane.length) + 1)
    middle: Floats = np.array([lane.position(s, 0.0) for s in along]) - origin_m
    return middle


def _within(points: Floats, reach_m: float) -> Floats:
    """Return the points within `reach_m` of the origin, or only the nearest if there are none."""
    away_m = np.hypot(*points.T)
    near: Floats = points[away_m <= max(reach_m, away_m.min())]
    return near


@dataclass(frozen=True)
class Crossing:
    """Describe the point where another path meets the ego's: it crosses it, or merges into it.

    An arc length is the distance along a path from its beginning, m.
    """

    x_m: float  # position, m to the east of the road's origin
    y_m: float  # position, m to the south of it
    ego_arc_m: float  # arc length along the ego's path, m
    other_arc_m: float  # arc length along the other path, m
    # whether the other path crosses, or merges into a lane that the ego takes as well
    kind: Literal["crossing", "merging"] = "crossing"


@dataclass(frozen=True)
class Ground:
    """Hold what rendered pictures show of a road's ground, in m to the east and to the *north*.

    `outlines` are edges of the road's surface, `marks` centre lines and `stops` stop lines, each an
    array of points, (n, 2); `boxes` are areas that labels must avoid, each its south-west and
    north-east corner, (2, 2).
    """

    # edges of the surface, (n, 2) each: the outer one, and those of islands
    outlines: tuple[Floats, ...]
    marks: tuple[Floats, ...]  # centre lines, (n, 2) each
    stops: tuple[Floats, ...]  # stop lines, (n, 2) each
    # south-west and north-east corners (2, 2) of areas that labels must avoid
    boxes: tuple[Floats, ...]


@dataclass(frozen=True)
class Road:
    """Describe a road with all of its paths, and which of its places matter to the ego.

    A path's key is its approach (where it comes from) and its route (what it does). The conflict
    zone is where others may meet the ego. A sector is a direction that danger can come from.
    Positions are in m to the east and south of the origin.
    """

    # description in frozen records: texts, and numbers with their unit in the name
    facts: Mapping[str, str | float]
    paths: Mapping[PathKey, Path]  # every path, by its key
    ego: PathKey  # key of the ego's path
    # points where other paths meet the ego's, at which conflicts are looked for, by the other
    # path's key
    crossings: Mapping[PathKey, Crossing]
    # position of the centroid of the conflict zone; messages are weighted by the distance to it
    zone_m: tuple[float, float]
    # the points, (k, 2) m, that must be seen in each sector, by its name
    sectors: Mapping[str, Floats]
    # returns the road network, a `highway_env.road.road.RoadNetwork`, always the same object, which
    # must not be written to
    network: Callable[[], Any]
    # keys of the paths that the ego reaches by changing lane, from left to right, `ego` among them;
    # they lie side by side and are equally long
    ways: tuple[PathKey, ...] = ()
    # form of the scene graphs: 2 lists every relation to the ego's ways; 1 lists crossings only, as
    # in the frozen dataset `occluded-intersection-v2`
    form: Literal[1, 2] = 2
    origin_m: tuple[float, float] = (0.0, 0.0)  # position of the origin in highway-env's own frame
    # returns, for the scenario's parameters, the distance along the ego's path, m, at which the
    # episode ends; vehicles beyond do not matter. None if the goal is not a place on its path.
    goal_m: Callable[[Any], float] | None = None
    waits: bool = False  # whether the goal is to wait: who drives less reaches it sooner
    # returns the ground for a picture that reaches so many metres, its argument, from the origin;
    # None if it is that of the network's lanes
    ground: Callable[[float], Ground] | None = None

    def ground_within(self, far_m: float) -> Ground:
        """Return what pictures show of the ground: the surface, centre lines and stop lines.

        They are drawn up to `far_m` m from the road's origin on each side.
        """
        return self.ground(far_m) if self.ground else ground(self.network(), far_m, self.origin_m)

    def beside(self, key: PathKey, arc_m: float | None = None) -> dict[Side, PathKey]:
        """Return the keys of the paths to which the ego may change its lane, by side.

        They are of paths side by side: `key` itself as `own`, its `left` and `right`. A side
        without a path is left out. With `arc_m`, a distance along the path `key`, so is one whose
        path shares the lane there. A key is (approach, route).
        """
        if key not in self.ways:
            return {"own": key}
        place = self.ways.index(key)
        places: dict[Side, int] = {"own": place, "left": place - 1, "right": place + 1}
        sides = {side: self.ways[n] for side, n in places.items() if 0 <= n < len(self.ways)}
        if arc_m is None:
            return sides
        x, y, _ = self.paths[key].at(arc_m)
        return {
            side: way
            for side, way in sides.items()
            if side == "own" or self.paths[way].project(x, y)[1] > ONE_LANE_M
        }

    def project(self, keys: Sequence[PathKey], x_m: Floats, y_m: Floats) -> Floats:
        """Project n positions, each on the path of its own key, (3, n).

        Rows of the result are arc lengths along the paths (m), unsigned offsets to the side (m) and
        the paths' headings there (rad). `keys` are n pairs of approach and route; `x_m` and `y_m`,
        (n,), are m to the east and south of the origin.
        """
        projected, places = np.empty((3, len(keys))), defaultdict[PathKey, list[int]](list)
        for n, key in enumerate(keys):
            places[key].append(n)
        for key, some in places.items():
            projected[:, some] = self.paths[key].project_all(x_m[some], y_m[some])
        return projected

    @cached_property
    def forks(self) -> frozenset[tuple[PathKey, int]]:
        """Return the sections whose lane several paths of one approach share.

        Each is a path's key (approach, route) and the section's number from 0 in it. There, only a
        vehicle's indicator tells which of these paths it will take.
        """
        of_lane: dict[tuple[str, Lane], list[tuple[PathKey, int]]] = {}
        for key, path in self.paths.items():
            for section, lane in enumerate(path.lanes):
                of_lane.setdefault((path.approach, lane), []).append((key, section))
        return frozenset(
            place for places in of_lane.values() if len(places) > 1 for place in places
        )

    @cached_property
    def ego_path(self) -> Path:
        return self.paths[self.ego]

    @cached_property
    def zone_arc_m(self) -> float:
        """Return how far along the ego's path the conflict zone is, m.

        It is the point of the path that is nearest to the zone's centre, where others may meet the
        ego.
        """
        return self.ego_path.project(*self.zone_m)[0]

    @cached_property
    def watched(self) -> Floats:
        """Return the points of the road from which a danger may come, (points, 2) m.

        They are those of all sectors, directions of danger.
        """
        return np.concatenate(list(self.sectors.values()))


def paths_along(
    network: Any, ways: Mapping[PathKey, tuple[Sequence[Lane], Sequence[str], int]]
) -> dict[PathKey, Path]:
    """Build the paths of a network by key (approach, route).

    `network` is a `highway_env.road.road.RoadNetwork`. `ways` has, by key, the indices of a path's
    consecutive lanes, the role of each lane in scene graphs, and the right of way, the higher one
    first.
    """
    return {
        key: Path.along(network, *key, lanes, roles, priority)
        for key, (lanes, roles, priority) in ways.items()
    }


def crossings(paths: Mapping[PathKey, Path], ego: PathKey) -> dict[PathKey, Crossing]:
    """Return where paths of other approaches first meet the ego's path, by path key.

    A key is (approach, route): where a path comes from, and what it does. `ego` is that of the
    ego's path. Paths that do not meet it, or more than once without a common lane, are left out.
    """
    ego_path = paths[ego]
    meetings = {}
    for key, path in paths.items():
        if key[0] == ego[0]:
            continue
        shared = [lane for lane in ego_path.lanes if lane in path.lanes]
        if shared:
            begin, its_begin = (
                (0.0, *p.ends_m)[p.lanes.index(shared[0])] for p in (ego_path, path)
            )
            meetings[key] = Crossing(*ego_path.at(begin)[:2], begin, its_begin, "merging")
            continue
        point = intersection(LineString(ego_path.points), LineString(path.points))
        if point.geom_type == "Point":
            x, y = float(point.x), float(point.y)
            meetings[key] = Crossing(x, y, ego_path.project(x, y)[0], path.project(x, y)[0])
    return meetings


def straights(width_m: float, *lanes: tuple[str, str, float, float, float, tuple[int, int]]) -> Any:
    """Build a `highway_env.road.road.RoadNetwork` of straight lanes parallel to the x axis.

    A lane is given by its two nodes, the x where it begins, the x where it ends and its y, in m,
    and its two line types (`highway_env.road.lane.LineType`), left and right. All are `width_m`
    wide.
    """
    from harness.world.highway import RoadNetwork, StraightLane

    net = RoadNetwork()
    for start, end, begin_m, end_m, y_m, lines in lanes:
        net.add_lane(
            start, end, StraightLane([begin_m, y_m], [end_m, y_m], width_m, line_types=lines)
        )
    return net


def to_the_left(
    begin: tuple[float, float], end: tuple[float, float], width_m: float
) -> tuple[Any, Any]:
    """Build a lane shift to the left of two arcs: one that turns left, and one that turns back.

    They are lanes of highway-env, `width_m` wide. `begin` and `end` are x and y in m; both ends
    head east, and `end` lies farther north. Unlike highway-env's `SineLane`, an arc's longitudinal
    coordinate is its true length.
    """
    from harness.world.highway import CircularLane, LineType

    along, across = end[0] - begin[0], begin[1] - end[1]
    turn, quarter = 2 * math.atan(across / along), math.pi / 2
    radius = along / 2 / math.sin(turn)
    centres = [begin[0], begin[1] - radius], [end[0], end[1] + radius]
    angles = (quarter, quarter - turn), (-quarter - turn, -quarter)
    lines = {"width": width_m, "line_types": (LineType.NONE, LineType.NONE)}
    first = CircularLane(centres[0], radius, *angles[0], False, **lines)
    second = CircularLane(centres[1], radius, *angles[1], True, **lines)
    return first, second


def lanes_of(network: Any) -> dict[Lane, Any]:
    """Return the lanes of a road network by highway-env's index of each.

    Such an index is the two nodes of the lane's road, and its number from the left. `network` is a
    `highway_env.road.road.RoadNetwork`, and a lane an object of highway-env.
    """
    lanes: dict[Lane, Any] = {}
    for begin, following in network.graph.items():
        for end, beside in following.items():
            lanes |= {(begin, end, number): lane for number, lane in enumerate(beside)}
    return lanes


def ground(network: Any, far_m: float, origin_m: tuple[float, float] = (0.0, 0.0)) -> Ground:
    """Build what rendered pictures show of the ground: the edges and centre lines of the lanes.

    It is made of the lanes of `network`, a `highway_env.road.road.RoadNetwork`, within `far_m` m of
    the road's origin. `origin_m` is where that origin is in the network's own frame, m.
    """
    lanes = network.lanes_list()
    view = shapely.box(-far_m, -far_m, far_m, far_m)
    strips = []
    for lane in lanes:
        middle = LineString(_middle(lane, origin_m))
        strips.append(middle.buffer(lane.width / 2 + 0.05, cap_style="flat"))
    surface = shapely.union_all(strips).buffer(1.0).buffer(-1.0).intersection(view)
    pieces = [piece for piece in shapely.get_parts(surface) if piece.geom_type == "Polygon"]
    rings = [ring for piece in pieces for ring in (piece.exterior, *piece.interiors)]
    outlines = tuple(np.asarray(ring.simplify(0.05).coords) * NORTH for ring in rings)
    return Ground(outlines, tuple(_marks(lanes, view, origin_m)), (), tuple(_boxes(strips, view)))


def _marks(lanes: Sequence[Any], view: Any, origin_m: tuple[float, float]) -> Iterator[Floats]:
    """Yield the lines between lanes that lie side by side; a line may belong to either lane."""
    for lane, side in product(lanes, (0, 1)):
        if lane.line_types[side] == STRIPED:
            along = np.linspace(0, lane.length, math.ceil(lane.length) + 1)
            edge_m = (side - 0.5) * lane.width
            points = [lane.position(s, edge_m) for s in along] - np.array(origin_m)
            line = LineString(points).intersection(view)
            for part in shapely.get_parts(line):
                if len(part.coords) > 1:
                    yield np.asarray(part.coords) * NORTH


def _boxes(strips: Sequence[Any], view: Any) -> Iterator[Floats]:
    """Yield the bounding boxes of the lanes within the view."""
    for strip in strips:
        seen = strip.intersection(view)
        if not seen.is_empty:
            west, north, east, south = seen.bounds
            yield np.array([[west, -south], [east, -north]])
