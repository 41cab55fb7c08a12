"""What certifies settings: p-values by hand and by scipy, and the order of tests by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.extensions.promise.risk import Order, best, p_values, units_needed

# 0 first; then 1, 2, 3 and 4, 5
ORDER = Order(0, ((1, 2, 3), (4, 5)))


@pytest.mark.parametrize(
    ("at_most", "delta", "units"),
    [(0.05, 0.05, 59), (0.01, 0.05, 299), (0.5, 0.5, 1), (0.5, 0.25, 2), (0.05, 0.0125, 86)],
)
def test_so_many_harmless_units_are_enough_and_one_less_is_not(at_most, delta, units):
    assert units_needed(at_most, delta) == units
    for binary in (True, False):
        assert p_values(np.array(0.0), units, at_most, binary) <= delta
        assert p_values(np.array(0.0), units - 1, at_most, binary) > delta if units > 1 else True


def test_p_values_by_hand():
    """Of 4 units with a half each: at most one harm is 5 of 16; e times that is .849,
    and exp(-4 kl) is .593.
    """
    kl = 0.25 * math.log(0.25 / 0.5) + 0.75 * math.log(0.75 / 0.5)
    assert p_values(np.array(0.25), 4, 0.5, True) == pytest.approx(5 / 16)
    assert p_values(np.array(0.25), 4, 0.5, False) == pytest.approx(math.exp(-4 * kl))
    assert p_values(np.array([0.0, 1.0]), 4, 0.5, True) == pytest.approx([1 / 16, 1.0])
    # a harm of .1 in 4 units is not none: the binomial tail is that of one
    assert p_values(np.array(0.025), 4, 0.5, True) == pytest.approx(5 / 16)


def test_p_values_are_those_of_scipy():
    binom = pytest.importorskip("scipy.stats").binom
    for n, at_most in ((59, 0.05), (300, 0.01), (1000, 0.1)):
        k = np.arange(n + 1)
        tail = binom.cdf(k, n, at_most)
        np.testing.assert_allclose(p_values(k / n, n, at_most, True), tail, atol=1e-9)
        # exp(-n kl) is how much less likely k harms are of `at_most` than of k / n
        bound = np.exp(binom.logpmf(k, n, at_most) - binom.logpmf(k, n, k / n))
        expected = np.minimum(np.minimum(bound, math.e * tail), 1)
        below = k / n < at_most
        np.testing.assert_allclose(p_values(k / n, n, at_most, False)[below], expected[below])


def test_an_order_of_tests_by_hand():
    """At .05 the first passes at .05, the two chains at .025 each, each until its first failure."""
    p = np.array([0.04, 0.01, 0.03, 0.001, 0.025, 0.0])
    certified = ORDER.certified(p, 0.05)
    assert certified.tolist() == [True, True, False, False, True, True]
    p[0] = 0.051
    assert not ORDER.certified(p, 0.05).any()


def test_the_best_has_the_most_success_then_the_fewest_requests():
    certified = np.array([[True, True, True, False], [False, False, False, False]])
    success = np.array([0.5, 0.7, 0.7, 0.9])
    requests = np.array([0.0, 3.0, 2.0, 0.0])
    assert best(certified, np.tile(success, (2, 1)), np.tile(requests, (2, 1))).tolist() == [2, -1]


@given(
    st.lists(st.floats(0, 0.3), min_size=6, max_size=6),
    st.booleans(),
    st.integers(60, 200),
    st.integers(0, 2**32 - 1),
)
def test_no_more_than_delta_of_all_tune_layouts_promise_what_is_false(truth, whole, n, seed):
    """Whatever the true harms are: of 400 draws of tune layouts, a false promise in few.

    Of 400 with probability .05, 41 or more are drawn in less than one of 10 000 tries.
    """
    draws, at_most, delta = np.random.default_rng(seed), 0.1, 0.05
    rates = np.array(truth)
    means = draws.binomial(n, rates, (400, 6)) / n
    if not whole:  # a mean of harms over the channel's draws
        means = draws.binomial(5 * n, rates, (400, 6)) / (5 * n)
    certified = ORDER.certified(p_values(means, n, at_most, whole), delta)
    is_false = (certified & (rates > at_most)).any(axis=1)
    assert is_false.sum() <= 40
