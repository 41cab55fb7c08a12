"""p-values of many comparisons at once, and Holm's correction of them."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from harness.core.statistics import Estimate

LEVEL = 0.05  # the chance of a false alarm among all comparisons that are shown together
LEAST = 1e-12  # p-value below which levels of confidence are too near 1 to be told apart


def p_value(interval: Callable[[float], Estimate]) -> float | None:
    """Two-sided p-value of a difference of 0: 1 less the level at which its interval just touches 0.

    So it is below 0.05 exactly where the 95 % interval leaves 0 out, also of an interval that is not
    symmetric; of Student's t interval it is the paired t test's.

    Args:
        interval: the difference with its interval at a level of confidence, the wider the higher the level.

    Returns:
        None where there is no interval; `LEAST` for all that is less, and 1 for all above 0.999.
    """
    from scipy.optimize import brentq

    found = interval(1 - LEVEL)
    if math.isnan(found.low) or math.isnan(found.high):
        return None

    def reach(log_p: float) -> float:
        """How far 0 is beyond the interval's nearer end."""
        at = interval(1 - math.exp(log_p))
        return at.low if found.value > 0 else -at.high

    surest, least_sure = math.log(LEAST), math.log(0.999)
    if reach(least_sure) <= 0:
        return 1.0
    if reach(surest) >= 0:
        return LEAST
    return math.exp(brentq(reach, surest, least_sure, xtol=1e-9))


def p_of_bootstrap(value: float, low: float, high: float) -> float | None:
    """Two-sided p-value of a difference of 0 from a bootstrap's 95 % interval.

    Resamples are too few to find the level at which it would touch 0, so the side nearer to 0 is taken as a
    normal distribution's (Altman and Bland 2011, doi:10.1136/bmj.d2304). None without an interval.
    """
    from scipy.special import ndtr, ndtri

    if math.isnan(low) or math.isnan(high):
        return None
    half = value - low if value > 0 else high - value
    if half <= 0:  # no spread on that side, so no more is known than whether 0 is left out
        return LEVEL if value else 1.0
    return float(2 * ndtr(-abs(value) / half * ndtri(0.975)))


def holm(p_values: Sequence[float], comparisons: int | None = None) -> list[float]:
    """Holm's step-down correction (Holm 1979): each p-value as it counts among all of them, in their order.

    Calling a difference real where its corrected p is at most `LEVEL` raises a false alarm among them in 5 %
    of cases at most, however they depend on each other.

    Args:
        p_values: of the comparisons that are shown.
        comparisons: how many there are, where those shown were picked among more; the others then count as
            the less striking ones, which can only raise what is returned.
    """
    order = np.argsort(p_values, kind="stable")
    steps = np.array(p_values)[order] * ((comparisons or len(p_values)) - np.arange(len(p_values)))
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(p) for p in corrected]
