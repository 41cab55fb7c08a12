"""Correct a mean over some layouts by what is known of more layouts,
before anybody was asked there.

The values are regressed on what is known, and their mean is moved by how far its mean in all
layouts is from that in those with a value: a control variate (Glynn and Szechtman 2002), or the
regression estimator of two-phase sampling (Cochran 1977, section 12.6). Its variance has three
parts: of what the regression leaves, of its slopes, and of the layouts that are known, which are a
sample, too.

The interval is that of the plain mean, moved as the mean is. Its ends are as much nearer as the
standard error is smaller, times a quotient of Student's t: what the plain interval does near 0 and
1 stays. It is at least as wide as Student's, since the plain one may be narrower elsewhere.
`benchmarks/difficulty.py` measures how often it holds the truth.
"""

import math

import numpy as np

from harness.core.arrays import Floats
from harness.core.quantiles import student_quantile
from harness.core.statistics import LEVEL, ROUNDING, Estimate

LEAST = 30  # layouts with a value: of fewer, intervals hold the truth too seldom
# what is known varies less in a direction that counts as none, as a standard deviation
COLLINEAR = 1e-6


def corrected(
    plain: Estimate,
    values: Floats,
    variables: Floats,
    pool: Floats,
    least: float,
    level: float = LEVEL,
) -> Estimate | None:
    """Return the mean of values (E,), corrected by control variates; None if it cannot be.

    The correction makes its interval narrower. A control variate is a variable that correlates with
    the values and is known of more cases than they are. Here the cases are layouts, drawn start
    situations of a scenario with one episode each, and the values are success in some of them. None
    is returned with fewer than `LEAST` values, without further layouts, or if the values or all
    variables are constant.

    Args:
        plain: the uncorrected mean of `values` with its interval.
        values: one of each of E layouts that are a random part of all, from `least` to 1, (E,).
        variables: the K control variates of these layouts, in the same order, (E, K).
        pool: the control variates of all N layouts, these included, (N, K).
        least: the least that a value can be, such as 0 for a share, -1 for a difference of shares.
        level: the level of confidence of the interval of `plain`, from 0 to 1.
    """
    n, deviations = len(values), values - values.mean()
    squares, centred = float(deviations @ deviations), variables - variables.mean(axis=0)
    left_axes, lengths, axes = np.linalg.svd(centred, full_matrices=False)
    apart = lengths > COLLINEAR * math.sqrt(n)
    if n < LEAST or len(pool) <= n or squares < ROUNDING or not apart.any():
        return None
    axes = axes[apart] / lengths[apart, None]  # in which what is known is uncorrelated, of length 1
    along = deviations @ left_axes[:, apart]
    ahead, freedom = axes @ (pool - variables.mean(axis=0)).T, n - 1 - int(apart.sum())
    left = max(squares - float(along @ along), 0.0) / freedom
    error = left * (1 / n + float(np.sum(ahead.mean(axis=1) ** 2)))
    error += float((along @ ahead).var(ddof=1)) / len(pool)
    t, plain_t = (student_quantile(each, 0.5 + level / 2) for each in (freedom, n - 1))
    nearer = t / plain_t * math.sqrt(error / (squares / (n - 1) / n))
    nearer = max(nearer, 2 * t * math.sqrt(error) / (plain.high - plain.low))
    value = min(max(plain.value + float(along @ ahead.mean(axis=1)), least), 1.0)
    low, high = (value + nearer * (end - plain.value) for end in (plain.low, plain.high))
    return Estimate(value, max(low, least), min(high, 1.0), plain.n, plain.n_excluded)


def worth(plain: Estimate, better: Estimate) -> float:
    """Return how many times as many episodes `plain` needs to be as precise as `better`.

    Both are estimates of the same mean over episodes; `better` is the one with control variates.
    The result is the square of how many times as wide the interval of `plain` is: of its lower or
    its upper half, whichever gives less; 1 if neither is known.
    """
    below = plain.value - plain.low, better.value - better.low
    above = plain.high - plain.value, better.high - better.value
    return min(((wide / narrow) ** 2 for wide, narrow in (below, above) if narrow > 0), default=1.0)
