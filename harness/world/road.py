"""A road as paths: where vehicles can go on it, where their ways cross, and what lies around.

Frame: metres, x to the east, y to the *south* (highway-env's screen frame), headings in radians from +x
towards +y.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, Literal

import numpy as np
import shapely
from shapely import LineString, intersection

from harness.core.arrays import Floats

PathKey = tuple[str, str]  # approach and route
Lane = tuple[str, str, int]  # highway-env's name of it: two nodes, and a number from the left
STEP_M = 0.25  # between the points of a path
ONE_LANE_M = 1.0  # ways nearer to each other than this are in one lane
BEND_M = 3.0  # before and behind, over which a bend is measured
STRIPED = 1  # highway-env's LineType of a line that may be crossed
NORTH = np.array([1.0, -1.0])  # from this frame to that of pictures


@dataclass(frozen=True, eq=False)
class Path:
    """One way along the road, in sections: one a lane of highway-env.

    Attributes:
        approach: where it comes from.
        route: what it does, such as `straight`. Who is to go `left` or `right` shows it.
        points: (n, 2) m, evenly spaced.
        arc_m: (n,) distance along the path.
        ends_m: arc lengths at which a section ends and the next begins; paths of one approach share the first
            section.
        roles: what each section is called in a scene graph.
        lanes: the lane of each section.
        priority: right of way; the higher one goes first.
    """

    approach: str
    route: str
    points: Floats
    arc_m: Floats
    ends_m: tuple[float, ...]
    roles: tuple[str, ...]
    lanes: tuple[Lane, ...]
    priority: int

    @classmethod
    def along(
        cls, network: Any, approach: str, route: str, lanes: Sequence[Lane], roles: Sequence[str],
        priority: int, origin_m: tuple[float, float] = (0.0, 0.0), reach_m: float = math.inf,
    ) -> "Path":  # fmt: skip
        """The middle of some of highway-env's lanes, each of which goes on where the one before it ends.

        Of a lane as much as lies within `reach_m` of the origin of the road's frame, and at least a point.
        """
        middles = [_within(_middle(network.get_lane(lane), origin_m), reach_m) for lane in lanes]
        corners = np.concatenate(middles)
        arc = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
        ends = arc[np.cumsum([len(middle) for middle in middles])[:-1]]
        even = np.linspace(0.0, arc[-1], math.ceil(arc[-1] / STEP_M) + 1)
        points = np.column_stack([np.interp(even, arc, along) for along in corners.T])
        return cls(approach, route, points, even, tuple(ends.tolist()), tuple(roles), tuple(lanes), priority)

    @cached_property
    def columns(self) -> Floats:
        """(2, n) m, the points' coordinates, each in one piece."""
        return np.ascontiguousarray(self.points.T)

    @cached_property
    def headings_rad(self) -> Floats:
        """(n,) direction of travel."""
        along = np.gradient(self.points, axis=0)
        heading: Floats = np.arctan2(along[:, 1], along[:, 0])
        return heading

    @cached_property
    def bends(self) -> Floats:
        """(n,) curvature in 1/m, whichever way it turns."""
        reach = round(BEND_M / float(self.arc_m[1]))
        turned = np.unwrap(self.headings_rad)
        padded = np.pad(turned, reach, mode="edge")
        return np.asarray(np.abs(padded[2 * reach :] - padded[: -2 * reach]) / (2 * BEND_M))

    # Every viewer of a scene looks at the same vehicles, and scenes that part share most of them.
    @lru_cache(maxsize=8192)  # noqa: B019 paths live as long as their road, which is for good
    def project(self, x_m: float, y_m: float) -> tuple[float, float, float]:
        """Arc length (m), unsigned lateral offset (m) and heading (rad) of the path's nearest point."""
        x, y = self.columns
        gap = np.hypot(x - x_m, y - y_m)
        i = int(gap.argmin())
        heading = float(self.headings_rad[i])
        dx, dy = x_m - x[i], y_m - y[i]
        along = dx * np.cos(heading) + dy * np.sin(heading)
        lateral = float(np.sqrt(max(gap[i] ** 2 - along**2, 0.0)))
        return float(self.arc_m[i] + along), lateral, heading

    @lru_cache(maxsize=8192)  # noqa: B019
    def at(self, arc_m: float) -> tuple[float, float, float]:
        """Position (m, m) and heading (rad) at an arc length."""
        x, y = (float(np.interp(arc_m, self.arc_m, along)) for along in self.columns)
        nearest = int(np.searchsorted(self.arc_m, arc_m).clip(0, len(self.arc_m) - 1))
        return x, y, float(self.headings_rad[nearest])

    def section(self, arc_m: float) -> int:
        """The section that an arc length is in."""
        return bisect_right(self.ends_m, arc_m)

    def lane_role(self, arc_m: float) -> str:
        """What the section at an arc length is called."""
        return self.roles[self.section(arc_m)]


def _middle(lane: Any, origin_m: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """(n, 2) m, points of the middle of one of highway-env's lanes, its ends among them."""
    along = np.linspace(0, lane.length, math.ceil(lane.length) + 1)
    middle: Floats = np.array([lane.position(s, 0.0) for s in along]) - origin_m
    return middle


def _within(points: Floats, reach_m: float) -> Floats:
    """Those of the points that lie so near the origin, or the nearest."""
    away_m = np.hypot(*points.T)
    near: Floats = points[away_m <= max(reach_m, away_m.min())]
    return near


@dataclass(frozen=True)
class Crossing:
    """Where another path meets the ego's: position and arc lengths along both, in metres.

    Attributes:
        x_m: m to the east.
        y_m: m to the south.
        ego_arc_m: along the ego's path.
        other_arc_m: along the other path.
        kind: whether it goes across, or into a lane that the ego takes as well.
    """

    x_m: float
    y_m: float
    ego_arc_m: float
    other_arc_m: float
    kind: Literal["crossing", "merging"] = "crossing"


@dataclass(frozen=True)
class Ground:
    """What a picture shows of a road, in m to the east and to the *north*.

    Attributes:
        outlines: (n, 2) each, its edges: the outer one, and those of what it goes round.
        marks: centre lines, (n, 2) each.
        stops: stop lines, (n, 2) each.
        boxes: west-south and east-north corners (2, 2) of what labels keep off.
    """

    outlines: tuple[Floats, ...]
    marks: tuple[Floats, ...]
    stops: tuple[Floats, ...]
    boxes: tuple[Floats, ...]


@dataclass(frozen=True)
class Road:
    """A road, and what matters on it for the ego.

    Attributes:
        facts: what a frozen record says of it: texts, and numbers with their unit in the name.
        paths: every path, by approach and route.
        ego: the ego's path.
        ways: paths that the ego changes between by changing lane, from left to right, `ego` among them: side
            by side, and as long.
        form: of its scene graphs; 2 lists every relation to the ego's ways, 1 crossings alone, as
            `occluded-intersection-v2` is frozen.
        crossings: where the ego's path meets others, and so where conflicts are looked for.
        zone_m: position of the conflict zone; distances to it weigh messages.
        sectors: where danger can come from, and the points (k, 2) m that must be seen to know of it.
        network: gives highway-env's network, always the same one; nobody writes to it.
        ground: gives what a picture shows that reaches so many metres from the origin.
        origin_m: where the origin is in highway-env's own frame.
        goal_m: gives, of the scenario's parameters, the arc length of the ego's path at which its episode is
            over: whom it would meet beyond does not matter. None where that is no place on its path.
    """

    facts: Mapping[str, str | float]
    paths: Mapping[PathKey, Path]
    ego: PathKey
    crossings: Mapping[PathKey, Crossing]
    zone_m: tuple[float, float]
    sectors: Mapping[str, Floats]
    network: Callable[[], Any]
    ground: Callable[[float], Ground]
    ways: tuple[PathKey, ...] = ()
    form: Literal[1, 2] = 2
    origin_m: tuple[float, float] = (0.0, 0.0)
    goal_m: Callable[[Any], float] | None = None

    def beside(self, key: PathKey, arc_m: float | None = None) -> dict[str, PathKey]:
        """The ego's ways from the one that it is on: `own`, and `left` and `right` where there are such.

        At an arc length, those alone that are in a lane of their own there.
        """
        if key not in self.ways:
            return {"own": key}
        place = self.ways.index(key)
        places = {"own": place, "left": place - 1, "right": place + 1}
        found = {side: self.ways[n] for side, n in places.items() if 0 <= n < len(self.ways)}
        if arc_m is None:
            return found
        x, y, _ = self.paths[key].at(arc_m)
        return {
            side: way for side, way in found.items()
            if side == "own" or self.paths[way].project(x, y)[1] > ONE_LANE_M
        }  # fmt: skip

    @cached_property
    def forks(self) -> frozenset[tuple[PathKey, int]]:
        """Sections, by path and number, that several paths of one approach share: an indicator tells them."""
        of_lane: dict[tuple[str, Lane], list[tuple[PathKey, int]]] = {}
        for key, path in self.paths.items():
            for section, lane in enumerate(path.lanes):
                of_lane.setdefault((path.approach, lane), []).append((key, section))
        return frozenset(place for places in of_lane.values() if len(places) > 1 for place in places)

    @cached_property
    def ego_path(self) -> Path:
        """The ego's path."""
        return self.paths[self.ego]

    @cached_property
    def zone_arc_m(self) -> float:
        """Arc length at which the ego's path passes the conflict zone."""
        return self.ego_path.project(*self.zone_m)[0]

    @cached_property
    def watched(self) -> Floats:
        """(points, 2) m of all sectors, one after the other."""
        return np.concatenate(list(self.sectors.values()))


def crossings(paths: Mapping[PathKey, Path], ego: PathKey) -> dict[PathKey, Crossing]:
    """Where paths from elsewhere first meet the ego's, by the other's approach and route."""
    mine = paths[ego]
    found = {}
    for key, path in paths.items():
        if key[0] == ego[0]:
            continue
        shared = [lane for lane in mine.lanes if lane in path.lanes]
        if shared:
            begin, its_begin = ((0.0, *p.ends_m)[p.lanes.index(shared[0])] for p in (mine, path))
            found[key] = Crossing(*mine.at(begin)[:2], begin, its_begin, "merging")
            continue
        point = intersection(LineString(mine.points), LineString(path.points))
        if point.geom_type == "Point":
            x, y = float(point.x), float(point.y)
            found[key] = Crossing(x, y, mine.project(x, y)[0], path.project(x, y)[0])
    return found


def straights(width_m: float, *lanes: tuple[str, str, float, float, float, tuple[int, int]]) -> Any:
    """highway-env's network of lanes along x: of each its nodes, begin, end and y in metres, and lines."""
    from highway_env.road.lane import StraightLane
    from highway_env.road.road import RoadNetwork

    net = RoadNetwork()
    for start, end, begin_m, end_m, y_m, lines in lanes:
        net.add_lane(start, end, StraightLane([begin_m, y_m], [end_m, y_m], width_m, line_types=lines))
    return net


def to_the_left(begin: tuple[float, float], end: tuple[float, float], width_m: float) -> tuple[Any, Any]:
    """Two of highway-env's arcs, as long as their longitudinal coordinate, unlike its `SineLane`.

    Both ends head east and the end lies farther north; metres. The first arc turns left, the second back.
    """
    from highway_env.road.lane import CircularLane, LineType

    along, across = end[0] - begin[0], begin[1] - end[1]
    turn, quarter = 2 * math.atan(across / along), math.pi / 2
    radius = along / 2 / math.sin(turn)
    centres = [begin[0], begin[1] - radius], [end[0], end[1] + radius]
    angles = (quarter, quarter - turn), (-quarter - turn, -quarter)
    lines = {"width": width_m, "line_types": (LineType.NONE, LineType.NONE)}
    first, second = (
        CircularLane(centre, radius, *at, clockwise, **lines)
        for centre, at, clockwise in zip(centres, angles, (False, True), strict=True)
    )
    return first, second


def ground(network: Any, far_m: float, origin_m: tuple[float, float] = (0.0, 0.0)) -> Ground:
    """What a picture shows of highway-env's lanes up to `far_m`: their surface, and the lines within it."""
    lanes = network.lanes_list()
    view = shapely.box(-far_m, -far_m, far_m, far_m)
    strips = [
        LineString(_middle(lane, origin_m)).buffer(lane.width / 2 + 0.05, cap_style="flat") for lane in lanes
    ]
    surface = shapely.union_all(strips).buffer(1.0).buffer(-1.0).intersection(view)
    pieces = [piece for piece in shapely.get_parts(surface) if piece.geom_type == "Polygon"]
    rings = [ring for piece in pieces for ring in (piece.exterior, *piece.interiors)]
    outlines = tuple(np.asarray(ring.simplify(0.05).coords) * NORTH for ring in rings)
    return Ground(outlines, tuple(_marks(lanes, view, origin_m)), (), tuple(_boxes(strips, view)))


def _marks(lanes: Sequence[Any], view: Any, origin_m: tuple[float, float]) -> Iterator[Floats]:
    """Lines between lanes that lie side by side, which may be either one's."""
    for lane, side in product(lanes, (0, 1)):
        if lane.line_types[side] == STRIPED:
            along = np.linspace(0, lane.length, math.ceil(lane.length) + 1)
            edge_m = (side - 0.5) * lane.width
            line = LineString([lane.position(s, edge_m) for s in along] - np.array(origin_m)).intersection(
                view
            )
            yield from (np.asarray(p.coords) * NORTH for p in shapely.get_parts(line) if len(p.coords) > 1)


def _boxes(strips: Sequence[Any], view: Any) -> Iterator[Floats]:
    """Boxes around the lanes within the view."""
    for strip in strips:
        seen = strip.intersection(view)
        if not seen.is_empty:
            west, north, east, south = seen.bounds
            yield np.array([[west, -south], [east, -north]])
