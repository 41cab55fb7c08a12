"""The three sensors of every vehicle, with their range and their noise.

LiDAR: all round, 80 m; position to 0.1 m on each axis, heading to 2°, speed from tracking to 0.8
m/s. Radar: 60° to either side of the front and of the rear, 150 m; range to 0.4 m, bearing to 1°,
range rate to 0.15 m/s, and tracking with it gives speed to 0.2 m/s. Camera: 60° to either side of
the front and of the rear, 60 m by day and else as `harness.world.ambient` says; kind and turn
indicator, which bicycles and pedestrians do not have. It never adds to a position, because the
LiDAR sees all that it sees and places it better. Noise is Gaussian with those standard deviations
(declared for this harness, typical of automotive data sheets, no particular product), keyed by
episode, step, viewer and object.
"""

from collections.abc import Collection, Sequence
from itertools import compress, product
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from harness.core import noise
from harness.core.arrays import Bools, Floats
from harness.world.ambient import Ambient, sun_rad
from harness.world.parameters import Parameters
from harness.world.perception.rays import Look, Surfaces, cast, rays_on, surfaces, turned
from harness.world.state import BROAD, Kind, VehicleState, WorldState

LIDAR_RANGE_M, RADAR_RANGE_M = 80.0, 150.0
HALF_FIELD_RAD = np.radians(60.0)
# Rays on an object below which no sensor reports it. A bicycle, motorcycle or pedestrian is so
# narrow that one ray shows much of it, and several layers of a LiDAR meet it one above the other.
LEAST_RAYS, LEAST_ON_NARROW = 3, 1
# Standard deviations: the LiDAR's position on each axis, the radar's range.
LIDAR_NOISE_M, RADAR_NOISE_M = 0.1, 0.4
BEARING_NOISE_RAD = np.radians(1.0)  # of the radar
SPEED_NOISE_MPS = {True: 0.2, False: 0.8}  # with the radar, or by the LiDAR's tracking alone
# Names of the sensors that report, by whether each of them does.
SENSORS = {
    flags: tuple(compress(("camera", "lidar", "radar"), flags))
    for flags in product((False, True), repeat=3)
}

Pair = tuple[int, int]  # indices of a viewer, and of a vehicle among its surfaces
Line = tuple[WorldState, VehicleState, VehicleState]  # a state, a viewer, and whom it looks at


class Detection(Struct, frozen=True):
    """Describe one object as all sensors of one vehicle together report it, in the road's frame.

    What one sensor alone can tell is None without it.
    """

    id: str  # the object's id (association across vehicles is assumed to be perfect)
    sensors: tuple[str, ...]  # those of `camera`, `lidar` and `radar` that reported it
    kind: Kind | None  # kind of road user, from the camera; None without one
    # turn indicator from the camera: `left`, `right` or `off`; None without camera or indicator
    indicator: str | None
    x_m: float  # estimated position of the centre, m to the east of the road's origin
    y_m: float  # estimated position of the centre, m to the south
    # estimated heading, rad from +x (east) towards +y (south); None if only the radar saw it
    heading_rad: float | None
    speed_mps: float  # estimated speed, m/s
    # range rate from the radar, m/s, negative when closing; None without one
    range_rate_mps: float | None
    braking: bool | None = None  # whether it is seen to brake, from the camera; None without one
    # seconds since it was seen, of one that a message reports of an earlier time; else None
    age_s: float | None = None


def detect(state: WorldState, viewer: VehicleState, parameters: Parameters) -> list[Detection]:
    """Return what the sensors of `viewer` report of a state, in the order of its vehicles.

    The scenario's `parameters` have the light and weather, and the rule of what a vehicle that is
    not reported hides.
    """
    looks = [(state, viewer)]
    return list(reports(looks, surfaces(looks), parameters).values())


def reports(
    looks: Sequence[Look], around: Surfaces, parameters: Parameters
) -> dict[Pair, Detection]:
    """Return what the sensors of several viewers report, by (viewer, vehicle).

    Both parts of a key are indices from 0: the viewer's in `looks`, each a state and the vehicle
    that looks in it, and the vehicle's among the viewer's surfaces in `around`, which is
    `surfaces(looks)`. A vehicle that is hit by too few rays or out of range is not reported. Under
    `parameters.perception` 1 it still hides what is behind it, under 2 it hides nothing.
    """
    lines = _lines(_around(looks), parameters.light)
    seen = _reported(lines, around, parameters)
    pairs = zip(around.viewer[seen].tolist(), around.place[seen].tolist(), strict=True)
    detected = _estimates(lines.take(seen[around.vehicle]))
    return {pair: d for pair, d in zip(pairs, detected, strict=True) if d}


def reported(looks: Sequence[Look], around: Surfaces, parameters: Parameters) -> Bools:
    """Return a mask of the n surfaces that are vehicles which viewers' sensors report, (n,).

    A surface is the outline of a vehicle or building as a viewer sees it. The arguments are as
    those of `reports`, which has these vehicles.
    """
    return _reported(_lines(_around(looks), parameters.light), around, parameters)


def _around(looks: Sequence[Look]) -> list[Line]:
    """Return the line to each vehicle around each viewer, in the order of their surfaces."""
    lines = []
    for state, viewer in looks:
        lines += [(state, viewer, v) for v in state.vehicles if v.id != viewer.id]
    return lines


def _reported(lines: "_Lines", around: Surfaces, parameters: Parameters) -> Bools:
    # rays from which each surface is reported; no number is enough for what is out of range
    least = np.full(len(around.place), np.inf)
    broad = np.array([target.kind in BROAD for *_, target in lines.pairs], dtype=bool)
    of_kind = np.where(broad, LEAST_RAYS, LEAST_ON_NARROW)
    least[around.vehicle] = np.where(lines.sensors.any(axis=0), of_kind, np.inf)
    rays = cast(around, least < np.inf)
    before = np.ones(len(around.place), dtype=bool)
    count, first = rays_on(around, rays, before)
    now = count >= least
    if parameters.perception == 1:
        return now
    solid = ~around.vehicle | now
    # What is reported although all hide each other stays so. The other rays end on what is not
    # reported.
    passing = (first >= 0) & ~solid[first]
    rays, first, certain = rays.of(passing), first[passing], np.where(solid, count, 0)
    if not (~solid[rays.surface] & (rays.t < np.inf) & (rays.surface != first)).any():
        return now
    while True:
        then = certain + rays_on(around, rays, solid)[0] >= least
        after = ~around.vehicle | then
        if np.array_equal(after, solid):
            return then
        if np.array_equal(after, before):
            # Vehicles that run into each other may hide each other in turns: none of them is
            # reported.
            return then & now
        before, solid, now = solid, after, then


def among(around: Surfaces, pairs: Collection[tuple[int, int]]) -> Bools:
    """Return a mask of the surfaces that belong to some pairs of a viewer and a vehicle, (n,).

    A surface is the outline of a vehicle or building. A pair of `pairs` is the index of a viewer
    and that of a surface among the viewer's own, from 0; `around` has all n surfaces, viewer by
    viewer.
    """
    most = max([len(ids) for ids in around.ids], default=0)
    table = np.zeros((len(around.ids), most), dtype=bool)
    viewers, places = np.array(list(pairs), dtype=int).reshape(-1, 2).T
    table[viewers, places] = True
    return table[around.viewer, around.place]


def _motion(vehicles: Sequence[VehicleState]) -> Floats:
    """Return x, y, heading and speed of vehicles, (4, n)."""
    rows = [(v.x_m, v.y_m, v.heading_rad, v.speed_mps) for v in vehicles]
    return np.array(rows).reshape(-1, 4).T.copy()


class _Lines(NamedTuple):
    """Hold what lies between n viewers and the vehicles that they look at, each (n,)."""

    pairs: Sequence[Line]
    viewers: Floats  # x, y, heading and speed of the viewers, (4, n)
    vehicles: Floats  # the same of the vehicles
    distance_m: Floats
    bearing_rad: Floats  # of the line in the road's frame
    sensors: Bools  # whether camera, LiDAR and radar report the vehicle, (3, n)

    def take(self, which: Bools) -> "_Lines":
        """Return the lines of a mask, (n,)."""
        return _Lines(
            list(compress(self.pairs, which)),
            self.viewers[:, which],
            self.vehicles[:, which],
            self.distance_m[which],
            self.bearing_rad[which],
            self.sensors[:, which],
        )


def _lines(pairs: Sequence[Line], ambient: Ambient) -> _Lines:
    viewers = _motion([viewer for _, viewer, _ in pairs])
    vehicles = _motion([target for *_, target in pairs])
    dx, dy = vehicles[:2] - viewers[:2]
    distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
    off_axis = np.abs(turned(bearing - viewers[2]))
    in_field = np.minimum(off_axis, np.pi - off_axis) <= HALF_FIELD_RAD
    camera = in_field & (distance <= ambient.camera_m)
    if ambient.glare_rad:
        camera &= ~_dazzled([state.episode_seed for state, *_ in pairs], bearing, ambient)
    lidar = distance <= LIDAR_RANGE_M
    radar = in_field & (distance <= RADAR_RANGE_M)
    return _Lines(pairs, viewers, vehicles, distance, bearing, np.stack([camera, lidar, radar]))


def detections(pairs: Sequence[Line], ambient: Ambient) -> list[Detection | None]:
    """Return what a viewer's sensors report of a vehicle, for each pair; None if nothing.

    Each of `pairs` is a state, a viewer, and a vehicle that the viewer has a line of sight to,
    which is not checked. `ambient` is the light and weather, which limit the camera.
    """
    return _estimates(_lines(pairs, ambient))


def _estimates(lines: _Lines) -> list[Detection | None]:
    pairs, viewers, vehicles, distance, bearing, (_, lidar, radar) = lines
    if not pairs:
        return []
    (from_x, from_y, from_heading, from_speed), (x, y, heading, speed) = viewers, vehicles
    z = np.zeros((8, len(pairs)))
    sensed = np.flatnonzero(lines.sensors.any(axis=0)).tolist()
    places: dict[tuple[object, ...], list[int]] = {}  # several between two decisions
    for k in sensed:
        state, viewer, v = pairs[k]
        key = "sensors", state.episode_seed, state.step, viewer.id, v.id
        places.setdefault(key, []).append(k)
    for there, draws in zip(places.values(), noise.generators(list(places)), strict=True):
        z[:, there] = draws.standard_normal((8, 1))

    # Across the bearing the radar is far coarser than the LiDAR, whose position is taken if both
    # see.
    r, b = distance + RADAR_NOISE_M * z[0], bearing + BEARING_NOISE_RAD * z[1]
    x_m = np.where(lidar, x + LIDAR_NOISE_M * z[0], from_x + r * np.cos(b))
    y_m = np.where(lidar, y + LIDAR_NOISE_M * z[1], from_y + r * np.sin(b))
    # The velocity relative to the viewer.
    parting_x = speed * np.cos(heading) - from_speed * np.cos(from_heading)
    parting_y = speed * np.sin(heading) - from_speed * np.sin(from_heading)
    parting = np.stack([parting_x, parting_y], axis=-1)
    sight = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    rate_mps = np.vecdot(parting, sight) + 0.15 * z[2]
    heading_rad = heading + np.radians(2.0) * z[3]
    speed_noise_mps = np.where(radar, SPEED_NOISE_MPS[True], SPEED_NOISE_MPS[False])
    speed_mps = np.maximum(speed + speed_noise_mps * z[4], 0.0)
    flags = lines.sensors.T.tolist()
    estimates = np.stack([x_m, y_m, heading_rad, speed_mps, rate_mps], axis=-1).tolist()
    detected: list[Detection | None] = []
    for (*_, v), by_sensor, numbers in zip(pairs, flags, estimates, strict=True):
        by_camera, by_lidar, by_radar = by_sensor
        its_x, its_y, its_heading, its_speed, its_rate = numbers
        detection = Detection(
            v.id,
            SENSORS[by_camera, by_lidar, by_radar],
            v.kind if by_camera else None,
            v.indicator if by_camera else None,
            its_x,
            its_y,
            its_heading if by_lidar else None,
            its_speed,
            its_rate if by_radar else None,
            v.braking if by_camera else None,
        )
        detected.append(detection if any(by_sensor) else None)
    return detected


def _dazzled(episode_seeds: Sequence[int], bearing_rad: Floats, ambient: Ambient) -> Bools:
    """Return whether the sun blinds a camera in each direction (n,), in episodes of these seeds."""
    suns = {seed: sun_rad(seed) for seed in set(episode_seeds)}
    sun = np.array([suns[seed] for seed in episode_seeds])
    return np.asarray(np.abs(turned(bearing_rad - sun)) < ambient.glare_rad)
