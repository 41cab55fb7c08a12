"""Beacons: what vehicles know of each other before anybody asks.

The ego and the helpers broadcast where they are, as with a CAM or a BSM; nobody else has a radio. A receiver
knows a sender from the last beacon that got through, and takes it to have driven on from there at constant
speed along its heading, as receivers do. The dials are the scenario's (`Parameters`):

    rate      10 Hz, a BSM's; a CAM comes 1 to 10 times a second (ETSI EN 302 637-2). Each vehicle begins at
              a time of its own.
    delay     20 ms until all receivers have it, a frame: NR Mode 2 waits 17.5 ms for a slot on average.
    loss      8 %, the paper's V2X profile. That losses are independent is assumed: a shadowed link loses
              many beacons in a row.
    noise     Gaussian, 0.2 m on each axis and 0.2°: the noisy setting of V2X-ViT (arXiv 2203.10638). That a
              speed has 0.1 m/s, and that errors are new in each beacon, is assumed. They are the sender's,
              so all receivers read the same, rounded to 1 cm, 1 cm/s and 1 mrad.
    content   pose and speed, and the ego's target speed, which no CAM has: that is assumed.

Until its start an episode's vehicles have driven at constant speed, and the first beacon, up to LEAD_S
before the start, gets through to everybody. Draws are keyed by layout seed, sender, receiver and number of
the beacon, so no condition, no seed of the channel and no order of asking changes what anybody knows.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from harness.core import noise
from harness.core.arrays import Bools, Floats
from harness.world.scenario import Parameters
from harness.world.state import Beacon, VehicleState, WorldState

LEAD_S = 1.0
ROUNDING_S = 1e-9


def last_heard(state: WorldState, sender: str, receiver: str) -> Beacon | None:
    """The newest beacon of the sender that the receiver has; None where it knows the truth instead."""
    heard = [
        b
        for b in state.beacons
        if b.sender == sender and receiver in b.heard_by and _is_there(b, state.time_s)
    ]
    return max(heard, key=lambda b: b.time_s, default=None)


def known(state: WorldState, sender: str, receiver: str) -> VehicleState:
    """Where the receiver takes the sender to be now: the truth of itself, and under perfect knowledge."""
    vehicle, beacon = state.vehicle(sender), last_heard(state, sender, receiver)
    if beacon is None:
        return vehicle
    travelled_m = beacon.speed_mps * (state.time_s - beacon.time_s)
    return replace(
        vehicle,
        x_m=beacon.x_m + travelled_m * math.cos(beacon.heading_rad),
        y_m=beacon.y_m + travelled_m * math.sin(beacon.heading_rad),
        heading_rad=beacon.heading_rad,
        speed_mps=beacon.speed_mps,
    )


def lead_in(p: Parameters, poses: Floats) -> Floats:
    """Poses (F, V, 4) from the first beacon to the start, where they are (V, 4), at constant speed."""
    x, y, heading, speed = poses.T
    time_s = np.arange(-_lead_frames(p), 1)[:, None] / p.simulation_hz
    course = [x + speed * np.cos(heading) * time_s, y + speed * np.sin(heading) * time_s]
    return np.stack([*course, *np.broadcast_arrays(heading, speed, time_s)[:2]], axis=-1)


def broadcast(
    p: Parameters, seed: int, before: Sequence[Beacon], radios: Sequence[str], target_mps: float,
    poses: Floats, first_frame: int,
) -> tuple[Beacon, ...]:  # fmt: skip
    """The beacons that matter after some more frames: the last ones heard, and those under way.

    Args:
        p: the dials.
        seed: of the layout.
        before: the beacons that mattered before these frames.
        radios: ids of who broadcasts, the ego first, then the helpers, whom it hears and who hear it.
        target_mps: what the ego's speed controller aims at.
        poses: x, y, heading and speed of each in each frame, (F, V, 4).
        first_frame: number of the first of these frames; 0 is the start.
    """
    if p.perfect_knowledge:
        return ()
    end = first_frame + len(poses)
    beacons = []
    for place, sender in enumerate(radios):
        beacons += [b for b in before if b.sender == sender]
        receivers = tuple(radios[:1] if place else radios[1:])
        phase, errors, lost = _draws(p, seed, sender, receivers)
        every = p.simulation_hz / p.beacon_hz  # frames
        number = max(0, int((first_frame + _lead_frames(p)) / every - phase) - 1)
        while (frame := math.floor((number + phase) * every) - _lead_frames(p)) < end:
            if frame >= first_frame:
                x, y, heading, speed = (poses[frame - first_frame, place] + errors[number]).tolist()
                hearing = tuple(r for r, gone in zip(receivers, lost[number], strict=True) if not gone)
                time_s = frame / p.simulation_hz
                beacons.append(Beacon(
                    sender, time_s, time_s + p.beacon_delay_s, round(x, 2), round(y, 2), round(heading, 3),
                    max(round(speed, 2), 0.0), None if place else target_mps, hearing,
                ))  # fmt: skip
            number += 1
    return _that_matter(beacons, (end - 1) / p.simulation_hz)


def _that_matter(beacons: Sequence[Beacon], time_s: float) -> tuple[Beacon, ...]:
    """The last that each receiver has, and those under way; each sender's in order of time."""
    last = {(b.sender, r): b for b in beacons if _is_there(b, time_s) for r in b.heard_by}
    return tuple(
        b for b in beacons if any(not _is_there(b, time_s) or last[b.sender, r] is b for r in b.heard_by)
    )


def _is_there(beacon: Beacon, time_s: float) -> bool:
    return beacon.arrives_s <= time_s + ROUNDING_S


def _lead_frames(p: Parameters) -> int:
    return math.ceil(max(LEAD_S, 1 / p.beacon_hz + p.beacon_delay_s) * p.simulation_hz)


@lru_cache(maxsize=1024)
def _draws(p: Parameters, seed: int, sender: str, receivers: tuple[str, ...]) -> tuple[float, Floats, Bools]:
    """When a sender begins, as a share of its period; its errors (n, 4); who loses which beacon (n, R)."""
    n = math.ceil((_lead_frames(p) / p.simulation_hz + p.time_limit_s) * p.beacon_hz) + 1
    own = noise.generator("beacons", seed, sender)
    phase = float(own.random())
    errors = own.standard_normal((n, 4)) * [
        p.beacon_noise_m,
        p.beacon_noise_m,
        p.beacon_noise_rad,
        p.beacon_noise_mps,
    ]
    lost = np.zeros((n, len(receivers)), dtype=bool)
    for place, receiver in enumerate(receivers):
        lost[1:, place] = noise.uniforms((n,), "beacons", seed, sender, receiver)[1:] < p.beacon_loss
    return phase, errors, lost
