"""A road as paths: where vehicles can go on it, where their ways cross, and what lies around.

Frame: metres, x to the east, y to the *south* (highway-env's screen frame), headings in radians from +x
towards +y. The ego's path runs straight to the north.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from shapely import LineString, intersection

from harness.core.arrays import Floats

PathKey = tuple[str, str]  # approach and route
Lane = tuple[str, str, int]  # highway-env's name of it: two nodes, and a number from the left


@dataclass(frozen=True)
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

    @cached_property
    def headings_rad(self) -> Floats:
        """(n,) direction of travel."""
        along = np.gradient(self.points, axis=0)
        heading: Floats = np.arctan2(along[:, 1], along[:, 0])
        return heading

    def project(self, x_m: float, y_m: float) -> tuple[float, float, float]:
        """Arc length (m), unsigned lateral offset (m) and heading (rad) of the path's nearest point."""
        gap = np.hypot(self.points[:, 0] - x_m, self.points[:, 1] - y_m)
        i = int(gap.argmin())
        heading = float(self.headings_rad[i])
        dx, dy = x_m - self.points[i, 0], y_m - self.points[i, 1]
        along = dx * np.cos(heading) + dy * np.sin(heading)
        lateral = float(np.sqrt(max(gap[i] ** 2 - along**2, 0.0)))
        return float(self.arc_m[i] + along), lateral, heading

    def at(self, arc_m: float) -> tuple[float, float, float]:
        """Position (m, m) and heading (rad) at an arc length."""
        x = float(np.interp(arc_m, self.arc_m, self.points[:, 0]))
        y = float(np.interp(arc_m, self.arc_m, self.points[:, 1]))
        nearest = int(np.searchsorted(self.arc_m, arc_m).clip(0, len(self.arc_m) - 1))
        return x, y, float(self.headings_rad[nearest])

    def section(self, arc_m: float) -> int:
        """The section that an arc length is in."""
        return bisect_right(self.ends_m, arc_m)

    def lane_role(self, arc_m: float) -> str:
        """What the section at an arc length is called."""
        return self.roles[self.section(arc_m)]


@dataclass(frozen=True)
class Crossing:
    """Where another path meets the ego's: position and arc lengths along both, in metres."""

    x_m: float
    y_m: float
    ego_arc_m: float
    other_arc_m: float


@dataclass(frozen=True)
class Ground:
    """What a picture shows of a road, in m to the east and to the *north*.

    Attributes:
        outline: (n, 2) its edge.
        marks: centre lines, (n, 2) each.
        stops: stop lines, (n, 2) each.
        boxes: west-south and east-north corners (2, 2) of what labels keep off.
    """

    outline: Floats
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
        crossings: where the ego's path meets others, and so where conflicts are looked for.
        zone_m: position of the conflict zone; distances to it weigh messages.
        sectors: where danger can come from, and the points (k, 2) m that must be seen to know of it.
        network: gives highway-env's network, always the same one; nobody writes to it.
        ground: gives what a picture shows that reaches so many metres from the origin.
    """

    facts: Mapping[str, str | float]
    paths: Mapping[PathKey, Path]
    ego: PathKey
    crossings: Mapping[PathKey, Crossing]
    zone_m: tuple[float, float]
    sectors: Mapping[str, Floats]
    network: Callable[[], Any]
    ground: Callable[[float], Ground]

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
    """Where paths from elsewhere cross the ego's, by the other's approach and route."""
    mine = paths[ego]
    found = {}
    for key, path in paths.items():
        if key[0] == ego[0]:
            continue
        point = intersection(LineString(mine.points), LineString(path.points))
        if point.geom_type == "Point":  # a path that merges into the ego's lane shares a line with it
            x, y = float(point.x), float(point.y)
            found[key] = Crossing(x, y, mine.project(x, y)[0], path.project(x, y)[0])
    return found
