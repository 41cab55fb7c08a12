"""Semi-persistent scheduling on a sidelink:
how many resources are taken, and how often two vehicles collide.

Vehicles stand evenly along a road, all send at one rate, and each chooses at random from the
resources that it has not sensed as taken. Equation numbers are those of Gonzalez-Martin, Sepulcre,
Molina-Masegosa and Gozalvez, "Analytical Models of the Performance of C-V2X Mode 4 Vehicular
Communications", IEEE TVT 68(2), 2019.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats

REACH_M = 1500  # vehicles farther away are not sensed
METRES: Floats = np.abs(np.arange(-REACH_M, REACH_M + 1.0))  # distances of all that may be

# Share of the resources that must be left to choose from (TS 36.213, 14.1.1.6; TS 38.214, 8.1.4).
LEAST_SHARE = 0.2

STEP_DB = 0.1  # step by which Step 3 raises the threshold until enough resources are left


@dataclass(frozen=True)
class Scheduling:
    """Hold what a vehicle's choice of a resource depends on in semi-persistent scheduling.

    A resource is what one packet takes of the channel: some frequency in one slot of time. A
    vehicle keeps the same resource for several packets; a period is the time from one of its
    packets to the next. Equations, whose numbers stand in brackets below, are those of
    Gonzalez-Martin et al. (IEEE TVT 68(2), 2019).
    """

    per_m: float  # packets that the vehicles on one metre of road send in a period
    resources: float  # number of resources in a period (28)
    # share of the choices in which a vehicle that could sense another does not know of the other's
    # choice, since both were made anew within one period (24)
    forgotten: float
    # share of the packets of a vehicle so many metres away whose power is above a threshold in dBm
    # (11), for an array of metres; the second argument is the threshold
    sensed: Callable[[Floats, float], Floats]
    threshold_dbm: float  # sensing threshold of a receiver

    @property
    def busy_ratio(self) -> float:
        return self._taken(self.threshold_dbm, 1) / self.resources

    def same_by_exclusion(self, apart_m: Floats) -> Floats:
        """Return the probability that a vehicle `apart_m` metres away takes the same resource.

        A resource is what one packet takes of the channel. The shape is that of `apart_m`. It is by
        Step 2 of a vehicle's choice, in which both exclude the resources that they sense as taken
        (Gonzalez-Martin et al. 2019, equation 23). The source does not limit them; at most 80 % can
        be excluded.
        """
        taken = min(self._taken(self.threshold_dbm, 1), (1 - LEAST_SHARE) * self.resources)
        return self._same(apart_m, taken, self.threshold_dbm)

    def same_by_ranking(self, apart_m: Floats) -> Floats:
        """Return the probability that a vehicle `apart_m` metres away takes the same resource.

        A resource is what one packet takes of the channel. The shape is that of `apart_m`. It is by
        Step 3 of a vehicle's choice, in which both keep the fifth of the resources with the least
        power (Gonzalez-Martin et al. 2019, equations 31 to 33), as if the threshold had been raised
        until only these were left.
        """
        threshold_dbm = self.threshold_dbm
        while (taken := self._taken(threshold_dbm, 2)) > (1 - LEAST_SHARE) * self.resources:
            threshold_dbm += STEP_DB
        return self._same(apart_m, taken, threshold_dbm)

    def _taken(self, threshold_dbm: float, times: int) -> float:
        """Count the resources taken: those of `times` the sensed packets (29, 29.1; 32, 33)."""
        packets = times * self.per_m * float(self.sensed(METRES, threshold_dbm).sum())
        return taken(packets, self.resources)

    def _same(self, apart_m: Floats, taken: float, threshold_dbm: float) -> Floats:
        """Apply (24) to (27) and (30):
        the nearer two vehicles are, the more remaining resources they share.

        The result is at least that of two vehicles that sense independently; the source's equations
        fall below that at a busy ratio of about 0.75 and more.
        """
        sensed = self.sensed(METRES, self.threshold_dbm)
        size = 2 * sensed.size - 1
        length = 1 << size.bit_length()  # of which a transform is fast
        forth, back = np.fft.rfft(sensed, length), np.fft.rfft(sensed[::-1], length)
        both_ways = np.fft.irfft(forth * back, length)
        overlap = both_ways[2 * REACH_M : size]  # (30.2), by metre from 0 on
        by_chance = taken**2 / self.resources
        # In (30) the density cancels: beta / Spsr is 1 / the sum of `sensed`.
        nearness = overlap / max(overlap[0], 1e-300)
        both = taken * overlap / max(sensed.sum(), 1e-300) + (1 - nearness) * by_chance
        common = np.interp(apart_m, np.arange(overlap.size), self.resources - 2 * taken + both)
        unaware = 1 - (1 - self.forgotten) * self.sensed(apart_m, threshold_dbm)
        at_least = 1 / self.resources
        return np.asarray(unaware * np.clip(common / (self.resources - taken) ** 2, at_least, 1.0))


def taken(packets: float, resources: float) -> float:
    """Return how many of the resources of a radio channel the packets in one period take.

    A resource is what one packet takes: some frequency in one slot of time. A period is the time
    from one packet of a vehicle to its next; `packets` are sent in it and `resources` are there. By
    equation 29 of Gonzalez-Martin et al. (2019), half of the packets do not overlap and the others
    fall at random. The equation does not state the limit `resources`, but it holds in its range.
    """
    half = packets / 2
    free = resources - half
    if free <= 0:
        return resources
    later = min(int(half), int(free))
    return min(half + later - later * (later + 1) / (2 * free), resources)
