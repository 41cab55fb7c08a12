"""What stands between the antennas of the ego and its helpers: geometry for channel models that need it."""

from collections.abc import Sequence

import numpy as np

from harness.core.arrays import Floats
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Site
from harness.world.perception.rays import meetings
from harness.world.state import HEIGHTS_M, VehicleState, WorldState

LEAST_ANGLE_RAD = np.pi / 6  # streets that meet at less run side by side, or merge


def site(moments: Sequence[tuple[WorldState, Sequence[str]]]) -> Site:
    """The links of some moments, (n, ...).

    An antenna is at the centre of its vehicle. Of what stands between two, a building counts for more than a
    vehicle.

    Args:
        moments: the state, and the ids of the ego and its helpers, in this order.
    """
    n, helpers = len(moments), max((len(viewers) for _, viewers in moments), default=1) - 1
    xy_m = np.full((n, 1 + helpers, 2), np.nan)
    sight, blocker_m = np.full((n, helpers), CLEAR), np.zeros((n, helpers))
    corner_m = np.full((n, helpers, 2), np.nan)
    for i, (state, viewers) in enumerate(moments):
        ego, *others = (state.vehicle(name) for name in viewers)
        xy_m[i, : len(viewers)] = [(v.x_m, v.y_m) for v in (ego, *others)]
        for h, helper in enumerate(others):
            sight[i, h], blocker_m[i, h] = _between(state, ego, helper)
            corner_m[i, h] = corner(ego, helper)
    return Site(xy_m, sight, blocker_m, corner_m)


def _between(state: WorldState, a: VehicleState, b: VehicleState) -> tuple[int, float]:
    """What stands between two vehicles, and the height of the tallest vehicle that does."""
    origin, line = np.array([a.x_m, a.y_m]), np.array([[b.x_m - a.x_m, b.y_m - a.y_m]])
    vehicles = [v for v in state.vehicles if v.id not in (a.id, b.id)]
    corners = [*(v.corners() for v in vehicles), *(building.corners() for building in state.buildings)]
    if not corners:
        return CLEAR, 0.0
    t, _ = meetings(origin, line, np.array(corners))
    met: list[bool] = (t.reshape(-1, 4).min(axis=1) < 1).tolist()
    tallest = max((HEIGHTS_M[v.kind] for v, there in zip(vehicles, met, strict=False) if there), default=0.0)
    if any(met[len(vehicles) :]):
        return BUILDING, tallest
    return (VEHICLE if tallest else CLEAR), tallest


def corner(a: VehicleState, b: VehicleState) -> Floats:
    """How far two vehicles are from where the lines along their headings cross, (2,) m; NaN without."""
    sine = np.sin(b.heading_rad - a.heading_rad)
    if abs(sine) < np.sin(LEAST_ANGLE_RAD):
        return np.full(2, np.nan)
    dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
    along_a = (dx * np.sin(b.heading_rad) - dy * np.cos(b.heading_rad)) / sine
    along_b = (dx * np.sin(a.heading_rad) - dy * np.cos(a.heading_rad)) / sine
    return np.abs([along_a, along_b])
