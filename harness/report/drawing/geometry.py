"""Where things lie in a picture of a scene: m to the east and to the *north* of the origin.

The frame of `harness.world.road` has south instead, so every position is flipped on its way in.
"""

import numpy as np

from harness.core.arrays import Floats
from harness.world.road import Ground
from harness.world.scenario import Scenario
from harness.world.scene_graph import Conflict, SceneGraph
from harness.world.state import VehicleState, WorldState

VIEW_M = 80.0  # from the origin to the edge of a picture
LOW_M, LOW_SHAPE = 40.0, 0.6  # roads that reach no farther north to south; height by width of their pictures
BEYOND_M = 80.0  # roads are drawn so far beyond the edge, for who is there


def north_up(points: Floats) -> Floats:
    """Points (..., 2) m of `harness.world.road`'s frame, with y to the north."""
    return points * [1.0, -1.0]


def conflict_points(state: WorldState, graph: SceneGraph) -> tuple[list[Conflict], Floats]:
    """Conflicts of a viewer's graph, and where, (n, 2) m to the east and north.

    Not of who is ahead or behind: there the other vehicle itself is the place.
    """
    eye = state.vehicle(graph.viewer)
    cos, sin = np.cos(eye.heading_rad), np.sin(eye.heading_rad)
    conflicts = [c for c in graph.conflicts if c.kind not in ("ahead", "behind")]
    relative = np.array([(c.point.forward_m, c.point.left_m) for c in conflicts]).reshape(-1, 2)
    points = north_up(np.array([eye.x_m, eye.y_m]) + relative @ np.array([[cos, sin], [sin, -cos]]))
    return conflicts, points


def ground_of(scenario: Scenario) -> Ground:
    """Return what is drawn of a scenario's road, to beyond the edge."""
    return scenario.road().ground_within(VIEW_M + BEYOND_M)


def shape_of(scenario: Scenario) -> float:
    """Height by width of a picture of where it is decided: a road from west to east needs no square."""
    outlines = scenario.road().ground_within(VIEW_M).outlines
    return LOW_SHAPE if np.ptp(np.concatenate(outlines)[:, 1]) <= LOW_M else 1.0


def shadows(state: WorldState, eye: VehicleState, far_m: float) -> Floats:
    """What lies behind walls and vehicles as seen from the middle of one: quadrangles (n, 4, 2) up to far_m.

    All go round the same way, so that together they are one shape by the nonzero rule.
    """
    shapes = [b.corners() for b in state.buildings]
    shapes += [v.corners() for v in state.vehicles if v.id != eye.id]
    a = north_up(np.array(shapes).reshape(-1, 4, 2))
    b, at = np.roll(a, -1, axis=1).reshape(-1, 2), north_up(np.array([eye.x_m, eye.y_m]))
    a = a.reshape(-1, 2)
    beyond = [at + (p - at) * far_m / np.maximum(np.hypot(*(p - at).T), 1e-9)[:, None] for p in (b, a)]
    quads = np.stack([a, b, *beyond], axis=1)
    across = (b - a)[:, 0] * (at - a)[:, 1] - (b - a)[:, 1] * (at - a)[:, 0]
    return np.where((across > 0)[:, None, None], quads[:, ::-1], quads)
