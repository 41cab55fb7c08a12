"""How intents become one policy."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.coordination.consensus import (
    inverse_distance_weights,
    linear_pool,
    log_pool,
    median,
    trimmed_mean,
)
from harness.coordination.rules import POOLS


def test_weights_fall_with_the_distance_to_the_conflict_zone():
    """1/20 : 1/10 : 1/5 is 1 : 2 : 4."""
    weights = inverse_distance_weights(np.array([20.0, 10.0, 5.0]), np.array([True, True]), 1.0)
    assert weights == pytest.approx([1 / 7, 2 / 7, 4 / 7])


def test_a_helper_not_heard_has_no_weight_even_where_its_distance_is_unknown():
    weights = inverse_distance_weights(np.array([20.0, np.nan, 5.0]), np.array([False, True]), 1.0)
    assert weights == pytest.approx([0.2, 0.0, 0.8])


def test_the_ego_alone_has_all_the_weight():
    assert inverse_distance_weights(np.array([7.0, 3.0]), np.array([False]), 1.0).tolist() == [
        1.0,
        0.0,
    ]
    assert inverse_distance_weights(np.array([7.0]), np.zeros(0, bool), 1.0).tolist() == [1.0]


def test_a_vehicle_in_the_zone_counts_as_if_at_the_least_distance():
    near = inverse_distance_weights(np.array([3.0, 0.0]), np.array([True]), 1.0)
    assert near == pytest.approx([0.25, 0.75])


def test_the_pool_is_the_weighted_mean():
    p = np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]])
    assert linear_pool(p, np.array([0.75, 0.25])) == pytest.approx([0.4, 0.225, 0.375])


def test_a_row_without_weight_may_hold_anything():
    p = np.array([[0.2, 0.8], [np.nan, np.nan]])
    assert linear_pool(p, np.array([1.0, 0.0])).tolist() == [0.2, 0.8]


def test_the_logarithmic_pool_is_the_weighted_geometric_mean():
    p = np.array([[0.9, 0.1], [0.1, 0.9]])
    assert log_pool(p, np.array([0.5, 0.5])) == pytest.approx([0.5, 0.5])
    odds = (9 ** (2 / 3)) * ((1 / 9) ** (1 / 3))  # of the first action
    assert log_pool(p, np.array([2 / 3, 1 / 3])) == pytest.approx(
        [odds / (1 + odds), 1 / (1 + odds)]
    )


def test_in_a_logarithmic_pool_a_rounded_zero_is_no_veto():
    p = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    assert log_pool(p, np.full(3, 1 / 3))[1] > 0.9


def test_the_median_is_deaf_to_one_outlier():
    """Of 0.1, 0.2 and 0.9 the middle is 0.2; of 0.9, 0.8 and 0.1 it is 0.8."""
    p = np.array([[0.1, 0.9], [0.2, 0.8], [0.9, 0.1]])
    assert median(p, np.full(3, 1 / 3)) == pytest.approx([0.2, 0.8])


def test_a_median_of_two_equals_is_their_mean():
    p = np.array([[0.1, 0.9], [0.5, 0.5]])
    assert median(p, np.array([0.5, 0.5])) == pytest.approx([0.3, 0.7])


def test_medians_of_vehicles_that_each_swear_by_another_action_leave_the_mean():
    p = np.eye(3)
    assert median(p, np.full(3, 1 / 3)) == pytest.approx(np.full(3, 1 / 3))


def test_the_trimmed_mean_leaves_out_a_quarter_of_the_weight_on_either_side():
    """Of four equals the lowest and the highest go: (0.2 + 0.4) / 2, and (0.6 + 0.8) / 2."""
    p = np.array([[0.0, 1.0], [0.2, 0.8], [0.4, 0.6], [0.9, 0.1]])
    assert trimmed_mean(p, np.full(4, 0.25)) == pytest.approx([0.3, 0.7])


@st.composite
def heard(draw: Any) -> tuple[Any, Any]:
    """Intents (n, 1+H, A), and weights with the ego always heard; who is not may hold NaN."""
    n, vehicles, actions = draw(st.integers(1, 3)), draw(st.integers(1, 5)), draw(st.integers(2, 4))
    p = draw(arrays(float, (n, vehicles, actions), elements=st.floats(0.01, 1)))
    raw = draw(arrays(float, (n, vehicles), elements=st.sampled_from([0.0, 0.5, 1.0, 2.0])))
    raw[:, 0] += 0.25
    p = np.where((raw > 0)[..., None], p / p.sum(axis=-1, keepdims=True), np.nan)
    return p, raw / raw.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize("rule", POOLS)
@given(case=heard())
@settings(max_examples=30)
def test_whatever_the_rule_a_policy_is_a_distribution_and_lies_between_those_heard(
    rule: str, case: Any
):
    p, weights = case
    fused = POOLS[rule](p, weights)
    assert fused.sum(axis=-1) == pytest.approx(1.0)
    assert (fused >= 0).all()
    alone = weights[:, 0] == 1
    assert fused[alone] == pytest.approx(p[alone, 0])


@pytest.mark.parametrize("rule", POOLS)
@given(case=heard(), data=st.data())
@settings(max_examples=30)
def test_the_order_of_helpers_changes_no_policy(rule: str, case: Any, data: Any):
    p, weights = case
    order = [0, *data.draw(st.permutations(range(1, p.shape[1])))]
    assert POOLS[rule](p[:, order], weights[:, order]) == pytest.approx(POOLS[rule](p, weights))


@pytest.mark.parametrize("rule", POOLS)
@given(case=heard())
@settings(max_examples=30)
def test_many_decisions_at_once_are_each_of_them_alone(rule: str, case: Any):
    p, weights = case
    batched = POOLS[rule](p, weights)
    for one, q, w in zip(batched, p, weights, strict=True):
        assert POOLS[rule](q, w) == pytest.approx(one)
