"""Latencies of a table, by hand: each link has its own row's, and percentiles are drawn.

Without a word to the contrary the ego is at 0, the helpers at 50 and 100 m,
everything is received, and all vehicles have inferred by 100 ms.
"""

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.extensions.radio.reception import drawn
from harness.extensions.radio.trace import Spread, Trace, from_profile, read
from harness.radio.channel import REPLY, REQUEST, Antenna, Draws, Site
from harness.radio.fading import Trips
from harness.radio.profiles import CHANNELS

MEAN = "distance_m,reception,latency_ms\n"
SPREAD = "distance_m,reception,latency_p50_ms,latency_p95_ms\n"
NEAR = "0,1,2\n50,1,10\n100,1,30\n"
FAR = "101,1,900000\n5000,0.5,1000000\n"
UNIT = Antenna(0.0, 0.0, 5.0)
EDGES = ("none", "relay", "fusion")


def load(tmp_path: Path, text: str, **settings: object) -> Trace:
    (tmp_path / "run.csv").write_text(text)
    return from_profile({"file": "run.csv", **settings}, tmp_path, "mine.toml [parameters]")


def line(*at_m: float) -> Site:
    n = len(at_m) - 1
    places = np.stack([np.array(at_m), np.zeros(1 + n)], axis=-1)
    return Site(places, np.zeros(n, int), np.zeros(n), np.full((n, 2), np.nan))


def scene(unit_m: float = 50.0) -> Intents:
    where = replace(line(0, 50, 100), antennas={UNIT: line(unit_m, 0, 50, 100)})
    return Intents(
        np.full(3, 1 / 3), np.array([(0.8, 0.1, 0.1), (0.0, 0.0, 1.0)]), np.ones(2, bool),
        np.array([20.0, 10.0, 5.0]), np.array([50.0, 100.0]), np.full(2, 1000.0), np.full(3, 0.1), where,
    )  # fmt: skip


def luck(n: int, helpers: int = 2) -> Draws:
    trips = Trips(np.arange(n), np.full(n, 7), np.zeros(n, int), 1)
    return Draws(np.full((n, helpers, 2), 0.5), np.full((n, helpers), 0.5), trips)


def batch(n: int) -> Intents:
    """Return the scene `n` times."""
    return scene().take(None).take(np.zeros(n, int))


@pytest.fixture
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


def play(
    patch: pytest.MonkeyPatch, trace: Trace, intents: Intents, draws: Draws, **settings: Any
) -> Exchange:
    patch.setitem(CHANNELS._loaded, "traced", trace)
    usual: dict[str, Any] = {"profile": "traced", "window_s": 0.5, "radius_m": 100.0}
    return exchange(OperatingPoint.of("x", **{**usual, **settings}), intents, draws)


def same(one: Exchange, other: Exchange) -> None:
    for field in fields(Exchange):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


@pytest.mark.parametrize(("on_demand", "more_s"), [(False, 0.0), (True, 0.1)])
def test_each_helper_hears_and_answers_after_the_latency_of_its_own_row(
    patch, tmp_path, on_demand, more_s
):
    """At 50 m 10 ms there and 10 back; at 100 m 30 and 30;
    an inference of 100 ms between, on demand.
    """
    heard = play(patch, load(tmp_path, MEAN + NEAR), scene(), luck(1).take(0), on_demand=on_demand)
    assert heard.arrival_s == pytest.approx([0.12 + more_s, 0.16 + more_s])
    assert heard.exchange_s == pytest.approx(0.16 + more_s)


def test_a_helper_that_is_slower_than_the_request_replies_when_it_has_inferred(patch, tmp_path):
    """The near one has its answer at 125 ms and the request at 110; the far one both at 130."""
    intents = replace(scene(), inference_s=np.array([0.1, 0.125, 0.125]))
    heard = play(patch, load(tmp_path, MEAN + NEAR), intents, luck(1).take(0))
    assert heard.arrival_s == pytest.approx([0.135, 0.16])


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("blank", ["", "40,0,\n", "100,0,nan\n"])
def test_rows_beyond_every_link_change_no_number(patch, tmp_path, edge, blank):
    rows = "0,1,2\n50,1,10\n" + (blank or "100,1,30\n")
    if blank.startswith("40"):
        rows += "100,1,30\n"
    near, far = (load(tmp_path, MEAN + rows + more) for more in ("", FAR))
    same(*(play(patch, each, batch(20), luck(20), edge=edge) for each in (near, far)))


def test_rows_beyond_the_radius_change_no_decision_even_if_somebody_is_there(patch, tmp_path):
    """The second helper, 100 m away, is not asked."""
    near, far = (load(tmp_path, MEAN + f"0,1,2\n50,1,10\n100,1,{ms}\n") for ms in (30, 1000000))
    one, other = (
        play(patch, each, scene(), luck(1).take(0), radius_m=60.0) for each in (near, far)
    )
    same(one, other)
    assert one.exchange_s == pytest.approx(0.12)


def test_a_unit_that_fuses_has_a_latency_for_each_of_its_links(patch, tmp_path):
    """The ego is 50 m from it (10 ms), one helper at it (2 ms), the other 50 m away.

    It has the request at 110 ms, the helpers have its own at 112 and 120,
    and replies end at 114 and 130. The policy is with the ego at 140.
    """
    heard = play(patch, load(tmp_path, MEAN + NEAR), scene(), luck(1).take(0), edge="fusion")
    assert heard.arrival_s == pytest.approx([0.114, 0.130])
    assert heard.exchange_s == pytest.approx(0.140)


def test_a_relayed_reply_comes_over_the_links_that_it_takes(patch, tmp_path):
    """Directly the far reply ends at 160 ms;
    over the unit, 50 m from both, at 130 + 10 + 10 = 150.
    """
    heard = play(patch, load(tmp_path, MEAN + NEAR), scene(), luck(1).take(0), edge="relay")
    assert heard.arrival_s == pytest.approx([0.12, 0.15]), "the near one is heard directly"
    assert heard.exchange_s == pytest.approx(0.15)


@pytest.mark.slow
def test_drawn_latencies_have_the_percentiles_of_the_links_own_row(tmp_path):
    """At 50 m 10 and 20 ms, at 100 m 30 and 90; the median of a lognormal is its geometric mean."""
    trace = load(tmp_path, SPREAD + "50,1,10,20\n100,1,30,90\n")
    n = 20_000
    where = Site(
        np.broadcast_to(line(0, 50, 100).xy_m, (n, 3, 2)), np.zeros((n, 2), int), np.zeros((n, 2)),
        np.full((n, 2, 2), np.nan),
    )  # fmt: skip
    asked, replied = (trace.latencies_s(where, luck(n), way) for way in (REQUEST, REPLY))
    for latency_s in (asked, replied):
        assert np.percentile(latency_s, 50, axis=0) == pytest.approx([0.010, 0.030], rel=0.02)
        assert np.percentile(latency_s, 95, axis=0) == pytest.approx([0.020, 0.090], rel=0.03)
        assert np.exp(np.log(latency_s).mean(axis=0)) == pytest.approx([0.010, 0.030], rel=0.02)
    pairs = np.concatenate([np.log(asked), np.log(replied)], axis=-1)
    apart = np.corrcoef(pairs, rowvar=False) - np.eye(4)
    assert np.abs(apart).max() < 0.03, "messages draw independently"


@pytest.mark.parametrize("edge", EDGES)
def test_a_decision_of_a_batch_draws_what_it_draws_alone(patch, tmp_path, edge):
    trace = load(tmp_path, SPREAD + "0,1,2,5\n50,0.8,10,20\n100,0.6,30,300\n")
    intents, draws = batch(12), luck(12)
    together = play(patch, trace, intents, draws, edge=edge)
    assert len(set(together.exchange_s.tolist())) > 6
    alone = play(patch, trace, intents.take(5), draws.take(5), edge=edge)
    for field in fields(Exchange):
        np.testing.assert_array_equal(getattr(together, field.name)[5], getattr(alone, field.name))


def test_conditions_share_the_luck_of_latencies(patch, tmp_path):
    """Asked alone, or with another, or by another rule,
    the near helper is heard at the same moment.
    """
    trace = load(tmp_path, SPREAD + "0,1,2,5\n50,1,10,20\n100,1,30,300\n")
    both, near, ruled = (
        play(patch, trace, batch(12), luck(12), **settings)
        for settings in ({}, {"radius_m": 60.0}, {"consensus": "bayes", "window_s": 0.2})
    )
    assert np.array_equal(both.arrival_s[:, 0], near.arrival_s[:, 0])
    assert np.array_equal(both.arrival_s, ruled.arrival_s)


def test_equal_percentiles_are_a_fixed_latency(patch, tmp_path):
    fixed = load(tmp_path, SPREAD + "0,1,2,2\n50,1,10,10\n100,1,30,30\n")
    always = play(patch, fixed, batch(4), luck(4))
    assert always.arrival_s == pytest.approx(np.tile([0.12, 0.16], (4, 1)))
    mean = play(patch, load(tmp_path, MEAN + NEAR), batch(4), luck(4))
    assert always.arrival_s == pytest.approx(mean.arrival_s)


def test_a_check_of_the_radio_draws_a_round_trip_over_each_distance(tmp_path):
    near, far = drawn(load(tmp_path, MEAN + NEAR), [50, 100], 100)
    assert (near.delay_s, far.delay_s) == pytest.approx((0.020, 0.060))


def test_percentiles_are_blank_only_together_and_then_those_before(tmp_path):
    points = load(tmp_path, SPREAD + "0,1,2,5\n50,0,,nan\n100,1,30,300\n").receptions.points
    assert [point.latency_s for point in points] == [
        Spread(0.002, 0.005), Spread(0.002, 0.005), Spread(0.03, 0.3)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "distance_m,reception,latency_p50_ms\n1,1,1\n",
            "has latency_p50_ms without latency_p95_ms; add",
        ),
        (
            "distance_m,reception,latency_p95_ms\n1,1,1\n",
            "without latency_p50_ms; add latency_p50_ms, or",
        ),
        (
            "distance_m,reception,latency_ms,latency_p50_ms,latency_p95_ms\n1,1,1,1,1\n",
            "has both latency_ms and latency_p50_ms; give latency_ms, or latency_p50_ms and "
            "latency_p95_ms",
        ),
        (
            SPREAD + "1,1,9,8\n",
            "latency_p95_ms is 8; it must be latency_p50_ms of its row, 9, or more",
        ),
        (
            SPREAD + "1,1,-9,8\n",
            "latency_p50_ms is '-9'; it must be milliseconds, 0.001 to 1000000; both may",
        ),
        (SPREAD + "1,1,0,8\n", "latency_p50_ms is '0'; it must be milliseconds, 0.001 to 1000000"),
        (SPREAD + "1,1,2,inf\n", "latency_p95_ms is 'inf'; it must be milliseconds"),
        (SPREAD + "1,1,nan,8\n", "latency_p50_ms is 'nan'; it must be milliseconds"),
        (
            SPREAD + "1,0,,8\n",
            "latency_p50_ms is ''; it must be milliseconds, 0.001 to 1000000; both may be",
        ),
        (MEAN + "1,1,inf\n", "latency_ms is 'inf'; it must be milliseconds, 0 to 1000000"),
    ],
)
def test_a_table_with_bad_latencies_is_refused_in_one_line(tmp_path, text, says):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(UserError) as refused:
        read(tmp_path / "run.csv")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
