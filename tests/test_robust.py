"""Rules that count heads, and the one that learns whom to trust,
by hand and by what they promise.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.coordination.claims import Claims
from harness.coordination.consensus import Messages, capped, inverse_distance_weights
from harness.coordination.contents import INTENTS
from harness.coordination.robust import (
    HEADS,
    bayes,
    centred_clipping,
    geometric_median,
    head_trimmed_mean,
)
from harness.coordination.rules import RULES, reads
from harness.coordination.trust import Trust, divergence
from harness.core.errors import UserError

EQUAL = np.full(4, 0.25)
CAREFUL, DOUBT, BOLD = [0.8, 0.1, 0.1], [0.4, 0.3, 0.3], [0.0, 0.0, 1.0]


def claims(distance_m: Any, sensed_m: Any, **other: Any) -> Claims:
    """All on roads, out of each other's way, at standstill, in the first second of an episode."""
    places, helpers = len(distance_m), len(distance_m) - 1
    angle = np.arange(places) * 2 * np.pi / max(places, 4)
    usual: dict[str, Any] = {
        "xy_m": np.array(distance_m)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        "speed_mps": np.zeros(helpers), "time_s": np.array(0.0), "error_m": np.array(0.2),
        "sensed_m": np.full(helpers, np.nan) if sensed_m is None else np.array(sensed_m, dtype=float),
        "from_road_m": lambda xy_m: np.zeros(xy_m.shape[:-1]),
    }  # fmt: skip
    return Claims(**usual | other)


def messages(
    p: Any, distance_m: Any, sensed_m: Any = None, heard: Any = None, **claimed: Any
) -> Messages:
    p, distance_m = np.array(p, dtype=float), np.array(distance_m, dtype=float)
    heard = np.ones(len(p) - 1, dtype=bool) if heard is None else np.array(heard)
    weights = inverse_distance_weights(distance_m, heard, 1.0)
    arrival_s, said = np.where(heard, 0.1, np.inf), claims(distance_m, sensed_m, **claimed)
    return Messages(p, weights, heard, arrival_s, distance_m, np.ones(len(heard)), said)


def decided(rule: str, told: Messages) -> int:
    start = RULES[rule].start((), len(told.heard), told.intents.shape[-1])
    return int(np.argmax(RULES[rule].fuse(told, start).policy))


def test_one_liar_at_three_metres_flips_every_weighted_rule_and_no_rule_of_heads():
    """The ego 15 m off and two helpers at 10 and 12 m are for SLOWER;
    one claims 3 m and says FASTER.
    """
    told = messages(
        [[0.6, 0.3, 0.1], CAREFUL, CAREFUL, BOLD], [15, 10, 12, 3], sensed_m=[10, 12, 30]
    )
    assert {rule for rule in RULES if INTENTS in reads(rule) and decided(rule, told) == 2} == {
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
    """From (.8, .1, .1) a message at distance 1.21 and one at .6 pull alike:
    0.3 in their direction.
    """
    loud, soft = (np.array([CAREFUL, said]) for said in (BOLD, [0.4, 0.05, 0.55]))
    half = np.array([0.5, 0.5])
    moved = [np.linalg.norm(centred_clipping(p, half) - p[0]) for p in (loud, soft)]
    assert moved[0] == pytest.approx(moved[1], rel=0.35)
    assert moved[0] < 0.8


def test_in_the_bayesian_pool_a_voice_counts_for_so_much_and_no_more():
    """At reliability .8 and three actions a sure voice is worth (.8 + .0667) / .0667 = 13 to
    one.
    """
    p = np.array([[1 / 3, 1 / 3, 1 / 3], BOLD])
    policy = bayes(p, np.array([0.5, 0.5]))
    assert policy[2] / policy[0] == pytest.approx(13.0)


@st.composite
def agreed(draw: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """The ego and one to three helpers that agree on an action,
    and one voice more that may say anything.
    """
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
@settings(max_examples=30)
def test_no_single_helper_flips_a_decision_on_which_all_others_agree(rule: str, case: Any):
    p, distance_m, choice = case
    assert decided(rule, messages(p, distance_m)) == choice


@pytest.mark.parametrize("rule", [*HEADS, "trust"])
@given(
    p=arrays(float, (4, 3), elements=st.floats(0.01, 1)),
    heard=st.lists(st.booleans(), min_size=3, max_size=3),
)
@settings(max_examples=30)
def test_every_rule_gives_a_distribution_and_the_egos_own_where_it_is_alone(
    rule: str, p: Any, heard: Any
):
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
    """Helper 1 claims 3 m and is seen at 30 m: all that can speak against it does.
    1.5 to .3 + 4.
    """
    told = messages([DOUBT] * 4, [20, 3, 10, 10], sensed_m=[30, np.nan, 10])
    fused = TRUST.fuse(told, START)
    assert fused.trust == pytest.approx([1.5 / 5.8, 2.5 / 2.8, 2.5 / 2.8])
    assert fused.weights == pytest.approx([0.05 / 0.25, 0, 0.1 / 0.25, 0.1 / 0.25])


def test_a_claim_within_the_tolerance_is_corrected_and_believed():
    """It claims 8 m and is seen at 10 m, as far as the other."""
    fused = TRUST.fuse(messages([DOUBT] * 3, [20, 8, 10], sensed_m=[10, 10]), TRUST.start((), 2, 3))
    assert fused.weights[1] == pytest.approx(fused.weights[2])


def trusted(*steps: Any) -> list[bool]:
    """Whom it trusts after these steps, in which all are in doubt; helpers at 10, 20 and 30 m."""
    state, fused = START, None
    for claimed in steps:
        fused = TRUST.fuse(messages([DOUBT] * 4, [20, 10, 20, 30], **claimed), state)
        state = fused.state
    assert fused is not None
    return (fused.trust >= 0.5).tolist()


EGO, ABOUT = [20.0, 0.0], [[0.0, 10.0], [-20.0, 0.0], [0.0, -30.0]]
FAST = np.array([7.0, 7.0, 70.0])


def places(*helpers: Any) -> Any:
    return {"xy_m": np.array([EGO, *helpers])}


def test_who_claims_to_drive_and_stays_where_it_is_is_trusted_no_more():
    """Two that claim 7 m/s and have moved 7 m and 0 m in a second;
    the slack is 2 + 2 x 4 x .2 = 3.6 m.
    """
    speed = {"speed_mps": np.array([7.0, 7.0, 3.5])}
    moved = [[0.0, 17.0], [-20.0, 0.0], [0.0, -30.0]]
    steps = places(*ABOUT) | speed, places(*moved) | speed | {"time_s": np.array(1.0)}
    assert trusted(*steps[:1]) == [True, True, True], "there is no past yet"
    assert trusted(*steps) == [True, False, True]


def test_no_vehicle_is_as_fast_as_that_whatever_it_claims():
    """The third moves by 70 m in a second, as it claims to;
    the first jumps by 70 m and claims 7 m/s.
    """
    later = {"time_s": np.array(1.0), "speed_mps": FAST}
    moved = [[0.0, 80.0], [-27.0, 0.0], [0.0, -100.0]]
    assert trusted(places(*ABOUT) | {"speed_mps": FAST}, places(*moved) | later) == [
        False,
        True,
        False,
    ]


def test_who_has_not_been_heard_for_a_while_may_be_farther_off():
    speed = {"speed_mps": np.full(3, 7.0)}
    moved = [[0.0, 31.0], [-41.0, 0.0], [0.0, -37.0]]
    late = places(*moved) | speed | {"time_s": np.array(3.0)}
    assert trusted(places(*ABOUT) | speed, late) == [True, True, False]


def test_who_claims_to_be_off_the_road_is_trusted_no_more():
    """A lane and a beacon's errors are 2 + 4 x .2 = 2.8 m; a larger declared error allows more."""
    away = {"from_road_m": lambda xy_m: np.array([2.7, 2.9, 50.0])}
    assert trusted(away) == [True, False, False]
    assert trusted(away | {"error_m": np.array(1.0)}) == [True, True, False]


def test_two_in_one_place_are_both_trusted_no_more_but_for_one_that_the_ego_sees_there():
    one_place = places([0.0, 10.0], [0.0, 12.0], [0.0, 30.0])
    assert trusted(one_place) == [False, False, True]
    assert trusted(one_place | {"sensed_m": [10.0, np.nan, np.nan]}) == [True, False, True]


def test_where_helpers_come_or_go_memory_is_of_nobody_and_the_rule_says_so():
    told = messages([DOUBT] * 4, [20, 10, 20, 30])
    for others in (2, 4):
        with pytest.raises(UserError, match="helpers or voices come or go during an episode here"):
            TRUST.fuse(told, TRUST.start(told.heard.shape[:-1], others, 3))


def test_where_nobody_looked_nothing_is_held_against_anybody():
    told = replace(messages([DOUBT] * 4, [20, 10, 20, 30]), claims=None)
    fused = TRUST.fuse(told, START)
    assert (fused.trust > 0.5).all()
    assert fused.weights == pytest.approx(told.weights)


@given(
    speed=arrays(float, 3, elements=st.floats(0, 40)),
    pulls=arrays(float, (5, 3), elements=st.floats(-8, 3)),
    heading=arrays(float, 3, elements=st.floats(0, 6.28)),
    errors=arrays(float, (6, 3, 2), elements=st.floats(-0.6, 0.6)),
)
def test_nobody_is_distrusted_for_driving(speed: Any, pulls: Any, heading: Any, errors: Any):
    """Braking at 8 m/s² at most and pulling away at 3, straight on,
    with errors up to three sigma.
    """
    at = np.array([[0.0, 500.0], [-500.0, 0.0], [500.0, 900.0]])
    along, steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1), []
    for n in range(6):
        claimed = {"speed_mps": speed, "time_s": np.array(float(n))}
        steps.append(places(*(at + errors[n])) | claimed)
        if n < 5:
            faster = np.clip(speed + pulls[n], 0, 40)
            at = at + along * ((speed + faster) / 2)[:, None]
            speed = faster
    assert trusted(*steps) == [True, True, True]


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
    """Others are in doubt; one is surer of SLOWER than they are:
    it is far from all, but not very far.
    """
    fused = TRUST.fuse(messages([DOUBT, [0.9, 0.05, 0.05], DOUBT, DOUBT], [20, 5, 10, 10]), START)
    assert fused.trust[0] > 0.5
    assert np.argmax(fused.policy) == 0


def test_what_the_ego_sees_later_speaks_against_who_said_otherwise():
    """At the second step the ego is sure of SLOWER;
    helper 1 had been sure of FASTER, helper 2 in doubt.
    """
    before = TRUST.fuse(messages([DOUBT, BOLD, DOUBT, BOLD], [20, 10, 10, 10]), START)
    now = TRUST.fuse(messages([[1.0, 0, 0], DOUBT, DOUBT, DOUBT], [20, 10, 10, 10]), before.state)
    assert now.trust[0] < now.trust[1]


def test_who_is_not_heard_keeps_its_reputation():
    lied = TRUST.fuse(messages([CAREFUL, CAREFUL, CAREFUL, BOLD], [10, 10, 10, 10]), START)
    quiet = messages([CAREFUL] * 4, [10, 10, 10, 10], heard=[True, True, False])
    later = TRUST.fuse(quiet, lied.state)
    assert later.trust[2] == pytest.approx(lied.trust[2])


def test_a_cap_takes_weight_from_one_helper_and_gives_it_to_all_others_in_proportion():
    """Of .1, .2, .1 and .6 the last may have .3:
    the other .7 are shared as 1 to 2 to 1, and .35 is too much.

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
