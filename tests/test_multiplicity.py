"""Holm's correction and p-values of intervals, by hand and against SciPy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from harness.core.multiplicity import holm, p_of_interval
from harness.core.statistics import episode_interval

SHARES = st.lists(st.floats(0, 1), min_size=1, max_size=12)


def test_holm_by_hand() -> None:
    """Sorted 0.01, 0.02, 0.03, 0.04 count 4, 3, 2 and 1 times, and none less than the one before it."""
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.02]) == [0.02]
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []
    assert holm([0.01, 0.02], 4) == pytest.approx([0.04, 0.06]), "two picked among four"


@given(SHARES)
def test_holm_lies_between_no_correction_and_bonferroni_and_keeps_the_order(p_values: list[float]) -> None:
    corrected = holm(p_values)
    for p, q in zip(p_values, corrected, strict=True):
        assert p <= q <= min(1.0, p * len(p_values)) + 1e-12
    order = np.argsort(p_values, kind="stable")
    assert np.all(np.diff(np.array(corrected)[order]) >= 0)
    picked = sorted(p_values)[: len(p_values) // 2 + 1]
    shown = holm(picked, len(p_values))
    assert shown == pytest.approx(sorted(corrected)[: len(picked)]), "the least are corrected as among all"


def test_false_alarms_among_many_true_nothings_stay_at_five_percent() -> None:
    """2 000 pages of 20 comparisons without any difference: 64 % have a p under 0.05, Holm's in 5 %."""
    draws = np.random.default_rng(0).random((2000, 20))
    alarms = np.mean([min(holm(page.tolist())) <= 0.05 for page in draws])
    assert np.mean(draws.min(axis=1) <= 0.05) > 0.6
    assert alarms == pytest.approx(0.05, abs=0.015)


@given(st.lists(st.integers(-20, 20), min_size=2, max_size=40).filter(lambda values: len(set(values)) > 1))
def test_the_p_of_students_interval_is_the_t_tests(values: list[int]) -> None:
    found = episode_interval(np.array(values, dtype=float))
    p_value = p_of_interval(found.value, found.low, found.high, found.n)
    assert p_value == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue, rel=1e-6, abs=1e-300)


def test_an_interval_that_touches_0_has_p_005_on_whichever_side() -> None:
    assert p_of_interval(3.0, 0.0, 9.0, 20) == pytest.approx(0.05)
    assert p_of_interval(-3.0, -9.0, 0.0, 20) == pytest.approx(0.05)
    assert p_of_interval(3.0, 0.1, 9.0, 20) < 0.05 < p_of_interval(3.0, -0.1, 9.0, 20)


def test_where_every_episode_changes_alike_the_sign_says_how_sure_that_is() -> None:
    """Two heads in a row are one in two, both sides; ten are 2 in 1024."""
    assert p_of_interval(5.0, 5.0, 5.0, 2) == 0.5
    assert p_of_interval(5.0, 5.0, 5.0, 10) == 2 / 1024
    assert p_of_interval(0.0, 0.0, 0.0, 10) == 1.0
    assert p_of_interval(5.0, math.nan, math.nan, 1) is None
