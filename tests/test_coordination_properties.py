"""What holds for every cooperative decision."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.coordination.coordinate import Coordination, coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import POOLS
from harness.radio.channel import Draws

COOPERATIVE = [POINTS["v2x"], POINTS["6g"], POINTS["6g"].changed(density_coupled=True)]
Case = tuple[Intents, Draws]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Four decisions with up to five helpers, of which some are absent and all NaN;
    some answers are sure, and in some cases helpers must wait before they send.
    """
    helpers, actions = draw(st.integers(0, 5)), draw(st.integers(2, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (4, helpers)
    valid = rng.random(shape) < draw(st.sampled_from([0.0, 0.5, 1.0]))
    intents = rng.dirichlet(
        np.full(actions, draw(st.sampled_from([0.05, 1.0, 50.0]))), (4, 1 + helpers)
    )
    range_m = rng.uniform(0, 150, shape)
    allowed_s = np.where(valid, rng.uniform(0, 0.4, shape), np.nan)
    return Intents(
        own=intents[:, 0],
        helpers=np.where(valid[..., None], intents[:, 1:], np.nan),
        valid=valid,
        distance_m=rng.uniform(0, 50, (4, 1 + helpers)),
        range_m=np.where(valid, range_m, np.nan),
        payload_bits=rng.uniform(0, 8000, shape),
        inference_s=rng.uniform(0.1, 0.2, (4, 1 + helpers)),
        allowed_s=draw(st.sampled_from([None, allowed_s])),
    ), Draws(rng.random((*shape, 2)), rng.random(shape))


points = st.builds(
    OperatingPoint.changed,
    st.sampled_from(COOPERATIVE),
    tau_nats=st.floats(0, 1.2),
    max_helpers=st.integers(0, 5),
    ego_distance_m=st.none() | st.floats(0.1, 50),
    further=st.sampled_from(["", "roadside_edge=true"]),
    on_demand=st.booleans(),
    consensus=st.sampled_from(sorted(POOLS)),
)


def shuffled(case: Case, order: list[int]) -> Case:
    """The case with its helpers in another order."""
    intents, draws = case
    with_ego = [0, *(1 + i for i in order)]
    per_helper = ("helpers", "valid", "range_m", "payload_bits")
    changed = {name: getattr(intents, name)[:, order] for name in per_helper}
    changed |= {name: getattr(intents, name)[:, with_ego] for name in ("distance_m", "inference_s")}
    if intents.allowed_s is not None:
        changed["allowed_s"] = intents.allowed_s[:, order]
    return replace(intents, **changed), Draws(draws.link[:, order], draws.jitter[:, order])


def assert_same(a: Coordination, b: Coordination, *but: str) -> None:
    for field in fields(a):
        if field.name not in but:
            np.testing.assert_allclose(getattr(a, field.name), getattr(b, field.name), 1e-12, 1e-15)


@given(points, cases())
def test_weights_and_policy_are_distributions(point, case):
    decision = coordinate(point, *case)
    for p in (decision.weights, decision.fused):
        assert np.all(p >= 0)
        assert np.sum(p, axis=-1) == pytest.approx(1.0, abs=1e-12)


@given(points, cases())
def test_only_who_is_heard_in_time_counts_and_hearing_nobody_leaves_the_ego_as_it_was(point, case):
    decision = coordinate(point, *case)
    assert np.array_equal(decision.weights[:, 1:] > 0, decision.on_time)
    assert np.all(decision.on_time <= decision.delivered)
    assert np.all(decision.delivered <= decision.asked)
    assert np.all(decision.asked <= case[0].valid)
    alone = ~decision.on_time.any(axis=-1)
    assert np.array_equal(decision.fused[alone], case[0].own[alone])


@given(points, cases())
def test_every_scheduled_reply_is_on_time_late_or_lost(point, case):
    decision = coordinate(point, *case)
    heard = decision.on_time.sum(axis=-1)
    assert np.array_equal(decision.messages, heard + decision.late + decision.lost)
    assert np.all(decision.messages <= point.ask.max_helpers)


@given(points, cases())
def test_a_decision_ends_after_the_egos_inference_and_every_arrival(point, case):
    decision = coordinate(point, *case)
    assert np.all(decision.latency_s >= case[0].inference_s[:, 0])
    arrived = np.where(decision.delivered, decision.arrival_s, 0.0)
    assert np.all(decision.latency_s[:, None] >= arrived)


@given(points, cases())
def test_helpers_that_must_wait_delay_a_decision_by_so_much_at_most(point, case):
    intents, draws = case
    at_once, now = replace(intents, allowed_s=None), np.zeros(intents.valid.shape)
    free = coordinate(point, at_once, draws)
    assert_same(coordinate(point, replace(intents, allowed_s=now), draws), free)
    if intents.allowed_s is not None:
        held = coordinate(point, *case)
        assert np.all(held.latency_s >= free.latency_s)
        sent = np.isfinite(held.arrival_s)
        assert np.all(held.arrival_s[sent] > intents.allowed_s[sent])
        longest_s = np.max(np.where(free.asked, intents.allowed_s, 0.0), axis=-1, initial=0.0)
        waits_s = np.maximum(longest_s - intents.inference_s[:, 0], 0.0)
        assert np.all(held.latency_s <= free.latency_s + waits_s + 1e-12)
        assert np.array_equal(held.asked, free.asked)


@given(points, cases(), st.data())
@settings(max_examples=30)
def test_the_order_of_helpers_changes_nothing(point, case, data):
    order = data.draw(st.permutations(range(case[0].valid.shape[1])))
    decision, other = coordinate(point, *case), coordinate(point, *shuffled(case, order))
    assert_same(decision, other, "asked", "infers", "delivered", "arrival_s", "on_time", "weights")
    assert np.array_equal(decision.on_time[:, order], other.on_time)
    assert np.array_equal(decision.infers[:, order], other.infers)


@given(st.sampled_from(COOPERATIVE[:2]), cases(), st.floats(0, 1), st.floats(0, 1))
def test_more_loss_never_hears_more_helpers_with_the_same_draws(point, case, one, other):
    low, high = sorted((one, other))
    less, more = (coordinate(point.changed(loss=loss), *case) for loss in (low, high))
    assert np.all(more.on_time <= less.on_time)
    assert np.array_equal(more.latency_s, less.latency_s)


@pytest.mark.slow
@given(points, cases())
@settings(max_examples=30)
def test_a_single_decision_is_a_row_of_the_batch(point, case):
    batch = coordinate(point, *case)
    for i in range(4):
        row = Coordination(**{f.name: getattr(batch, f.name)[i] for f in fields(batch)})
        assert_same(coordinate(point, *(each.take(i) for each in case)), row)


@given(points, cases())
@settings(max_examples=30)
def test_a_threshold_above_the_uniform_entropy_is_the_single_local_point(point, case):
    never = point.changed(tau_nats=math.log(case[0].own.shape[-1]) + 1e-9)
    # Helpers who might be asked infer from the start.
    assert_same(
        coordinate(never, *case), coordinate(POINTS["single-local"], *case), "loss", "infers"
    )


@given(cases(), st.floats(0, 1.2), st.floats(0, 1.2))
def test_a_higher_threshold_never_asks_more(case, one, other):
    low, high = sorted((one, other))
    eager, calm = (
        coordinate(OperatingPoint.of("x", "v2x", tau_nats=tau), *case) for tau in (low, high)
    )
    assert np.all(calm.messages <= eager.messages)
