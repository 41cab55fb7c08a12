"""Test the difference in success between two runs of the same episodes."""

from dataclasses import dataclass

from harness.core.arrays import Floats
from harness.core.statistics import rate_difference


@dataclass(frozen=True)
class SuccessTest:
    """Result of a test of the difference in success."""

    # `mcnemar` if no seed changes any episode's success, so that an episode is one yes or no; else `interval`
    method: str
    p_value: float | None = None  # exact two-sided p-value of McNemar's test; None for an interval
    low: float | None = None  # lower end of the 95 % interval of B - A over episodes; None for McNemar's test
    high: float | None = None  # upper end


def success_test(a: Floats, b: Floats) -> SuccessTest | None:
    """Test the difference in success between A and B over episodes; None for an interval of one episode.

    Args:
        a: A's success, 0 or 1, by episode and seed, (E, S).
        b: B's, in the same order.
    """
    from scipy.stats import binomtest

    if (a == a[:, :1]).all() and (b == b[:, :1]).all():
        gains, losses = int((b[:, 0] > a[:, 0]).sum()), int((a[:, 0] > b[:, 0]).sum())
        p_value = float(binomtest(losses, gains + losses).pvalue) if gains + losses else 1.0
        return SuccessTest("mcnemar", p_value=p_value)
    if len(a) < 2:
        return None
    difference = rate_difference(b, a)
    return SuccessTest("interval", low=difference.low, high=difference.high)
