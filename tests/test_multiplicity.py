"""Holm's correction and p-values of intervals, by hand and against SciPy."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from harness.core.multiplicity import LEAST, LEVEL, clear, holm, p_of_bootstrap, p_value
from harness.core.statistics import Estimate, episode_interval, rate_difference

SHARES = st.lists(st.floats(0, 1), min_size=1, max_size=12)


def test_holm_by_hand() -> None:
    """Sorted 0.01, 0.02, 0.03, 0.04 count 4, 3, 2 and 1 times,
    and none less than the one before it.
    """
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.02]) == [0.02]
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []
    assert holm([0.01, 0.02], 4) == pytest.approx([0.04, 0.06]), "two picked among four"


@given(SHARES)
def test_holm_lies_between_no_correction_and_bonferroni_and_keeps_the_order(
    p_values: list[float],
) -> None:
    corrected = holm(p_values)
    for p, q in zip(p_values, corrected, strict=True):
        assert p <= q <= min(1.0, p * len(p_values)) + 1e-12
    order = np.argsort(p_values, kind="stable")
    assert np.all(np.diff(np.array(corrected)[order]) >= 0)
    picked = sorted(p_values)[: len(p_values) // 2 + 1]
    shown = holm(picked, len(p_values))
    assert shown == pytest.approx(sorted(corrected)[: len(picked)]), (
        "the least are corrected as among all"
    )


def of_values(values: list[int], level: float) -> Estimate:
    return episode_interval(np.array(values, dtype=float), level=level)


@given(st.lists(st.lists(st.integers(-9, 9), min_size=1, max_size=9), max_size=6))
@pytest.mark.slow
def test_what_is_clear_is_what_a_corrected_p_says(differences: list[list[int]]) -> None:
    intervals = {str(n): partial(of_values, values) for n, values in enumerate(differences)}
    p_values = [p_value(interval) for interval in intervals.values()]
    corrected = holm([1.0 if p is None else p for p in p_values])
    below = {name for name, p in zip(intervals, corrected, strict=True) if p <= LEVEL}
    assert clear(intervals) == below


def test_false_alarms_among_many_true_nothings_stay_at_five_percent() -> None:
    """2 000 pages of 20 comparisons without any difference:
    64 % have a p under 0.05, Holm's in 5 %.
    """
    draws = np.random.default_rng(0).random((2000, 20))
    alarms = np.mean([min(holm(page.tolist())) <= 0.05 for page in draws])
    assert np.mean(draws.min(axis=1) <= 0.05) > 0.6
    assert alarms == pytest.approx(0.05, abs=0.015)


@given(
    st.lists(st.integers(-20, 20), min_size=2, max_size=40).filter(
        lambda values: len(set(values)) > 1
    )
)
@pytest.mark.slow
def test_the_p_of_students_interval_is_the_t_tests(values: list[int]) -> None:
    found = p_value(lambda level: episode_interval(np.array(values, dtype=float), level=level))
    assert found == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue, rel=1e-3, abs=LEAST)


@given(
    st.lists(st.tuples(st.booleans(), st.booleans()), min_size=2, max_size=60),
    st.floats(0.5, 0.999),
)
@pytest.mark.slow
def test_the_interval_of_a_rate_leaves_0_out_just_where_p_is_less(
    pairs: list[tuple[bool, bool]], level: float
) -> None:
    """No formula of the 95 % ends does this, since these intervals are not symmetric."""
    a, b = np.array(pairs, dtype=float).T
    p = p_value(lambda at: rate_difference(a, b, at))
    assert p is not None
    assert LEAST <= p <= 1
    found = rate_difference(a, b, level)
    assert (found.low > 0 or found.high < 0) == (p < 1 - level) or p == pytest.approx(
        1 - level, rel=1e-6
    )
    assert p_value(lambda at: rate_difference(b, a, at)) == pytest.approx(p), "the other way round"


def test_rates_that_agree_in_every_episode_have_p_1() -> None:
    alike = np.array([1.0, 1.0, 0.0])
    assert p_value(lambda level: rate_difference(alike, alike, level)) == 1.0


def test_what_is_surer_than_numbers_can_say_is_not_0() -> None:
    """Fifty milliseconds more in even episodes and 50.01 in odd ones."""
    slower = np.array([50.0, 50.01] * 120)
    assert p_value(lambda level: episode_interval(slower, level=level)) == LEAST


def test_where_there_is_no_interval_there_is_no_p() -> None:
    """Every time changed alike, and there is no telling how others would;
    or there is one episode.
    """
    assert p_value(lambda level: episode_interval(np.full(10, 5.0), level=level)) is None
    assert p_value(lambda level: rate_difference(np.ones(1), np.zeros(1), level)) is None
    assert p_of_bootstrap(5.0, math.nan, math.nan) is None


def test_a_bootstraps_interval_that_touches_0_has_p_005_on_whichever_side() -> None:
    assert p_of_bootstrap(3.0, 0.0, 9.0) == pytest.approx(0.05)
    assert p_of_bootstrap(-3.0, -9.0, 0.0) == pytest.approx(0.05)
    assert p_of_bootstrap(3.0, 0.1, 9.0) < 0.05 < p_of_bootstrap(3.0, -0.1, 9.0)
    assert p_of_bootstrap(0.0, 0.0, 400.0) == 1.0
    assert p_of_bootstrap(5.0, 5.0, 9.0) == 0.05, "no spread on the side of 0"
