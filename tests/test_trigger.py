"""When the ego asks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.coordination.trigger import entropy_nats, normalised_entropy, triggered


@pytest.mark.parametrize(
    ("p", "nats"),
    [
        ((1.0, 0.0, 0.0), 0.0),
        ((0.5, 0.5, 0.0), math.log(2)),
        ((0.5, 0.25, 0.25), 1.5 * math.log(2)),
        ((1 / 3, 1 / 3, 1 / 3), math.log(3)),
    ],
)
def test_entropy_of_textbook_distributions(p, nats):
    assert entropy_nats(np.array(p)) == pytest.approx(nats, abs=1e-15)
    assert normalised_entropy(np.array(p)) == pytest.approx(nats / math.log(3), abs=1e-15)


def test_two_even_actions_stay_below_the_papers_threshold():
    """ln 2 = 0.693 < 0.7: the paper's tau needs three actions."""
    assert not triggered(np.array([0.5, 0.5]), 0.7)
    assert triggered(np.array([0.5, 0.49, 0.01]), 0.7)


def test_an_entropy_equal_to_the_threshold_does_not_trigger():
    p = np.array([0.2, 0.3, 0.5])
    tau_nats = float(entropy_nats(p))
    assert not triggered(p, tau_nats)
    assert triggered(p, np.nextafter(tau_nats, 0.0))


def test_a_single_action_is_never_in_doubt():
    assert entropy_nats(np.array([1.0])) == 0.0
    assert normalised_entropy(np.array([1.0])) == 0.0


@given(arrays(float, st.tuples(st.integers(1, 4), st.integers(1, 6)), elements=st.floats(0, 1)))
def test_entropy_lies_between_sure_and_uniform(masses):
    p = (masses + 1e-9) / np.sum(masses + 1e-9, axis=-1, keepdims=True)
    entropy = entropy_nats(p)
    assert entropy.shape == masses.shape[:1]
    assert np.all(entropy >= 0)
    assert np.all(entropy <= math.log(p.shape[-1]) + 1e-12)
    assert np.all(normalised_entropy(p) <= 1 + 1e-12)


@given(st.permutations([0.0, 0.1, 0.2, 0.7]))
def test_the_order_of_actions_does_not_matter(p):
    assert entropy_nats(np.array(p)) == pytest.approx(0.8018185525433373, abs=1e-12)
