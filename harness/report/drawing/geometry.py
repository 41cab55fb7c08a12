"""Where things lie in a picture of a scene: m to the east and to the *north* of the origin.

The frame of `harness.world.road` has south instead, so every position is flipped on its way in.
"""

from typing import Any

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


def conflict_points(scene: Scene, viewer: str) -> tuple[list[dict[str, Any]], Floats]:
    """Conflicts that a viewer sees, and where, (n, 2) m to the east and north.

    Not of who is ahead or behind: there the other vehicle itself is the place.
    """
    eye = scene.state.vehicle(viewer)
    cos, sin = np.cos(eye.heading_rad), np.sin(eye.heading_rad)
    every = scene.record["graphs"][viewer]["conflicts"]
    conflicts = [c for c in every if c.get("kind") not in ("ahead", "behind")]
    relative = np.array([(c["point"]["forward_m"], c["point"]["left_m"]) for c in conflicts]).reshape(-1, 2)
    points = north_up(np.array([eye.x_m, eye.y_m]) + relative @ np.array([[cos, sin], [sin, -cos]]))
    return conflicts, points


def ground_of(scenario: Scenario) -> Ground:
    """What is drawn of a scenario's road, to beyond the edge."""
    return scenario.road().ground(VIEW_M + BEYOND_M)
