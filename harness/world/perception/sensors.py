"""The three sensors of every vehicle, with their range and their noise.

LiDAR: all round, 80 m; position to 0.1 m on each axis, heading to 2°, speed from tracking to 0.8 m/s.
Radar: 60° to either side of the front and of the rear, 150 m; range to 0.4 m, bearing to 1°, range rate
to 0.15 m/s, and tracking with it gives speed to 0.2 m/s.
Camera: 60° to either side of the front and of the rear, 60 m by day and else as `harness.world.ambient`
says; class and turn indicator. It never adds to a
position, because the LiDAR sees all that it sees and places it better.
Noise is Gaussian with those standard deviations (declared for this harness, typical of automotive
data sheets, no particular product), keyed by episode, step, viewer and object.
"""

from dataclasses import dataclass

import numpy as np

from harness.core import noise
from harness.world.ambient import AMBIENTS, DAY, Ambient, sun_rad
from harness.world.perception.rays import Sweep, turned
from harness.world.state import VehicleState, WorldState

LIDAR_RANGE_M, RADAR_RANGE_M = 80.0, 150.0
HALF_FIELD_RAD = np.radians(60.0)
LEAST_RAYS = 3  # rays on an object below which no sensor reports it
# Standard deviations: the LiDAR's position on each axis, the radar's range.
LIDAR_NOISE_M, RADAR_NOISE_M = 0.1, 0.4


@dataclass(frozen=True)
class Detection:
    """One object as all of a vehicle's sensors together report it, in the world frame.

    Attributes:
        id: the object's id (association across vehicles is assumed to be perfect).
        sensors: those of `camera`, `lidar` and `radar` that reported it.
        kind: class from the camera; None without one.
        indicator: turn indicator from the camera: `left`, `right` or `off`; None without one.
        x_m: estimated position of the centre.
        y_m: estimated position of the centre.
        heading_rad: estimated heading; None if only the radar saw it.
        speed_mps: estimated speed.
        range_rate_mps: range rate from the radar, negative when closing; None without one.
        braking: whether it is seen to brake, from the camera; None without one.
    """

    id: str
    sensors: tuple[str, ...]
    kind: str | None
    indicator: str | None
    x_m: float
    y_m: float
    heading_rad: float | None
    speed_mps: float
    range_rate_mps: float | None
    braking: bool | None = None


def detect(
    state: WorldState, viewer: VehicleState, view: Sweep, ambient: Ambient = AMBIENTS[DAY]
) -> list[Detection]:
    """Return the detections of one vehicle's sensors, in the order of the state's vehicles."""
    found = []
    for v in state.vehicles:
        if v.id != viewer.id and len(view.hits.get(v.id, ())) >= LEAST_RAYS:
            detection = _fused(state, viewer, v, ambient)
            if detection:
                found.append(detection)
    return found


def _fused(state: WorldState, viewer: VehicleState, v: VehicleState, ambient: Ambient) -> Detection | None:
    dx, dy = v.x_m - viewer.x_m, v.y_m - viewer.y_m
    distance, bearing = float(np.hypot(dx, dy)), float(np.arctan2(dy, dx))
    off_axis = abs(turned(bearing - viewer.heading_rad))
    in_field = min(off_axis, np.pi - off_axis) <= HALF_FIELD_RAD
    seen = {
        "camera": in_field and distance <= ambient.camera_m and not _dazzled(state, bearing, ambient),
        "lidar": distance <= LIDAR_RANGE_M,
        "radar": in_field and distance <= RADAR_RANGE_M,
    }
    sensors = tuple(name for name, yes in seen.items() if yes)
    if not sensors:
        return None
    z = noise.generator("sensors", state.episode_seed, state.step, viewer.id, v.id).standard_normal(8)

    # Across the bearing the radar is far coarser than the LiDAR, whose position is taken if both see.
    if seen["lidar"]:
        x, y = v.x_m + LIDAR_NOISE_M * z[0], v.y_m + LIDAR_NOISE_M * z[1]
    else:
        r, b = distance + RADAR_NOISE_M * z[0], bearing + np.radians(1.0) * z[1]
        x, y = viewer.x_m + r * np.cos(b), viewer.y_m + r * np.sin(b)
    rate = None
    if seen["radar"]:
        relative = np.array(
            [
                v.speed_mps * np.cos(v.heading_rad) - viewer.speed_mps * np.cos(viewer.heading_rad),
                v.speed_mps * np.sin(v.heading_rad) - viewer.speed_mps * np.sin(viewer.heading_rad),
            ]
        )
        rate = float(relative @ [np.cos(bearing), np.sin(bearing)] + 0.15 * z[2])
    return Detection(
        id=v.id,
        sensors=sensors,
        kind=v.kind if seen["camera"] else None,
        indicator=v.indicator if seen["camera"] else None,
        x_m=float(x),
        y_m=float(y),
        heading_rad=float(v.heading_rad + np.radians(2.0) * z[3]) if seen["lidar"] else None,
        speed_mps=float(max(v.speed_mps + (0.2 if seen["radar"] else 0.8) * z[4], 0.0)),
        range_rate_mps=rate,
        braking=v.braking if seen["camera"] else None,
    )


def _dazzled(state: WorldState, bearing_rad: float, ambient: Ambient) -> bool:
    """Whether the sun blinds a camera in this direction."""
    if not ambient.glare_rad:
        return False
    return bool(abs(turned(bearing_rad - sun_rad(state.episode_seed))) < ambient.glare_rad)
