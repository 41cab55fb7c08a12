"""CSMA/CA of broadcasts with one contention window: when the medium is free, taken, and taken twice at once.

All vehicles that share a medium hear each other here; packets are as long as each other and come at random.
`tests/test_its_g5.py` simulates the slots beside each of these.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from harness.core.arrays import Floats

SLOT_S = 13e-6  # IEEE 802.11-2012, 10 MHz OFDM
TICK_S, TICKS = 1e-6, 1 << 17  # of the access delay's distribution: 131 ms
RAREST = 1e-7  # share of the longest waits, which are cut off
SATURATED = 0.6  # busier, vehicles that all hear each other never catch up


def begin_per_s(busy: Floats | float, packet_s: float) -> Floats | float:
    """Packets that begin in a second of idle time, where so much of the time is busy."""
    return busy / (1 - busy) / packet_s


def free_share(busy: Floats | float, packet_s: float, aifs_s: float) -> Floats:
    """Share of time in which a vehicle that hears this busy ratio may begin to send.

    Of idle time, what is left of its gaps after an AIFS: their lengths are taken as exponential.
    """
    return (1 - np.asarray(busy)) * np.exp(-aifs_s * begin_per_s(busy, packet_s))


def mean_access_s(busy: float, packet_s: float, aifs_s: float, window: int) -> float:
    """Mean seconds from the wish to send until the medium is taken.

    Whatever is under way ends; then the medium must be idle for an AIFS, and for each slot of the back-off; a
    packet in between costs its airtime and another AIFS. Packets begin at random in idle time.
    """
    per_s = float(begin_per_s(busy, packet_s))
    aifs_idle_s = _idle_s(aifs_s, per_s, packet_s)
    slot_idle_s = _idle_s(SLOT_S, per_s, packet_s + aifs_idle_s)
    return busy * packet_s / 2 + aifs_idle_s + window / 2 * slot_idle_s


def _idle_s(needed_s: float, per_s: float, cost_s: float) -> float:
    """Mean time until the medium has been idle for so long on end, where interruptions cost so much each."""
    return needed_s if per_s == 0 else math.expm1(per_s * needed_s) * (1 / per_s + cost_s)


@lru_cache(maxsize=64)
def access(busy: float, packet_s: float, aifs_s: float, window: int) -> tuple[Floats, Floats]:
    """The distribution of which `mean_access_s` is the mean, from its generating function.

    Returns:
        Probabilities and seconds; with probability p it takes no longer.
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
def same_slot(per_slot: float, packet_slots: float, aifs_slots: float, window: int) -> tuple[float, float]:
    """How often packets that all can hear begin in the same slot, and the busy ratio.

    Who wants to send while the medium is busy ends its back-off soon after, as others do, so packets meet
    more often than if they began at random. This follows the mean number of vehicles with each count of
    back-off, slot by slot after a busy period, until the next. Numbers are taken as Poisson; what a busy
    period leaves behind is a fixed point.

    Args:
        per_slot: packets of all that come in a slot.
        packet_slots: airtime in slots.
        aifs_slots: in slots.
        window: back-off is uniform from 0 to so many slots.

    Returns:
        Share of packets that begin with another, and share of time that the medium is busy.
    """
    counts = window + 1
    slot, count = np.arange(counts + 1)[:, None], np.arange(counts)
    came = np.minimum(slot, counts - count) * per_slot / counts  # since the busy period
    left = np.zeros(counts)
    for _ in range(200):
        waiting = np.append(left + per_slot * packet_slots / counts, np.zeros(counts + 1))
        mean = waiting[slot + count] + came
        ends = -np.expm1(-mean[:, 0])
        reached = np.append(1.0, np.cumprod(1 - ends[:-1]))
        reached[-1] /= ends[-1]  # all later slots are like the last
        behind = np.where(count > 0, mean, 0.0) + per_slot * aifs_slots / counts
        before, left = left, (left + (reached * ends) @ behind) / 2
        if np.abs(left - before).max() < 1e-9:
            break
    begun = mean[:, 0]
    cycle = packet_slots + aifs_slots + reached.sum() - 1
    return float(reached @ (begun * ends) / (reached @ begun)), float(packet_slots / cycle)


def crowding(busy: float, packet_s: float, aifs_s: float, window: int) -> float:
    """How many times as often packets begin in the same slot as if they began at random in free time.

    That of vehicles which all hear each other and send as much as is heard; above `SATURATED` as there.
    """
    packet_slots = packet_s / SLOT_S
    per_slot = min(busy, SATURATED) / packet_slots
    if per_slot == 0:
        return 1.0
    share, its_busy = same_slot(per_slot, packet_slots, aifs_s / SLOT_S, window)
    return float(-math.log1p(-share) * free_share(its_busy, packet_s, aifs_s) / per_slot)
