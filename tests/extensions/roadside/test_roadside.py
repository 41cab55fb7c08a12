"""A roadside unit with a place, played by hand: read it as the specification.

One scene throughout. The ego is in doubt, at 145 ms. Two helpers have answered by then; a building
stands between the ego and the second one, and nothing between the unit and anybody. Every message
takes 20 ms, the unit 5 ms. In sight all messages cross; behind the building half of them do, and
the draws say which.
"""

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from channel_checks import check_channel
from evaluating import run as evaluate
from evaluating import spec_of
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.coordination.coordinate import Coordination, coordinate
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.extensions.radio.propagation import Propagation
from harness.extensions.radio.trace import Point, Spread, Table, Trace
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Antenna, Draws, Site
from harness.radio.fading import Trips
from harness.radio.profiles import CHANNELS
from harness.runs import formats
from harness.world.sight_lines import site
from harness.world.state import Building, VehicleState, WorldState

SHARES = {"clear": 1.0, "vehicle": 1.0, "building": 0.5}
TRACE = Trace(
    Table("", "", tuple(Point(0.0, share, sight, 0.02) for sight, share in SHARES.items())),
    0.02,
    "held",
)
SPREAD = Trace(
    Table(
        "",
        "",
        (Point(0.0, 1.0, None, Spread(0.01, 0.03)), Point(60.0, 0.5, None, Spread(0.03, 0.2))),
    ),
    0.0,
)
ABOVE = Antenna(0.0, 0.0, 5.0)
DOUBT = (0.3, 0.4, 0.3)
CROSSES, LOST = 0.9, 0.1  # draws behind the building


@pytest.fixture(autouse=True, scope="module")
def traced() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CHANNELS._loaded, "traced", TRACE)
        patch.setitem(CHANNELS._loaded, "spread", SPREAD)
        yield


def point(edge: str, **settings: Any) -> OperatingPoint:
    usual = {"profile": "traced", "edge_delay_s": 0.005, "window_s": 0.3}
    return OperatingPoint.of("x", **{**usual, "edge": edge, **settings})


def places(*sight: int) -> Site:
    n = len(sight)
    return Site(np.zeros((1 + n, 2)), np.array(sight), np.zeros(n), np.full((n, 2), np.nan))


def play(
    point: OperatingPoint, request: float = CROSSES, reply: float = LOST, seed: int = 0, to_ego: int = CLEAR,
    inference_s: tuple[float, ...] = (0.145, 0.145, 0.145),
) -> Coordination:  # fmt: skip
    where = replace(places(CLEAR, BUILDING), antennas={ABOVE: places(to_ego, CLEAR, CLEAR)})
    intents = Intents(
        np.array(DOUBT), np.array([(0.8, 0.1, 0.1), (0.0, 0.0, 1.0)]), np.ones(2, bool),
        np.array([20.0, 10.0, 5.0]), np.array([20.0, 30.0]), np.full(2, 1000.0), np.array(inference_s), where,
    )  # fmt: skip
    trips = Trips(np.array(seed), np.array(7), np.array(0), 1)
    packets = np.array([0.5, CROSSES, CROSSES, request, reply])
    return coordinate(point, intents, Draws(np.zeros((2, 2)), np.zeros(2), trips, packets))


def test_without_a_unit_a_reply_lost_behind_the_building_is_lost():
    """The helpers have the request at 165 ms, and their replies end at 185."""
    decision = play(point("none"))
    assert decision.arrival_s == pytest.approx([0.185, np.inf])
    assert decision.latency_s == pytest.approx(0.185)


def test_a_relay_sends_the_reply_once_more():
    """The unit has it at 185 ms as the ego would, sends its copy at 190,
    and the ego has that at 210.
    """
    decision = play(point("relay"))
    assert decision.arrival_s == pytest.approx([0.185, 0.210]), (
        "what came directly is not waited for twice"
    )
    assert decision.on_time.tolist() == [True, True]
    assert decision.latency_s == pytest.approx(0.210)
    assert (decision.requests, decision.messages, decision.lost) == (1, 2, 0)
    assert play(point("relay", window_s=0.2)).late == 1


def test_a_relay_knows_nothing_of_a_helper_that_the_request_did_not_reach():
    decision = play(point("relay"), request=LOST, reply=CROSSES)
    assert decision.delivered.tolist() == [True, False]
    assert decision.latency_s == pytest.approx(0.185), "no copy is on air"


def test_a_unit_that_fuses_asks_for_the_ego_and_sends_it_the_policy():
    """It has the ego's request at 165 ms, asks at 170, has the replies at 210,
    sends at 215: 235 ms.

    Weights are the ego's own: 1/20 : 1/10 : 1/5.
    """
    decision = play(point("fusion"))
    assert decision.arrival_s == pytest.approx([0.210, 0.210])
    assert decision.latency_s == pytest.approx(0.235)
    assert decision.weights == pytest.approx(np.array([1, 2, 4]) / 7)
    assert decision.fused == pytest.approx([(0.3 + 1.6) / 7, 0.6 / 7, 4.5 / 7])
    assert decision.fused == pytest.approx(play(point("none"), reply=CROSSES).fused)


def test_the_unit_sends_in_time_for_the_window_and_without_who_is_late():
    """To be back by 300 ms it sends at 275 at the latest:
    a reply at 270 is in the policy, at 280 not.
    """
    almost = play(point("fusion"), inference_s=(0.145, 0.145, 0.250))
    assert almost.on_time.tolist() == [True, True]
    assert almost.latency_s == pytest.approx(0.295)
    late = play(point("fusion"), inference_s=(0.145, 0.145, 0.260))
    assert late.on_time.tolist() == [True, False]
    assert late.late == 1
    assert late.latency_s == 0.3
    assert not late.deadline_missed


def test_a_window_too_short_for_the_way_over_the_unit_leaves_the_ego_alone():
    """Back by 185 ms it would have to send at 160, before it has the request at 165:
    it sends nothing.
    """
    decision = play(point("fusion", window_s=0.185))
    assert not decision.on_time.any()
    assert decision.fused.tolist() == list(DOUBT)
    assert decision.latency_s == pytest.approx(0.185), "the ego waits for a policy until then"
    assert decision.reply_bits == 2000, "the helpers replied, and no policy was sent"


def test_every_message_over_a_unit_that_fuses_is_counted():
    """Requests of 800 bits with the ego's intent and of 400; two replies of 1000;
    a policy of 400.
    """
    decision = play(point("fusion"))
    assert (decision.requests, decision.messages) == (2, 2)
    assert (decision.request_bits, decision.reply_bits) == (1200, 2400)
    sure = play(point("fusion", tau_nats=2.0))
    assert (sure.requests, sure.request_bits, sure.reply_bits, sure.latency_s) == (0, 0, 0, 0.145)


def test_an_ego_whose_request_or_policy_is_lost_has_heard_nobody():
    """Behind a building from the unit, half of either are lost:
    all four ends are met over 40 seeds.
    """
    met = set()
    for seed in range(40):
        decision = play(point("fusion"), to_ego=BUILDING, seed=seed)
        met.add((int(decision.requests), bool(decision.on_time.any())))
        if decision.requests == 1:
            assert (decision.messages, decision.request_bits, decision.reply_bits) == (0, 800, 0)
        else:
            assert (decision.messages, decision.request_bits, decision.reply_bits) == (
                2,
                1200,
                2400,
            )
        if not decision.on_time.any():
            assert decision.lost == decision.messages
            assert decision.fused.tolist() == list(DOUBT)
            assert decision.latency_s == 0.3
    assert met == {(1, False), (2, False), (2, True)}


def test_airtime_counts_both_hops_and_copies_that_nobody_needs():
    """Messages of 400, 800 and 1000 bits fit one block, 1 ms on air, and all cross."""
    alike: dict[str, Any] = {
        "profile": "mode2",
        "loss": 0.0,
        "window_s": 0.5,
        "further": "numerology=0",
    }
    slot_s = 1e-3
    for edge, messages in (("none", 3), ("relay", 5), ("fusion", 5)):
        assert play(point(edge, **alike)).airtime_s == pytest.approx(messages * slot_s)


# -- properties ------------------------------------------------------------------------------------


@st.composite
def cases(draw: st.DrawFn) -> tuple[Intents, Draws]:
    """Six unsure egos with up to four helpers, of which some are absent, somewhere round a unit."""
    helpers, rng = draw(st.integers(0, 4)), np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (6, helpers)

    def somewhere(n: int) -> Site:
        return Site(
            rng.uniform(-60, 60, (6, 1 + n, 2)), rng.integers(0, 3, (6, n)), rng.choice([1.5, 3.6], (6, n)),
            rng.choice([20.0, np.nan], (6, n, 1)) * np.ones(2),
        )  # fmt: skip

    valid = rng.random(shape) < 0.8
    intents = Intents(
        np.full((6, 3), 1 / 3), np.where(valid[..., None], rng.dirichlet(np.ones(3), shape), np.nan), valid,
        rng.uniform(1, 50, (6, 1 + helpers)), np.where(valid, rng.uniform(1, 90, shape), np.nan),
        rng.uniform(100, 4000, shape), rng.uniform(0.1, 0.16, (6, 1 + helpers)),
        replace(somewhere(helpers), antennas={ABOVE: somewhere(1 + helpers)}),
    )  # fmt: skip
    trips = Trips(rng.integers(0, 9, 6), rng.integers(0, 9, 6), rng.integers(0, 6, 6), 6)
    return intents, Draws(rng.random((*shape, 2)), rng.random(shape), trips)


RADIOS = ("mode4", "mode2", "its-g5", "traced", "its-g5:loss=0.3")
radios = st.sampled_from(RADIOS)
# over the last a relay may be faster than the direct link
all_radios = st.sampled_from([*RADIOS, "spread"])
delays = st.sampled_from([0.0, 0.01])


def over(name: str, **settings: Any) -> OperatingPoint:
    return named_point(name).changed(**settings)


@given(radios, cases(), delays)
@settings(max_examples=30)
def test_a_relay_loses_and_delays_nothing_that_came_directly(name, case, delay_s):
    direct, relayed = (
        exchange(over(name, edge=edge, edge_delay_s=delay_s), *case) for edge in ("none", "relay")
    )
    assert np.all(direct.delivered <= relayed.delivered)
    there = direct.delivered
    assert np.array_equal(direct.arrival_s[there], relayed.arrival_s[there])
    assert np.all(relayed.exchange_s >= direct.exchange_s)
    assert np.all((relayed.airtime_s >= direct.airtime_s) | np.isnan(direct.airtime_s))


@given(radios, cases())
@settings(max_examples=30)
def test_settings_of_a_unit_that_is_not_there_change_nothing(name, case):
    there = over(name, edge_delay_s=0.5, edge_x_m=9.0, edge_antenna_m=9.0)
    one, other = (exchange(each, *case) for each in (over(name), there))
    for field in fields(Exchange):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


@given(all_radios, cases(), delays, st.sampled_from(["relay", "fusion"]), st.booleans())
@settings(max_examples=30)
def test_a_single_decision_over_a_unit_is_a_row_of_the_batch(name, case, delay_s, edge, on_demand):
    beside = over(name, edge=edge, edge_delay_s=delay_s, on_demand=on_demand, window_s=0.3)
    batch = coordinate(beside, *case)
    assert np.all(batch.on_time <= batch.delivered)
    assert np.all(batch.delivered <= batch.asked)
    assert np.all(batch.asked <= case[0].valid)
    assert np.array_equal(batch.messages, batch.lost + batch.late + batch.on_time.sum(axis=-1))
    assert np.all(batch.latency_s >= case[0].inference_s[:, 0])
    alone = coordinate(beside, *(each.take(3) for each in case))
    for field in fields(Coordination):
        np.testing.assert_array_equal(getattr(alone, field.name), getattr(batch, field.name)[3])


@given(all_radios, cases(), delays)
@settings(max_examples=50)
def test_an_ego_acts_within_the_window_over_a_unit_that_fuses(name, case, delay_s):
    decision = coordinate(over(name, edge="fusion", edge_delay_s=delay_s), *case)
    assert not decision.deadline_missed.any()


@pytest.mark.parametrize("name", ["mode4", "mode2", "its-g5"])
def test_a_unit_of_lossless_links_and_a_long_window_gives_the_egos_own_policy(name):
    intents, draws = lossless()
    direct, fused = (
        coordinate(over(name, loss=0.0, window_s=2.0, edge=edge), intents, draws)
        for edge in ("none", "fusion")
    )
    assert np.array_equal(fused.on_time, direct.on_time)
    assert np.array_equal(fused.fused, direct.fused)
    assert np.all(fused.latency_s > direct.latency_s)


def lossless() -> tuple[Intents, Draws]:
    rng = np.random.default_rng(0)
    where, unit = (
        Site(
            rng.uniform(-9, 9, (6, 1 + n, 2)), np.zeros((6, n), int), np.zeros((6, n)),
            np.full((6, n, 2), np.nan),
        )
        for n in (3, 4)
    )  # fmt: skip
    intents = Intents(
        np.full((6, 3), 1 / 3), rng.dirichlet(np.ones(3), (6, 3)), np.ones((6, 3), bool),
        rng.uniform(1, 50, (6, 4)), rng.uniform(1, 90, (6, 3)), np.full((6, 3), 800.0), np.full((6, 4), 0.1),
        replace(where, antennas={ABOVE: unit}),
    )  # fmt: skip
    trips = Trips(np.arange(6), np.arange(6), np.zeros(6, int), 1)
    return intents, Draws(rng.random((6, 3, 2)), rng.random((6, 3)), trips)


# -- its settings ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"edge": "relays"}, "unknown edge 'relays'; did you mean 'relay'?"),
        (
            {"edge": "fusion"},
            "edge is 'fusion'; it must be none or relay: links of channel profile 6g have no",
        ),
        (
            {"edge": "relay", "edge_x_m": 3},
            "edge_x_m is 3.0; it must be left out: links of channel profile 6g",
        ),
        (
            {"profile": "mode4", "edge": "fusion", "consensus": "ego-prompt"},
            "edge is 'fusion'; it must be none or relay where consensus is ego-prompt: a unit has",
        ),
        (
            {"profile": "mode4", "edge": "fusion", "content": "objects"},
            "edge is 'fusion'; it must be none or relay where content is objects, which holds no",
        ),
        ({"edge_delay_s": -1}, "edge_delay_s is -1; it must be seconds, 0 or more"),
        ({"edge_antenna_m": 0.5}, "edge_antenna_m is 0.5; it must be metres from 1 to 100"),
    ],
)
def test_a_setting_that_is_not_allowed_is_one_line_that_names_it(settings, says):
    with pytest.raises(UserError) as error:
        OperatingPoint.from_dict({"name": "mine", "profile": "6g", **settings})
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("setting", ["edge=relay", "edge_x_m=3"])
def test_a_unit_is_refused_where_there_is_no_channel(setting: str) -> None:
    with pytest.raises(UserError, match=r"single-local has no channel, so edge"):
        named_point(f"single-local:{setting}")


def test_settings_of_a_unit_change_nothing_where_there_is_none():
    for name, setting in (("6g", "edge_delay_s"), ("mode4", "edge_x_m")):
        assert named_point(name).idle(setting) == "it has no roadside unit (edge is none)"
    for name, setting in (("6g:edge=relay", "tau_nats"), ("mode4:edge=relay", "edge_delay_s")):
        assert named_point(name).idle(setting) is None
    traced = named_point("traced:edge=relay,loss=0.1").idle("latency_s")
    assert traced is not None
    assert traced.endswith("has latencies of its own")


def test_over_a_channel_without_places_a_relay_is_its_second_path():
    v2x = OperatingPoint.of("x", "v2x", loss=0.0, edge="relay")
    assert v2x.channel == replace(CHANNELS["v2x"], loss=0.0, roadside_edge=True)


RELAYED = ["mode4:edge=relay,edge_delay_s=0.01", "its-g5:edge=relay", "mode2:edge=relay,loss=0.3"]


@pytest.mark.parametrize("name", RELAYED)
def test_a_relay_gives_each_link_a_fate_and_no_row_another_rows(name):
    check_channel(named_point(name).channel)


def test_the_setting_of_old_runs_is_a_relay() -> None:
    point = {"name": "6g", "roadside_edge": True}
    [read] = formats.upgraded({"conditions": [point]})["conditions"]
    assert OperatingPoint.from_dict({**read, "profile": "6g"}).setting("edge") == "relay"


# -- where it stands -------------------------------------------------------------------------------


def car(name: str, x_m: float, y_m: float, kind: str = "car") -> VehicleState:
    part = {"v1": "ego"}.get(name, "helper")
    return VehicleState(name, kind, part, x_m, y_m, 0.0, 8.0, "west", "straight", False)  # type: ignore[arg-type]


def test_a_unit_above_the_crossing_sees_round_the_corner_and_past_no_truck():
    corner = Building("b1", -30, 5, -5, 30)
    ego, helper, truck = car("v1", -25, 0), car("v2", 0, 25), car("v9", 10, 0, "truck")
    state = WorldState("any", 0, 0, 0.0, 8.0, (ego, helper, truck), (corner,))
    beside = Antenna(30.0, 0.0, 5.0)
    links = site([(state, ["v1", "v2"])], [ABOVE, beside], zones_m=[(0.0, 0.0)])
    assert links.sight.tolist() == [[BUILDING]]
    assert links.antennas[ABOVE].sight.tolist() == [[CLEAR, CLEAR]]
    assert links.antennas[beside].sight.tolist() == [[VEHICLE, CLEAR]]
    assert links.antennas[beside].blocker_m.tolist() == [[3.6, 0.0]]
    assert links.antennas[ABOVE].distance_m.tolist() == [[25, 25]]
    assert site([(state, ["v1"])], [beside], zones_m=[(-30.0, 0.0)]).antennas[
        beside
    ].distance_m.tolist() == [[25]]
    assert links.antennas[beside].first_m == 5.0


@pytest.mark.parametrize(
    ("blocker_m", "row"), [(1.4, (0.0, 0.0)), (3.6, (5.0, 4.0)), (6.0, (9.0, 4.5))]
)
def test_a_vehicle_between_blocks_by_the_higher_and_the_lower_antenna(blocker_m, row):
    """TR 37.885: nothing where both are higher than it, the middle row where one is,
    all where none is.
    """
    law = Propagation(environment="tr37885-urban")
    mean, deviation = row
    drawn = np.maximum(0, np.random.default_rng(0).normal(mean, deviation, 400_000))
    added_db, deviation_db = law.blockage_db(np.array(50.0), blocker_m, 5.0)
    assert added_db == pytest.approx(drawn.mean(), abs=0.03)
    assert deviation_db == pytest.approx(drawn.std(), abs=0.03)


def test_two_rays_reach_further_from_a_higher_antenna():
    """The breakpoint is at 4 h1 h2 f/c, and beyond it the loss has 17.3 log10 of each height."""
    law = Propagation()
    assert law.path_loss_db(np.array(2000.0), first_m=5.0) - law.path_loss_db(
        np.array(2000.0)
    ) == pytest.approx(-17.3 * np.log10(5.0 / 1.5))
    assert law.path_loss_db(np.array(100.0), first_m=5.0) == law.path_loss_db(np.array(100.0))


@pytest.mark.slow
def test_a_run_beside_a_unit_hears_more_and_the_condition_says_so(
    small: Dataset, tmp_path: Path
) -> None:
    names = ("its-g5", "its-g5:edge=relay", "its-g5:edge=fusion", "its-g5:edge=relay,edge_x_m=500")
    run = evaluate(spec_of(small, points=tuple(map(named_point, names))), tmp_path / "run").out
    summary = pd.read_csv(run / "summary.csv")
    lost = dict(summary[summary.metric == "observed_reply_loss"][["condition", "value"]].to_numpy())
    assert lost["its-g5:edge=relay"] < lost["its-g5"]
    assert lost["its-g5:edge=relay,edge_x_m=500"] == lost["its-g5"], "too far to hear anybody"
