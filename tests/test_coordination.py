"""Cooperative decisions played by hand: read them as the specification.

One scene throughout. The ego is 20 m from the conflict zone and in doubt. Three helpers at 10, 20
and 30 m from the ego, and 10, 20 and 5 m from the zone, answer in 1000 bits each. Everybody infers
for 145 ms. The request has 400 bits. Actions are SLOWER, IDLE, FASTER.
"""

from dataclasses import fields

import numpy as np
import pytest

from harness.coordination.coordinate import Coordination, FusionInputs, coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import CLOUD, POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.radio.channel import Draws

DOUBT = (0.3, 0.4, 0.3)
ALONE, V2X, SIXG = POINTS["single-local"], POINTS["v2x"], POINTS["6g"]


def play(
    point: OperatingPoint,
    own=DOUBT,
    helpers=((0.8, 0.1, 0.1), (0.6, 0.2, 0.2), (0.0, 0.0, 1.0)),
    valid=(True, True, True),
    distance_m=(20.0, 10.0, 20.0, 5.0),
    range_m=(10.0, 20.0, 30.0),
    inference_s=(0.145, 0.145, 0.145, 0.145),
    link=((0.9, 0.9), (0.9, 0.9), (0.9, 0.9)),
    jitter=(0.0, 0.5, 1.0),
    fusion_call=None,
    allowed_s=None,
) -> Coordination:
    intents = Intents(
        np.array(own),
        np.array(helpers),
        np.array(valid),
        np.array(distance_m),
        np.array(range_m),
        np.full(len(valid), 1000.0),
        np.array(inference_s),
        allowed_s=None if allowed_s is None else np.array(allowed_s),
    )
    return coordinate(
        point, intents, Draws(np.array(link), np.array(jitter)), FusionInputs(fusion_call)
    )


def test_alone_the_ego_acts_on_its_own_intent_after_its_own_inference():
    decision = play(ALONE)
    assert not decision.triggered
    assert decision.messages == 0
    assert np.isnan(decision.loss)
    assert decision.fused.tolist() == list(DOUBT)
    assert decision.action == 1
    assert decision.latency_s == 0.145
    assert not decision.deadline_missed


def test_from_a_cloud_the_ego_has_its_intent_after_the_round_trip_and_asks_nobody():
    for own_s in (0.145, 2.0, np.nan):
        decision = play(CLOUD, inference_s=(own_s, 0.1, 0.1, 0.1))
        assert decision.messages == 0
        assert decision.latency_s == 0.51
        assert decision.deadline_missed
    sooner = CLOUD.changed(round_trip_s=0.15)
    assert not play(sooner).deadline_missed
    # With a radio too, it asks once the cloud has answered.
    assert play(SIXG.changed(round_trip_s=0.3)).arrival_s.min() > 0.3


def test_over_v2x_the_third_reply_is_late_and_not_fused_but_waited_for():
    """A request of 40 us, slots of 25.1 ms: replies end at 170.14, 195.24 and 220.34 ms.

    Weights are 1/20 : 1/10 : 1/20.
    """
    decision = play(V2X)
    assert decision.triggered
    assert decision.arrival_s == pytest.approx([0.17014, 0.19524, 0.22034])
    assert decision.on_time.tolist() == [True, True, False]
    assert decision.weights == pytest.approx([0.25, 0.5, 0.25, 0.0])
    assert decision.fused == pytest.approx([0.625, 0.2, 0.175])
    assert decision.action == 0
    assert decision.latency_s == pytest.approx(0.22034)
    assert decision.deadline_missed
    assert (decision.messages, decision.lost, decision.late) == (3, 0, 1)


def test_over_6g_all_three_are_fused_and_the_slowest_is_the_latency():
    """2 us of the request, 5 ms, 5 us of the reply and 0, 0.95, 1.9 ms of jitter.

    Weights are 1/20 : 1/10 : 1/20 : 1/5.
    """
    decision = play(SIXG)
    assert decision.arrival_s == pytest.approx([0.150007, 0.150957, 0.151907])
    assert decision.on_time.tolist() == [True, True, True]
    assert decision.weights == pytest.approx([0.125, 0.25, 0.125, 0.5])
    assert decision.fused == pytest.approx([0.3125, 0.1, 0.5875])
    assert decision.action == 2
    assert decision.latency_s == pytest.approx(0.151907)
    assert not decision.deadline_missed
    assert (decision.messages, decision.lost, decision.late) == (3, 0, 0)


def test_a_helper_that_has_just_sent_something_replies_once_it_may():
    """As above; the second may after 160 ms, the third after 500, too late to be fused."""
    decision = play(SIXG, allowed_s=(0.1, 0.16, 0.5))
    assert decision.arrival_s == pytest.approx([0.150007, 0.165955, 0.506905])
    assert decision.on_time.tolist() == [True, True, False]
    assert decision.latency_s == pytest.approx(0.506905)
    # Over v2x the others take their slots before the first may.
    decision = play(V2X, allowed_s=(0.2, 0.0, 0.0))
    assert decision.arrival_s == pytest.approx([0.2251, 0.17014, 0.19524])


@pytest.mark.parametrize("lost_link", [(0.01, 0.9), (0.9, 0.01)], ids=["request", "reply"])
def test_a_helper_whose_request_or_reply_is_lost_keeps_its_slot_and_is_not_fused(lost_link):
    decision = play(V2X, link=(lost_link, (0.9, 0.9), (0.9, 0.9)))
    assert decision.arrival_s == pytest.approx([np.inf, 0.19524, 0.22034])
    assert decision.weights == pytest.approx([0.5, 0.0, 0.5, 0.0])
    assert decision.fused == pytest.approx([0.45, 0.3, 0.25])
    assert decision.latency_s == pytest.approx(0.22034)
    assert (decision.messages, decision.lost, decision.late) == (3, 1, 1)


def test_a_request_is_one_message_of_its_own_and_costs_bits_and_airtime():
    """Over v2x 400 bits are 40 us and three replies of 1000 bits 300 us;
    the paper counts replies alone.
    """
    decision = play(V2X)
    assert (decision.requests, decision.messages) == (1, 3)
    assert (decision.request_bits, decision.reply_bits) == (400, 3000)
    assert decision.airtime_s == pytest.approx(340e-6)
    twice = play(V2X.changed(further="roadside_edge=true"))
    assert (twice.requests, twice.reply_bits) == (1, 3000)
    assert twice.airtime_s == pytest.approx(640e-6), "replies go twice, the request once"
    long = play(V2X.changed(request_bits=10_000.0))
    assert long.arrival_s == pytest.approx([0.1711, 0.1962, 0.2213]), (
        "a request of 1 ms holds up every reply"
    )
    slow = play(
        SIXG.changed(request_bits=2e6), inference_s=(0.145, 0.145, 0.150, 0.165), jitter=(0, 0, 0)
    )
    assert slow.arrival_s == pytest.approx([0.160005, 0.160005, 0.170005]), (
        "none leaves before it is heard"
    )


@pytest.mark.parametrize("quiet", [{"own": (0.9, 0.05, 0.05)}, {"valid": (False, False, False)}])
def test_who_asks_nobody_sends_nothing(quiet):
    decision = play(V2X, **quiet)
    assert (decision.requests, decision.request_bits, decision.reply_bits, decision.airtime_s) == (
        0,
        0,
        0,
        0,
    )
    assert decision.latency_s == 0.145


def test_an_ego_that_hears_nobody_falls_back_to_its_own_intent():
    decision = play(SIXG.changed(loss=1.0))
    assert decision.triggered
    assert decision.lost == 3
    assert decision.fused.tolist() == list(DOUBT)


def test_without_helpers_the_ego_asks_nobody_and_acts_at_once():
    none = {"helpers": np.zeros((0, 3)), "valid": np.zeros(0, bool), "range_m": (), "jitter": ()}
    decision = play(V2X, distance_m=(20.0,), inference_s=(0.145,), link=np.zeros((0, 2)), **none)
    assert not decision.triggered
    assert decision.messages == 0
    assert decision.fused.tolist() == list(DOUBT)
    assert decision.latency_s == 0.145


def test_an_unsure_ego_with_nobody_in_its_radius_asks_nobody():
    decision = play(SIXG.changed(radius_m=1.0))
    assert not decision.triggered
    assert (decision.requests, decision.messages) == (0, 0)
    assert decision.latency_s == 0.145


def test_a_sure_ego_does_not_ask():
    decision = play(SIXG, own=(0.9, 0.05, 0.05))
    assert not decision.triggered
    assert decision.messages == 0
    assert decision.action == 0
    assert decision.latency_s == 0.145


def test_an_entropy_equal_to_tau_does_not_ask():
    tau_nats = float(play(SIXG).entropy_nats)
    assert not play(SIXG.changed(tau_nats=tau_nats)).triggered
    assert play(SIXG.changed(tau_nats=tau_nats - 1e-12)).triggered


def test_an_invalid_helper_sends_nothing_and_takes_no_slot():
    """Its rows are unknown; the third helper moves up to the second slot and is now on time."""
    unknown = np.nan
    decision = play(
        V2X,
        helpers=((0.8, 0.1, 0.1), (unknown, unknown, unknown), (0.0, 0.0, 1.0)),
        valid=(True, False, True),
        distance_m=(20.0, 10.0, unknown, 5.0),
        range_m=(10.0, unknown, 30.0),
        inference_s=(0.145, 0.145, unknown, 0.145),
    )
    assert decision.asked.tolist() == [True, False, True]
    assert decision.arrival_s == pytest.approx([0.17014, np.inf, 0.19524])
    assert decision.weights == pytest.approx([1 / 7, 2 / 7, 0.0, 4 / 7])
    assert decision.latency_s == pytest.approx(0.19524)


def test_only_the_nearest_in_the_radius_are_asked():
    assert play(SIXG.changed(max_helpers=2), range_m=(30.0, 10.0, 20.0)).asked.tolist() == [
        False,
        True,
        True,
    ]
    assert play(SIXG.changed(radius_m=20.0)).asked.tolist() == [True, True, False]
    assert play(SIXG.changed(max_helpers=0)).messages == 0


def test_a_reply_leaves_only_when_the_helper_has_its_own_answer():
    decision = play(SIXG, inference_s=(0.145, 0.100, 0.160, 0.250), jitter=(0.0, 0.0, 0.0))
    assert decision.arrival_s == pytest.approx([0.150007, 0.165005, 0.255005])
    assert decision.on_time.tolist() == [True, True, False]
    assert decision.latency_s == pytest.approx(0.255005)


def test_a_failed_ego_answer_becomes_the_fallback_and_says_so():
    failed = (np.nan, np.nan, np.nan)
    uniform, brake = play(SIXG, own=failed), play(SIXG.changed(fallback="brake"), own=failed)
    assert uniform.own_failed
    assert brake.own_failed
    assert not play(SIXG).own_failed
    assert uniform.own == pytest.approx([1 / 3, 1 / 3, 1 / 3])
    assert uniform.triggered
    assert brake.own.tolist() == [1.0, 0.0, 0.0]
    assert not brake.triggered
    assert brake.action == 0


def test_a_tie_goes_to_the_earlier_action():
    assert play(ALONE, own=(0.2, 0.4, 0.4)).action == 1


def test_density_coupling_counts_valid_helpers_in_the_radius_whether_asked_or_not():
    crowd = SIXG.changed(density_coupled=True)
    assert play(crowd).loss == pytest.approx(0.066)
    assert play(crowd.changed(max_helpers=1)).loss == pytest.approx(0.066)
    assert play(crowd, valid=(True, False, True)).loss == pytest.approx(0.036)
    assert play(crowd.changed(radius_m=15.0)).loss == pytest.approx(0.006)
    heard = play(crowd, link=((0.067, 0.9), (0.065, 0.9), (0.9, 0.065))).delivered
    assert heard.tolist() == [True, False, False]


def test_a_points_own_loss_replaces_the_profiles():
    draws = ((0.05, 0.9), (0.9, 0.9), (0.9, 0.15))
    assert play(V2X, link=draws).delivered.tolist() == [False, True, True]
    assert play(V2X.changed(loss=0.02), link=draws).delivered.tolist() == [True, True, True]
    assert play(V2X.changed(loss=0.2), link=draws).delivered.tolist() == [False, True, False]


def test_the_papers_proxy_stands_for_the_egos_distance_in_equation_2():
    """Over 6g everybody is heard. Weights are 1/3.5 : 1/10 : 1/20 :
    1/5, the ego's .449 and not .125.
    """
    near = play(SIXG.changed(ego_distance_m=3.5))
    closeness = np.array([1 / 3.5, 1 / 10, 1 / 20, 1 / 5])
    assert near.weights == pytest.approx(closeness / closeness.sum())
    assert near.weights[0] == pytest.approx(0.449, abs=5e-4)
    assert play(SIXG).weights[0] == pytest.approx(0.125)
    assert near.fused[1] == pytest.approx(near.weights @ np.array([0.4, 0.1, 0.2, 0.0]))
    assert play(SIXG.changed(ego_distance_m=0.5)).weights == pytest.approx(
        play(SIXG.changed(ego_distance_m=1.0)).weights
    ), "min_distance_m bounds it as well"


def test_a_roadside_edge_saves_a_lost_reply_and_takes_a_second_hop():
    draws = ((0.9, 0.05), (0.9, 0.9), (0.05, 0.9))
    decision = play(V2X.changed(further="roadside_edge=true"), link=draws)
    assert decision.delivered.tolist() == [True, True, False]
    assert decision.arrival_s == pytest.approx([0.19524, 0.24544, np.inf])
    assert decision.on_time.tolist() == [True, False, False]


def test_helpers_on_demand_begin_when_they_are_asked():
    """145 ms of the ego, 40 us of the request, 145 ms of each helper, then slots of 25.1 ms."""
    wide = V2X.changed(on_demand=True, window_s=0.4)
    assert play(wide).arrival_s == pytest.approx([0.31514, 0.34024, 0.36534])
    slow = play(wide, inference_s=(0.145, 0.145, 0.100, 0.300))
    assert slow.arrival_s == pytest.approx([0.31514, 0.27014, 0.47014])
    assert slow.on_time.tolist() == [True, True, False]
    assert play(V2X.changed(on_demand=True)).fused.tolist() == list(DOUBT), "nobody is on time"


AGREED = (0.1, 0.2, 0.7)


def asked_again(*heard: bool, answer=AGREED, seconds=0.160):
    """The ego's model is asked with the messages of exactly these helpers."""

    def fusion_call(on_time):
        assert on_time.tolist() == list(heard)
        return np.array(answer, dtype=float), np.float64(seconds)

    return fusion_call


def test_ego_prompt_acts_on_the_models_second_answer_and_waits_for_it():
    """Over 6g the exchange ends at 151.907 ms; the second inference takes 160 ms more."""
    decision = play(SIXG.changed(consensus="ego-prompt"), fusion_call=asked_again(True, True, True))
    assert decision.fused == pytest.approx(AGREED)
    assert decision.action == 2
    assert decision.exchange_s == pytest.approx(0.151907)
    assert decision.latency_s == pytest.approx(0.311907)
    assert decision.deadline_missed
    assert np.isnan(decision.weights).all()


def test_ego_prompt_reads_only_what_came_in_time():
    """Over v2x the third reply ends at 220.34 ms: waited for, not read."""
    decision = play(V2X.changed(consensus="ego-prompt"), fusion_call=asked_again(True, True, False))
    assert decision.latency_s == pytest.approx(0.38034)
    assert decision.late == 1


def test_ego_prompt_is_not_asked_by_an_ego_that_hears_nobody():
    fusion_call = asked_again(False, False, False, answer=(np.nan,) * 3, seconds=np.nan)
    for point, own in ((SIXG.changed(loss=1.0), DOUBT), (SIXG, (0.9, 0.05, 0.05))):
        decision = play(point.changed(consensus="ego-prompt"), own=own, fusion_call=fusion_call)
        assert decision.fused.tolist() == list(own)
        assert decision.latency_s == decision.exchange_s
        assert decision.weights.tolist() == [1.0, 0.0, 0.0, 0.0]
        assert not decision.fusion_failed


def test_a_second_answer_that_failed_leaves_the_ego_its_own_intent_but_not_the_time():
    failed = asked_again(True, True, True, answer=(np.nan,) * 3)
    decision = play(SIXG.changed(consensus="ego-prompt"), fusion_call=failed)
    assert decision.fusion_failed
    assert decision.fused.tolist() == list(DOUBT)
    assert decision.latency_s == pytest.approx(0.311907)


@pytest.mark.parametrize(
    ("rule", "policy"),
    [
        ("linear", (0.3125, 0.1, 0.5875)),
        # Products of p^w, p floored at 0.001: .02414, .01297, .39560, over their sum.
        ("log-pool", (0.05578, 0.02997, 0.91425)),
        # Helpers' 0 of weight 1/2 is SLOWER's lower middle, 0.3 its upper: 0.15; IDLE 0.05; FASTER
        # 0.65.
        ("median", (0.15 / 0.85, 0.05 / 0.85, 0.65 / 0.85)),
        # The middle half of the weight. SLOWER: 0 for .25, .3 for .125, .6 for .125, so .225; .05
        # and .625.
        ("trimmed-mean", (0.225 / 0.9, 0.05 / 0.9, 0.625 / 0.9)),
    ],
)
def test_each_rule_makes_another_policy_of_the_same_messages(rule, policy):
    """Weights 1/8, 1/4, 1/8, 1/2 of DOUBT, (.8, .1, .1), (.6, .2, .2), (0, 0, 1).
    None takes time.
    """
    decision = play(SIXG.changed(consensus=rule))
    assert decision.fused == pytest.approx(policy, abs=2e-4)
    assert decision.latency_s == decision.exchange_s


def test_block_fading_is_one_draw_for_all_steps_of_an_episode():
    """Two episodes of six steps, the link draws without the step axis filled in:
    18 messages each.
    """
    rng = np.random.default_rng(0)
    link = rng.random((2, 1, 3, 2))
    own, helpers = np.full((2, 6, 3), 1 / 3), rng.dirichlet(np.ones(3), (2, 6, 3))
    ones = np.ones((2, 6, 3))
    decisions = coordinate(
        SIXG.changed(loss=0.4),
        Intents(own, helpers, ones > 0, np.ones((2, 6, 4)), ones, ones, np.full((2, 6, 4), 0.145)),
        Draws(link, rng.random((2, 6, 3))),
    )
    assert decisions.messages.sum(axis=1).tolist() == [18, 18]
    assert np.array_equal(decisions.delivered, np.repeat(decisions.delivered[:, :1], 6, axis=1))


def test_every_array_of_a_batch_has_the_batch_in_front():
    rng = np.random.default_rng(1)
    decisions = coordinate(
        SIXG,
        Intents(
            rng.dirichlet(np.ones(3), (5, 2)),
            rng.dirichlet(np.ones(3), (5, 2, 4)),
            rng.random((5, 2, 4)) < 0.5,
            rng.random((5, 2, 5)),
            rng.random((5, 2, 4)),
            rng.random((5, 2, 4)),
            rng.random((5, 2, 5)),
        ),
        Draws(rng.random((5, 2, 4, 2)), rng.random((5, 2, 4))),
    )
    per_helper = {"asked", "infers", "delivered", "arrival_s", "on_time", "trust"}
    inner = {"own": (3,), "fused": (3,), "weights": (5,), "state": (0,)} | dict.fromkeys(
        per_helper, (4,)
    )
    for field in fields(decisions):
        assert getattr(decisions, field.name).shape == (5, 2, *inner.get(field.name, ())), (
            field.name
        )
