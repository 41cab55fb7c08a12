"""Rules that count heads, and the one that learns whom to trust, by hand and by what they promise."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.coordination.consensus import Messages, capped, inverse_distance_weights
from harness.coordination.robust import HEADS, bayes, centred_clipping, geometric_median, head_trimmed_mean
from harness.coordination.rules import RULES
from harness.coordination.trust import Trust, divergence

EQUAL = np.full(4, 0.25)
CAREFUL, DOUBT, BOLD = [0.8, 0.1, 0.1], [0.4, 0.3, 0.3], [0.0, 0.0, 1.0]


def messages(p: Any, distance_m: Any, sensed_m: Any = None, heard: Any = None) -> Messages:
    p, distance_m = np.array(p, dtype=float), np.array(distance_m, dtype=float)
    heard = np.ones(len(p) - 1, dtype=bool) if heard is None else np.array(heard)
    weights = inverse_distance_weights(distance_m, heard, 1.0)
    sensed = np.full(len(heard), np.nan) if sensed_m is None else np.array(sensed_m, dtype=float)
    return Messages(p, weights, heard, np.where(heard, 0.1, np.inf), distance_m, np.ones(len(heard)), sensed)


def decided(rule: str, told: Messages) -> int:
    start = RULES[rule].start((), len(told.heard), told.intents.shape[-1])
    return int(np.argmax(RULES[rule].fuse(told, start).policy))


def test_one_liar_at_three_metres_flips_every_weighted_rule_and_no_rule_of_heads():
    """The ego 15 m off and two helpers at 10 and 12 m are for SLOWER; one claims 3 m and says FASTER."""
    told = messages([[0.6, 0.3, 0.1], CAREFUL, CAREFUL, BOLD], [15, 10, 12, 3], sensed_m=[10, 12, 30])
    assert {rule for rule in RULES if decided(rule, told) == 2} == {
        "linear",
        "log-pool",
        "median",
        "trimmed-mean",
    }
    assert {decided(rule, told) for rule in (*HEADS, "trust")} == {0}


def test_the_trimmed_mean_of_heads_leaves_the_highest_and_the_lowest_out():
    """Of .9, .5, .3 and .1 it keeps .5 and .3; of .1, .3, .5 and .9 the same: .4 each of .8."""
    p = np.array([[0.9, 0.1], [0.5, 0.5], [0.3, 0.7], [0.1, 0.9]])
    assert head_trimmed_mean(p, EQUAL).tolist() == [0.4 / (0.4 + 0.6), 0.6 / (0.4 + 0.6)]


def test_the_geometric_median_of_three_alike_and_one_other_is_the_three():
    p = np.array([CAREFUL, CAREFUL, CAREFUL, BOLD])
    assert geometric_median(p, EQUAL) == pytest.approx(CAREFUL, abs=1e-4)


def test_centred_clipping_steps_no_farther_for_a_louder_voice():
    """From (.8, .1, .1) a message at distance 1.21 and one at .6 pull alike: 0.3 in their direction."""
    loud, soft = (np.array([CAREFUL, said]) for said in (BOLD, [0.4, 0.05, 0.55]))
    half = np.array([0.5, 0.5])
    moved = [np.linalg.norm(centred_clipping(p, half) - p[0]) for p in (loud, soft)]
    assert moved[0] == pytest.approx(moved[1], rel=0.35)
    assert moved[0] < 0.8


def test_in_the_bayesian_pool_a_voice_counts_for_so_much_and_no_more():
    """At reliability .8 and three actions a sure voice is worth (.8 + .0667) / .0667 = 13 to one."""
    p = np.array([[1 / 3, 1 / 3, 1 / 3], BOLD])
    policy = bayes(p, np.array([0.5, 0.5]))
    assert policy[2] / policy[0] == pytest.approx(13.0)


@st.composite
def agreed(draw: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """The ego and one to three helpers that agree on an action, and one voice more that may say anything."""
    actions, others = draw(st.integers(2, 5)), draw(st.integers(2, 4))
    choice = draw(st.integers(0, actions - 1))
    raw = draw(arrays(float, (others + 1, actions), elements=st.floats(0.01, 1)))
    for row in raw[:others]:
        best = int(np.argmax(row))
        row[best], row[choice] = row[choice], row[best] + 0.01
    p = raw / raw.sum(axis=-1, keepdims=True)
    distances = draw(arrays(float, others + 1, elements=st.floats(0.1, 100)))
    return p, distances, choice


@pytest.mark.parametrize("rule", HEADS)
@given(case=agreed())
def test_no_single_helper_flips_a_decision_on_which_all_others_agree(rule: str, case: Any):
    p, distance_m, choice = case
    assert decided(rule, messages(p, distance_m)) == choice


@pytest.mark.parametrize("rule", [*HEADS, "trust"])
@given(
    p=arrays(float, (4, 3), elements=st.floats(0.01, 1)),
    heard=st.lists(st.booleans(), min_size=3, max_size=3),
)
def test_every_rule_gives_a_distribution_and_the_egos_own_where_it_is_alone(rule: str, p: Any, heard: Any):
    told = messages(p / p.sum(axis=-1, keepdims=True), [10, 10, 10, 10], heard=heard)
    fused = RULES[rule].fuse(told, RULES[rule].start((), 3, 3))
    assert fused.policy.sum() == pytest.approx(1.0)
    assert (fused.policy >= 0).all()
    if not any(heard):
        assert fused.policy == pytest.approx(told.intents[0], abs=1e-6)


def test_divergence_is_from_nothing_to_one():
    assert divergence(np.array(DOUBT), np.array(DOUBT)) == pytest.approx(0.0)
    assert divergence(np.array([1.0, 0, 0]), np.array([0, 0.5, 0.5])) == pytest.approx(1.0)


TRUST = Trust()
START = TRUST.start((), 3, 3)


def test_who_is_not_where_it_claims_is_trusted_no_more_and_counts_by_where_it_is():
    """Helper 1 claims 3 m and is seen at 30 m: all that can speak against it does. 1.5 to .3 + 4."""
    told = messages([DOUBT] * 4, [20, 3, 10, 10], sensed_m=[30, np.nan, 10])
    fused = TRUST.fuse(told, START)
    assert fused.trust == pytest.approx([1.5 / 5.8, 2.5 / 2.8, 2.5 / 2.8])
    assert fused.weights == pytest.approx([0.05 / 0.25, 0, 0.1 / 0.25, 0.1 / 0.25])


def test_a_claim_within_the_tolerance_is_corrected_and_believed():
    """It claims 8 m and is seen at 10 m, as far as the other."""
    fused = TRUST.fuse(messages([DOUBT] * 3, [20, 8, 10], sensed_m=[10, 10]), TRUST.start((), 2, 3))
    assert fused.weights[1] == pytest.approx(fused.weights[2])


def test_a_liar_far_from_all_others_is_distrusted_at_once_and_forgiven_in_time():
    told = messages([CAREFUL, CAREFUL, CAREFUL, BOLD], [10, 10, 10, 10])
    first = TRUST.fuse(told, START)
    assert first.trust[2] < 0.5 < first.trust[0]
    assert first.weights[3] == 0
    honest, state, steps = replace(told, intents=np.array([CAREFUL] * 4)), first.state, 0
    while TRUST.fuse(honest, state).trust[2] < 0.5:
        state, steps = TRUST.fuse(honest, state).state, steps + 1
    assert 0 < steps < 6


def test_a_witness_that_nobody_backs_is_believed_at_first():
    """Others are in doubt; one is surer of SLOWER than they are: it is far from all, but not very far."""
    fused = TRUST.fuse(messages([DOUBT, [0.9, 0.05, 0.05], DOUBT, DOUBT], [20, 5, 10, 10]), START)
    assert fused.trust[0] > 0.5
    assert np.argmax(fused.policy) == 0


def test_what_the_ego_sees_later_speaks_against_who_said_otherwise():
    """At the second step the ego is sure of SLOWER; helper 1 had been sure of FASTER, helper 2 in doubt."""
    before = TRUST.fuse(messages([DOUBT, BOLD, DOUBT, BOLD], [20, 10, 10, 10]), START)
    now = TRUST.fuse(messages([[1.0, 0, 0], DOUBT, DOUBT, DOUBT], [20, 10, 10, 10]), before.state)
    assert now.trust[0] < now.trust[1]


def test_who_is_not_heard_keeps_its_reputation():
    lied = TRUST.fuse(messages([CAREFUL, CAREFUL, CAREFUL, BOLD], [10, 10, 10, 10]), START)
    quiet = messages([CAREFUL] * 4, [10, 10, 10, 10], heard=[True, True, False])
    later = TRUST.fuse(quiet, lied.state)
    assert later.trust[2] == pytest.approx(lied.trust[2])


def test_a_cap_takes_weight_from_one_helper_and_gives_it_to_all_others_in_proportion():
    """Of .1, .2, .1 and .6 the last may have .3: the other .7 are shared as 1 to 2 to 1, and .35 is too much.

    So that one has .3 as well, and the ego and the third helper share the rest.
    """
    assert capped(np.array([0.1, 0.2, 0.1, 0.6]), 0.5) == pytest.approx([0.125, 0.25, 0.125, 0.5])
    assert capped(np.array([0.1, 0.2, 0.1, 0.6]), 0.3) == pytest.approx([0.2, 0.3, 0.2, 0.3])


@given(raw=arrays(float, (5, 4), elements=st.floats(0.01, 1)), most=st.floats(0.05, 1))
def test_capped_weights_sum_to_one_and_no_helper_has_more(raw: Any, most: float):
    weights = capped(raw / raw.sum(axis=-1, keepdims=True), most)
    assert weights.sum(axis=-1) == pytest.approx(1.0)
    assert (weights[:, 1:] <= most + 1e-12).all()
    assert (weights >= 0).all()
