"""p-values of many comparisons at once, and Holm's correction of them."""

import math
from collections.abc import Sequence

import numpy as np

LEVEL = 0.05  # the chance of a false alarm among all comparisons that are shown together


def p_of_interval(value: float, low: float, high: float, n: int, level: float = 0.95) -> float | None:
    """Two-sided p-value of a difference of 0 from the difference's interval.

    It is that of the interval which would just touch 0 (Altman and Bland 2011, doi:10.1136/bmj.d2304), so it
    is below 1 - level where the interval leaves 0 out; of Student's interval it is the t test's.

    Args:
        value: the difference.
        low: lower end of its interval.
        high: upper end.
        n: units behind it, which give n - 1 degrees of freedom.
        level: of the interval.

    Returns:
        None where there is no interval.
    """
    from scipy.special import stdtr, stdtrit

    if n < 2 or math.isnan(low) or math.isnan(high):
        return None
    half = value - low if value > 0 else high - value
    if half <= 0:
        # Every unit changed alike, and no spread is known: the sign test of n units that agree.
        return 1.0 if value == 0 else min(1.0, 2.0 ** (1 - n))
    t = abs(value) / half * float(stdtrit(n - 1, 0.5 + level / 2))
    return float(2 * stdtr(n - 1, -t))


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
