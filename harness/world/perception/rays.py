"""Ray casting: which objects a vehicle has a line of sight to, past buildings and other vehicles."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.core.arrays import Floats
from harness.world.state import VehicleState, WorldState

RAYS = 1440  # a quarter of a degree apart


@dataclass(frozen=True)
class Sweep:
    """One full turn of rays from a vehicle's centre.

    Attributes:
        bearing_rad: direction of each ray in the world frame, (RAYS,).
        range_m: distance to the first surface, (RAYS,); inf if there is none.
        hits: indices of the rays that end on each vehicle or building, by id.
    """

    bearing_rad: Floats
    range_m: Floats
    hits: dict[str, NDArray[np.intp]]


def turned(angle_rad: Any) -> Any:
    """Wrap an angle, or angles, to -pi to pi."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def surfaces(state: WorldState, viewer: VehicleState) -> tuple[list[str], Floats]:
    """Return ids and corners (n, 4, 2) of everything that stops a ray, except the viewer itself."""
    solid = [v for v in state.vehicles if v.id != viewer.id]
    ids = [v.id for v in solid] + [b.id for b in state.buildings]
    return ids, np.array([v.corners() for v in solid] + [b.corners() for b in state.buildings])


def meetings(origin: Floats, targets: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Intersect rays with the walls of surfaces; wall k of a surface goes from its corner k to the next.

    Args:
        origin: (2,) m.
        targets: (r, 2) direction vectors; a ray parameter of 1 is their length.
        corners: (n, 4, 2) m.

    Returns:
        Ray parameter, (r, 4n), inf if a wall is not met; and position along the wall from 0 to 1, (r, 4n).
    """
    start, along = (part.reshape(-1, 2) for part in _walls(origin, corners))
    return _met(start, along, targets[:, None])


def _walls(origin: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Return each wall's beginning relative to the origin and its vector, both (n, 4, 2)."""
    start = corners - origin
    return start, np.roll(corners, -1, axis=1) - origin - start


def _met(start: Floats, along: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """Compute `meetings` for walls (..., 2) and rays (..., 2) that broadcast against each other."""
    (x, y), (dx, dy), (ray_x, ray_y) = (np.moveaxis(part, -1, 0) for part in (start, along, targets))
    # Solve origin + t * ray = start + u * along for every ray and edge by Cramer's rule.
    determinant = ray_x * dy - ray_y * dx
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (x * dy - y * dx) / determinant
        u = (x * ray_y - y * ray_x) / determinant
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf), u


def first_hits(origin: Floats, targets: Floats, corners: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Find where rays first meet a surface.

    Args:
        origin: (2,) m.
        targets: (r, 2) direction vectors; a ray parameter of 1 is their length.
        corners: (n, 4, 2) m.

    Returns:
        Ray parameter, (r,), inf if nothing is met; and index of the object that is met first, (r,).
    """
    t, _ = meetings(origin, targets, corners)
    edge = t.argmin(axis=1)
    return t[np.arange(len(t)), edge], edge // 4


def sweep(state: WorldState, viewer: VehicleState) -> Sweep:
    """Cast rays in all directions from a vehicle."""
    bearing, rays = _all_round()
    ids, corners = surfaces(state, viewer)
    origin = np.array([viewer.x_m, viewer.y_m])
    distance, met = np.full(RAYS, np.inf), np.zeros(RAYS, dtype=int)
    towards = _towards(origin, corners)
    surface = np.repeat(np.arange(len(ids)), [len(some) for some in towards])
    start, along = (np.swapaxes(part, 0, 1)[:, surface] for part in _walls(origin, corners))
    t, _ = _met(start, along, rays[np.concatenate(towards)])
    nearest, begin = t.min(axis=0), 0
    for n, some in enumerate(towards):
        there = nearest[begin : begin + len(some)]
        nearer = there < distance[some]
        distance[some[nearer]], met[some[nearer]] = there[nearer], n
        begin += len(some)
    reached = np.isfinite(distance)
    hits = {name: np.flatnonzero(reached & (met == n)) for n, name in enumerate(ids)}
    return Sweep(bearing, distance, {name: rays for name, rays in hits.items() if len(rays)})


def _towards(origin: Floats, corners: Floats) -> list[NDArray[np.intp]]:
    """Return the indices of the rays that may meet each surface: those between its outermost corners."""
    to = corners - origin
    bearing = np.arctan2(to[..., 1], to[..., 0])
    aside = turned(bearing - bearing[:, :1])
    step = 2 * np.pi / RAYS
    first = np.floor((bearing[:, 0] + aside.min(axis=1)) / step).astype(int).tolist()
    last = np.ceil((bearing[:, 0] + aside.max(axis=1)) / step).astype(int).tolist()
    # A viewer inside a surface, or right beside it, may meet it in any direction.
    all_round = (np.ptp(aside, axis=1) >= np.pi - step).tolist()
    return [
        np.arange(RAYS) if everywhere else np.arange(begin - 1, end + 2) % RAYS
        for begin, end, everywhere in zip(first, last, all_round, strict=True)
    ]


@lru_cache(maxsize=1)
def _all_round() -> tuple[Floats, Floats]:
    """Return bearings (RAYS,) and their directions (RAYS, 2); shared arrays, not to be written to."""
    bearing = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
    return bearing, np.column_stack([np.cos(bearing), np.sin(bearing)])


def blocked_by(state: WorldState, viewer: VehicleState, points: Floats) -> list[str | None]:
    """Return for each of the points (k, 2) the id of what blocks the view of it; None if it is seen."""
    ids, corners = surfaces(state, viewer)
    origin = np.array([viewer.x_m, viewer.y_m])
    distance, met = first_hits(origin, points - origin, corners)
    return [ids[m] if d < 1 else None for d, m in zip(distance, met, strict=True)]
