"""Intervals of means that hold at every look at once,
so that a run may stop when it has seen enough.

Of shares: each value from 0 to 1 is a bet for or against a mean m: capital that never grows on
average if m is the mean. By Ville's inequality it exceeds 20 with a probability of 5 % at most,
whenever one looks, and so the means at which it does not are a 95 % confidence sequence:
Waudby-Smith and Ramdas 2024, Estimating means of bounded random variables by betting, J. R. Stat.
Soc. B 86(1), the hedged capital with a grid of bets.

Of paired differences: the interval of `statistics.paired_difference`, as much wider as the normal
mixture of Robbins is (Waudby-Smith and others 2024, Time-uniform central limit theory and
asymptotic confidence sequences, Ann. Stat. 52(6)). It is half as wide as by bets where parts are
averaged, and holds for many episodes, not for any number. How often runs that stop hold the truth
is simulated by `benchmarks/interim_looks.py`.
"""

import math
from collections.abc import Sequence

import numpy as np

from harness.core.arrays import Floats
from harness.core.statistics import LEVEL, Estimate, paired_reach

# Shares of what may be bet: any are valid, and these are good for 20 to 5000 values.
BETS = np.geomspace(0.01, 0.8, 10)
# episodes at which an interval of differences is least wide, against that of one look
NARROWEST = 100
MEANS = np.linspace(0.0, 1.0, 1001)  # the means that are tried; ends are the next one outwards


def any_time(parts: Sequence[Floats]) -> Estimate:
    """Return a mean of shares with a 95 % interval that stays valid at every look.

    Such an interval, a confidence sequence, may be computed after each episode, and the run stopped
    by it. `parts` are one or two strata (groups that are averaged apart) of E independent values
    from 0 to 1, (E,) each, NaN left out; the result is the unweighted mean of their means. By
    betting: Waudby-Smith and Ramdas 2024.
    """
    values = [part[~np.isnan(part)] for part in parts]
    n, n_excluded = sum(map(len, values)), sum(map(len, parts)) - sum(map(len, values))
    if not all(map(len, values)):
        return Estimate(math.nan, math.nan, math.nan, n, n_excluded)
    capitals = [_log_capital(part) for part in values]
    low, high = _least_mean(capitals), 1 - _least_mean([capital[::-1] for capital in capitals])
    value = float(np.mean([part.mean() for part in values]))
    return Estimate(value, low, high, n, n_excluded)


def any_time_difference(parts: Sequence[Floats]) -> Estimate:
    """Return a mean paired difference of shares, with an interval that stays valid at every look.

    `parts` are its strata, groups that are averaged apart: differences from -1 to 1 of E episodes,
    (E,) each, NaN left out. The result is the unweighted mean of their means. The 95 % interval may
    be computed after any number of episodes (asymptotically), and the run stopped by it.
    """
    return paired_reach(parts, _mixture(sum(int((~np.isnan(part)).sum()) for part in parts)))


def _mixture(n: int) -> float:
    """Return the standard errors that an interval reaches after n episodes.

    A mixture whose prior weighs as n / r episodes reaches sqrt((1 + 1/r) (ln(1 + r) - 2 ln alpha)),
    which is least at r = 9 for alpha = 0.05.
    """
    r = 9 * max(n, 1) / NARROWEST
    return math.sqrt((1 + 1 / r) * (math.log1p(r) - 2 * math.log(1 - LEVEL)))


def _log_capital(values: Floats) -> Floats:
    """Return the logarithm of the capital after these values for each of `MEANS`, (M,).

    Half of it is bet on a greater mean and half on a smaller one, spread evenly over `BETS`. It
    does not depend on the order of the values, and is log-convex in the mean.
    """
    distinct, count = np.unique(values, return_counts=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = [
            np.where(side == mean, 1.0, side / mean)
            for side, mean in ((distinct, MEANS[:, None]), (1 - distinct, 1 - MEANS[:, None]))
        ]
        logs = [np.log1p(BETS[:, None] * (ratio[:, None, :] - 1)) @ count for ratio in ratios]
    return np.asarray(np.logaddexp.reduce(np.hstack(logs), axis=1) - math.log(2 * len(BETS)))


def _least_mean(capitals: Sequence[Floats]) -> float:
    """Return the least mean of one or two parts' means that their capital together does not
    refute.
    """
    most, first = -math.log(1 - LEVEL), capitals[0]
    if len(capitals) == 1:
        return float(MEANS[max(np.flatnonzero(first < most)[0] - 1, 0)])
    second = capitals[1]
    lowest = int(np.argmin(second))
    # Left of its lowest capital falls with the mean: the least mean there that what is left does
    # not refute.
    place = lowest - np.searchsorted(second[lowest::-1], most - first, side="left") + 1
    possible = most - first > second[lowest]
    means = (MEANS + MEANS[np.clip(place - 1, 0, None)]) / 2
    return float(max(np.min(means[possible]) - MEANS[1] / 2, 0.0))
