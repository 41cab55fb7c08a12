"""Scores of intents, and means with an interval.

A score has one value per decision; an interval turns values into an `Estimate`. Steps of one episode
are no independent trials, so intervals are over episodes or over seeds.
"""

import math
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Estimate:
    """A mean and its confidence interval.

    Attributes:
        value: the mean; NaN if there was nothing to average.
        low: lower end of the interval; NaN where the data cannot bound it.
        high: upper end.
        n: independent units behind it: episodes, pairs of episodes or seeds.
        n_excluded: units left out because their value is NaN.
    """

    value: float
    low: float
    high: float
    n: int
    n_excluded: int


def safe_target(safe: Bools) -> Floats:
    """Distribution that is uniform over the safe actions, `(..., A)`; NaN where no action is safe."""
    count = np.sum(safe, axis=-1, keepdims=True)
    return np.where(count > 0, safe / np.maximum(count, 1), np.nan)


def brier(p: Floats, target: Floats) -> Floats:
    """Squared distance of intents from target distributions, both `(..., A)`; 0 best, 2 worst. `(...)`.

    Brier 1950 for many classes, with a distribution (`safe_target`) in the place of the one true class.
    It is smallest at p = target: of two safe actions, sure of one scores 0.5 and undecided scores 0.
    """
    score: Floats = np.sum((p - target) ** 2, axis=-1)
    return score


def negative_log_likelihood(p: Floats, safe: Bools, floor: float = 1e-4) -> Floats:
    """-ln of the probability that intents `(..., A)` give to the safe actions; 0 best. Shape `(...)`.

    The logarithmic score (Good 1952) with the set of safe actions as the event that came true: how the
    mass is spread inside the set does not matter, which `brier` looks at. NaN where no action is safe.

    Args:
        p: intents.
        safe: which actions are safe, `(..., A)`.
        floor: least probability counted, so that one answer both sure and wrong costs -ln(floor)
            = 9.2 nats and not infinity.
    """
    mass = np.sum(np.where(safe, p, 0.0), axis=-1)
    # Rounding may put the mass of a distribution a hair above 1.
    return np.where(np.any(safe, axis=-1), -np.log(np.clip(mass, floor, 1.0)), np.nan)


def seed_interval(per_seed_means: Floats, level: float = 0.95) -> Estimate:
    """Mean over seeds `(S,)` with Student's t interval, the paper's error bars; t(4) = 2.776 for 5 seeds.

    One seed has a value and no interval.
    """
    return _student(per_seed_means, level)


def episode_interval(values_by_episode: Floats, level: float = 0.95) -> Estimate:
    """Mean over episodes with Student's t interval over the episodes' own means.

    For yes/no outcomes use `rate_interval`: t gives 0 of 20 an interval of no width.

    Args:
        values_by_episode: `(E,)`, or `(E, ...)` with steps behind. An episode's mean is over what is not
            NaN in it; an episode with nothing else is excluded.
        level: confidence level.
    """
    values = values_by_episode.reshape(len(values_by_episode), math.prod(values_by_episode.shape[1:]))
    return _student(known_mean(values, axis=-1), level)


def known_mean(values: Floats, axis: int) -> Floats:
    """Mean along an axis of what is not NaN; NaN where nothing is."""
    known = ~np.isnan(values)
    count = np.sum(known, axis=axis)
    total = np.sum(np.where(known, values, 0.0), axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def rate_interval(outcomes_by_episode: Floats, level: float = 0.95) -> Estimate:
    """Share of ones among 0/1 outcomes `(E,)` with Wilson's score interval (Wilson 1927)."""
    outcomes = outcomes_by_episode[~np.isnan(outcomes_by_episode)]
    n = len(outcomes)
    n_excluded = len(outcomes_by_episode) - n
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, n_excluded)
    rate = float(np.mean(outcomes))
    return Estimate(rate, *wilson(rate, n, level), n, n_excluded)


def wilson(rate: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a share among n (Wilson 1927)."""
    from scipy.special import ndtri

    z = float(ndtri(0.5 + level / 2))
    centre = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * math.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    # At 0 and 1 the end is the rate itself; only rounding says otherwise.
    return min(max(centre - half, 0.0), rate), max(min(centre + half, 1.0), rate)


def share_interval(hits: Floats, episodes: Ints, level: float = 0.95) -> Estimate:
    """Share of ones among decisions, with Wilson's interval for as many as they are worth.

    Decisions of one episode go together, so n of them say as much as n / deff independent ones, deff being
    the variance of the share over episodes as clusters against that of independent decisions, 1 at least
    (Korn and Graubard 1998). Where all are alike nobody can tell deff, and an episode counts as one.

    Args:
        hits: 0 or 1, `(n,)`; NaN is left out.
        episodes: of which episode each is, `(n,)`.
        level: confidence level.

    Returns:
        The share, with the number of decisions as n.
    """
    known = ~np.isnan(hits)
    y, _, cluster = hits[known], *np.unique(episodes[known], return_inverse=True)
    n, clusters = len(y), int(cluster.max()) + 1 if len(y) else 0
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, len(hits))
    rate = float(np.mean(y))
    worth = float(clusters)
    if clusters > 1 and 0.0 < rate < 1.0:
        totals = np.bincount(cluster, weights=y - rate)
        variance = clusters / (clusters - 1) * float(np.sum(totals**2)) / n**2
        worth = n / max(variance / (rate * (1 - rate) / n), 1.0)
    low, high = wilson(rate, worth, level)
    return Estimate(rate, low, high, n, len(hits) - n)


def paired_difference(a: Floats, b: Floats, level: float = 0.95) -> Estimate:
    """Mean of a - b over episodes with Student's t interval.

    Args:
        a: one condition's values, `(E,)` or `(E, ...)`, episodes in the same order as in `b`.
        b: the other's. Where either is NaN the pair is excluded.
        level: confidence level.
    """
    return episode_interval(a - b, level)


def _student(values: Floats, level: float) -> Estimate:
    from scipy.special import stdtrit

    known = values[~np.isnan(values)]
    n = len(known)
    n_excluded = len(values) - n
    if n < 2:
        return Estimate(float(known[0]) if n else math.nan, math.nan, math.nan, n, n_excluded)
    mean = float(np.mean(known))
    half = float(stdtrit(n - 1, 0.5 + level / 2) * np.std(known, ddof=1) / math.sqrt(n))
    return Estimate(mean, mean - half, mean + half, n, n_excluded)
