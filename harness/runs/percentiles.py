"""Latency percentiles: their intervals, and their differences between two runs.

A percentile is of all decisions or answers of a run: episodes have none of their own that have a mean. The
interval is a bootstrap: episodes are resampled, each with all that is of it, in two runs the same ones, and
the ends are percentiles of what the percentile, or B - A, then is (Efron and Tibshirani 1993, chapter 13).
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.statistics import Estimate, known_mean, resampled
from harness.runs.metrics import PERCENTILES

RESAMPLES, RESAMPLING_SEED = 999, 0
AT_ONCE = 4_000_000  # numbers that are laid out together

Decided = tuple[Ints, Floats]  # of one seed's decisions, the episode's place and the value


def differences(
    a: Sequence[Decided], b: Sequence[Decided], episodes: int
) -> Iterator[tuple[int, float, float, Estimate]]:
    """Of each of `PERCENTILES`: itself, A's, B's, and B - A with its interval over so many episodes.

    A run's percentile is the mean over its seeds. An episode that either run knows nothing of in a seed is
    left out there.
    """
    weights = resampled(np.random.default_rng(RESAMPLING_SEED), episodes, RESAMPLES)
    both = [_met(one, other) for one, other in zip(a, b, strict=True)]
    n = len(set().union(*(set(one[0].tolist()) for one, _ in both)))
    if not n:
        return
    before, after = (
        known_mean(np.array([_percentiles(pair[side], weights) for pair in both]), 0) for side in (0, 1)
    )
    for percent, x, y in zip(PERCENTILES, before, after, strict=True):
        estimate = Estimate(float(y[0] - x[0]), *_ends(y - x, n), n, episodes - n)
        yield percent, float(x[0]), float(y[0]), estimate


def intervals(values: Floats, episodes: Sequence[str]) -> dict[int, tuple[float, float]]:
    """The 95 % interval of each of `PERCENTILES` of some values, (n,), each of an episode; NaN for none."""
    names, place = np.unique(episodes, return_inverse=True)
    weights = resampled(np.random.default_rng(RESAMPLING_SEED), len(names), RESAMPLES)
    found = _percentiles((place, values), weights)
    return {p: _ends(each, len(names)) for p, each in zip(PERCENTILES, found, strict=True)}


def _ends(found: Floats, episodes: int) -> tuple[float, float]:
    """Where the middle 95 % of the resamples end; NaN where they tell nothing of other episodes."""
    sampled = found[1:][~np.isnan(found[1:])]
    low, high = np.percentile(sampled, (2.5, 97.5)) if episodes > 1 else (math.nan, math.nan)
    return (math.nan, math.nan) if low == high else (float(low), float(high))


def _met(a: Decided, b: Decided) -> tuple[Decided, Decided]:
    """What is known, of the episodes that both know."""
    (one, other) = ((place[~np.isnan(v)], v[~np.isnan(v)]) for place, v in (a, b))
    in_both = np.intersect1d(one[0], other[0])
    kept = [(p[np.isin(p, in_both)], v[np.isin(p, in_both)]) for p, v in (one, other)]
    return kept[0], kept[1]


def _percentiles(decided: Decided, weights: Ints) -> Floats:
    """`PERCENTILES` of decisions, each counted as often as its episode: (P, R) from weights (R, E)."""
    parts = math.ceil(len(weights) * max(len(decided[0]), 1) / AT_ONCE)
    return np.hstack([_weighted(decided, part) for part in np.array_split(weights, parts)])


def _weighted(decided: Decided, weights: Ints) -> Floats:
    place, values = decided
    result = np.full((len(PERCENTILES), len(weights)), np.nan)
    some = weights[:, np.unique(place)].any(axis=1)  # resamples that have a decision at all
    order = np.argsort(values, kind="stable")
    counted = weights[some][:, place[order]].cumsum(axis=1)
    if not counted.size:
        return result
    last = counted[:, -1] - 1
    # Rows one above the other are one ascending line, in which every row is searched at once.
    row, size = np.arange(len(counted)), counted.shape[1]
    lift = row * (last.max() + 2)
    line = (counted + lift[:, None]).ravel()

    def at(k: Ints) -> Floats:
        """The k-th smallest, from 0."""
        picked: Floats = values[order][np.searchsorted(line, k + lift, side="right") - row * size]
        return picked

    position = np.array(PERCENTILES)[:, None] / 100 * last
    lower = np.floor(position).astype(np.int64)
    low, high = at(lower), at(np.minimum(lower + 1, last))
    result[:, some] = low + (high - low) * (position - lower)
    return result
