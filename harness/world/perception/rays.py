"""Ray casting: which objects a vehicle has a line of sight to, past buildings and other vehicles.

Many viewers look at once, in one pass over arrays, and one viewer is many of which there is one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.core.arrays import Bools, Floats, Ints
from harness.world.state import SIZES_M, VehicleState, WorldState, rectangle

RAYS = 1440  # a quarter of a degree apart
Look = tuple[WorldState, VehicleState]  # a state, and the vehicle that looks around in it


@dataclass(frozen=True)
class Sweep:
    """Hold the rays that a vehicle casts in one full turn, `RAYS` of them, and what each hits."""

    # direction of each ray in the road's frame, radians from +x (east) towards +y (south), (RAYS,)
    bearing_rad: Floats
    range_m: Floats  # distance to the first surface that each ray meets, m, (RAYS,); inf if to none
    # indices from 0 of the rays that end on each vehicle or building, by its id; who is not hit is
    # left out
    hits: dict[str, NDArray[np.intp]]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Hold the outlines that stop the rays of v viewers, n in all, viewer by viewer.

    A viewer is a vehicle that looks. Its surfaces are all other vehicles of its state, in their
    order, then the buildings. Positions are in m to the east and south of the road's origin.
    """

    origins_m: Floats  # the viewers' centres, (v, 2)
    # ids of each viewer's surfaces, v tuples in the viewers' order
    ids: tuple[tuple[str, ...], ...]
    viewer: Ints  # index from 0 of the viewer whose surface each is, (n,)
    place: Ints  # index from 0 of each among that viewer's surfaces, (n,)
    vehicle: Bools  # whether each surface is a vehicle, rather than a building, (n,)
    corners_m: Floats  # the four corners of each surface, (n, 4, 2)

    def by_viewer(self, values: Any) -> Any:
        """Return values of all surfaces as a table with a row for each viewer, (v, k).

        A surface is the outline of a vehicle or building, as one of the v viewers sees it.
        `values`, (n,), has one for each, and k is the number of surfaces of the viewer that has the
        most; cells without a surface are 0 or false.
        """
        table = np.zeros((len(self.ids), max(map(len, self.ids), default=0)), dtype=values.dtype)
        table[self.viewer, self.place] = values
        return table


def turned(angle_rad: Any) -> Any:
    """Wrap an angle, or an array of angles, `angle_rad`, to -pi to pi rad."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


class Outlines(NamedTuple):
    """Hold the outlines of all vehicles of some states, n, and behind these of all buildings, m."""

    corners_m: Floats  # the four corners of each, (n+m, 4, 2)
    # where the vehicles and the buildings of each state begin, by the state's `id`
    first: dict[int, tuple[int, int]]


def outlines(states: Sequence[WorldState]) -> Outlines:
    """Return the outlines of all vehicles and buildings in some states, one of which may be there
    several times.

    Positions are in m to the east and south of the road's origin.
    """
    once = {id(state): state for state in states}
    vehicles = [
        (v.x_m, v.y_m, v.heading_rad, *SIZES_M[v.kind]) for s in once.values() for v in s.vehicles
    ]
    # the states of an episode share their buildings
    walls = {id(state.buildings): state.buildings for state in once.values()}
    boxes = [building.corners() for buildings in walls.values() for building in buildings]
    of_vehicles = rectangle(*np.ascontiguousarray(np.array(vehicles).reshape(-1, 5).T))
    corners_m = np.concatenate([of_vehicles, np.array(boxes).reshape(-1, 4, 2)])
    begin, box = 0, len(vehicles)
    first, first_box = dict[int, tuple[int, int]](), dict[int, int]()
    for wall, buildings in walls.items():
        first_box[wall] = box
        box += len(buildings)
    for key, state in once.items():
        first[key] = begin, first_box[id(state.buildings)]
        begin += len(state.vehicles)
    return Outlines(corners_m, first)


def surfaces(looks: Sequence[Look]) -> Surfaces:
    """Return the outlines of all vehicles and buildings around each viewer, itself excluded.

    Each of `looks` is a state and the vehicle in it that looks, the viewer.
    """
    corners, first = outlines([state for state, _ in looks])
    at, ids, counts = [], [], []
    for state, viewer in looks:
        begin, box = first[id(state)]
        seen = [n for n, v in enumerate(state.vehicles) if v.id != viewer.id]
        at += [begin + n for n in seen]
        at += range(box, box + len(state.buildings))
        ids.append((*(state.vehicles[n].id for n in seen), *(b.id for b in state.buildings)))
        counts.append(len(seen))
    sizes = list(map(len, ids))
    whose = np.repeat(np.arange(len(looks)), sizes)
    place = np.concatenate([np.arange(size) for size in sizes])
    return Surfaces(
        np.array([(v.x_m, v.y_m) for _, v in looks]),
        tuple(ids),
        whose,
        place,
        place < np.array(counts)[whose],
        corners[np.array(at, dtype=int)],
    )


def meetings(origin: Floats, targets: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Intersect r rays from a point with the walls of n rectangles.

    The rays go from `origin` (2,) to `targets` (r, 2), and the rectangles are `corners` (n, 4, 2),
    all in m; wall k goes from corner k to the next. Both results are (r, 4n), a column a wall: how
    far along the ray the wall is, 1 at the target and inf if it is missed, and where on the wall,
    from 0 to 1.
    """
    walls = _walls(np.broadcast_to(origin, (len(corners), 2)), corners).swapaxes(1, 2)
    return _met(walls.reshape(5, -1), targets[:, :1], targets[:, 1:])


def first_met(origins: Floats, targets: Floats, corners: Floats) -> Floats:
    """Return how far along each of n ways a rectangle of its own is met, (n,); inf if it is missed.

    The ways go from `origins` to `targets`, (n, 2), and the rectangles are `corners` (n, 4, 2), all
    in m. It is 1 at the target.
    """
    t, _ = _met(_walls(origins, corners), *(targets - origins).T)
    first: Floats = t.min(axis=0)
    return first


def _walls(origins: Floats, corners: Floats) -> Floats:
    """Return what `_met` reads of the walls of surfaces (n, 4, 2) as seen from origins (n, 2), (5,
    4, n).

    These are x and y of a wall's beginning, those of its vector, and their cross product.
    """
    begin = corners.transpose(2, 1, 0) - origins.T[:, None]
    (x, y), (dx, dy) = begin, np.roll(begin, -1, axis=1) - begin
    return np.stack([x, y, dx, dy, x * dy - y * dx])


def _met(walls: Floats, ray_x: Floats, ray_y: Floats) -> tuple[Floats, Floats]:
    """Compute `meetings` for walls (5, ...) and rays whose coordinates broadcast against each
    other.
    """
    x, y, dx, dy, cross = walls
    # Solve origin + t * ray = start + u * along for every ray and edge by Cramer's rule.
    determinant = ray_x * dy - ray_y * dx
    with np.errstate(divide="ignore", invalid="ignore"):
        t = cross / determinant
        u = (x * ray_y - y * ray_x) / determinant
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf), u


def _first(surface: Ints, target: Ints, t: Floats, targets: int) -> tuple[Floats, Ints]:
    """Find which surface each target's ray meets first;
    of equally near ones, that with the lowest number.

    A surface, by ascending number, may be met on the way to a target at ray parameter t, all (m,).
    Returned are the ray parameter and the number of the surface, (targets,); inf and -1 if nothing
    is met.
    """
    least, met = np.full(targets, np.inf), np.full(targets, -1)
    np.minimum.at(least, target, t)
    nearest = np.flatnonzero((t == least[target]) & (t < np.inf))[::-1]
    met[target[nearest]] = surface[nearest]  # of several, the last one written stays
    return least, met


@dataclass(frozen=True, eq=False)
class Rays:
    """Hold m possible meetings of a ray with a surface, by ascending number of the surface.

    A surface is the outline of a vehicle or building, and a ray goes from a vehicle that looks, a
    viewer.
    """

    surface: Ints  # index of the surface in the arrays of `Surfaces`, (m,)
    target: Ints  # number of the ray from 0, viewer by viewer, `RAYS` of them each, (m,)
    t: Floats  # distance at which the ray meets the surface, m, (m,); inf if it passes by

    def of(self, which: Bools) -> "Rays":
        return Rays(self.surface[which], self.target[which], self.t[which])


def sweep(state: WorldState, viewer: VehicleState) -> Sweep:
    """Cast `RAYS` rays in all directions from a vehicle's centre, and return what they hit.

    They hit all vehicles and buildings of `state` but `viewer`, the vehicle itself.
    """
    around = surfaces([(state, viewer)])
    rays = cast(around, np.ones(len(around.place), dtype=bool))
    distance, met = _first(rays.surface, rays.target, rays.t, RAYS)
    hits = {name: np.flatnonzero(met == n) for n, name in enumerate(around.ids[0])}
    return Sweep(
        _all_round()[0], distance, {name: rays for name, rays in hits.items() if len(rays)}
    )


def cast(around: Surfaces, of: Bools) -> Rays:
    """Follow rays from all viewers that may meet certain outlines, and return what they meet.

    Outlines, surfaces, are of vehicles and buildings; `of`, (n,), says which of the n of `around`
    count. The rays that may meet one of these are followed to all surfaces.
    """
    begin, count = _towards(around)
    surface = np.repeat(np.arange(len(count)), count)
    ray = np.arange(len(surface)) + (begin - np.cumsum(count) + count)[surface]
    ray[ray >= RAYS] -= RAYS
    target = ray + (around.viewer * RAYS)[surface]
    if not of.all():
        needed = np.zeros(len(around.ids) * RAYS, dtype=bool)
        needed[target[of[surface]]] = True
        taken = needed[target]
        surface, ray, target = surface[taken], ray[taken], target[taken]
    walls = _walls(around.origins_m[around.viewer], around.corners_m)
    t, _ = _met(walls.take(surface, axis=2), *_all_round()[1].take(ray, axis=1))
    return Rays(surface, target, t.min(axis=0))


def rays_on(around: Surfaces, rays: Rays, solid: Bools) -> tuple[Ints, Ints]:
    """Return how many rays reach each surface, (n,), and where each ray of `rays` ends, (m,).

    `around` has the n surfaces, outlines of vehicles and buildings. Only those where `solid`, (n,),
    is true stop rays; all others let them pass. The second result is, for each of the m meetings,
    the index of the surface that stops its ray; -1 if none.
    """
    stops = solid[rays.surface]
    ended = rays.of(stops)
    least, met = _first(ended.surface, ended.target, ended.t, len(around.ids) * RAYS)
    come = rays.surface[~stops & (rays.t < least[rays.target])]
    return np.bincount(np.concatenate([met[met >= 0], come]), minlength=len(solid)), met[
        rays.target
    ]


def _towards(around: Surfaces) -> tuple[Ints, Ints]:
    """Return the first ray that may meet each surface, (n,), and how many may,
    between its outer corners.
    """
    to = around.corners_m - around.origins_m[around.viewer, None]
    bearing = np.arctan2(to[..., 1], to[..., 0])
    aside = turned(bearing - bearing[:, :1])
    step = 2 * np.pi / RAYS
    first = np.floor((bearing[:, 0] + aside.min(axis=1)) / step).astype(int) - 1
    last = np.ceil((bearing[:, 0] + aside.max(axis=1)) / step).astype(int) + 1
    # A viewer inside a surface, or right beside it, may meet it in any direction.
    all_round = np.ptp(aside, axis=1) >= np.pi - step
    return np.where(all_round, 0, first % RAYS), np.where(all_round, RAYS, last + 1 - first)


@lru_cache(maxsize=1)
def _all_round() -> tuple[Floats, Floats]:
    """Return bearings (RAYS,) and their directions (2, RAYS);
    shared arrays, not to be written to.
    """
    bearing = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
    return bearing, np.stack([np.cos(bearing), np.sin(bearing)])


def hidden(around: Surfaces, points: Floats, solid: Bools) -> Ints:
    """Return which surface hides each of k points from each of v viewers, (v, k); -1 if none.

    It is the surface's index in `around`, the outlines of vehicles and buildings around the
    viewers. `points` are (k, 2) m, the same for all viewers. Only surfaces where `solid`, (n,), is
    true hide.
    """
    surface = np.flatnonzero(solid)
    viewer = around.viewer[surface]
    walls = _walls(around.origins_m[viewer], around.corners_m[surface])
    x, y = points.T[:, None] - around.origins_m.T[..., None]
    t, _ = _met(walls[..., None], x[viewer], y[viewer])
    target = viewer[:, None] * len(points) + np.arange(len(points))
    least, met = _first(
        np.repeat(surface, len(points)), target.ravel(), t.min(axis=0).ravel(), x.size
    )
    return np.where(least < 1, met, -1).reshape(x.shape)


def blocked_by(state: WorldState, viewer: VehicleState, points: Floats) -> list[str | None]:
    """Return the id of the vehicle or building that hides each point from a viewer; None if seen.

    `viewer` is a vehicle of `state`, and `points` are (k, 2), m to the east and south of the road's
    origin.
    """
    around = surfaces([(state, viewer)])
    met = hidden(around, points, np.ones(len(around.place), dtype=bool))
    return [around.ids[0][n] if n >= 0 else None for n in met[0].tolist()]
