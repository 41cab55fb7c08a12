"""Where things lie in a picture of a scene: m to the east and to the *north* of the origin.

The frame of `harness.world.road` has south instead, so every position is flipped on its way in.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.world.road import Ground
from harness.world.scenario import Scenario
from harness.world.scene_graph import Conflict, SceneGraph
from harness.world.state import VehicleState, WorldState

VIEW_M = 80.0  # from the origin to the edge of a picture
# roads that reach no farther north to south; height by width of their pictures
LOW_M, LOW_SHAPE = 40.0, 0.6
BEYOND_M = 80.0  # roads are drawn so far beyond the edge, for who is there
MARGIN_M, LEAST_M = 8.0, 60.0  # around what a view holds; its width
# what is farther north, south, east or west of the ego than this is not followed
NEAR_M = VIEW_M - MARGIN_M


def north_up(points: Floats) -> Floats:
    """Return points of the simulator, m east and south, as pictures have them, m east and north.

    Both are (..., 2). In the simulator, as on a screen, y points to the south.
    """
    return points * [1.0, -1.0]


def conflict_points(state: WorldState, graph: SceneGraph) -> tuple[list[Conflict], Floats]:
    """Return the n conflicts in a viewer's scene graph and where they are, (n, 2), m.

    A conflict is a place where the viewer's path and another vehicle's meet. Positions are to the
    east and to the north. Conflicts with vehicles ahead or behind are left out, since these have no
    fixed place. A scene graph is what one vehicle knows of a scene.
    """
    eye = state.vehicle(graph.viewer)
    cos, sin = np.cos(eye.heading_rad), np.sin(eye.heading_rad)
    conflicts = [c for c in graph.conflicts if c.kind not in ("ahead", "behind")]
    relative = np.array([(c.point.forward_m, c.point.left_m) for c in conflicts]).reshape(-1, 2)
    points = north_up(np.array([eye.x_m, eye.y_m]) + relative @ np.array([[cos, sin], [sin, -cos]]))
    return conflicts, points


def ground_of(scenario: Scenario) -> Ground:
    """Return the outlines of a scenario's road to draw, with its centre and stop lines.

    They reach up to `BEYOND_M` metres beyond the largest picture of a scene. Points are m to the
    east and to the north of the scenario's origin.
    """
    return scenario.road().ground_within(VIEW_M + BEYOND_M)


def drawn_ground(scenario: Scenario) -> dict[str, Any]:
    """Return the ground of a scenario's road as a page's script draws it: lists of points, m.

    Points are to the east and to the north of the scenario's origin, up to `view_m` on each side.
    """
    surface = ground_of(scenario)
    return {
        "view_m": VIEW_M,
        "outlines": [outline.round(2).tolist() for outline in surface.outlines],
        "marks": [mark.tolist() for mark in surface.marks],
        "stops": [stop.tolist() for stop in surface.stops],
    }


def shape_of(scenario: Scenario) -> float:
    """Return height by width of a scenario's picture: 1, or less for a road from west to east."""
    outlines = scenario.road().ground_within(VIEW_M).outlines
    return LOW_SHAPE if np.ptp(np.concatenate(outlines)[:, 1]) <= LOW_M else 1.0


def shadows(state: WorldState, eye: VehicleState, far_m: float) -> Floats:
    """Return the areas hidden behind buildings and vehicles from the middle of the vehicle `eye`.

    They are quadrangles (n, 4, 2), m east and north, that end `far_m` from the eye. All have the
    same orientation, so that the nonzero fill rule unites them.
    """
    shapes = [b.corners() for b in state.buildings]
    shapes += [v.corners() for v in state.vehicles if v.id != eye.id]
    a = north_up(np.array(shapes).reshape(-1, 4, 2))
    b, at = np.roll(a, -1, axis=1).reshape(-1, 2), north_up(np.array([eye.x_m, eye.y_m]))
    a = a.reshape(-1, 2)
    beyond = [
        at + (p - at) * far_m / np.maximum(np.hypot(*(p - at).T), 1e-9)[:, None] for p in (b, a)
    ]
    quads = np.stack([a, b, *beyond], axis=1)
    across = (b - a)[:, 0] * (at - a)[:, 1] - (b - a)[:, 1] * (at - a)[:, 0]
    return np.where((across > 0)[:, None, None], quads[:, ::-1], quads)


@dataclass(frozen=True)
class View:
    """Hold the rectangle of the world that a picture shows, m to the east and to the north.

    `west_m` and `south_m` are its corner, from the origin of the scenario, `width_m` and `height_m`
    its sides.
    """

    west_m: float  # its west edge, east of the origin
    south_m: float  # its south edge, north of the origin
    width_m: float  # from west to east
    height_m: float  # from south to north

    @property
    def edges(self) -> Floats:
        """Return the south-west and the north-east corner of the view, (2, 2), m."""
        start = np.array([self.west_m, self.south_m])
        return np.array([start, start + np.array([self.width_m, self.height_m])])

    @property
    def scale(self) -> float:
        """Return the view's width as a fraction of the largest view's, 2 `VIEW_M`."""
        return self.width_m / (2 * VIEW_M)

    def holds(self, points: Floats, margin_m: float = 0.0) -> bool:
        """Return whether all of some points are in the picture's view, `margin_m` from its edge.

        They are (..., 2), m east and north.
        """
        low, high = self.edges
        return bool(np.all((points >= low + margin_m) & (points <= high - margin_m)))


def spots(
    state: WorldState,
    zone_m: tuple[float, float],
    graph: SceneGraph | None,
    who: Collection[str | None],
    crossed: tuple[list[Conflict], Floats] | None = None,
) -> Floats:
    """Return the n points that a picture must show, (n, 2), m east and north.

    The first is the ego; points farther than `NEAR_M` from it are left out.

    Args:
        state: the vehicles' positions.
        zone_m: the point where paths cross, in the frame of `harness.world.road` (m east and
            south).
        graph: scene graph of the viewer, whose conflicts (places where paths meet) are added; None
            for none.
        who: ids of other vehicles to show: the dangerous one and helpers; None is ignored.
        crossed: the result of `conflict_points` for the graph, if known.
    """
    conflicts, crossings = crossed or (
        conflict_points(state, graph) if graph else ([], np.empty((0, 2)))
    )
    wanted = {*who, state.ego.id, *(conflict.vehicle for conflict in conflicts)}
    wanted |= {graph.viewer} if graph else set()
    at = [(v.x_m, v.y_m) for v in state.vehicles if v.id in wanted]
    points = [[x_m, -y_m] for x_m, y_m in (*at, zone_m)]
    points += crossings.tolist()
    (east_m, north_m), near = points[0], []
    for x_m, y_m in points:
        if abs(x_m - east_m) <= NEAR_M and abs(y_m - north_m) <= NEAR_M:
            near.append((x_m, y_m))
    return np.array(near)


def view_of(held: Floats, shape: float = 1.0) -> View:
    """Return the view around points (n, 2), m east and north, with a margin.

    It is centred on them as far as the world's edge allows; its height is `shape` times its width.
    """
    eastward, northward = held.T.tolist()  # of a few points, for which NumPy takes longer
    west, east, south, north = min(eastward), max(eastward), min(northward), max(northward)
    width = max(LEAST_M, east - west + 2 * MARGIN_M, (north - south + 2 * MARGIN_M) / shape)

    def start(low: float, high: float, size: float) -> float:
        room = max(VIEW_M - size / 2, 0.0)
        middle = min(max((low + high) / 2, -room), room)
        return min(max(middle, high + MARGIN_M - size / 2), low - MARGIN_M + size / 2) - size / 2

    return View(start(west, east, width), start(south, north, shape * width), width, shape * width)
