"""Geometry of the radio links between the ego and its helpers:
distances, and obstacles between antennas.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Antenna, Site
from harness.world.perception.rays import first_met, outlines
from harness.world.scenario import Names
from harness.world.state import BROAD, HEIGHTS_M, VehicleState, WorldState

NO_NAMES = Names(math.nan, {})
LEAST_ANGLE_RAD = np.pi / 6  # streets that meet at a smaller angle run side by side, or merge


Place = tuple[float, float]
Link = tuple[WorldState, VehicleState | Place, VehicleState]  # a state, and both ends in it


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
    links: list[Link] = []
    for i, (state, first, targets) in enumerate(points):
        xy_m[i, : 1 + len(targets)] = [_xy(end) for end in (first, *targets)]
        links += [(state, first, target) for target in targets]
    there = ~np.isnan(xy_m[:, 1:, 0])
    sight[there], blocker_m[there] = _between(links)
    pairs = [(a, b) for _, a, b in links if isinstance(a, VehicleState)]
    if pairs:  # a place has no course
        corner_m[there] = corners(pairs)
    return Site(xy_m, sight, blocker_m, corner_m)


def _xy(end: VehicleState | Place) -> Place:
    return (end.x_m, end.y_m) if isinstance(end, VehicleState) else end


def _between(links: Sequence[Link]) -> tuple[Ints, Floats]:
    """Return what stands between both ends of m links, and the height of the tallest vehicle
    there, both (m,).
    """
    corners_m, first = outlines([state for state, _, _ in links])
    # number of a link, that of an outline that may stand between its ends, and its height, 0 of a
    # building
    obstacles: list[tuple[int, int, float]] = []
    for n, (state, a, b) in enumerate(links):
        begin, box = first[id(state)]
        # TR 37.885 has a loss for cars and trucks alone; others are narrower than the first
        # Fresnel zone, which at 5.9 GHz is 1 m wide halfway along 20 m.
        for place, v in enumerate(state.vehicles):
            if v.kind in BROAD and v not in (a, b):
                obstacles.append((n, begin + place, HEIGHTS_M[v.kind]))
        obstacles += [(n, box + place, 0.0) for place in range(len(state.buildings))]
    rows = np.array(obstacles).reshape(-1, 3)
    (link, outline), height_m = rows[:, :2].T.astype(int), rows[:, 2]
    ends = np.array([(*_xy(a), *_xy(b)) for _, a, b in links]).reshape(-1, 4)[link]
    met = first_met(ends[:, :2], ends[:, 2:], corners_m[outline]) < 1
    tallest_m, walled = np.zeros(len(links)), np.zeros(len(links), dtype=bool)
    np.maximum.at(tallest_m, link[met], height_m[met])
    walled[link[met & (height_m == 0)]] = True
    return np.select([walled, tallest_m > 0], [BUILDING, VEHICLE], CLEAR), tallest_m


def corners(pairs: Sequence[tuple[VehicleState, VehicleState]]) -> Floats:
    """Return how far two vehicles are, m, from where their straight courses cross, (n, 2).

    `pairs` are n such vehicles. It is how far radio waves go around a corner of streets. NaN if
    their headings are within 30° of parallel.
    """
    poses = [(v.x_m, v.y_m, v.heading_rad) for pair in pairs for v in pair]
    x, y, heading = np.array(poses).reshape(-1, 2, 3).T.copy()
    (dx,), (dy,) = np.diff(x, axis=0), np.diff(y, axis=0)
    sine = np.sin(heading[1] - heading[0])
    crossing = np.where(np.abs(sine) < np.sin(LEAST_ANGLE_RAD), np.nan, sine)
    aside_m = dx * np.sin(heading[::-1]) - dy * np.cos(heading[::-1])
    return np.asarray(np.abs(aside_m / crossing).T)
