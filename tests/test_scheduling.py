"""Whom the ego asks, and when: every schedule played by hand, and what holds for all of them.

One scene throughout. The ego is in doubt: .5, .3, .2, which is 1.0297 nats, and its margin is .2.
It does not see 80 % of the left region and 40 % of the right. The helpers at 10, 20 and 30 m see,
of what it does not, 0, 50 and 60 % of the left, and 10, 10 and 40 % of the right.
"""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from swarm_extras import NEAR

from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import POINTS, OperatingPoint, named_point
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import (
    Formula,
    Outlook,
    Schedule,
    ScheduleInputs,
    always,
    chosen,
)
from harness.core.errors import UserError
from harness.radio.channel import Draws
from harness.radio.fading import Trips

SIXG = POINTS["6g"]
SURE = (0.98, 0.01, 0.01)
BUILT_IN = [name for name in SCHEDULES if name in SCHEDULES.built_in]
EVERY = [*BUILT_IN, "near"]  # which is of `tests/plugin`
FREE = {name for name in BUILT_IN if SCHEDULES[name].threshold is None}  # no threshold of their own


@pytest.fixture(autouse=True)
def plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCHEDULES._loaded, "near", NEAR)


def scene(
    own=(0.5, 0.3, 0.2), range_m=(10.0, 20.0, 30.0), valid=(True, True, True), unseen=(0.8, 0.4)
):
    added = np.array([(0.0, 0.1), (0.5, 0.1), (0.6, 0.4)])
    return Intents(
        np.array(own), np.full((3, 3), 1 / 3), np.array(valid), np.full(4, 10.0), np.array(range_m),
        np.full(3, 1000.0), np.full(4, 0.145), outlook=Outlook(np.array(unseen), added, np.array(3.0)),
    )  # fmt: skip


def draws(seed=0, layout=7, step=0, jitter=0.0) -> Draws:
    trips = Trips(np.array(seed), np.array(layout), np.array(step), 6)
    return Draws(np.full((3, 2), 0.9), np.full(3, jitter), trips)


def asked(point: str, intents: Intents | None = None, at: Draws | None = None) -> list[bool]:
    return exchange(named_point(point), intents or scene(), at or draws()).asked.tolist()


ALL, NOBODY = [True] * 3, [False] * 3


@pytest.mark.parametrize(
    ("point", "who"),
    [
        ("6g", ALL),
        ("6g:tau=1.03", NOBODY),  # the ego has 1.0297 nats
        ("6g:tau=1.02", ALL),
        ("6g:max_helpers=1", [True, False, False]),  # the nearest
        ("6g:schedule=never", NOBODY),
        ("6g:schedule=always", ALL),
        ("6g:schedule=always,max_helpers=2", [True, True, False]),
        ("6g:schedule=margin,threshold=0.79", ALL),  # 1 - (.5 - .3) is .8
        ("6g:schedule=margin,threshold=0.8", NOBODY),
        ("6g:schedule=risk,threshold=0.82", ALL),  # 1.0297 nats x .8 is .8238
        ("6g:schedule=risk,threshold=0.83", NOBODY),
        ("6g:schedule=coverage", [False, True, True]),  # means over both regions: .05, .3, .5
        ("6g:schedule=coverage,threshold=0.3", [False, False, True]),
        ("6g:schedule=coverage,threshold=0.01,max_helpers=1", [False, False, True]),
        ("6g:schedule=deadline,threshold=1.0", ALL),  # .988² x 1.0297 is 1.005
        ("6g:schedule=deadline,threshold=1.01", NOBODY),
        # Over v2x replies end at 170, 195 and 220 ms, jitter aside: the third is never in time.
        ("v2x:schedule=deadline,threshold=0", [True, True, False]),
        ("v2x:schedule=deadline,threshold=0,window_s=0.16", NOBODY),
        ("single-local", NOBODY),
        ("single-local:schedule=always", NOBODY),
    ],
)
def test_a_schedule_asks_these(point, who):
    assert asked(point) == who


def test_a_sure_ego_asks_nobody_but_by_what_it_does_not_see():
    sure = scene(own=SURE)
    for name in ("entropy", "margin", "risk", "deadline"):
        assert asked(f"6g:schedule={name}", sure) == NOBODY
    assert asked("6g:schedule=coverage", sure) == [False, True, True]
    assert asked("6g:schedule=risk", scene(unseen=(0.0, 0.0))) == NOBODY


def test_who_is_out_of_the_radius_or_gave_no_answer_is_asked_by_nobody():
    for name in EVERY:
        least = "" if name in FREE else ",threshold=0"
        far, mute = scene(range_m=(10.0, 20.0, 300.0)), scene(valid=(True, True, False))
        assert not asked(f"6g:schedule={name}{least}", far)[2]
        assert not asked(f"6g:schedule={name}{least}", mute)[2]
        assert asked(f"6g:schedule={name}{least}", scene(valid=(False,) * 3)) == NOBODY


def wide(intents: Intents, n: int) -> Intents:
    """The same decision n times, nowhere."""
    alike: Any = {f: np.broadcast_to(v, (n, *v.shape)) for f, v in intents.arrays().items()}
    return replace(intents, **alike, outlook=None)


def test_random_asks_in_its_share_of_decisions_whatever_the_channel_draws():
    """Lots are keyed by seed, layout and step,
    and a larger share asks wherever a smaller one did.
    """
    places = np.array(
        [(seed, layout, step) for seed in range(5) for layout in range(40) for step in range(6)]
    )
    lots = Draws(
        np.full((1200, 3, 2), 0.9),
        np.zeros((1200, 3)),
        Trips(places[:, 0], places[:, 1], places[:, 2], 6),
    )
    point = SIXG.changed(schedule="random")

    def asks(share, at=lots):
        return exchange(point.changed(threshold=1 - share), wide(scene(), 1200), at).asked.any(
            axis=1
        )

    for share in (0.2, 0.5, 1.0):
        assert asks(share).mean() == pytest.approx(share, abs=0.045)  # 3 standard errors
    assert not (asks(0.2) & ~asks(0.5)).any()
    other = replace(lots, link=lots.link * 0.5, jitter=lots.jitter + 0.5)
    assert (asks(0.5, other) == asks(0.5)).all()
    for n in range(20):
        assert exchange(point, scene(), draws(*places[n])).asked.any() == asks(0.5)[n]


@pytest.mark.parametrize("profile", ["v2x", "6g"])
def test_what_the_deadline_expects_is_what_the_channel_does_on_average(profile, monkeypatch):
    """The share of 4000 decisions with draws of their own;
    what is expected looks at none of them.
    """
    rng, expected = np.random.default_rng(3), []

    def spied(known: ScheduleInputs) -> np.ndarray:
        expected.append(known.in_time)
        return always(known)

    monkeypatch.setitem(SCHEDULES._loaded, "deadline", Formula(spied, 0.0, ("in_time",)))
    uniforms = Draws(rng.random((4000, 3, 2)), rng.random((4000, 3)))
    point = OperatingPoint.of("x", profile, window_s=0.196, schedule="deadline")
    share = exchange(point, wide(scene(), 4000), uniforms).on_time.mean(axis=0)
    assert expected[0][0] == pytest.approx(share, abs=0.08)  # of 8 imagined jitters
    assert (expected[0] == expected[0][0]).all()


# -- every schedule --------------------------------------------------------------------------------


def known(rng: np.random.Generator, n=40, helpers=4, actions=3, regions=2) -> ScheduleInputs:
    may_ask = rng.random((n, helpers)) < 0.7
    hole = np.where(may_ask, 1.0, np.nan)
    own = rng.dirichlet(np.ones(actions), n)
    return ScheduleInputs(
        own, rng.uniform(0, 1.1, n), may_ask, rng.uniform(1, 90, (n, helpers)) * hole,
        rng.uniform(1, 90, (n, 1 + helpers)), rng.random((n, helpers)) * hole,
        Outlook(rng.random((n, regions)), rng.random((n, helpers, regions)) * hole[..., None], rng.random(n)),
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
def test_always_is_entropy_at_a_threshold_of_0_where_there_is_any_entropy(shares, tau):
    intents = scene(own=tuple(shares / shares.sum()))
    everybody = exchange(named_point("6g:schedule=always"), intents, draws())
    at_zero = exchange(SIXG.changed(tau_nats=0.0), intents, draws())
    assert same(everybody, at_zero)
    paper = exchange(SIXG.changed(tau_nats=tau), intents, draws())
    assert same(paper, everybody if paper.entropy_nats > tau else exchange(NEVER, intents, draws()))


NEVER = named_point("6g:schedule=never")


def same(a: Exchange, b: Exchange) -> bool:
    return all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True)
        for f in fields(Exchange)
    )


def test_asking_whom_a_schedule_asks_is_the_same_exchange():
    for point in (SIXG, POINTS["v2x"], named_point("v2x:schedule=coverage")):
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
            "6g:schedule=always,threshold=0.5",
            "it must be left out where schedule is always, which has none",
        ),
        (
            "6g:schedule=margin,threshold=-1",
            "threshold is -1.0; it must be a finite number, 0 or more",
        ),
        (
            "6g:schedule=margin,threshold=x",
            "threshold is 'x'; it must be a finite number, 0 or more",
        ),
    ],
)
def test_a_schedule_that_cannot_be_is_one_line(point, says):
    with pytest.raises(UserError, match=says) as error:
        named_point(point)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["coverage", "risk", "random"])
def test_the_papers_study_has_no_scene_to_look_at(name):
    nowhere = replace(scene(), outlook=None)
    with pytest.raises(UserError, match=f"schedule {name} needs vehicles that are somewhere"):
        exchange(
            named_point(f"6g:schedule={name}"), nowhere, Draws(np.full((3, 2), 0.9), np.zeros(3))
        )
