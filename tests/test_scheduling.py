"""Whom the ego asks, and when: the paper's schedule, and what holds for every one."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from one_scene import ALL, NOBODY, SIXG, asked, draws, same, scene
from swarm_extras import NEAR

from harness.coordination.exchange import exchange
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import Outlook, Schedule, ScheduleInputs, chosen
from harness.core.errors import UserError

NEVER = named_point("6g:schedule=never")
OURS = [name for name in SCHEDULES if SCHEDULES.is_ours(name)]
EVERY = [*OURS, "near"]  # which is of `tests/plugin`
FREE = {name for name in OURS if SCHEDULES[name].threshold is None}  # no threshold of their own


@pytest.fixture(autouse=True)
def plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCHEDULES._loaded, "near", NEAR)


@pytest.mark.parametrize(
    ("point", "who"),
    [
        ("6g", ALL),
        ("6g:tau=1.03", NOBODY),  # the ego has 1.0297 nats
        ("6g:tau=1.02", ALL),
        ("6g:max_helpers=1", [True, False, False]),  # the nearest
        ("6g:schedule=never", NOBODY),
        ("single-local", NOBODY),
    ],
)
def test_a_schedule_asks_these(point, who):
    assert asked(point) == who


def test_a_sure_ego_asks_nobody():
    assert asked("6g", scene(own=(0.98, 0.01, 0.01))) == NOBODY


def test_who_is_out_of_the_radius_or_gave_no_answer_is_asked_by_nobody():
    for name in EVERY:
        least = "" if name in FREE else ",threshold=0"
        far, mute = scene(range_m=(10.0, 20.0, 300.0)), scene(valid=(True, True, False))
        assert not asked(f"6g:schedule={name}{least}", far)[2]
        assert not asked(f"6g:schedule={name}{least}", mute)[2]
        assert asked(f"6g:schedule={name}{least}", scene(valid=(False,) * 3)) == NOBODY


def known(rng: np.random.Generator, n=40, helpers=4, actions=3, regions=2) -> ScheduleInputs:
    may_ask = rng.random((n, helpers)) < 0.7
    hole = np.where(may_ask, 1.0, np.nan)
    own = rng.dirichlet(np.ones(actions), n)
    return ScheduleInputs(
        own, rng.uniform(0, 1.1, n), may_ask, rng.uniform(1, 90, (n, helpers)) * hole,
        rng.uniform(1, 90, (n, 1 + helpers)), rng.random((n, helpers)) * hole,
        Outlook(
            rng.random((n, regions)), rng.random((n, helpers, regions)) * hole[..., None],
            rng.random(n), np.full(n, regions),
        ),
        rng.random(n),
    )  # fmt: skip


def row(of: ScheduleInputs, at) -> ScheduleInputs:
    return replace(
        of, **{f.name: v[at] for f in fields(of) if isinstance(v := getattr(of, f.name), np.ndarray)},
        outlook=of.outlook.take(at),
    )  # fmt: skip


@pytest.mark.parametrize("name", EVERY)
def test_every_schedule_asks_whom_it_may_as_a_batch_and_one_at_a_time(name: str):
    schedule, every = SCHEDULES[name], known(np.random.default_rng(5))
    assert isinstance(schedule, Schedule)
    assert set(schedule.needs) <= {"in_time", "outlook", "lot"}
    blind = replace(
        every, **{n: None for n in ("in_time", "outlook", "lot") if n not in schedule.needs}
    )
    worth = schedule.worth(blind)
    assert worth.shape in ((40, 4), (40, 1))
    previous = None
    for threshold in (0.0, 0.3, 0.9):
        for most in (1, 2, 4):
            who = chosen(worth, threshold, every.may_ask, every.range_m, most)
            assert not (who & ~every.may_ask).any()
            assert who.sum(axis=1).max() <= most
            single = chosen(
                schedule.worth(row(every, 7)), threshold, every.may_ask[7], every.range_m[7], most
            )
            assert single.tolist() == who[7].tolist()
        if previous is not None:
            assert not (who & ~previous).any(), (
                "a higher threshold asks nobody whom a lower one did not"
            )
        previous = who


@given(
    arrays(float, (5, 4), elements=st.sampled_from([0.0, 0.2, 0.5, 0.7, np.nan])),
    arrays(float, (5, 4), elements=st.sampled_from([5.0, 10.0, 20.0])),
    arrays(bool, (5, 4)),
    st.integers(0, 5),
)
def test_of_those_worth_it_the_most_worth_are_asked_and_of_equals_the_nearest(
    worth, range_m, may_ask, most
):
    who = chosen(worth, 0.1, may_ask, range_m, most)
    for i in range(5):
        able = [h for h in range(4) if may_ask[i, h] and worth[i, h] > 0.1]
        best = sorted(able, key=lambda h: (-worth[i, h], range_m[i, h], h))[:most]
        assert np.flatnonzero(who[i]).tolist() == sorted(best)


@given(arrays(float, 3, elements=st.floats(0.001, 1)), st.floats(0, 1.2))
def test_an_ego_above_tau_asks_all_and_one_below_it_nobody(shares, tau):
    intents = scene(own=tuple(shares / shares.sum()))
    everybody = exchange(SIXG.changed(tau_nats=0.0), intents, draws())
    paper = exchange(SIXG.changed(tau_nats=tau), intents, draws())
    assert same(paper, everybody if paper.entropy_nats > tau else exchange(NEVER, intents, draws()))


def test_asking_whom_a_schedule_asks_is_the_same_exchange():
    for point in (SIXG, POINTS["v2x"]):
        by_schedule = exchange(point, scene(), draws())
        assert same(by_schedule, exchange(point, scene(), draws(), by_schedule.asked))


@pytest.mark.parametrize(
    ("point", "says"),
    [
        ("6g:schedule=entrop", "unknown schedule 'entrop'; did you mean 'entropy'"),
        (
            "6g:schedule=oracle",
            "schedule oracle looks at how scenes end; `harness study schedule compare` plays it",
        ),
        (
            "6g:threshold=0.5",
            "threshold is 0.5; it must be left out where schedule is entropy: its is tau_n",
        ),
        (
            "6g:schedule=never,threshold=0.5",
            "it must be left out where schedule is never, which has none",
        ),
    ],
)
def test_a_schedule_that_cannot_be_is_one_line(point, says):
    with pytest.raises(UserError, match=says) as error:
        named_point(point)
    assert "\n" not in str(error.value)
