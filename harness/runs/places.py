"""Sums, means and least values of groups, such as episodes, by each value's place."""

import numpy as np

from harness.core.arrays import Floats, Ints


def sum_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the sum of the known values in each of n groups, such as over an episode, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1. NaN are left
    out; the sum of no value is 0.
    """
    return np.bincount(places, weights=np.nan_to_num(values), minlength=n).astype(float)


def mean_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the mean of the known values of each of n groups, such as episodes, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1. NaN for a
    group without a known value.
    """
    is_known = ~np.isnan(values)
    count = np.bincount(places[is_known], minlength=n)
    total = sum_by_place(values[is_known], places[is_known], n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def least_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the least of the known values of each of n groups, such as episodes, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1. NaN for a
    group without a known value.
    """
    least = np.full(n, np.nan)
    np.fmin.at(least, places, values)
    return least
