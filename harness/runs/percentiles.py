"""Compute latency percentiles, their intervals, and those of their differences between two runs.

A percentile is taken over all decisions or answers of a run; it is not a mean of percentiles of
episodes. Its interval is a percentile bootstrap (Efron and Tibshirani 1993, chapter 13): whole
episodes are resampled, the same ones in two runs, and the ends are percentiles of the resampled
percentile, or of its difference B - A.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.statistics import FEWEST, Estimate, known_mean, resampled, too_few

PERCENTILES = (50, 95, 99)
RESAMPLES, RESAMPLING_SEED = 999, 0
AT_ONCE = 4_000_000  # how many numbers are in memory at once

Decided = tuple[Ints, Floats]  # the episode's index and the value of each decision of one seed


def percentiles(latency_ms: Floats) -> Floats:
    """Return the `PERCENTILES`, such as the 95th, of latencies (n,), ms; NaN if none is known.

    Unknown latencies, which are NaN, are left out.
    """
    measured = latency_ms[~np.isnan(latency_ms)]
    return (
        np.percentile(measured, PERCENTILES) if len(measured) else np.full(len(PERCENTILES), np.nan)
    )


def differences(
    a: Sequence[Decided], b: Sequence[Decided], episodes: int, clusters: Ints | None = None
) -> Iterator[tuple[int, float, float, Estimate]]:
    """Yield for each of `PERCENTILES` the percent, its value in run A and in B, and the difference.

    The difference is B - A with its interval.

    `a` and `b` have of each run, for each seed of the channel's random numbers, the index of each
    of n decisions' episodes and its value, (n,) each; a percentile is the mean over seeds. In a
    seed, an episode without values in either run is left out. `episodes` is the number of all
    episodes, (E,) `clusters` are resampled in their place if they have some.
    """
    weights = resampled(np.random.default_rng(RESAMPLING_SEED), episodes, RESAMPLES, clusters)
    common = [_common(of_a, of_b) for of_a, of_b in zip(a, b, strict=True)]
    n = len(set().union(*(set(of_a[0].tolist()) for of_a, _ in common)))
    if not n:
        return
    of_a = [_percentiles(of_one, weights) for of_one, _ in common]
    of_b = [_percentiles(of_other, weights) for _, of_other in common]
    values_a, values_b = known_mean(np.array(of_a), 0), known_mean(np.array(of_b), 0)
    for percent, x, y in zip(PERCENTILES, values_a, values_b, strict=True):
        ends = (math.nan, math.nan) if too_few(clusters) else _ends(y - x, n)
        estimate = Estimate(float(y[0] - x[0]), *ends, n, episodes - n)
        yield percent, float(x[0]), float(y[0]), estimate


def intervals(
    values: Floats, units: Sequence[str], is_clustered: bool = False
) -> dict[int, tuple[float, float]]:
    """Return the 95 % bootstrap interval of each of `PERCENTILES` of n values, by the percent.

    Whole units are resampled: `values` are (n,), and `units` names the episode of each, or its
    cluster if `is_clustered`. An end is NaN if the data cannot bound it, or of too few clusters.
    """
    names, index = np.unique(units, return_inverse=True)
    if is_clustered and len(names) < FEWEST:
        return dict.fromkeys(PERCENTILES, (math.nan, math.nan))
    weights = resampled(np.random.default_rng(RESAMPLING_SEED), len(names), RESAMPLES)
    resampled_percentiles = _percentiles((index, values), weights)
    return {
        p: _ends(resamples, len(names))
        for p, resamples in zip(PERCENTILES, resampled_percentiles, strict=True)
    }


def _ends(resamples: Floats, episodes: int) -> tuple[float, float]:
    """Return the ends of the middle 95 % of resamples;
    NaN for a single episode or if both ends are equal.
    """
    sampled = resamples[1:][~np.isnan(resamples[1:])]
    low, high = np.percentile(sampled, (2.5, 97.5)) if episodes > 1 else (math.nan, math.nan)
    return (math.nan, math.nan) if low == high else (float(low), float(high))


def _common(a: Decided, b: Decided) -> tuple[Decided, Decided]:
    """Return the known values of both runs, of the episodes in which both have some."""
    (known_a, known_b) = ((place[~np.isnan(v)], v[~np.isnan(v)]) for place, v in (a, b))
    in_both = np.intersect1d(known_a[0], known_b[0])
    shared = [(p[np.isin(p, in_both)], v[np.isin(p, in_both)]) for p, v in (known_a, known_b)]
    return shared[0], shared[1]


def _percentiles(decided: Decided, weights: Ints) -> Floats:
    """Return `PERCENTILES` of weighted decisions, (P, R);
    weights (R, E) count each episode in a resample.
    """
    parts = math.ceil(len(weights) * max(len(decided[0]), 1) / AT_ONCE)
    return np.hstack([_weighted(decided, part) for part in np.array_split(weights, parts)])


def _weighted(decided: Decided, weights: Ints) -> Floats:
    index, values = decided
    result = np.full((len(PERCENTILES), len(weights)), np.nan)
    filled = weights[:, np.unique(index)].any(axis=1)  # resamples that have any decision
    order = np.argsort(values, kind="stable")
    counted = weights[filled][:, index[order]].cumsum(axis=1)
    if not counted.size:
        return result
    last = counted[:, -1] - 1
    # Each row is lifted above the one before, so that one sorted search serves all rows.
    row, size = np.arange(len(counted)), counted.shape[1]
    lift = row * (last.max() + 2)
    ascending = (counted + lift[:, None]).ravel()

    def smallest(k: Ints) -> Floats:
        """Return the k-th smallest value of each resample, from 0."""
        picked: Floats = values[order][
            np.searchsorted(ascending, k + lift, side="right") - row * size
        ]
        return picked

    position = np.array(PERCENTILES)[:, None] / 100 * last
    lower = np.floor(position).astype(np.int64)
    low, high = smallest(lower), smallest(np.minimum(lower + 1, last))
    result[:, filled] = low + (high - low) * (position - lower)
    return result
