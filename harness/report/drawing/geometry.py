"""Where things lie in a picture of a scene: m to the east and to the *north* of the origin.

The frame of `harness.world.road` has south instead, so every position is flipped on its way in.
"""

import numpy as np

from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.world.road import Ground
from harness.world.scenario import Scenario

VIEW_M = 80.0  # from the origin to the edge of a picture
BEYOND_M = 5.0  # roads are drawn so far beyond the edge


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


def ground_of(scenario: Scenario) -> Ground:
    """What is drawn of a scenario's road, to beyond the edge."""
    return scenario.road().ground(VIEW_M + BEYOND_M)
