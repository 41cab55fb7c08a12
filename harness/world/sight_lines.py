"""Geometry of the radio links between the ego and its helpers:
distances, and obstacles between antennas.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from harness.core.arrays import Floats
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Antenna, Site
from harness.world.perception.rays import meetings
from harness.world.scenario import Names
from harness.world.state import BROAD, HEIGHTS_M, Building, VehicleState, WorldState

NO_NAMES = Names(math.nan, {})
LEAST_ANGLE_RAD = np.pi / 6  # streets that meet at a smaller angle run side by side, or merge


Place = tuple[float, float]


def site(
    points: Sequence[tuple[WorldState, Sequence[str]]],
    antennas: Collection[Antenna] = (),
    zones_m: Sequence[Place] = (),
    names: Sequence[Names | None] = (),
) -> Site:
    """Return where the ego and its helpers are in n states, and what is between them.

    Arrays of the result are (n, ...). Each of the n `points` is a state with the ids of its ego and
    helpers, the ego first. Antennas are at vehicle centres; if a building and a vehicle both block
    a link, the building counts. `antennas` are on no vehicle, and add links to the ego and helpers;
    their positions are relative to the point's entry in `zones_m`, the centre of the conflict zone
    of its road, m. It is needed where there are antennas. `names` has for each point what the
    source of its traffic calls vehicles, and is empty where no point has such a source.
    """
    states = [state for state, _ in points]
    viewers: list[list[VehicleState]] = []
    for state, ids in points:
        viewers.append([state.vehicle(id_) for id_ in ids])
    egos = [ego for ego, *_ in viewers]
    helpers = [others for _, *others in viewers]
    among = _site(list(zip(states, egos, helpers, strict=True)))
    of_antennas = {}
    for antenna in antennas:
        places_m = [(x_m + antenna.x_m, y_m + antenna.y_m) for x_m, y_m in zones_m]
        links = _site(list(zip(states, places_m, viewers, strict=True)))
        of_antennas[antenna] = replace(links, first_m=antenna.height_m)
    among = replace(among, antennas=of_antennas)
    return _named(among, points, names) if any(names) else among


def _named(
    among: Site,
    points: Sequence[tuple[WorldState, Sequence[str]]],
    names: Sequence[Names | None],
) -> Site:
    """Return the site with the vehicles' names, and the time, in the source of their traffic."""
    called, times_s, several = [], [], False
    for (state, ids), names_here in zip(points, names, strict=True):
        begin_s, by_id, several_here = names_here or NO_NAMES
        several |= several_here
        absent = 1 + among.sight.shape[-1] - len(ids)
        called.append([*(by_id.get(id_, "") for id_ in ids), *[""] * absent])
        times_s.append(begin_s + state.time_s)
    texts = np.array(called, dtype=str)
    return replace(among, names=texts, time_s=np.array(times_s), several_scenes=several)


def _site(
    points: Sequence[tuple[WorldState, VehicleState | Place, Sequence[VehicleState]]],
) -> Site:
    """Return the links from one end, a vehicle or a place, to some vehicles."""
    n = len(points)
    most = max((len(targets) for _, _, targets in points), default=0)
    xy_m = np.full((n, 1 + most, 2), np.nan)
    sight, blocker_m = np.full((n, most), CLEAR), np.zeros((n, most))
    corner_m = np.full((n, most, 2), np.nan)
    for i, (state, first, targets) in enumerate(points):
        xy_m[i, : 1 + len(targets)] = [_xy(end) for end in (first, *targets)]
        for h, target in enumerate(targets):
            sight[i, h], blocker_m[i, h] = _between(state, first, target)
            if isinstance(first, VehicleState):
                corner_m[i, h] = corner(first, target)
    return Site(xy_m, sight, blocker_m, corner_m)


def _xy(end: VehicleState | Place) -> Place:
    return (end.x_m, end.y_m) if isinstance(end, VehicleState) else end


def _between(state: WorldState, a: VehicleState | Place, b: VehicleState) -> tuple[int, float]:
    """Return what stands between two ends, and the height of the tallest vehicle between them."""
    origin, line = np.array(_xy(a)), np.array([_xy(b)]) - _xy(a)
    # TR 37.885 has a loss for cars and trucks alone; others are narrower than the first Fresnel
    # zone, which at 5.9 GHz is 1 m wide halfway along 20 m.
    vehicles = [v for v in state.vehicles if v.kind in BROAD and v not in (a, b)]
    obstacles: list[VehicleState | Building] = [*vehicles, *state.buildings]
    corners = [obstacle.corners() for obstacle in obstacles]
    if not corners:
        return CLEAR, 0.0
    t, _ = meetings(origin, line, np.array(corners))
    met: list[bool] = (t.reshape(-1, 4).min(axis=1) < 1).tolist()
    between = list(compress(vehicles, met))
    tallest_m = max((HEIGHTS_M[v.kind] for v in between), default=0.0)
    if any(met[len(vehicles) :]):
        return BUILDING, tallest_m
    return (VEHICLE if tallest_m else CLEAR), tallest_m


def corner(a: VehicleState, b: VehicleState) -> Floats:
    """Return how far vehicles `a` and `b` are, m, from where their straight courses cross, (2,).

    It is how far radio waves go around a corner of streets. NaN if their headings are within 30° of
    parallel.
    """
    sine = np.sin(b.heading_rad - a.heading_rad)
    if abs(sine) < np.sin(LEAST_ANGLE_RAD):
        return np.full(2, np.nan)
    dx, dy = b.x_m - a.x_m, b.y_m - a.y_m
    along_a = (dx * np.sin(b.heading_rad) - dy * np.cos(b.heading_rad)) / sine
    along_b = (dx * np.sin(a.heading_rad) - dy * np.cos(a.heading_rad)) / sine
    return np.abs([along_a, along_b])
