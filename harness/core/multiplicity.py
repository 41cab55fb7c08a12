"""p-values of differences between two runs, and Holm's correction for many comparisons."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.core.quantiles import normal_quantile, normal_share, root
from harness.core.statistics import Estimate

LEVEL = 0.05  # the chance of a false alarm among all comparisons that are shown together
LEAST = 1e-12  # below this p-value, levels of confidence are too near 1 to be told apart


def p_value(interval: Callable[[float], Estimate]) -> float | None:
    """Return the two-sided p-value of a difference of 0, by inverting its confidence interval.

    `interval` takes a level of confidence, from 0 to 1, and returns the difference's estimate with
    an interval at that level. The result is below 0.05 exactly if the 95 % interval excludes 0; for
    Student's t interval it is that of the paired t test. None without an interval; `LEAST` for any
    smaller value, and 1 above 0.999.
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
    return math.exp(root(reach, surest, least_sure, 1e-9))


def p_of_bootstrap(value: float, low: float, high: float) -> float | None:
    """Return the two-sided p-value of a difference of 0 from a bootstrap's 95 % interval.

    `value` is the difference, and `low` and `high` are the ends of the interval. The side nearer to
    0 is treated as that of a normal distribution (Altman and Bland 2011, doi:10.1136/bmj.d2304),
    since resamples are too few to invert the interval. None without an interval.
    """
    if math.isnan(low) or math.isnan(high):
        return None
    half = value - low if value > 0 else high - value
    if half <= 0:  # without spread on that side, only whether 0 is excluded is known
        return LEVEL if value else 1.0
    return float(2 * normal_share(-abs(value) / half * normal_quantile(0.975)))


def clear(intervals: Mapping[str, Callable[[float], Estimate]]) -> set[str]:
    """Return the names of the differences whose p-value, corrected by Holm's method, is `LEVEL` at
    most.

    `intervals` are by name, each as `p_value` takes it. One or two of each tell, where its p-value
    needs some twenty and SciPy's search for a root.
    """
    names = set[str]()
    while rest := intervals.keys() - names:
        here = {name: intervals[name](1 - LEVEL / len(rest)) for name in rest}
        more = {name for name, each in here.items() if each.low > 0 or each.high < 0}
        if not more:
            break
        names |= more
    return names


def holm(p_values: Sequence[float], comparisons: int | None = None) -> list[float]:
    """Correct p-values for multiple comparisons by Holm's step-down method (1979).

    Returns the corrected p-values in the order given. Differences whose corrected p is at most
    `LEVEL` include a false alarm with a probability of at most 5 %, however they depend on each
    other. `comparisons` is the number of comparisons from which these were picked, if larger than
    their own number.
    """
    order = np.argsort(p_values, kind="stable")
    steps = np.array(p_values)[order] * ((comparisons or len(p_values)) - np.arange(len(p_values)))
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(p) for p in corrected]
