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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
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
    time_s = (first_frame + len(poses) - 1) / p.simulation_hz
    kept: list[Beacon] = []
    for place, sender in enumerate(radios):
        receivers = tuple(radios[:1] if place else radios[1:])
        target = None if place else target_mps
        newest_first = chain(
            _sent(p, seed, sender, receivers, target, poses[:, place], first_frame),
            reversed([b for b in before if b.sender == sender]),
        )
        kept += reversed(_that_matter(newest_first, {*receivers}, time_s))
    return tuple(kept)


def _that_matter(newest_first: Iterable[Beacon], receivers: set[str], time_s: float) -> list[Beacon]:
    """Of one sender's beacons those under way, and the last that each receiver has."""
    kept = []
    for beacon in newest_first:
        if not receivers:
            break
        if not receivers.isdisjoint(beacon.heard_by):
            kept.append(beacon)
        if _is_there(beacon, time_s):
            receivers = receivers.difference(beacon.heard_by)
    return kept


def _sent(
    p: Parameters, seed: int, sender: str, receivers: tuple[str, ...], target_mps: float | None,
    poses: Floats, first_frame: int,
) -> Iterator[Beacon]:  # fmt: skip
    """What one vehicle, whose poses these are, (F, 4), broadcasts in these frames, the last first."""
    phase, errors, heard_by = _draws(p, seed, sender, receivers)
    every, lead = p.simulation_hz / p.beacon_hz, _lead_frames(p)  # frames
    number = math.ceil((first_frame + len(poses) + lead) / every - phase)
    while number >= 0 and (frame := math.floor((number + phase) * every) - lead) >= first_frame:
        if frame < first_frame + len(poses):
            x, y, heading, speed = (poses[frame - first_frame] + errors[number]).tolist()
            time_s = frame / p.simulation_hz
            yield Beacon(
                sender, time_s, time_s + p.beacon_delay_s, round(x, 2), round(y, 2), round(heading, 3),
                max(round(speed, 2), 0.0), target_mps, heard_by[number],
            )  # fmt: skip
        number -= 1


def _is_there(beacon: Beacon, time_s: float) -> bool:
    return beacon.arrives_s <= time_s + ROUNDING_S


def _lead_frames(p: Parameters) -> int:
    return math.ceil(max(LEAD_S, 1 / p.beacon_hz + p.beacon_delay_s) * p.simulation_hz)


@lru_cache(maxsize=1024)
def _draws(
    p: Parameters, seed: int, sender: str, receivers: tuple[str, ...]
) -> tuple[float, Floats, list[tuple[str, ...]]]:
    """When a sender begins, as a share of its period; its errors, (n, 4); who hears each beacon."""
    n = math.ceil((_lead_frames(p) / p.simulation_hz + p.time_limit_s) * p.beacon_hz) + 2
    own = noise.generator("beacons", seed, sender)
    phase = float(own.random())
    sizes = [p.beacon_noise_m, p.beacon_noise_m, p.beacon_noise_rad, p.beacon_noise_mps]
    errors = own.standard_normal((n, 4)) * sizes
    draws = {receiver: noise.uniforms((n,), "beacons", seed, sender, receiver) for receiver in receivers}
    heard_by = [
        tuple(r for r in receivers if number == 0 or draws[r][number] >= p.beacon_loss) for number in range(n)
    ]
    return phase, errors, heard_by
