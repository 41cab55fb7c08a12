"""The test of a difference in success between two runs of the same episodes."""

from dataclasses import dataclass

from harness.core.arrays import Floats
from harness.core.statistics import rate_difference


@dataclass(frozen=True)
class SuccessTest:
    """What a test says of the difference in success.

    Attributes:
        method: `mcnemar` where no seed changes an episode's success, so that an episode is one yes or no;
            else `interval`.
        p_value: two-sided and exact, of McNemar's test; None for an interval.
        low: lower end of the 95 % interval of B - A over episodes; None for McNemar's test.
        high: upper end.
    """

    method: str
    p_value: float | None = None
    low: float | None = None
    high: float | None = None


def success_test(a: Floats, b: Floats) -> SuccessTest | None:
    """Test the difference in success, 0 or 1, both (E, S), over episodes."""
    from scipy.stats import binomtest

    if (a == a[:, :1]).all() and (b == b[:, :1]).all():
        gained, lost = (int((x > y).sum()) for x, y in ((b[:, 0], a[:, 0]), (a[:, 0], b[:, 0])))
        p_value = float(binomtest(lost, gained + lost).pvalue) if gained + lost else 1.0
        return SuccessTest("mcnemar", p_value=p_value)
    if len(a) < 2:
        return None
    found = rate_difference(b, a)
    return SuccessTest("interval", low=found.low, high=found.high)
