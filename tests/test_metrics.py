"""Scores and intervals, against tables and published values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from harness.core.statistics import (
    Estimate,
    brier,
    episode_interval,
    mean_of,
    negative_log_likelihood,
    rate_difference,
    rate_interval,
    safe_target,
    seed_interval,
    seed_rate_interval,
    wilson,
)

NAN = math.nan


@pytest.mark.parametrize(
    ("n", "t"), [(2, 12.706), (3, 4.303), (5, 2.776), (10, 2.262), (31, 2.042)]
)
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
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx(
        (0.94, 0.9204, 0.9596), abs=5e-5
    )
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
    with_gaps, without = (
        interval(np.array([1.0, NAN, 0.0, 1.0, NAN])),
        interval(np.array([1.0, 0.0, 1.0])),
    )
    assert with_gaps == Estimate(without.value, without.low, without.high, 3, 2)


def test_steps_of_one_episode_are_one_trial():
    """Episode means 1, 0 and 2; the fourth episode is unknown throughout."""
    steps = np.array([[1.0, 1.0], [0.0, 0.0], [2.0, NAN], [NAN, NAN]])
    means = episode_interval(np.array([1.0, 0.0, 2.0]))
    assert episode_interval(steps) == Estimate(means.value, means.low, means.high, 3, 1)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
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


def test_seeds_and_decisions_of_an_episode_are_worth_what_their_spread_says():
    """Means of episodes 1, 1, .5, .5, mean .75:
    the squares sum to 1/4, and over 4 · 3 the variance is 1/48.

    .75 · .25 over that is 9. All fourth powers are alike, so all 3 degrees of freedom count: t =
    3.182, and 9 times (1.960 / 3.182)² is 3.414, less than the 4 episodes. With .8 and .7 the
    variance is 1/1200.
    """
    apart, near = (
        rate_interval(np.array([1.0, 1.0, 0.5, 0.5])),
        rate_interval(np.array([0.8, 0.8, 0.7, 0.7])),
    )
    assert (apart.value, apart.low, apart.high) == pytest.approx((0.75, *wilson(0.75, 4)))
    assert (near.low, near.high) == pytest.approx(
        wilson(0.75, 225 * (1.959964 / 3.182446) ** 2), rel=1e-6
    )


def test_where_few_episodes_differ_the_spread_is_hardly_known():
    """One of ten at .5, nine at 1: mean .95, squares .225, fourth powers .0411,
    2 · .225² / .0360 = 2.81.
    """
    rate = rate_interval(np.array([0.5] + [1.0] * 9))
    t = stats.t.ppf(0.975, 2 * 0.225**2 / (0.45**4 + 9 * 0.05**4 - 0.225**2 / 10))
    assert 0.95 * 0.05 / (0.225 / 90) * (1.959964 / t) ** 2 < 10, "so an episode counts as one"
    assert (rate.low, rate.high) == pytest.approx(wilson(0.95, 10))


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_no_interval_of_a_rate_has_no_width_or_leaves_its_range(values):
    estimate = rate_interval(np.array(values))
    assert 0 <= estimate.low <= estimate.value <= estimate.high <= 1
    assert estimate.low < estimate.high


def test_a_pair_counts_only_where_both_are_known():
    difference = rate_difference(np.array([1.0, 0.0, NAN, 1.0]), np.array([0.0, 0.0, 0.0, NAN]))
    assert (difference.value, difference.n, difference.n_excluded) == (0.5, 2, 2)


def test_a_paired_difference_of_newcombe_1998():
    """Statistics in Medicine 17:2635-2650, method 10:
    of 50 pairs 36 both, 12 the first, 2 the second alone.

    By hand, p = .96 and q = .76 (Wilson's ends .8654, .9890 and .6259, .8570): the covariance is
    .72 - .96 · .76 = -.0096, from which nothing is taken, so the correlation is -.0096 / (.1960 ·
    .4271).
    """
    difference = rate_difference(
        np.repeat([1.0, 1.0, 0.0], [36, 12, 2]), np.repeat([1.0, 0.0, 1.0], [36, 12, 2])
    )
    assert (difference.value, difference.low, difference.high) == pytest.approx(
        (0.2, 0.0569, 0.3404), abs=5e-5
    )


def test_where_all_pairs_agree_some_of_other_episodes_might_not():
    """Of 20 pairs half succeed: the covariance .25 less 1/20 leaves a correlation of .8."""
    a = np.repeat([0.0, 1.0], 10)
    low, high = wilson(0.5, 20)
    half = math.sqrt(2 * (1 - 0.8)) * (high - 0.5)
    difference = rate_difference(a, a)
    assert (difference.value, difference.low, difference.high) == pytest.approx((0.0, -half, half))
    assert high - 0.5 == pytest.approx(0.5 - low)


@pytest.mark.parametrize("n", [20, 50, 100, 600])
def test_where_all_pairs_succeed_the_interval_is_the_score_interval_of_tango(n: int):
    """Tango 1998, without a discordant pair: n d / (1 - d) is z² at the ends, whatever agrees."""
    z2 = stats.norm.ppf(0.975) ** 2
    difference = rate_difference(np.ones(n), np.ones(n))
    assert (difference.low, difference.high) == pytest.approx((-z2 / (n + z2), z2 / (n + z2)))


@pytest.mark.parametrize("gain", [0.02, 0.05, 0.088])
def test_pairs_that_all_agree_need_their_interval(gain: float):
    """Of 50 pairs each gains with this probability:
    by all outcomes, 94 % and more of intervals hold it.

    At .05 no pair of the sample gains in .95^50, 8 % of samples, so that an interval that then
    stops below 5 points holds too little. At .088 coverage is least.
    """
    n, both = 50, 0.5
    covered = 0.0
    for gained in range(16):
        for same in range(10, 41):
            chance = stats.binom.pmf(gained, n, gain) * stats.binom.pmf(
                same, n - gained, both / (1 - gain)
            )
            if chance > 1e-7:
                first = np.repeat([1.0, 1.0, 0.0], [same, gained, n - same - gained])
                second = np.repeat([1.0, 0.0], [same, n - same])
                difference = rate_difference(first, second)
                covered += chance * (difference.low <= gain <= difference.high)
    assert 0.94 < covered <= 1


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=2, max_size=12))
def test_a_difference_of_rates_turns_its_sign_with_its_sides(pairs):
    a, b = np.array(pairs).T
    one, other = rate_difference(a, b), rate_difference(b, a)
    assert (one.low, one.high) == pytest.approx((-other.high, -other.low), abs=1e-9)
    assert -1 - 1e-9 <= one.low < one.high <= 1 + 1e-9
    assert one.low <= one.value <= one.high


def test_over_seeds_these_episodes_stay_what_they_are():
    """Two of four episodes hang on the seed:
    the squares in them, 1/2 and 1/2, over 4 (2 - 1) are 1/4.

    Of 8 values that is 2, and with two more that go another way 4: t(4) = 2.776 times 2 over 8.
    """
    estimate = seed_rate_interval(np.array([[1.0, 1.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]]))
    half = 2.776445 * 2 / 8
    assert (estimate.value, estimate.low) == pytest.approx((0.5, 0.5 - half))
    assert estimate.high == 1.0, "and not 1.19"
    assert (estimate.n, estimate.n_excluded) == (2, 0)


def test_where_no_seed_changes_anything_one_might():
    estimate = seed_rate_interval(np.repeat([[1.0] * 30 + [0.0] * 10], 5, axis=0))
    assert estimate.value == 0.75
    assert estimate.high - 0.75 == pytest.approx(stats.t.ppf(0.975, 160) * math.sqrt(2) / 200)


def test_one_seed_of_a_rate_has_no_interval_either():
    estimate = seed_rate_interval(np.array([[1.0, 0.0]]))
    assert (estimate.value, estimate.n) == (0.5, 1)
    assert math.isnan(estimate.low)


def test_where_all_are_alike_students_t_knows_no_ends():
    for values in ([3.0, 3.0, 3.0], [0.1 + 0.2, 0.3, 0.3]):
        estimate = episode_interval(np.array(values))
        assert estimate.value == pytest.approx(values[0])
        assert math.isnan(estimate.low)
        assert math.isnan(estimate.high)


def test_values_of_an_episode_go_together_in_students_t_too():
    """Totals of three episodes about the mean 2: -2, 0 and 2, so 3/2 · 8 over 6² is 1/3."""
    values, of = np.array([1.0, 1.0, 2.0, 2.0, 3.0, 3.0]), np.array([7, 7, 8, 8, 9, 9])
    estimate = episode_interval(values, of)
    assert (estimate.value, estimate.n) == (2.0, 6)
    assert estimate.high - 2.0 == pytest.approx(4.302653 / math.sqrt(3))
    alone = episode_interval(np.array([1.0, 2.0, 3.0]))
    assert (estimate.low, estimate.high) == pytest.approx((alone.low, alone.high))


def test_brier_scores_by_hand():
    safe = np.array(
        [[True, False, False], [True, True, False], [True, True, False], [True, False, False]]
    )
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
    together = rate_interval(alike, np.repeat(np.arange(4), 6))
    alone = rate_interval(alike, np.arange(24))
    assert together.value == alone.value == 0.75
    assert (together.n, alone.n) == (24, 24)
    assert (together.low, together.high) == pytest.approx(wilson(0.75, 4))
    assert (alone.low, alone.high) == pytest.approx(wilson(0.75, 24))


def test_where_all_decisions_are_alike_an_episode_counts_as_one():
    share = rate_interval(np.ones(60), np.repeat(np.arange(10), 6))
    assert (share.low, share.high) == wilson(1.0, 10.0)


def test_a_long_episode_counts_for_more_than_a_short_one():
    """Nine decisions of one episode and one of another are worth 10² / (9² + 1²) episodes."""
    share = rate_interval(np.ones(10), np.array([0] * 9 + [1]))
    assert (share.low, share.high) == wilson(1.0, 100 / 82)


def test_unknown_decisions_are_left_out_and_none_gives_no_share():
    share = rate_interval(np.array([1.0, np.nan, 0.0]), np.array([0, 0, 1]))
    assert (share.value, share.n, share.n_excluded) == (0.5, 2, 1)
    assert np.isnan(rate_interval(np.array([np.nan]), np.array([0])).value)


def test_the_mean_of_two_families_by_hand():
    """.5 [.3, .6] and .9 [.8, .96]: the ends are half of √(.2² + .1²) below and of √(.1² + .06²)
    above .7.
    """
    mean = mean_of([Estimate(0.5, 0.3, 0.6, 20, 0), Estimate(0.9, 0.8, 0.96, 50, 1)])
    assert (mean.value, mean.low, mean.high) == pytest.approx((0.7, 0.588197, 0.758310), abs=1e-6)
    assert (mean.n, mean.n_excluded) == (70, 1)


def test_the_mean_of_one_family_is_its_own_and_what_one_does_not_bound_the_mean_does_not():
    one = mean_of([Estimate(0.5, 0.3, 0.6, 20, 0)])
    assert (one.value, one.low, one.high) == pytest.approx((0.5, 0.3, 0.6))
    open_above = mean_of([Estimate(0.5, 0.3, 0.6, 20, 0), Estimate(0.9, 0.8, NAN, 1, 0)])
    assert open_above.low == pytest.approx(0.588197, abs=1e-6)
    assert math.isnan(open_above.high)


@pytest.mark.parametrize("rates", [(0.5, 0.5, 0.5), (0.4, 0.7, 0.9), (0.6, 0.95, 0.8)])
def test_the_interval_of_the_mean_over_families_holds_the_truth_as_often_as_it_says(rates):
    """Exactly, over all outcomes of 20 episodes in each of three families."""
    n = 20
    of_k = [Estimate(k / n, *wilson(k / n, n), n, 0) for k in range(n + 1)]
    chances = [np.atleast_1d(stats.binom.pmf(np.arange(n + 1), n, rate)) for rate in rates]
    truth, held = sum(rates) / 3, 0.0
    for ks in np.ndindex(n + 1, n + 1, n + 1):
        mean = mean_of([of_k[k] for k in ks])
        if mean.low <= truth <= mean.high:
            held += math.prod(chance[k] for chance, k in zip(chances, ks, strict=True))
    assert 0.94 < held < 0.97
