"""How intents become one policy."""

import numpy as np
import pytest

from harness.consensus import inverse_distance_weights, linear_pool


def test_weights_fall_with_the_distance_to_the_conflict_zone():
    """1/20 : 1/10 : 1/5 is 1 : 2 : 4."""
    weights = inverse_distance_weights(np.array([20.0, 10.0, 5.0]), np.array([True, True]), 1.0)
    assert weights == pytest.approx([1 / 7, 2 / 7, 4 / 7])


def test_a_helper_not_heard_has_no_weight_even_where_its_distance_is_unknown():
    weights = inverse_distance_weights(np.array([20.0, np.nan, 5.0]), np.array([False, True]), 1.0)
    assert weights == pytest.approx([0.2, 0.0, 0.8])


def test_the_ego_alone_has_all_the_weight():
    assert inverse_distance_weights(np.array([7.0, 3.0]), np.array([False]), 1.0).tolist() == [1.0, 0.0]
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
