"""Which replies cross, and when they have arrived."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.noise import uniforms
from harness.radio.channel import Draws, Links
from harness.radio.constant import density_coupled_loss, link_up
from harness.radio.profiles import CHANNELS, NO_CHANNEL

V2X: Any = CHANNELS["v2x"]
SIXG: Any = CHANNELS["6g"]
RANGE_M = np.array([10.0, 20.0, 30.0])
ALL = np.array([True, True, True])
NONE_S = np.zeros(3)


def reply_delay_s(channel, asked, ready_s, range_m, payload_bits, jitter, roadside_edge=False):
    links = Links(
        asked, ready_s, range_m, payload_bits, in_radius=asked, rounds=np.zeros_like(asked)
    )
    channel = replace(channel, roadside_edge=roadside_edge)
    return channel.deliver(links, Draws(np.zeros((*asked.shape, 2)), jitter)).delay_s


def test_density_coupled_loss_meets_the_papers_three_points_and_ends_at_one():
    loss = density_coupled_loss(np.array([0, 1, 2, 3, 4, 8, 36]))
    assert loss == pytest.approx([0.0, 0.0, 0.006, 0.036, 0.066, 0.186, 1.0], abs=1e-12)


@pytest.mark.parametrize(
    ("request_draw", "reply_draw", "heard"),
    [(0.5, 0.5, True), (0.05, 0.5, False), (0.5, 0.05, False), (0.08, 0.08, True)],
)
def test_request_and_reply_must_both_cross(request_draw, reply_draw, heard):
    assert link_up(np.array([[request_draw, reply_draw]]), np.array(0.08)).tolist() == [heard]


@pytest.mark.parametrize("loss", [0.0, 0.012, 0.08, 0.4, 1.0])
def test_a_helper_is_heard_with_the_square_of_the_chance_to_cross(loss):
    up = link_up(uniforms((40_000, 1, 2), "round trip"), np.array(loss))
    assert np.mean(up) == pytest.approx((1 - loss) ** 2, abs=0.01)


def test_a_roadside_edge_gives_the_reply_a_second_path_and_the_request_none():
    draws = np.array([[0.5, 0.05], [0.05, 0.5], [0.5, 0.005]])
    assert link_up(draws, np.array(0.08)).tolist() == [False, False, False]
    assert link_up(draws, np.array(0.08), roadside_edge=True).tolist() == [True, False, False]


def test_each_decision_may_have_its_own_loss():
    draws = np.full((2, 1, 2), 0.1)
    assert link_up(draws, np.array([[0.05], [0.2]])).tolist() == [[True], [False]]


def test_nothing_crosses_without_a_channel():
    assert not link_up(np.full((2, 2), 0.999), np.array(NO_CHANNEL.loss)).any()


def test_v2x_serves_the_nearest_first_and_the_kth_pays_k_slots():
    """1000 bits at 10 Mbit/s are 0.1 ms, so a slot is 25.1 ms."""
    delay_s = reply_delay_s(
        V2X, ALL, NONE_S, np.array([30.0, 10.0, 20.0]), np.full(3, 1000.0), NONE_S
    )
    assert delay_s == pytest.approx([0.0753, 0.0251, 0.0502])


def test_who_is_not_asked_takes_no_slot():
    asked = np.array([False, True, True])
    delay_s = reply_delay_s(V2X, asked, np.full(3, 0.0), RANGE_M, np.full(3, 1000.0), NONE_S)
    assert delay_s == pytest.approx([np.inf, 0.0251, 0.0502])


def test_a_slow_helper_holds_up_nobody_and_waits_for_the_medium():
    """The nearest is ready after 30 ms, while the second is being served until 50 ms."""
    ready_s = np.array([0.030, 0.0, 0.0])
    delay_s = reply_delay_s(V2X, ALL, ready_s, RANGE_M, np.zeros(3), NONE_S)
    assert delay_s == pytest.approx([0.075, 0.025, 0.050])


def test_a_medium_that_fell_idle_is_taken_when_the_helper_is_ready():
    ready_s = np.array([0.0, 0.100, 0.110])
    delay_s = reply_delay_s(V2X, ALL, ready_s, RANGE_M, np.zeros(3), NONE_S)
    assert delay_s == pytest.approx([0.025, 0.125, 0.150])


def test_6g_serves_all_at_once_with_up_to_1_9_ms_of_jitter():
    """1000 bits at 200 Mbit/s are 5 us."""
    delay_s = reply_delay_s(
        SIXG, ALL, NONE_S, RANGE_M, np.full(3, 1000.0), np.array([0.0, 0.5, 1.0])
    )
    assert delay_s == pytest.approx([0.005005, 0.005955, 0.006905])


def test_a_roadside_edge_adds_a_second_hop_to_the_slot():
    bits = np.full(3, 1000.0)
    serial_s = reply_delay_s(V2X, ALL, NONE_S, RANGE_M, bits, NONE_S, roadside_edge=True)
    jitter = np.array([0.0, 0.5, 1.0])
    parallel_s = reply_delay_s(SIXG, ALL, NONE_S, RANGE_M, bits, jitter, roadside_edge=True)
    assert serial_s == pytest.approx([0.0502, 0.1004, 0.1506])
    assert parallel_s == pytest.approx([0.01001, 0.01191, 0.01381]), (
        "twice 5.005 ms and twice the jitter"
    )


def test_the_declared_6g_jitter_puts_the_mean_decision_at_the_papers_151_4_ms():
    shape = (20_000, 3)
    jitter = uniforms(shape, "jitter")
    delay_s = reply_delay_s(
        SIXG, np.ones(shape, bool), np.zeros(shape), np.zeros(shape), np.full(shape, 500.0), jitter
    )
    assert 145 + 1000 * np.mean(np.max(delay_s, axis=-1)) == pytest.approx(151.4, abs=0.05)


slots = st.lists(
    st.tuples(st.booleans(), st.floats(0, 0.2), st.floats(1, 100), st.floats(0, 8000)),
    min_size=1,
    max_size=6,
)


@given(slots)
def test_serial_slots_never_overlap_and_none_starts_before_its_helper_is_ready(helpers):
    asked, ready_s, range_m, bits = (np.array(column) for column in zip(*helpers, strict=True))
    end_s = reply_delay_s(V2X, asked, ready_s, range_m, bits, np.zeros(len(helpers)))
    slot_s = V2X.latency_s + bits / V2X.bandwidth_bps
    assert np.array_equal(np.isfinite(end_s), asked)
    assert np.all((end_s - slot_s >= ready_s - 1e-12)[asked])
    order = np.argsort(np.where(asked, end_s, np.inf))[: asked.sum()]
    assert np.all((end_s - slot_s)[order][1:] >= end_s[order][:-1] - 1e-12)
