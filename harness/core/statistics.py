"""Scores of intents, and confidence intervals of means, shares and differences.

A score has one value per decision; an interval turns values into an `Estimate`. Steps of one
episode are not independent trials, so intervals are over episodes or over seeds. Neither are the
episodes of layouts that are cut from one thing, such as a recording of traffic: these are a
*cluster*, and clusters take the place of episodes (Liang and Zeger 1986). `benchmarks/intervals.py`
measures how often intervals cover the true value.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.quantiles import normal_quantile, student_quantile

LEVEL = 0.95  # of confidence
LEAST_MASS = 1e-4  # least probability that is counted of safe actions
ALIKE = 4.0  # episodes, over all parts of a mean, by which each part varies as all do
# differing units, up to which an interval counts on rarer and heavier ones than were seen
FEW = 6.0
FEWEST = 10  # clusters that a bootstrap resamples: of fewer, its interval is far too narrow
# a smaller sum of squares is rounding only; relative to the mean where that is above 1
ROUNDING = 1e-18


@dataclass(frozen=True)
class Estimate:
    """Hold a mean, `value`, and the ends of its confidence interval, `low` and `high`.

    `n` is the number of independent units behind it, such as episodes, pairs of episodes or seeds,
    and `n_excluded` how many more were left out because their value is NaN. What is not known is
    NaN.
    """

    value: float  # the mean; NaN if there was nothing to average
    low: float  # lower end of the interval; NaN if the data cannot bound it
    high: float  # upper end
    n: int  # number of independent units: episodes, pairs of episodes or seeds
    n_excluded: int  # units left out because their value is NaN


def safe_target(safe: Bools) -> Floats:
    """Return the uniform distribution over the safe ones of A actions, `(..., A)`.

    `safe` says of each action whether the episode can still succeed after it, `(..., A)`. NaN where
    no action is safe.
    """
    count = np.sum(safe, axis=-1, keepdims=True)
    return np.where(count > 0, safe / np.maximum(count, 1), np.nan)


def brier(p: Floats, target: Floats) -> Floats:
    """Return the Brier score (1950) of distributions over A actions, `(..., A)` to `(...)`.

    `p` has the probabilities that an intent (an answer's distribution) gives to the actions, and
    `target` those it is scored against: of one true action, or of several (`safe_target`). The
    score is their squared distance: 0 is best, 2 worst. It is smallest at p = target: with two safe
    actions, an intent that is sure of one scores 0.5, and one that is undecided between both scores
    0.
    """
    score: Floats = np.sum((p - target) ** 2, axis=-1)
    return score


def negative_log_likelihood(p: Floats, safe: Bools) -> Floats:
    """Return -ln of the probability that intents give to the safe ones of A actions, `(...)`.

    `p`, `(..., A)`, has the probabilities that an intent (an answer's distribution) gives to the
    actions, and `safe`, `(..., A)`, says after which of them the episode can still succeed. This is
    the logarithmic score (Good 1952) of the event that the action is safe, in nats; 0 is best. How
    the probability is spread among safe actions does not matter. NaN where no action is safe. An
    answer that is sure and wrong costs -ln(`LEAST_MASS`) = 9.2.
    """
    mass = np.sum(np.where(safe, p, 0.0), axis=-1)
    # Rounding may put the mass of a distribution slightly above 1.
    return np.where(np.any(safe, axis=-1), -np.log(np.clip(mass, LEAST_MASS, 1.0)), np.nan)


def seed_interval(per_seed_means: Floats) -> Estimate:
    """Return the mean over S channel seeds with Student's t interval at 95 %.

    `per_seed_means`, `(S,)`, has the mean over all episodes under each channel seed, a number that
    fixes which messages get lost. With one seed, or if all have the same mean, the ends are NaN.
    """
    return _student(per_seed_means, np.arange(len(per_seed_means)))


def episode_interval(
    values_by_episode: Floats, episodes: Ints | None = None, level: float = LEVEL
) -> Estimate:
    """Return the mean with Student's t interval over episodes; for shares see `rate_interval`.

    Args:
        values_by_episode: of E episodes, `(E,)`, or `(E, ...)` with more axes such as steps, over
            which an episode's known values are averaged; an episode that is all NaN is excluded.
            With `episodes`, n values, `(n,)`.
        episodes: the number of each value's episode, `(n,)`. The mean is then over values, and the
            variance that of a ratio of totals (Cochran 1977, section 6.3).
        level: of confidence, from 0 to 1.

    If all episodes are alike the ends are NaN.
    """
    values = values_by_episode.reshape(
        len(values_by_episode), math.prod(values_by_episode.shape[1:])
    )
    means = known_mean(values, axis=-1)
    return _student(means, np.arange(len(means)) if episodes is None else episodes, level)


def known_mean(values: Floats, axis: int) -> Floats:
    """Return the mean of `values`, of any shape, along an axis, which is dropped.

    NaN are left out, or returned if all values along the axis are NaN.
    """
    is_known = ~np.isnan(values)
    count = np.sum(is_known, axis=axis)
    total = np.sum(np.where(is_known, values, 0.0), axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def cluster_numbers(names: Sequence[str | None]) -> Ints | None:
    """Return the number from 0 of each episode's cluster, (E,); None if each is of its own.

    `names` has the name of each episode's cluster; one without is a cluster of its own. Names that
    have one of their `parts_of` in common are of one cluster.
    """
    return joined_clusters([names])


def parts_of(name: str) -> list[str]:
    """Return the parts of a cluster's name: `a + b` says that it is of both."""
    return name.split(" + ")


def joined_clusters(partitions: Sequence[Sequence[str | None]]) -> Ints | None:
    """Return the number from 0 of each of E episodes' cluster, (E,); None if each is of its own.

    Each of `partitions` has the name of each episode's cluster, as one source has it. Two episodes
    are in one cluster if any source says so: whoever states finer clusters gains nothing.
    """
    earlier = list(range(len(partitions[0])))  # of each: one of its cluster; the first is its own
    for names in partitions:
        first_of: dict[str, int] = {}
        for place, name in enumerate(names):
            for part in [] if name is None else parts_of(name):
                both = first_of.setdefault(part, place), place
                one, other = sorted(_first(earlier, each) for each in both)
                earlier[other] = one
    numbers: dict[int, int] = {}
    firsts = [_first(earlier, place) for place in range(len(earlier))]
    each = [numbers.setdefault(first, len(numbers)) for first in firsts]
    return None if len(numbers) == len(each) else np.array(each, dtype=np.int64)


def _first(earlier: Sequence[int], place: int) -> int:
    while earlier[place] != place:
        place = earlier[place]
    return place


def units_of(episodes: Ints, numbers: Sequence[int], clusters: Ints | None) -> Ints:
    """Return the number of what each of n values is counted under: its cluster, or its episode.

    `episodes`, (n,), has the number of each value's episode, `numbers` those of all E episodes, and
    `clusters`, (E,), the number of each one's cluster; None if each is a cluster of its own.
    """
    if clusters is None:
        return episodes
    cluster_of = dict(zip(numbers, clusters.tolist(), strict=True))
    return np.array([cluster_of[episode] for episode in episodes.tolist()], dtype=np.int64)


def too_few(clusters: Ints | None) -> bool:
    """Return whether episodes are of fewer than `FEWEST` clusters, too few for a bootstrap.

    `clusters`, (E,), has the number of each episode's cluster; None if each is its own.
    """
    return clusters is not None and len(np.unique(clusters)) < FEWEST


def rate_interval(values: Floats, episodes: Ints | None = None) -> Estimate:
    """Return the mean of n shares from 0 to 1, with Wilson's 95 % interval of the effective size.

    `values` are `(n,)`, NaN left out. `episodes`, `(n,)`, has the number of each value's episode;
    by default each value has one of its own. Values of one episode correlate, so the effective size
    is smaller than n by the variance between episodes; it is 1 for a single episode. Numbers of
    clusters of episodes do the same.
    """
    is_known = ~np.isnan(values)
    n, n_excluded = int(is_known.sum()), int((~is_known).sum())
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, n_excluded)
    rate = float(np.mean(values[is_known]))
    totals, sizes = _clusters(
        values[is_known] - rate, None if episodes is None else episodes[is_known]
    )
    return Estimate(rate, *wilson(rate, _effective_n(rate, totals, sizes)), n, n_excluded)


def wilson(rate: float, n: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the ends of Wilson's score interval (1927) of a share `rate` observed in n trials.

    `level` is the confidence of the interval.
    """
    z = _normal(level)
    centre = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * math.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    # At 0 and 1 the end is exactly the rate; without these bounds rounding would move it.
    return min(max(centre - half, 0.0), rate), max(min(centre + half, 1.0), rate)


def seed_rate_interval(values: Floats) -> Estimate:
    """Return the mean of shares over seeds, for fixed episodes, with an interval over other seeds.

    `values` are from 0 to 1, or differences of such, `(S, E)`, of S seeds by E episodes; NaN is
    left out. The variance is that between seeds within each episode, pooled, with E (S - 1) degrees
    of freedom. Two values that deviate from the rest of their episode are added, one each way (as
    Bonett and Price 2012 do with pairs), since seeds that were not drawn may differ. n is the
    number of seeds; with one seed the ends are NaN.
    """
    means = known_mean(values, axis=1)
    value, counted = float(known_mean(means, axis=0)), int((~np.isnan(means)).sum())
    is_known = ~np.isnan(values)
    freedom = int(np.sum(np.maximum(is_known.sum(axis=0) - 1, 0)))
    if freedom == 0:
        return Estimate(value, math.nan, math.nan, counted, len(means) - counted)
    within = float(np.nansum((values - known_mean(values, axis=0)) ** 2)) / freedom
    n = int(is_known.sum())
    half = student_quantile(freedom, 0.5 + LEVEL / 2) * math.sqrt(n * within + 2) / n
    return Estimate(
        value, max(value - half, -1.0), min(value + half, 1.0), counted, len(means) - counted
    )


def paired_difference(
    parts: Sequence[Floats], level: float = LEVEL, clusters: Sequence[Ints] | None = None
) -> Estimate:
    """Return the unweighted mean of the strata's mean differences, with an interval over episodes.

    Strata are groups of episodes, such as those with a danger (a vehicle in the ego's way) and
    those without. The variance is that of a stratified mean (Cochran 1977, section 5.6). It is
    enlarged for rare differences that were not seen, in two ways that were found by simulation
    (`benchmarks/differences.py` measures coverage and power). Each stratum's variance is mixed with
    that of all, as of `ALIKE` more episodes over all strata. And two episodes that differ are
    added, one each way (as Bonett and Price 2012 add pairs): with k that differ, their squared
    weight goes from the largest possible to the usual one by exp(-k / `FEW`). The ends are NaN if a
    stratum has only one episode.

    Of clusters the totals vary in place of episodes, over all strata at once, and two clusters that
    differ are added. The ends are NaN if there is only one cluster.

    Args:
        parts: for each stratum the differences of its E episodes, from -1 to 1, (E,); NaN is left
            out.
        level: of confidence, from 0 to 1.
        clusters: for each stratum the number of each episode's cluster, (E,), the same in all
            strata; None if each episode is a cluster of its own.
    """
    return paired_reach(parts, _normal(level), clusters)


def paired_reach(
    parts: Sequence[Floats], errors: float, clusters: Sequence[Ints] | None = None
) -> Estimate:
    """Return the mean over strata of paired differences, with ends so many standard errors away.

    It is `paired_difference` with another interval. `parts` has for each stratum (group of
    episodes) the differences of its E episodes, from -1 to 1, (E,); `errors` is the number of
    standard errors from the mean to either end, such as 1.96. `clusters` has for each the number of
    each episode's cluster, (E,); None if each is its own.
    """
    value, error = _paired_error(parts, clusters)
    n = sum(int((~np.isnan(part)).sum()) for part in parts)
    half = errors * error
    low, high = float(np.maximum(value - half, -1.0)), float(np.minimum(value + half, 1.0))
    return Estimate(value, low, high, n, sum(map(len, parts)) - n)


def _paired_error(
    parts: Sequence[Floats], clusters: Sequence[Ints] | None = None
) -> tuple[float, float]:
    """Return the mean of `paired_difference` and its standard error; NaN where it is not known."""
    known_parts = [part[~np.isnan(part)] for part in parts]
    sizes = np.array([len(part) for part in known_parts])
    if sizes.min() == 0:
        return math.nan, math.nan
    value = float(np.mean([part.mean() for part in known_parts]))
    weights = 1 / (len(parts) * sizes)  # of an episode in each part
    if clusters is not None:
        numbers = [of_part[~np.isnan(part)] for of_part, part in zip(clusters, parts, strict=True)]
        return value, _clustered_error(known_parts, np.repeat(weights, sizes), numbers)
    if sizes.min() == 1:
        return value, math.nan
    more = ALIKE / len(parts) if len(parts) > 1 else 0.0
    own_variances = np.array([part.var(ddof=1) for part in known_parts])
    of_all = float(np.mean(np.concatenate(known_parts) ** 2))
    variances = (sizes * own_variances + more * of_all) / (sizes + more)
    effects = np.concatenate(
        [part * weight for part, weight in zip(known_parts, weights, strict=True)]
    )
    added = _of_two_more(effects, float(weights.max()))
    return value, math.sqrt(float(np.sum(weights**2 * sizes * variances)) + added)


def _clustered_error(parts: Sequence[Floats], weights: Floats, clusters: Sequence[Ints]) -> float:
    """Return the standard error of the mean of parts' means over C clusters; NaN for one cluster.

    `weights` are those of all parts' episodes in the mean, one part after another, (E,).
    """
    place: Ints = np.unique(np.concatenate(clusters), return_inverse=True)[1]
    count = int(place.max()) + 1
    if count < 2:
        return math.nan
    deviations = np.concatenate([part - part.mean() for part in parts])
    effects: Floats = np.bincount(place, weights=np.concatenate(parts) * weights).astype(float)
    totals = np.bincount(place, weights=deviations * weights)
    variance = count / (count - 1) * float(np.sum(totals**2))
    heaviest = float(np.bincount(place, weights=weights).max())
    return math.sqrt(variance + _of_two_more(effects, heaviest))


def _of_two_more(effects: Floats, heaviest: float) -> float:
    """Return the variance that two more units which differ add to a mean, one each way.

    `effects` are what each unit adds to the mean, (n,), and `heaviest` is the greatest weight.
    """
    differing = effects[effects != 0]
    usual = float(np.mean(differing**2)) if len(differing) else 0.0
    return 2 * (usual + (heaviest**2 - usual) * math.exp(-len(differing) / FEW))


def rate_difference(a: Floats, b: Floats, level: float = LEVEL) -> Estimate:
    """Return the mean paired difference of two sets of shares, with a combined Wilson interval.

    `a` and `b` are of the same E episodes, `(E,)`, or `(E, ...)` with more axes; a pair in which
    either is NaN is left out. The ends of both `rate_interval`s are combined by the correlation
    over episodes (Newcombe 1998, method 10; Zou and Donner 2008), with two more pairs that differ,
    one each way. Wider than `paired_difference`, and kept for results that were computed with it
    (`runs/pinned.py`).
    """
    unknown = np.isnan(a) | np.isnan(b)
    x, y = (
        known_mean(
            np.where(unknown, np.nan, side).reshape(len(side), math.prod(side.shape[1:])), axis=-1
        )
        for side in (a, b)
    )
    x, y = x[~np.isnan(x)], y[~np.isnan(y)]
    n, n_excluded = len(x), len(a) - len(x)
    value = float(np.mean(x - y)) if n else math.nan
    if n < 2:
        return Estimate(value, math.nan, math.nan, n, n_excluded)
    p, p_off, p_low, p_high, p_n = _around(x, level)
    q, q_off, q_low, q_high, q_n = _around(y, level)
    covariance = float(np.mean(p_off * q_off))
    covariance = max(covariance - 1 / math.sqrt(p_n * q_n), 0.0) if covariance > 0 else covariance
    spread = math.sqrt(float(np.mean(p_off**2) * np.mean(q_off**2)))
    correlation = covariance / spread if spread > 0 else 0.0

    def reach(below: float, above: float) -> float:
        return math.sqrt(max(below**2 - 2 * correlation * below * above + above**2, 0.0))

    low, high = value - reach(p - p_low, q_high - q), value + reach(p_high - p, q - q_low)
    return Estimate(value, low, high, n, n_excluded)


def mean_of(estimates: Sequence[Estimate], together: bool = False) -> Estimate:
    """Return the unweighted mean of independent estimates, with an interval combined from theirs.

    The distances of the ends from the values are combined as the root of their sum of squares
    ("MOVER": Zou and Donner 2008), so the level of confidence is that of the estimates. The
    estimates are taken as all there are, not as a sample of more. NaN where any estimate is.
    `together` is for estimates that are not independent, as of the same clusters: the distances are
    averaged, which is widest, as if all were off the same way.
    """
    value = np.array([estimate.value for estimate in estimates])
    low = np.array([estimate.low for estimate in estimates])
    high = np.array([estimate.high for estimate in estimates])
    mean = float(np.mean(value))
    below, above = (_combined(np.abs(value - end), together) for end in (low, high))
    n, n_excluded = sum(e.n for e in estimates), sum(e.n_excluded for e in estimates)
    return Estimate(mean, mean - below, mean + above, n, n_excluded)


def _combined(distances: Floats, together: bool) -> float:
    """Return how far the end of a mean's interval is away, from the distances of what it is of."""
    total = float(distances.sum()) if together else math.hypot(*distances)
    return total / len(distances)


def resampled(draws: np.random.Generator, n: int, times: int, clusters: Ints | None = None) -> Ints:
    """Return how often each of n units is in `times` bootstrap resamples, `(1 + times, n)`.

    The first row is all ones: the units themselves. Each other one counts n draws with replacement.
    With `clusters`, the number from 0 of each unit's cluster, (n,), clusters are drawn in place of
    units, as many as there are: all units of one count alike.
    """
    if clusters is not None:
        return resampled(draws, int(clusters.max()) + 1, times)[:, clusters]
    return np.vstack(
        [np.ones((1, n), dtype=np.int64), draws.multinomial(n, np.full(n, 1 / n), times)]
    )


def resampled_estimate(values: Floats, n: int, clusters: Ints | None = None) -> Estimate:
    """Return a statistic of n units with the 95 % percentile interval of its bootstrap.

    A unit is what is drawn with replacement, such as an episode. `values`, `(1 + times,)`, has the
    statistic of the units themselves, then that of each resample, in the order of `resampled`. NaN
    resamples are left out; if the first is NaN, there is no interval, nor if `clusters`, (n,), has
    the numbers of fewer than `FEWEST` clusters of the units.
    """
    resamples = values[1:][~np.isnan(values[1:])]
    if np.isnan(values[0]):
        return Estimate(math.nan, math.nan, math.nan, 0, n)
    has_ends = len(resamples) > 0 and not too_few(clusters)
    low, high = np.percentile(resamples, (2.5, 97.5)).tolist() if has_ends else (math.nan, math.nan)
    return Estimate(float(values[0]), low, high, n, 0)


def _around(values: Floats, level: float) -> tuple[float, Floats, float, float, float]:
    """Return the mean of shares `(E,)`, the deviations,
    the interval's ends and the effective sample size.
    """
    rate = float(np.mean(values))
    deviations = values - rate
    effective_n = _effective_n(rate, deviations, np.ones(len(values)), level)
    return rate, deviations, *wilson(rate, effective_n, level), effective_n


def _effective_n(rate: float, totals: Floats, sizes: Floats, level: float = LEVEL) -> float:
    """Return the number of independent yes-or-no trials that are as informative as these episodes.

    This is the effective sample size of Korn and Graubard (1998): rate (1 - rate) over the variance
    of the mean with episodes as clusters, reduced for Student's t in place of the normal
    distribution. The degrees of freedom are Satterthwaite's, from the fourth moment: they are few
    if few episodes differ from the rest. An episode counts as one trial at least, since no values
    from 0 to 1 vary more than yes or no. `totals` are each episode's sum of deviations from the
    rate, and `sizes` the number of its values, (C,).
    """
    clusters, n = len(totals), float(sizes.sum())
    least = n**2 / float(np.sum(sizes**2))
    squares, fourths = float(np.sum(totals**2)), float(np.sum(totals**4))
    if clusters < 2 or squares < ROUNDING:
        return least
    variance = clusters / (clusters - 1) * squares / n**2
    uneven = fourths - squares**2 / clusters
    freedom = 2 * squares**2 / uneven if uneven > 0 else math.inf
    t = student_quantile(min(max(freedom, 1.0), clusters - 1.0), 0.5 + level / 2)
    return max(rate * (1 - rate) / variance * (_normal(level) / t) ** 2, least)


def _clusters(values: Floats, episodes: Ints | None) -> tuple[Floats, Floats]:
    if episodes is None:
        return values, np.ones(len(values))
    place: Ints = np.unique(episodes, return_inverse=True)[1]
    return np.bincount(place, weights=values).astype(float), np.bincount(place).astype(float)


def _student(values: Floats, episodes: Ints, level: float = LEVEL) -> Estimate:
    is_known = ~np.isnan(values)
    n, n_excluded = int(is_known.sum()), int((~is_known).sum())
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, n_excluded)
    mean = float(np.mean(values[is_known]))
    totals, _ = _clusters(values[is_known] - mean, episodes[is_known])
    clusters, squares = len(totals), float(np.sum(totals**2))
    if clusters < 2 or squares < ROUNDING * max(mean**2, 1.0):
        return Estimate(mean, math.nan, math.nan, n, n_excluded)
    error = math.sqrt(clusters / (clusters - 1) * squares) / n
    half = student_quantile(clusters - 1, 0.5 + level / 2) * error
    return Estimate(mean, mean - half, mean + half, n, n_excluded)


def _normal(level: float) -> float:
    return float(normal_quantile(0.5 + level / 2))
