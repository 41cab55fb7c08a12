"""Say where vehicles were between two decision points, from their states at both.

Scenes are states at decisions, a second apart, and a stream runs ten times a second. Positions lie
on the cubic curve that has both places and both velocities (Hermite), and headings turn evenly.
Before the first decision, vehicles have driven at constant speed, as for beacons.
"""

from collections.abc import Sequence

import numpy as np
from msgspec import structs

from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.world.state import VehicleState, WorldState


def moments(scene: Scene, times_s: Sequence[float]) -> list[WorldState]:
    """Return the state of the world at some times up to a scene, since the decision before.

    `times_s` are in s from the start of the episode. At the first decision of a course, they may
    lie as far back as one wants. A vehicle that is not there at both ends is left out. All states
    have the scene's step, by which sensors draw their errors: that of a track lasts until the next
    decision.
    """
    earlier = scene.before()
    after = scene.state
    poses = _before(after, times_s) if earlier is None else _between(earlier.state, after, times_s)
    ids = {v.id for v in after.vehicles} if earlier is None else _both(earlier.state, after)
    vehicles = [v for v in after.vehicles if v.id in ids]
    states = []
    for time_s, rows in zip(times_s, poses.tolist(), strict=True):
        there = tuple(_at(v, row) for v, row in zip(vehicles, rows, strict=True))
        states.append(structs.replace(after, time_s=time_s, vehicles=there, beacons=()))
    return states


def _both(before: WorldState, after: WorldState) -> set[str]:
    return {v.id for v in before.vehicles} & {v.id for v in after.vehicles}


def _at(v: VehicleState, row: Sequence[float]) -> VehicleState:
    x, y, heading, speed = row
    return structs.replace(v, x_m=x, y_m=y, heading_rad=heading, speed_mps=speed)


def _poses(vehicles: Sequence[VehicleState]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return places (V, 2), velocities (V, 2), headings (V,) and speeds (V,)."""
    rows = [(v.x_m, v.y_m, v.heading_rad, v.speed_mps) for v in vehicles]
    x, y, heading, speed = np.array(rows).reshape(-1, 4).T
    along = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.stack([x, y], axis=-1), along * speed[:, None], heading, speed


def _before(first: WorldState, times_s: Sequence[float]) -> Floats:
    """Return x, y, heading and speed before the first decision, (T, V, 4)."""
    place, velocity, heading, speed = _poses(first.vehicles)
    ago_s = np.asarray(times_s)[:, None, None] - first.time_s
    places = place + velocity * ago_s
    others = np.broadcast_to(np.stack([heading, speed], axis=-1), places.shape)
    return np.concatenate([places, others], axis=-1)


def _between(before: WorldState, after: WorldState, times_s: Sequence[float]) -> Floats:
    """Return x, y, heading and speed between two decisions, (T, V, 4), of who is there at both."""
    ids = _both(before, after)
    place, velocity, heading, _ = _poses([v for v in before.vehicles if v.id in ids])
    end, end_velocity, end_heading, _ = _poses([v for v in after.vehicles if v.id in ids])
    length_s = after.time_s - before.time_s
    t = ((np.asarray(times_s) - before.time_s) / length_s)[:, None, None]
    moved, start_m, end_m = end - place, velocity * length_s, end_velocity * length_s
    # Coefficients of the cubic in t, from 0 to 1.
    square, cube = 3 * moved - 2 * start_m - end_m, start_m + end_m - 2 * moved
    places = place + t * (start_m + t * (square + t * cube))
    motion = (start_m + t * (2 * square + 3 * t * cube)) / length_s
    turned = np.remainder(end_heading - heading + np.pi, 2 * np.pi) - np.pi
    headings = heading + t[..., 0] * turned
    along = motion[..., 0] * np.cos(headings) + motion[..., 1] * np.sin(headings)
    speeds = np.maximum(along, 0.0)
    return np.concatenate([places, headings[..., None], speeds[..., None]], axis=-1)
