"""Where things lie in a picture of a scene: m to the east and to the *north* of the junction's centre.

The frame of `harness.world.road` has south instead, so every position is flipped on its way in.
"""

import numpy as np

from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.world.road import JUNCTION_M, LANE_WIDTH_M

VIEW_M = 80.0  # from the centre of the junction to the edge of a picture


def north_up(points: Floats) -> Floats:
    """Points (..., 2) m of `harness.world.road`'s frame, with y to the north."""
    return points * [1.0, -1.0]


def conflict_points(scene: Scene, viewer: str) -> Floats:
    """Where a viewer sees paths cross, (n, 2) m to the east and north, as its graph orders them."""
    eye = scene.state.vehicle(viewer)
    cos, sin = np.cos(eye.heading_rad), np.sin(eye.heading_rad)
    conflicts = scene.record["graphs"][viewer]["conflicts"]
    relative = np.array([(c["point"]["forward_m"], c["point"]["left_m"]) for c in conflicts]).reshape(-1, 2)
    return north_up(np.array([eye.x_m, eye.y_m]) + relative @ np.array([[cos, sin], [sin, -cos]]))


def roads() -> tuple[Floats, list[Floats], list[Floats]]:
    """Outline of the roads to beyond the edge, centre line and stop line of each arm; (n, 2) m."""
    half, far = LANE_WIDTH_M, VIEW_M + 5.0
    # One corner of the junction, from the north arm to the east arm; a quarter turn gives the next.
    angle = np.linspace(np.pi, 1.5 * np.pi, 9)
    fillet = JUNCTION_M + (JUNCTION_M - half) * np.column_stack([np.cos(angle), np.sin(angle)])
    corner = np.vstack([[half, far], fillet, [far, half]])
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])  # clockwise, for row vectors
    turns = [np.linalg.matrix_power(quarter, n) for n in range(4)]
    outline = np.vstack([corner @ turn for turn in turns])
    marks = [np.array([[0.0, JUNCTION_M], [0.0, far]]) @ turn for turn in turns]
    stops = [np.array([[0.0, JUNCTION_M], [-half, JUNCTION_M]]) @ turn for turn in turns]
    return outline, marks, stops
