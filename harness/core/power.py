"""How many episodes find a paired difference of success,
and which difference so many episodes find.

A difference is found where the 95 % interval of `statistics.paired_difference` leaves out 0. Over n
episodes its standard error is that of a paired mean (Miller 2024, arXiv:2411.00640, section 5). The
interval is wider by what it counts on and has not seen. `benchmarks/plan.py` simulates the power.
"""

from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.quantiles import normal_quantile
from harness.core.statistics import ALIKE, FEW, LEVEL

UNKNOWN = 1e12  # stands for a variance that is not known
MOST = 1e9  # episodes; more are as good as never
HALVINGS = 60  # of a bracket: to the rounding of a number


@dataclass(frozen=True)
class Spread:
    """Hold how much a difference of success varies between episodes, for a power analysis.

    The difference is paired: of the same episode in two runs or settings. Strata are groups of
    episodes that are averaged apart, such as those with a danger (a vehicle in the ego's way) and
    those without; there are H. `shares`, (H,), has the share of all episodes that is in each, and
    `variances`, (..., H), the variance of one episode's difference of success there. The mean over
    strata is unweighted.
    """

    shares: Floats  # share of all episodes that is in each stratum, (H,); they sum to 1
    variances: Floats  # variance of an episode's difference in each stratum, (..., H)

    def episodes(self, difference: float, power: float) -> Floats:
        """Return how many episodes are needed to find a difference of success, (...).

        `difference` is one of shares of success, from 0 to 1, and `power` the probability with
        which it shall be found: that its 95 % interval excludes 0. The result has whole numbers;
        inf above `MOST`.
        """
        low, high = np.ones(self._shape), np.full(self._shape, MOST)
        for _ in range(HALVINGS):  # of the ratio, since the bracket spans nine orders of magnitude
            middle = np.sqrt(low * high)
            enough = self._needed(middle, np.full(self._shape, difference), power) <= difference
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(high < MOST, np.ceil(high - 1e-6), np.inf)

    def difference(self, n: float, power: float) -> Floats:
        """Return the least difference of success that n episodes find with this power, (...).

        It is a difference of shares, from 0 to 1; `power` is the probability that it is found: that
        its 95 % interval excludes 0. NaN if they find none up to 1.
        """
        low, high = np.zeros(self._shape), np.ones(self._shape)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            enough = self._needed(np.full(self._shape, n), middle, power) <= middle
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(high < 1, high, np.nan)

    @property
    def _shape(self) -> tuple[int, ...]:
        return self.variances.shape[:-1]

    def _needed(self, n: Floats, difference: Floats, power: float) -> Floats:
        """Return the difference that n episodes find if outcomes vary as they must for
        `difference`, (...).

        A difference makes outcomes of 0 and 1 vary, even if none is lost and a share of them
        gained: pilots that agree do not say that fewer layouts are enough. Over several seeds this
        is more than it must be.
        """
        least = (difference * (1 - difference))[..., None]
        varies = np.minimum(np.maximum(self.variances, least), UNKNOWN)
        of_part = n[..., None] * self.shares
        weights = 1 / (len(self.shares) * of_part)  # of an episode in the mean
        error = np.sum(weights**2 * of_part * varies, axis=-1)
        # The interval: each part's variance is mixed with that of all, and two more differ.
        more = ALIKE / len(self.shares) if len(self.shares) > 1 else 0.0
        of_all = np.sum(self.shares * varies, axis=-1)[..., None]
        mixed = (of_part * varies + more * of_all) / (of_part + more)
        differing = of_part * np.minimum(varies, 1.0)  # episodes, if each that differs does so by 1
        many = differing.sum(axis=-1)
        usual = np.sum(differing * weights**2, axis=-1) / np.where(many > 0, many, 1.0)
        added = 2 * (usual + (weights.max(axis=-1) ** 2 - usual) * np.exp(-many / FEW))
        assumed = np.sum(weights**2 * of_part * mixed, axis=-1) + added
        beyond = normal_quantile(0.5 + LEVEL / 2) * np.sqrt(assumed)
        return np.asarray(beyond + normal_quantile(power) * np.sqrt(error))


def variance(values: Floats, counts: Ints) -> Floats:
    """Return the sample variance of E values, (E,), for each set of integer weights, (...).

    `counts`, (..., E), are the weights: how often each value counts. inf where they sum to less
    than 2.
    """
    n = counts.sum(axis=-1)
    mean = counts @ values / np.maximum(n, 1)
    squares = np.maximum(counts @ values**2 - n * mean**2, 0)  # rounding may go below
    return np.where(n > 1, squares / np.maximum(n - 1, 1), np.inf)
