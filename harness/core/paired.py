"""The test of a difference in success between two runs of the same episodes."""

from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats

RESAMPLES, RESAMPLING_SEED = 9999, 0


@dataclass(frozen=True)
class SuccessTest:
    """What a test says of the difference in success.

    Attributes:
        method: `mcnemar` where no seed changes an episode's success, so that an episode is one yes or no;
            else `bootstrap`.
        p_value: two-sided and exact, of McNemar's test; None for the bootstrap.
        low: lower end of the bootstrap's 95 % interval of B - A; None for McNemar's test.
        high: upper end.
    """

    method: str
    p_value: float | None = None
    low: float | None = None
    high: float | None = None


def success_test(a: Floats, b: Floats) -> SuccessTest | None:
    """Test the difference in success, 0 or 1, both (E, S), over episodes."""
    from scipy.stats import binomtest, bootstrap

    if (a == a[:, :1]).all() and (b == b[:, :1]).all():
        gained, lost = (int((x > y).sum()) for x, y in ((b[:, 0], a[:, 0]), (a[:, 0], b[:, 0])))
        p_value = float(binomtest(lost, gained + lost).pvalue) if gained + lost else 1.0
        return SuccessTest("mcnemar", p_value=p_value)
    if len(a) < 2:
        return None
    found = bootstrap(
        ((b - a).mean(axis=1),), np.mean, n_resamples=RESAMPLES, batch=1000, method="percentile",
        rng=RESAMPLING_SEED,
    ).confidence_interval  # fmt: skip
    return SuccessTest("bootstrap", low=float(found.low), high=float(found.high))
