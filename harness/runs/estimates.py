"""Estimates of metrics and of their differences: means with intervals, and p-values."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from harness.core import multiplicity
from harness.core.arrays import Floats, Ints
from harness.core.figures import interval_of
from harness.core.statistics import (
    LEVEL,
    Estimate,
    episode_interval,
    known_mean,
    mean_of,
    paired_difference,
    rate_interval,
    seed_interval,
    seed_rate_interval,
)
from harness.runs.metrics import entry
from harness.runs.records import Score


def over_seeds(name: str, values: Floats) -> Estimate:
    """Return the mean of a metric's values with a 95 % interval over channel seeds.

    `values` are (S, E), by S seeds of the channel's random draws and E episodes, NaN where unknown;
    `name` is the metric's.
    """
    if entry(name).interval == "rate":
        return in_range(name, seed_rate_interval(values))
    return in_range(name, seed_interval(known_mean(values, axis=1)))


def over_episodes(name: str, values: Floats, clusters: Ints | None = None) -> Estimate:
    """Return the mean of a metric's values with a 95 % interval over episodes.

    `values` are (S, E), by S seeds of the channel's random draws and E episodes, NaN where unknown;
    `name` is the metric's. The interval is over the episodes' `clusters`, (E,), if they have some.
    """
    means = known_mean(values, axis=0)
    rate = entry(name).interval == "rate"
    if rate:
        return rate_interval(means, clusters)
    return in_range(name, episode_interval(means, clusters))


def difference(
    name: str,
    pairs: Sequence[tuple[Floats, Floats]],
    level: float = LEVEL,
    clusters: Ints | None = None,
) -> Estimate:
    """Return the difference a - b of a metric with its interval over episodes.

    `pairs` has the metric's values a and b of the same episodes, (E, S) each, by E episodes and S
    seeds of the channel's random draws: one pair, or of balanced success one for each half, with a
    danger and without, in which the episodes of the other half are NaN. `level` is the confidence
    of the interval, which is over the episodes' `clusters`, (E,), if they have some.
    """
    changes = [known_mean(a - b, axis=1) for a, b in pairs]
    if entry(name).interval != "rate":
        (change,) = changes
        return episode_interval(change, clusters, level)
    of_parts = None if clusters is None else [clusters] * len(changes)
    result = paired_difference(changes, level, of_parts)
    if len(pairs) == 1:
        return result
    return replace(result, n_excluded=max((result.n_excluded - result.n) // 2, 0))


def halved(
    name: str,
    estimate: Callable[[str], Estimate],
    shared: bool = False,
    clusters: Ints | None = None,
) -> Estimate:
    """Return a metric's estimate: for balanced success the mean of those of its two halves.

    A half is the episodes with a danger (a vehicle that would meet a cruising ego), or those
    without. `estimate` takes the name of a metric and returns its estimate. Halves have no episode
    in common, so that their intervals are independent, unless the episodes have `clusters`, (E,),
    which may be in both. `shared` says that they share units, such as seeds: n is then that of each
    half, else the sum. For any other metric it is `estimate(name)`.
    """
    halves = entry(name).halves
    if not halves:
        return estimate(name)
    first, second = map(estimate, halves)
    mean = mean_of([first, second], together=clusters is not None)
    n, n_excluded = (
        (first.n, first.n_excluded) if shared else (mean.n, (mean.n_excluded - mean.n) // 2)
    )
    return replace(mean, n=n, n_excluded=max(n_excluded, 0))


def p_value(
    name: str, pairs: Sequence[tuple[Floats, Floats]], clusters: Ints | None = None
) -> float | None:
    """Return the p-value of no difference in a metric; None if the difference has no interval.

    `name` is the metric's. `pairs` has the values of both sides for the same episodes, (E, S) each,
    by E episodes and S seeds of the channel's random draws: one pair, or for balanced success one
    for each half of the episodes, with a danger and without. `clusters`, (E,), are the episodes',
    if they have some.
    """
    return multiplicity.p_value(lambda level: difference(name, pairs, level, clusters))


def in_range(name: str, e: Estimate) -> Estimate:
    """Return an estimate with its interval cut to what the metric can be, from 0 to its `most`.

    `name` is the metric's, and `e` the estimate.
    """
    low, high = float(np.maximum(e.low, 0.0)), float(np.minimum(e.high, entry(name).most))
    return Estimate(e.value, low, high, e.n, e.n_excluded)


def written(score: Score) -> str:
    """Return a score and its interval as text, with the metric's unit but without its name."""
    return interval_of(score, entry(score.metric).unit)
