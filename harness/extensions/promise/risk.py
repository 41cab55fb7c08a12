"""Test which settings keep a promise: p-values of harm, and chains of them ("learn then test").

A setting is certified if the hypothesis that its mean harm is above `at_most` is rejected. Whatever
the model states, all rejections are right together with probability 1 - delta (Angelopoulos, Bates,
Candès, Jordan and Lei 2021, arXiv:2110.01052), so the best of them may be picked on the same
layouts.
"""

import math
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Bools, Floats, Ints

ROUNDING = 1e-9  # of a sum of harms
LEAST = 1e-6  # share of harm that may be promised, and probability that a promise is wrong


def units_needed(at_most: float, delta: float) -> int:
    """Return how many units, all without harm, promise a mean harm of `at_most` at `delta`.

    A unit is a layout, or a scene that several are cut from. Both are shares between 0 and 1.
    """
    return math.ceil(math.log(delta) / math.log1p(-at_most) - ROUNDING)


def p_values(means: Floats, n: int, at_most: float, binary: bool) -> Floats:
    """Return p-values of the hypothesis that the true mean harm is above `at_most`, (...).

    They are the binomial tail where a unit's harm can be nothing but 0 or 1 (`binary`), else the
    Hoeffding-Bentkus bound of Bates and others 2021 (arXiv:2101.02703), for harms from 0 to 1. Of
    no harm both are (1 - at_most)^n.

    Args:
        means: mean harms of n units that are drawn independently, (...).
        n: number of units.
        at_most: the share of harm that is promised, between 0 and 1.
        binary: whether the harm of every unit is 0 or 1 whatever the model does.
    """
    shares = np.minimum(np.asarray(means, dtype=float), at_most)
    tail: Floats = _tail(n, at_most)[np.ceil(np.asarray(means) * n - ROUNDING).astype(int)]
    if binary:
        return tail
    divergence = (1 - shares) * np.log((1 - shares) / (1 - at_most))
    above = np.where(shares > 0, shares, 1.0)
    divergence = divergence + np.where(shares > 0, shares * np.log(above / at_most), 0.0)
    bound: Floats = np.minimum(np.exp(-n * divergence), math.e * tail)
    return bound


def least_p(mean: float, n: int, at_most: float) -> float:
    """Return the smaller of both p-values that a mean harm of n units may have (`p_values`)."""
    means = np.array(mean)
    return min(float(p_values(means, n, at_most, binary)) for binary in (True, False))


def _tail(n: int, share: float) -> Floats:
    """Return the probabilities of at most k of n events of probability `share`, by k, (n + 1,)."""
    logs = np.zeros(n + 1)
    for k in range(n + 1):
        choices = math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
        logs[k] = choices + k * math.log(share) + (n - k) * math.log1p(-share)
    tail: Floats = np.minimum(np.cumsum(np.exp(logs)), 1.0)
    return tail


@dataclass(frozen=True)
class Order:
    """Hold the order in which L settings are tested, fixed before any harm is seen.

    `first` is tested at delta. If its hypothesis is rejected, each of the K chains is tested, at
    delta / K, until a hypothesis is not rejected. So a true hypothesis is rejected with probability
    delta at most: by the first test, or by the first true one of some chain (Bretz and others 2009,
    `doi:10.1002/sim.3495`).
    """

    first: int  # index of the setting that is tested first
    chains: tuple[tuple[int, ...], ...]  # indices of the others, chain by chain

    def certified(self, p: Floats, delta: float) -> Bools:
        """Return which settings are certified, (..., L), given their p-values, (..., L)."""
        passes = np.zeros(p.shape, dtype=bool)
        passes[..., self.first] = p[..., self.first] <= delta
        for chain in self.chains:
            places = list(chain)
            small = p[..., places] <= delta / len(self.chains)
            unbroken = np.logical_and.accumulate(small, axis=-1)
            passes[..., places] = unbroken & passes[..., self.first, None]
        return passes


def best(certified: Bools, success: Floats, requests: Floats) -> Ints:
    """Return the index of the certified setting with the most success, (...); -1 if none is.

    All are (..., L), of L settings; of equal success that with the fewest requests is taken, of
    these the first.
    """
    ranks = np.where(certified, success, -np.inf)
    likeliest = ranks >= ranks.max(axis=-1, keepdims=True) - ROUNDING
    costs = np.where(certified & likeliest, requests, np.inf)
    return np.where(certified.any(axis=-1), np.argmin(costs, axis=-1), -1)
