"""CSMA/CA of broadcasts with one contention window:
free time, access delay, and collisions in one slot.

All vehicles that share a medium hear each other here; packets have equal length and arrive at
random. `tests/test_its_g5.py` simulates the slots to check each function.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from harness.core.arrays import Floats

SLOT_S = 13e-6  # IEEE 802.11-2012, 10 MHz OFDM
TICK_S, TICKS = 1e-6, 1 << 17  # resolution and length of the access delay's distribution: 131 ms
RAREST = 1e-7  # this share of the longest waits is cut off
SATURATED = 0.6  # above this busy ratio, vehicles that all hear each other never catch up


def begin_per_s(busy: Floats | float, packet_s: float) -> Floats | float:
    """Return how many packets begin in a second of idle medium, of the shape of `busy`.

    `busy` is the channel busy ratio, the share of time, from 0 to below 1, in which the medium is
    sensed as busy, and `packet_s` a packet's time on air, s.
    """
    return busy / (1 - busy) / packet_s


def free_share(busy: Floats | float, packet_s: float, aifs_s: float) -> Floats:
    """Return the share of time in which a vehicle that hears this busy ratio may begin to send.

    `busy` is the share of time, from 0 to below 1, in which the medium is sensed as busy; the
    result has its shape. `packet_s` is a packet's time on air, s. It is the idle time without the
    first `aifs_s` seconds of each gap, for which the medium must be idle (AIFS); the lengths of
    gaps are assumed to be exponential.
    """
    return (1 - np.asarray(busy)) * np.exp(-aifs_s * begin_per_s(busy, packet_s))


def mean_access_s(busy: float, packet_s: float, aifs_s: float, window: int) -> float:
    """Return the mean access delay in s, from the wish to send until the medium is taken.

    `busy` is the channel busy ratio, the share of time in which the medium is sensed as busy,
    `packet_s` a packet's time on air and `aifs_s` the time that the medium must be idle first. A
    packet on air ends first; then the medium must be idle for that, and for each slot of the
    back-off (uniform from 0 to `window` slots). A packet in between costs its airtime and another
    AIFS. Packets begin at random in idle time.
    """
    per_s = float(begin_per_s(busy, packet_s))
    aifs_idle_s = _idle_s(aifs_s, per_s, packet_s)
    slot_idle_s = _idle_s(SLOT_S, per_s, packet_s + aifs_idle_s)
    return busy * packet_s / 2 + aifs_idle_s + window / 2 * slot_idle_s


def _idle_s(needed_s: float, per_s: float, cost_s: float) -> float:
    """Return the mean time until the medium has been idle without a break;
    interruptions cost `cost_s`.
    """
    return needed_s if per_s == 0 else math.expm1(per_s * needed_s) * (1 / per_s + cost_s)


@lru_cache(maxsize=64)
def access(busy: float, packet_s: float, aifs_s: float, window: int) -> tuple[Floats, Floats]:
    """Return the distribution of the access delay: n probabilities, (n,), and n delays in s, (n,).

    The access delay is the time from the wish to send until the medium is taken; with each
    probability it is no longer than the delay at the same index. `busy` is the share of time in
    which the medium is sensed as busy, `packet_s` a packet's time on air, `aifs_s` the time that
    the medium must be idle first, s, and `window` the longest back-off, in slots.
    """
    packet, aifs, slot = (round(s / TICK_S) for s in (packet_s, aifs_s, SLOT_S))
    starts = -math.expm1(-float(begin_per_s(busy, packet_s)) * TICK_S)  # in a tick of idle time
    z = np.exp(-2j * np.pi * np.arange(1, TICKS // 2 + 1) / TICKS)
    idle = (1 - starts) * z

    def after(ticks: int, interruption: NDArray[np.complex128]) -> NDArray[np.complex128]:
        done = idle**ticks
        return np.asarray(done / (1 - starts * (1 - done) / (1 - idle) * interruption))

    aifs_idle = after(aifs, z**packet)
    slot_idle = after(slot, z**packet * aifs_idle)
    back_off = (1 - slot_idle ** (window + 1)) / ((window + 1) * (1 - slot_idle))
    rest = (1 - busy) + busy * (1 - z**packet) / (packet * (1 - z))
    share = np.fft.irfft(np.append(1.0, rest * aifs_idle * back_off), TICKS)
    chances = np.maximum.accumulate(np.cumsum(share))
    chances = chances[: 1 + int(np.searchsorted(chances, 1 - RAREST))]
    return chances, np.arange(1.0, chances.size + 1) * TICK_S


@lru_cache(maxsize=64)
def same_slot(
    per_slot: float, packet_slots: float, aifs_slots: float, window: int
) -> tuple[float, float]:
    """Return the share of packets that begin in one slot with another, and the busy ratio.

    It is for vehicles that all hear each other. Those that want to send while the medium is busy
    end their back-off soon after it, so packets collide more often than if they began at random.
    The model follows the mean number of vehicles with each back-off count, slot by slot from one
    busy period to the next. Numbers are assumed to be Poisson; the vehicles that a busy period
    leaves waiting are a fixed point. `per_slot` counts the packets of all vehicles that arrive in a
    slot. `packet_slots` and `aifs_slots` are the time on air and the idle time before a back-off
    counts down, in slots; back-off is uniform from 0 to `window` slots.
    """
    counts = window + 1
    slot, count = np.arange(counts + 1)[:, None], np.arange(counts)
    arrived = np.minimum(slot, counts - count) * per_slot / counts  # since the busy period
    left = np.zeros(counts)
    for _ in range(200):
        waiting = np.append(left + per_slot * packet_slots / counts, np.zeros(counts + 1))
        mean = waiting[slot + count] + arrived
        ends = -np.expm1(-mean[:, 0])
        reached = np.append(1.0, np.cumprod(1 - ends[:-1]))
        reached[-1] /= ends[-1]  # all later slots are like the last
        behind = np.where(count > 0, mean, 0.0) + per_slot * aifs_slots / counts
        before, left = left, (left + (reached * ends) @ behind) / 2
        if np.abs(left - before).max() < 1e-9:
            break
    senders = mean[:, 0]
    cycle = packet_slots + aifs_slots + reached.sum() - 1
    return float(reached @ (senders * ends) / (reached @ senders)), float(packet_slots / cycle)


def crowding(busy: float, packet_s: float, aifs_s: float, window: int) -> float:
    """Return how many times as often packets begin in one slot as if they began at random.

    It is for vehicles which all hear each other and together cause the busy ratio `busy`, the share
    of time in which the medium is sensed as busy; above `SATURATED` it is constant. `packet_s` is a
    packet's time on air, `aifs_s` the time that the medium must be idle first, s, and `window` the
    longest back-off, in slots.
    """
    packet_slots = packet_s / SLOT_S
    per_slot = min(busy, SATURATED) / packet_slots
    if per_slot == 0:
        return 1.0
    share, its_busy = same_slot(per_slot, packet_slots, aifs_s / SLOT_S, window)
    return float(-math.log1p(-share) * free_share(its_busy, packet_s, aifs_s) / per_slot)
