"""Scores and intervals, against tables and published values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.statistics import (
    Estimate,
    brier,
    episode_interval,
    negative_log_likelihood,
    paired_difference,
    rate_interval,
    safe_target,
    seed_interval,
    share_interval,
    wilson,
)

NAN = math.nan


@pytest.mark.parametrize(("n", "t"), [(2, 12.706), (3, 4.303), (5, 2.776), (10, 2.262), (31, 2.042)])
def test_the_interval_over_seeds_uses_the_t_of_the_printed_tables(n, t):
    values = np.arange(float(n))
    estimate = seed_interval(values)
    assert estimate.value == pytest.approx((n - 1) / 2)
    standard_error = np.std(values, ddof=1) / math.sqrt(n)
    assert (estimate.high - estimate.value) / standard_error == pytest.approx(t, abs=5e-4)
    assert (estimate.value - estimate.low) / standard_error == pytest.approx(t, abs=5e-4)


def test_five_seeds_by_hand():
    """Mean 0.94, standard deviation 0.0158 over root 5 is 0.00707, times 2.776 is 0.0196."""
    estimate = seed_interval(np.array([0.92, 0.93, 0.94, 0.95, 0.96]))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.94, 0.9204, 0.9596), abs=5e-5)
    assert (estimate.n, estimate.n_excluded) == (5, 0)


def test_one_seed_has_a_value_and_no_interval():
    estimate = seed_interval(np.array([0.9]))
    assert (estimate.value, estimate.n) == (0.9, 1)
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.high)


@pytest.mark.parametrize("interval", [seed_interval, episode_interval, rate_interval])
@pytest.mark.parametrize("values", [[], [NAN, NAN]])
def test_nothing_to_average_is_unknown_and_not_zero(interval, values):
    estimate = interval(np.array(values, float))
    assert math.isnan(estimate.value)
    assert (estimate.n, estimate.n_excluded) == (0, len(values))


@pytest.mark.parametrize("interval", [seed_interval, episode_interval, rate_interval])
def test_unknown_values_are_excluded_and_counted(interval):
    with_gaps, without = interval(np.array([1.0, NAN, 0.0, 1.0, NAN])), interval(np.array([1.0, 0.0, 1.0]))
    assert with_gaps == Estimate(without.value, without.low, without.high, 3, 2)


def test_steps_of_one_episode_are_one_trial():
    """Episode means 1, 0 and 2; the fourth episode is unknown throughout."""
    steps = np.array([[1.0, 1.0], [0.0, 0.0], [2.0, NAN], [NAN, NAN]])
    means = episode_interval(np.array([1.0, 0.0, 2.0]))
    assert episode_interval(steps) == Estimate(means.value, means.low, means.high, 3, 1)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_intervals_of_newcombe_1998(successes, n, low, high):
    """Newcombe, Statistics in Medicine 17:857-872, table I, method 3."""
    estimate = rate_interval(np.array([1.0] * successes + [0.0] * (n - successes)))
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=5e-5)
    assert estimate.value == pytest.approx(successes / n)


def test_none_or_all_of_n_ends_exactly_at_zero_or_one():
    for n in range(1, 61):
        assert rate_interval(np.zeros(n)).low == 0.0
        assert rate_interval(np.ones(n)).high == 1.0


@given(st.integers(0, 60), st.integers(1, 60))
def test_a_rate_lies_in_its_interval_and_the_interval_in_zero_to_one(successes, failures):
    estimate = rate_interval(np.array([1.0] * successes + [0.0] * failures))
    assert 0 <= estimate.low <= estimate.value <= estimate.high <= 1


def test_a_pair_counts_only_where_both_are_known():
    difference = paired_difference(np.array([3.0, 2.0, NAN, 5.0]), np.array([1.0, 2.0, 0.0, NAN]))
    assert (difference.value, difference.n, difference.n_excluded) == (1.0, 2, 2)
    assert difference.high - difference.value == pytest.approx(12.706, rel=1e-4)


def test_a_condition_does_not_differ_from_itself():
    a = np.array([0.1, 0.7, 0.3])
    assert paired_difference(a, a) == Estimate(0.0, 0.0, 0.0, 3, 0)


def test_pairing_removes_what_both_conditions_share():
    episodes = np.array([10.0, 20.0, 30.0, 40.0])
    difference = paired_difference(episodes + 1, episodes)
    assert (difference.value, difference.low, difference.high) == pytest.approx((1.0, 1.0, 1.0))


def test_brier_scores_by_hand():
    safe = np.array([[True, False, False], [True, True, False], [True, True, False], [True, False, False]])
    p = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert brier(p, safe_target(safe)) == pytest.approx([0.0, 0.0, 0.5, 2.0])


def test_likelihood_counts_the_mass_on_all_safe_actions():
    safe = np.array([True, True, False])
    p = np.array([[0.5, 0.0, 0.5], [0.2, 0.3, 0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = [math.log(2), math.log(2), 0.0, 4 * math.log(10)]
    assert negative_log_likelihood(p, safe) == pytest.approx(expected)


def test_a_scene_without_a_safe_action_and_a_failed_answer_have_no_score():
    p, failed = np.array([0.2, 0.8]), np.array([NAN, NAN])
    nothing_safe, first_safe = np.array([False, False]), np.array([True, False])
    for answer, safe in ((p, nothing_safe), (failed, first_safe)):
        assert math.isnan(brier(answer, safe_target(safe)))
        assert math.isnan(negative_log_likelihood(answer, safe))


@given(st.integers(0, 2**32))
def test_in_the_mean_no_forecast_beats_the_truth(seed):
    """Propriety of the Brier score: over outcomes drawn from q, answering q costs least."""
    rng = np.random.default_rng(seed)
    q, p = rng.dirichlet(np.ones(3), 2)
    outcomes = np.eye(3, dtype=bool)
    assert q @ brier(q, safe_target(outcomes)) <= q @ brier(p, safe_target(outcomes)) + 1e-12


def test_decisions_of_one_episode_are_worth_less_than_as_many_alone():
    alike = np.repeat([1.0, 0.0, 1.0, 1.0], 6)
    together = share_interval(alike, np.repeat(np.arange(4), 6))
    alone = share_interval(alike, np.arange(24))
    assert together.value == alone.value == 0.75
    assert (together.n, alone.n) == (24, 24)
    # By hand: the variance over four clusters is 4/3 * 27/576 = 1/16, eight times that of 24 alone.
    assert (together.low, together.high) == pytest.approx(wilson(0.75, 3.0))
    assert (alone.low, alone.high) == pytest.approx(wilson(0.75, 23.0))


def test_where_all_decisions_are_alike_an_episode_counts_as_one():
    share = share_interval(np.ones(60), np.repeat(np.arange(10), 6))
    assert (share.low, share.high) == wilson(1.0, 10.0)


def test_unknown_decisions_are_left_out_and_none_gives_no_share():
    share = share_interval(np.array([1.0, np.nan, 0.0]), np.array([0, 0, 1]))
    assert (share.value, share.n, share.n_excluded) == (0.5, 2, 1)
    assert np.isnan(share_interval(np.array([np.nan]), np.array([0])).value)
