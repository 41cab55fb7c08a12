"""Whom the ego asks, and when: schedules beside the paper's, played by hand in one scene."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from one_scene import ALL, NOBODY, SIXG, asked, draws, same, scene

from harness.coordination.exchange import exchange
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.errors import UserError
from harness.extensions.schedules.formulas import always
from harness.radio.channel import Draws
from harness.radio.fading import Trips

SURE = (0.98, 0.01, 0.01)


@pytest.mark.parametrize(
    ("point", "who"),
    [
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
        ("single-local:schedule=always", NOBODY),
    ],
)
def test_a_schedule_asks_these(point, who):
    assert asked(point) == who


def test_a_sure_ego_asks_nobody_but_by_what_it_does_not_see():
    sure = scene(own=SURE)
    for name in ("margin", "risk", "deadline"):
        assert asked(f"6g:schedule={name}", sure) == NOBODY
    assert asked("6g:schedule=coverage", sure) == [False, True, True]
    assert asked("6g:schedule=risk", scene(unseen=(0.0, 0.0))) == NOBODY


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


@pytest.mark.parametrize(
    ("point", "says"),
    [
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


@given(arrays(float, 3, elements=st.floats(0.001, 1)))
def test_always_is_entropy_at_a_threshold_of_0_where_there_is_any_entropy(shares):
    intents = scene(own=tuple(shares / shares.sum()))
    everybody = exchange(named_point("6g:schedule=always"), intents, draws())
    assert same(everybody, exchange(SIXG.changed(tau_nats=0.0), intents, draws()))


def test_asking_whom_coverage_asks_is_the_same_exchange():
    by_schedule = exchange(named_point("v2x:schedule=coverage"), scene(), draws())
    assert same(by_schedule, exchange(POINTS["v2x"], scene(), draws(), by_schedule.asked))
