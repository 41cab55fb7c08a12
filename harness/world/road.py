"""The four-way intersection as paths: where a vehicle on each approach can go, and where paths cross.

Frame: metres, x to the east, y to the *south* (highway-env's screen frame), headings in radians from +x
towards +y. The ego comes from the south and goes north, so for it "left" is the west arm, "right" the east
arm and "oncoming" the north arm. Lane width and radii are those of highway-env 1.12's `IntersectionEnv`;
a test holds them against its road network.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from shapely import LineString, intersection

from harness.core.arrays import Floats

LANE_WIDTH_M = 4.0
JUNCTION_M = 11.0  # from the centre to where approach lanes end
ARM_M = 100.0  # length of an approach or exit lane
LEFT_TURN_RADIUS_M = 13.0
STEP_M = 0.25

APPROACHES = ("own", "left", "oncoming", "right")  # south, west, north, east: highway-env's nodes o0..o3
SECTORS = ("left", "right", "oncoming")  # where danger can come from
ROUTES = ("straight", "left")
EXITS = {"own": "exit-own", "left": "exit-left", "oncoming": "exit-ahead", "right": "exit-right"}


@dataclass(frozen=True)
class Path:
    """One way through the intersection.

    Attributes:
        approach: the arm it starts on.
        route: `straight` or `left`.
        points: (n, 2) m, evenly spaced by about `STEP_M`.
        arc_m: (n,) distance along the path.
        junction_m: arc lengths at which the junction is entered and left.
    """

    approach: str
    route: str
    points: Floats
    arc_m: Floats
    junction_m: tuple[float, float]

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

    def lane_role(self, arc_m: float) -> str:
        """`approach-…` before the junction, `junction`, then `exit-…`, named from the ego's seat."""
        if arc_m < self.junction_m[0]:
            return f"approach-{self.approach}"
        if arc_m < self.junction_m[1]:
            return "junction"
        ahead = 2 if self.route == "straight" else 1
        return EXITS[APPROACHES[(APPROACHES.index(self.approach) + ahead) % 4]]


@lru_cache(maxsize=1)
def paths() -> dict[tuple[str, str], Path]:
    """Every path, by (approach, route)."""
    built = {}
    for corner, approach in enumerate(APPROACHES):
        turn = np.pi / 2 * corner
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).round(12)
        for route in ROUTES:
            points = _southern(route) @ rotation.T
            arc = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
            inside = 2 * JUNCTION_M if route == "straight" else LEFT_TURN_RADIUS_M * np.pi / 2
            built[approach, route] = Path(approach, route, points, arc, (ARM_M, ARM_M + inside))
    return built


def _southern(route: str) -> Floats:
    """Points of a path that starts on the south arm."""
    half, end = LANE_WIDTH_M / 2, JUNCTION_M + ARM_M
    count = int(ARM_M / STEP_M)
    approach = np.column_stack([np.full(count, half), np.linspace(end, JUNCTION_M, count, endpoint=False)])
    if route == "straight":
        inside = np.linspace(JUNCTION_M, -JUNCTION_M, int(2 * JUNCTION_M / STEP_M), endpoint=False)
        leaving = np.linspace(-JUNCTION_M, -end, count + 1)
        y = np.concatenate([inside, leaving])
        return np.concatenate([approach, np.column_stack([np.full(len(y), half), y])])
    angle = np.linspace(0, np.pi / 2, int(LEFT_TURN_RADIUS_M * np.pi / 2 / STEP_M), endpoint=False)
    radius = LEFT_TURN_RADIUS_M
    arc = np.column_stack([half - radius + radius * np.cos(angle), JUNCTION_M - radius * np.sin(angle)])
    leaving = np.linspace(-JUNCTION_M, -end, count + 1)
    return np.concatenate([approach, arc, np.column_stack([leaving, np.full(count + 1, -half)])])


@dataclass(frozen=True)
class Crossing:
    """Where another path crosses the ego's: position and arc lengths along both, in metres."""

    x_m: float
    y_m: float
    ego_arc_m: float
    other_arc_m: float


@lru_cache(maxsize=1)
def crossings() -> dict[tuple[str, str], Crossing]:
    """Conflict points with the ego's path (`own`, `straight`), by the other's (approach, route)."""
    ego = paths()["own", "straight"]
    found = {}
    for key, path in paths().items():
        if key[0] == "own":
            continue
        point = intersection(LineString(ego.points), LineString(path.points))
        if point.geom_type == "Point":  # a path that merges into the ego's lane shares a line with it
            x, y = float(point.x), float(point.y)
            found[key] = Crossing(x, y, ego.project(x, y)[0], path.project(x, y)[0])
    return found


@lru_cache(maxsize=1)
def conflict_zone() -> tuple[float, float]:
    """Centroid (m, m) of the conflict points of the three dangers: what d_j of Eq. 2 is measured to."""
    points = [crossings()[key] for key in (("left", "straight"), ("right", "straight"), ("oncoming", "left"))]
    return float(np.mean([p.x_m for p in points])), float(np.mean([p.y_m for p in points]))
