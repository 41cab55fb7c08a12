"""Beacons: how vehicles know of each other before anybody asks.

The ego and the helpers broadcast their position, as with a CAM or a BSM; they hear each other. With
`radio_share` so does other traffic, the danger among it: the ego and all helpers hear it. A
receiver knows a sender from the last beacon that it received, and extrapolates from there at
constant speed along the heading, as real receivers do. The settings are the scenario's
(`Parameters`):

    rule      `fixed`: 10 Hz, a BSM's. `cam` (ETSI EN 302 637-2, 6.1.3): a check, 10 times a second,
              finds the vehicle turned by 4°, 4 m farther or 0.5 m/s faster or slower than its last
              CAM says; or that one older than 1 s or, for three CAMs on end, than the last interval
              of one that moved. Each vehicle begins at a time of its own.
    delay     20 ms until all receivers have it, a frame: NR Mode 2 waits 17.5 ms for a slot on
              average.
    loss      8 %, the paper's V2X profile. That losses are independent is assumed: a shadowed link
              loses many beacons in a row. With `beacon_channel` a beacon of 190 bytes (3GPP TR
              36.885) is lost as on that radio's link: by where both are when it is sent, what
              stands between them, and shadowing that belongs to the layout, and not to a run's
              seed.
    noise     Gaussian, 0.2 m on each axis and 0.2°: the noisy setting of V2X-ViT (arXiv
              2203.10638). That a speed has 0.1 m/s, and that errors are new in each beacon, is
              assumed. They are the sender's, so all receivers read the same, rounded to 1 cm, 1
              cm/s and 1 mrad.
    content   pose, speed and class, and the ego's target speed, which no CAM has: that is assumed.
              A CAM may have a turn indicator (EN 302 637-2, 7.1: in its low-frequency part); none
              is sent here.

Before the start of an episode, its vehicles have driven at constant speed, and the first beacon, up
to LEAD_S before the start, is received by everybody. Draws are keyed by layout seed, sender,
receiver and number of the beacon, so no condition, no seed of the channel and no order of asking
changes what anybody knows.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, lru_cache, partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from harness.core import noise
from harness.core.arrays import Floats
from harness.radio.fading import NO_SEED, Trips
from harness.radio.wrapped import link_loss
from harness.world.parameters import Parameters, beacon_radio
from harness.world.sight_lines import site
from harness.world.state import Beacon, VehicleState, WorldState

LEAD_S = 1.0
BITS = 8 * 190
# T_GenCam_DCC, T_GenCamMax and N_GenCam of EN 302 637-2
SHORTEST_S, LONGEST_S, UNMOVED = 0.1, 1.0, 3
TURN_RAD, MOVE_M, CHANGE_MPS = math.radians(4), 4.0, 0.5
ROUNDING_S = 1e-9


def last_heard(state: WorldState, sender: str, receiver: str) -> Beacon | None:
    """Return the newest beacon that one vehicle has from another at the state's time.

    A beacon is what a vehicle broadcasts about itself: pose and speed, with an age and errors.
    `sender` and `receiver` are ids of vehicles. None if there is no such beacon: nobody sends any
    under perfect knowledge, and no vehicle hears itself.
    """
    heard = [b for b in state.beacons if b.sender == sender and receiver in b.heard_by]
    return max(
        (b for b in heard if _is_there(b, state.time_s)), key=lambda b: b.time_s, default=None
    )


def state_by_beacon(state: WorldState, sender: str, receiver: str) -> VehicleState:
    """Return the sender's state as the receiver estimates it from the last beacon that it has.

    `sender` and `receiver` are ids of vehicles. A beacon, the sender's broadcast about itself, is
    extrapolated to the state's time at constant speed. It is the true state if the receiver has
    none, as under perfect knowledge or of itself.
    """
    return estimated(state.vehicle(sender), last_heard(state, sender, receiver), state.time_s)


def estimated(vehicle: VehicleState, beacon: Beacon | None, time_s: float) -> VehicleState:
    """Return a vehicle's state, extrapolated from its beacon to `time_s` at constant speed.

    A beacon is what a vehicle broadcasts about itself; `time_s` is in s from the start of the
    episode. What a beacon does not say, such as the class of vehicle, is as in `vehicle`, its true
    state, which is returned unchanged if `beacon` is None.
    """
    if beacon is None:
        return vehicle
    travelled_m = beacon.speed_mps * (time_s - beacon.time_s)
    return replace(
        vehicle,
        x_m=beacon.x_m + travelled_m * math.cos(beacon.heading_rad),
        y_m=beacon.y_m + travelled_m * math.sin(beacon.heading_rad),
        heading_rad=beacon.heading_rad,
        speed_mps=beacon.speed_mps,
    )


def lead_in(p: Parameters, poses: Floats) -> Floats:
    """Return where vehicles were before an episode starts, as far back as their beacons begin.

    So beacons are already heard at the start. `poses` are x and y (m), heading (rad) and speed
    (m/s) of V vehicles at the start, (V, 4), which have driven at constant speed until then. The
    result is (F, V, 4): poses in each of F frames, the start last. `p` has the scenario's rate and
    delay of beacons and the frames a second.
    """
    x, y, heading, speed = poses.T
    time_s = np.arange(-_lead_frames(p), 1)[:, None] / p.simulation_hz
    course = [x + speed * np.cos(heading) * time_s, y + speed * np.sin(heading) * time_s]
    return np.stack([*course, *np.broadcast_arrays(heading, speed, time_s)[:2]], axis=-1)


class Stretch(NamedTuple):
    """Hold what vehicles that send beacons, messages about themselves, did in F frames.

    `poses` are x and y (m), heading (rad) and speed (m/s) in each frame: of the 1+H vehicles that
    `broadcast` is about, (F, 1+H, 4), or of the one that `announced` is about, (F, 4). A stretch
    follows another without a gap.
    """

    poses: Floats
    first_frame: int  # number of the first of these frames; the episode starts with frame 0
    target_mps: float | None  # target speed that the first vehicle's beacons tell; None if none
    # returns, for the index from 0 of one of these frames, the probability to lose a beacon on the
    # link of the first vehicle and each other one, (H,), or to each receiver, (R,)
    loss: Callable[[int], Floats]


def waits(p: Parameters) -> bool:
    """Return whether beacons may be made long after their frames: only when somebody asks.

    They are vehicles' messages about themselves. Those of a physical radio hang on the state of the
    world when they are sent, and under rule `cam` on all before.
    """
    return p.beacon_rule == "fixed" and beacon_radio(p.beacon_channel) is None


def broadcast(
    p: Parameters,
    seed: int,
    before: Sequence[Beacon],
    radios: Sequence[str],
    stretches: Sequence[Stretch],
) -> tuple[Beacon, ...]:
    """Return the beacons of the ego and its helpers that are still needed after more frames.

    These are the last one that each receiver has, and those on the air. The ego and each helper
    hear each other.

    Args:
        p: the scenario's parameters, with the rate, the delay and the errors of beacons.
        seed: seed of the episode's layout, which keys all draws.
        before: the beacons that were needed until now.
        radios: ids of the ego, which is first, and of the H helpers.
        stretches: what these 1+H vehicles did since; one, unless beacons may wait (`waits`).
    """
    kept: list[Beacon] = []
    for place, sender in enumerate(radios):
        receivers = tuple(radios[:1] if place else radios[1:])
        links = slice(place - 1, place) if place else slice(None)
        of_sender = []
        for each in stretches:
            target_mps = None if place else each.target_mps
            of_sender.append(each._replace(poses=each.poses[:, place], target_mps=target_mps))
        kept += _after(p, seed, before, sender, receivers, of_sender, links)
    return tuple(kept)


def announced(
    p: Parameters,
    seed: int,
    before: Sequence[Beacon],
    sender: str,
    receivers: Sequence[str],
    stretches: Sequence[Stretch],
) -> tuple[Beacon, ...]:
    """Return the beacons of one sender that are still needed after more frames.

    These are the last one that each receiver has, and those on the air. It is for a vehicle that
    all R `receivers` hear; `broadcast` is for the ego and its helpers.

    Args:
        p: the scenario's parameters, with the rate, the delay and the errors of beacons.
        seed: seed of the episode's layout, which keys all draws.
        before: the beacons, of any sender, that were needed until now.
        sender: id of the vehicle that sends.
        receivers: ids of the vehicles that hear it.
        stretches: what it did since; one, unless beacons may wait (`waits`).
    """
    every, heard_by = slice(None), tuple(receivers)
    return tuple(_after(p, seed, before, sender, heard_by, stretches, every))


def _after(
    p: Parameters,
    seed: int,
    before: Sequence[Beacon],
    sender: str,
    receivers: tuple[str, ...],
    stretches: Sequence[Stretch],
    links: slice,
) -> Sequence[Beacon]:
    """Return the beacons of one sender that matter after some frames, by time."""
    if p.perfect_knowledge:
        return ()
    earlier = [b for b in before if b.sender == sender]
    newest_first = chain(
        *(_sent(p, seed, sender, receivers, each, earlier, links) for each in stretches[::-1]),
        reversed(earlier),
    )
    last = stretches[-1]
    time_s = (last.first_frame + len(last.poses) - 1) / p.simulation_hz
    return _that_matter(newest_first, {*receivers}, time_s)[::-1]


def _that_matter(
    newest_first: Iterable[Beacon], receivers: set[str], time_s: float
) -> list[Beacon]:
    """Keep a sender's beacons under way, the last that each receiver has,
    and under `cam` the last sent.
    """
    kept = list[Beacon]()
    for beacon in newest_first:
        if not receivers:
            break
        if not receivers.isdisjoint(beacon.heard_by) or (
            beacon.interval_s is not None and not kept
        ):
            kept.append(beacon)
        if _is_there(beacon, time_s):
            receivers = receivers.difference(beacon.heard_by)
    return kept


def _sent(
    p: Parameters,
    seed: int,
    sender: str,
    receivers: tuple[str, ...],
    stretch: Stretch,
    before: Sequence[Beacon],
    links: slice,
) -> Iterator[Beacon]:
    """Yield the beacons of one vehicle with poses (F, 4) in a stretch, the last first.

    `links` selects the values of its `loss` for its receivers.
    """
    poses, first_frame, target_mps, loss = stretch
    phase, errors, uniforms = _draws(p, seed, sender, receivers)
    every, shift = p.simulation_hz / p.beacon_hz, _lead_frames(p)  # frames

    def sent(number: int, frame: int, heard_by: tuple[str, ...] = ()) -> Beacon:
        x, y, heading, speed = (poses[frame - first_frame] + errors[number]).tolist()
        pose = round(x, 2), round(y, 2), round(heading, 3), max(round(speed, 2), 0.0)
        time_s = frame / p.simulation_hz
        return Beacon(sender, time_s, time_s + p.beacon_delay_s, *pose, target_mps, heard_by)

    def hear(number: int, frame: int) -> tuple[str, ...]:
        """Return the receivers that receive it."""
        if not number:
            return receivers
        crosses = uniforms[:, number] >= loss(frame - first_frame)[links]
        return tuple(r for r, there in zip(receivers, crosses.tolist(), strict=True) if there)

    def checks() -> Iterator[tuple[int, int]]:
        """Yield number and frame of each beacon that may be sent, the last first."""
        number = math.ceil((first_frame + len(poses) + shift) / every - phase)
        while (
            number >= 0 and (frame := math.floor((number + phase) * every) - shift) >= first_frame
        ):
            if frame < first_frame + len(poses):
                yield number, frame
            number -= 1

    if p.beacon_rule == "fixed":
        for number, frame in checks():
            yield sent(number, frame, hear(number, frame))
        return
    last, due = before[-1] if before else None, list[tuple[int, int, Beacon]]()
    for number, frame in reversed(list(checks())):
        if cam := due_cam(sent(number, frame), poses[frame - first_frame].tolist(), last):
            due.append((number, frame, cam))
            last = cam
    for number, frame, cam in reversed(due):
        yield replace(cam, heard_by=hear(number, frame))


def due_cam(beacon: Beacon, pose: Sequence[float], last: Beacon | None) -> Beacon | None:
    """Return a vehicle's CAM, its message about itself, if one is due (EN 302 637-2, 6.1.3).

    `beacon` is what it would send now, `pose` its true x and y (m), heading (rad) and speed (m/s),
    and `last` its last CAM; None before the first.
    """
    if last is None or last.interval_s is None:
        return replace(beacon, interval_s=LONGEST_S, unmoved=0)
    age_s = beacon.time_s - last.time_s + ROUNDING_S
    x, y, heading, speed = pose
    turned_rad = abs(math.remainder(heading - last.heading_rad, math.tau))
    moved = (
        turned_rad > TURN_RAD
        or math.hypot(x - last.x_m, y - last.y_m) > MOVE_M
        or abs(speed - last.speed_mps) > CHANGE_MPS
    )
    if age_s >= SHORTEST_S and moved:
        return replace(beacon, interval_s=round(age_s, 3), unmoved=0)
    if age_s >= last.interval_s:
        unmoved = min((last.unmoved or 0) + 1, UNMOVED)
        interval_s = LONGEST_S if unmoved == UNMOVED else last.interval_s
        return replace(beacon, interval_s=interval_s, unmoved=unmoved)
    return None


def _is_there(beacon: Beacon, time_s: float) -> bool:
    return beacon.arrives_s <= time_s + ROUNDING_S


def _lead_frames(p: Parameters) -> int:
    return math.ceil(max(LEAD_S, 1 / p.beacon_hz + p.beacon_delay_s) * p.simulation_hz)


def losses(
    p: Parameters, world: Callable[[], WorldState], radios: Sequence[str], poses: Floats
) -> Callable[[int], Floats]:
    """Return a function from a frame to the probability to lose a beacon on each of H links, (H,).

    Its argument is the index from 0 of one of the F frames of `poses`: x and y (m), heading (rad)
    and speed (m/s) of all V vehicles, (F, V, 4). `radios` are 1+H ids of vehicles; a link is from
    the first of them to each other one. `world` returns the present state, and is called only if
    the parameters `p` name a physical radio; else all links lose `p.beacon_loss`.
    """
    radio = beacon_radio(p.beacon_channel)
    if radio is None:
        declared = np.full(len(radios) - 1, p.beacon_loss)
        return lambda frame: declared
    state = world()
    # The ego's links have one seed, and those of any other first radio another.
    seed = NO_SEED if radios[0] == state.ego.id else NO_SEED - int(radios[0][1:])
    trips = Trips(np.array([seed]), np.array([state.episode_seed]), np.zeros(1, dtype=int), 1)

    @cache
    def at(frame: int) -> Floats:
        there = zip(state.vehicles, poses[frame].tolist(), strict=True)
        vehicles = tuple(
            replace(v, x_m=x, y_m=y, heading_rad=heading) for v, (x, y, heading, _) in there
        )
        links = site([(replace(state, vehicles=vehicles), radios)])
        return np.asarray(link_loss(radio, links, partial(trips.shadow, links.xy_m), BITS)[0])

    return at


@lru_cache(maxsize=1024)
def _draws(
    p: Parameters, seed: int, sender: str, receivers: tuple[str, ...]
) -> tuple[float, Floats, Floats]:
    """Draw a sender's phase as a share of its period, its errors, (n, 4),
    and draws for receivers, (R, n).
    """
    n = math.ceil((_lead_frames(p) / p.simulation_hz + p.time_limit_s) * p.beacon_hz) + 2
    generator = noise.generator("beacons", seed, sender)
    phase = float(generator.random())
    sizes = [p.beacon_noise_m, p.beacon_noise_m, p.beacon_noise_rad, p.beacon_noise_mps]
    errors = generator.standard_normal((n, 4)) * sizes
    draws = [noise.uniforms((n,), "beacons", seed, sender, receiver) for receiver in receivers]
    return phase, errors, np.array(draws).reshape(-1, n)
