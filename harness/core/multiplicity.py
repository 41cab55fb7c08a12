"""p-values of differences between two runs, and Holm's correction for many comparisons."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from harness.core.statistics import Estimate

LEVEL = 0.05  # the chance of a false alarm among all comparisons that are shown together
LEAST = 1e-12  # below this p-value, levels of confidence are too near 1 to be told apart


def p_value(interval: Callable[[float], Estimate]) -> float | None:
    """Return the two-sided p-value of a difference of 0:
    1 less the level at which the interval touches 0.

    It is below 0.05 exactly if the 95 % interval excludes 0, even for an asymmetric interval. For
    Student's t interval it is the p-value of the paired t test. It is None without an interval,
    `LEAST` for any smaller one, and 1 above 0.999. `interval` gives the difference at a level of
    confidence; a higher one is wider.
    """
    difference = interval(1 - LEVEL)
    if math.isnan(difference.low) or math.isnan(difference.high):
        return None

    def reach(log_p: float) -> float:
        """Return the distance of 0 from the interval's nearer end,
        positive if the interval excludes 0.
        """
        wider = interval(1 - math.exp(log_p))
        return wider.low if difference.value > 0 else -wider.high

    surest, least_sure = math.log(LEAST), math.log(0.999)
    if reach(least_sure) <= 0:
        return 1.0
    if reach(surest) >= 0:
        return LEAST
    from scipy.optimize import brentq

    return math.exp(brentq(reach, surest, least_sure, xtol=1e-9))


def p_of_bootstrap(value: float, low: float, high: float) -> float | None:
    """Return the two-sided p-value of a difference of 0 from a bootstrap's 95 % interval.

    Resamples are too few to find the level at which the interval would touch 0, so the side nearer
    to 0 is treated as a normal distribution's (Altman and Bland 2011, doi:10.1136/bmj.d2304). None
    without an interval.
    """
    from harness.core.special import ndtr, ndtri

    if math.isnan(low) or math.isnan(high):
        return None
    half = value - low if value > 0 else high - value
    if half <= 0:  # without spread on that side, only whether 0 is excluded is known
        return LEVEL if value else 1.0
    return float(2 * ndtr(-abs(value) / half * ndtri(0.975)))


def holm(p_values: Sequence[float], comparisons: int | None = None) -> list[float]:
    """Correct p-values for multiple comparisons by Holm's step-down method (Holm 1979);
    order is kept.

    If a difference is called real where its corrected p is at most `LEVEL`, at least one false
    alarm among all of them has a probability of 5 % at most, however they depend on each other. If
    those given were picked among more `comparisons`, the others count as less striking, which can
    only raise the result.
    """
    order = np.argsort(p_values, kind="stable")
    steps = np.array(p_values)[order] * ((comparisons or len(p_values)) - np.arange(len(p_values)))
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(p) for p in corrected]
