"""What packages' rules, channels, scenarios and attacks return is held to what it must be, and is
copied.
"""

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import wraps
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import one_way_crossing as crossing
import pytest
from one_way_crossing import SCENARIO

from harness.coordination.consensus import Fused, Messages
from harness.coordination.coordinate import _by_rule
from harness.coordination.rules import RULES
from harness.core.errors import UserError
from harness.radio import constant
from harness.radio.channel import Broadcast, Delivery, Draws, Links
from harness.radio.profiles import CHANNELS, NO_CHANNEL
from harness.radio.wrapped import Wrapped, broadcast, delivered
from harness.radio.wrapped import is_ours as wrapped_is_ours
from harness.world import scenarios
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import Building
from harness.world.world import World

P = np.full((2, 2), 0.5)
HEARD = np.ones((2, 1), dtype=bool)
MESSAGES = Messages(np.full((2, 2, 2), 0.5), P, HEARD, np.ones((2, 1)), P, np.ones((2, 1)))
NOW = Broadcast(0.0, 0.0)
FUSED = Fused(P, P, np.zeros((2, 3)), np.ones((2, 1)))
DRAWS = Draws(np.zeros((2, 1, 2)), np.zeros((2, 1)))
ONE = np.ones((2, 1))
LINKS = Links(HEARD, ONE, ONE, ONE, HEARD, HEARD)
DELIVERED = Delivery(HEARD, *np.ones((3, 2, 1)))


@dataclass(frozen=True)
class Rule:
    result: Fused
    memory: Any = None

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Any:
        return np.zeros((*batch, 3)) if self.memory is None else self.memory

    def fuse(self, messages: Messages, state: Any) -> Fused:
        return self.result


@dataclass(frozen=True)
class Radio:
    result: Delivery = DELIVERED
    asked: Broadcast = NOW
    writes: bool = False
    table: Any = None

    def request(self, bits: Any, draws: Draws) -> Broadcast:
        if self.writes:
            draws.link[...] = 1.0
        return self.asked

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        return self.result


def fused(monkeypatch: pytest.MonkeyPatch, rule: Rule) -> Fused:
    monkeypatch.setitem(RULES._loaded, "mine", rule)
    return _by_rule("mine", MESSAGES, None)


def masked(values: Any) -> Any:
    return np.ma.masked_array(values, mask=True)


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        (Rule(FUSED._replace(policy=masked(7 * P))), "fused policies of type MaskedArray"),
        (Rule(FUSED._replace(policy=cast("Any", P.tolist()))), "fused policies of type list"),
        (Rule(FUSED._replace(policy=P.astype(complex))), "fused policies of type complex128"),
        (Rule(FUSED._replace(weights=P.astype(str))), "weights of type <U"),
        (Rule(FUSED._replace(weights=P * np.inf)), "weights that are not from 0 to 1, such as inf"),
        (Rule(FUSED._replace(weights=-P)), "weights that are not from 0 to 1, such as -0.5"),
        (
            Rule(FUSED._replace(trust=np.full((2, 1), 7.0))),
            "trust that are not from 0 to 1, such as 7",
        ),
        (Rule(FUSED._replace(trust=np.full((2, 1), None))), "trust of type object"),
        (Rule(FUSED, np.zeros(3)), r"memory of shape \(3,\), not \(2, 3\)"),
        (Rule(FUSED, np.zeros(())), r"memory of shape \(\), not \(2, 0\)"),
    ],
)
def test_what_a_rule_returns_is_held_to_what_it_must_be(
    rule: Rule, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match=f"^rule mine fails .ValueError: {says}"):
        fused(monkeypatch, rule)


def test_what_a_rule_writes_later_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may have one array for all conditions, whose memories would be one."""
    result = Fused(P.copy(), P.copy(), np.zeros((2, 3)), np.ones((2, 1)))
    taken = fused(monkeypatch, Rule(result))
    before = [np.array(each) for each in taken]
    for each in result:
        each[...] = 0.25
    assert all(np.array_equal(a, b) for a, b in zip(taken, before, strict=True))


def test_ints_and_float32_are_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = fused(
        monkeypatch, Rule(FUSED._replace(policy=np.eye(2, dtype=int), weights=P.astype("f4")))
    )
    assert [each.dtype for each in taken] == [np.float64] * 4


@pytest.mark.parametrize(
    ("result", "says"),
    [
        (DELIVERED._replace(up=masked(HEARD)), "up of type MaskedArray"),
        (
            DELIVERED._replace(delay_s=np.full((2, 1), np.inf)),
            "a delay that is negative, infinite or NaN",
        ),
        (DELIVERED._replace(delay_s=np.full((2, 1), 1.0, object)), "delays of type object"),
        (DELIVERED._replace(delay_s=np.full((2, 1), 1e300)), "delays with 1e.300; allowed: up to"),
        (DELIVERED._replace(delay_s=0.5 * ONE), "a reply that ends 0.5 s after the request"),
        (DELIVERED._replace(loss=masked(np.full((2, 1), 9.0))), "losses of type MaskedArray"),
        (DELIVERED._replace(loss=np.full((2, 1), np.nan)), "a loss that is no probability"),
        (
            DELIVERED._replace(airtime_s=np.full((2, 1), np.inf)),
            "an airtime that is negative or infinite",
        ),
    ],
)
def test_what_a_channel_delivers_is_held_to_what_it_must_be(result: Delivery, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        delivered(Radio(result), LINKS, DRAWS)


def test_a_channel_cannot_write_to_the_draws_of_others_when_it_is_asked_for_a_request() -> None:
    """All conditions share them."""
    with pytest.raises(ValueError, match="read-only"):
        broadcast(Radio(writes=True), 1.0, DRAWS)
    for time_s in (-1.0, np.inf):
        with pytest.raises(ValueError, match="a request whose time is negative or infinite"):
            broadcast(Radio(asked=Broadcast(0.0, time_s)), 1.0, DRAWS)
    vast: tuple[tuple[Any, str], ...] = ((1e300, "with 1e.300"), (1j, "of type complex128"))
    for wrong, says in vast:
        with pytest.raises(ValueError, match=f"times of a request {says}"):
            broadcast(Radio(asked=Broadcast(0.0, wrong)), 1.0, DRAWS)
    assert np.isnan(broadcast(Radio(asked=Broadcast(np.nan, 0)), 1.0, DRAWS).heard_s)


def test_a_channel_whose_parameters_no_file_can_hold_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(CHANNELS._loaded, "mine", Radio(table=np.zeros(3)))
    with pytest.raises(
        UserError, match=r"^channel profile mine fails \(TypeError: Encoding objects"
    ):
        CHANNELS.record("mine")


LAYOUT = crossing.layout(1, SCENARIO.parameters)
EGO = LAYOUT.spawns[0]
XY_M, APPROACHES = np.zeros((4, 2, 2)), np.full((4, 2), "west")


def written(xy_m: Any) -> Any:
    xy_m[...] = 0.0
    return xy_m


def roads(**changes: Any) -> Any:
    return replace(SCENARIO, road=lambda: replace(crossing.road(), **changes)).road()


def laid(layout: Any) -> Any:
    scenario = replace(SCENARIO, layout=lambda seed, parameters: layout)
    return scenario.layout(1, scenario.parameters)


def ego(**changes: Any) -> Layout:
    return replace(LAYOUT, spawns=(replace(EGO, **changes), *LAYOUT.spawns[1:]))


def built(**changes: Any) -> Layout:
    walls = {"west_m": -9.0, "north_m": -9.0, "east_m": -5.0, "south_m": -5.0}
    return replace(LAYOUT, buildings=(Building("b1", **{**walls, **changes}),))


def cleared(act: Callable[[Any], Any]) -> Any:
    scenario = replace(SCENARIO, cleared=lambda xy_m, approaches, parameters: act(xy_m))
    return scenario.cleared(XY_M, APPROACHES, scenario.parameters)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda: laid(None), "TypeError: layout gives a NoneType and no Layout"),
        (lambda: laid(replace(LAYOUT, spawns=())), "ValueError: layout does not have one ego"),
        (lambda: laid(replace(LAYOUT, spawns=LAYOUT.spawns * 2)), "layout has two vehicles v1"),
        (lambda: laid(replace(LAYOUT, spawns=("v1",))), "layout gives a str and no Spawn"),
        (lambda: laid(replace(LAYOUT, buildings=(1,))), "layout gives a int and no Building"),
        (lambda: laid(replace(LAYOUT, danger="zork")), "layout has danger zork of v3, and no such"),
        (lambda: laid(replace(LAYOUT, danger_id=None)), "layout has danger west of None"),
        (lambda: laid(ego(arc_m=np.nan)), "v1 has arc_m nan, not from -1000 to 1000"),
        (lambda: laid(ego(arc_m=1e9)), "v1 has arc_m 1000000000.0, not from -1000 to 1000"),
        (lambda: laid(ego(speed_mps=1e6)), "v1 has speed_mps 1000000.0, not from 0 to 200"),
        (lambda: laid(ego(speed_mps=-30.0)), "v1 has speed_mps -30.0, not from 0 to 200"),
        (lambda: laid(ego(speed_mps="5")), "v1 has speed_mps '5', not from 0 to 200"),
        (lambda: laid(ego(brakes_at_s=np.inf)), "v1 has brakes_at_s inf, not from 0 to 20000"),
        (lambda: laid(ego(brakes_mps2=1e9)), "v1 has brakes_mps2 1000000000.0, not from 0 to 200"),
        (lambda: laid(built(east_m=np.nan)), "b1 has east_m nan, not from -1000 to 1000"),
        (lambda: laid(ego(route="left")), "v1 is on south, left, no path of the road"),
        (lambda: laid(ego(kind="tank")), "ValidationError: Invalid enum value 'tank'"),
        (lambda: laid(ego(id="zork")), "ValidationError: Expected `str` matching regex"),
        (lambda: cleared(lambda xy_m: 1 / 0), "ZeroDivisionError: division by zero at "),
        (lambda: cleared(lambda xy_m: None), "ValueError: cleared of type NoneType"),
        (lambda: cleared(lambda xy_m: np.bool_(True)), "cleared of type bool"),
        (lambda: cleared(lambda xy_m: np.zeros(4)), "cleared of type float64, not bool"),
        (lambda: cleared(written), "assignment destination is read-only"),
        (lambda: replace(SCENARIO, road=lambda: None).road(), "road gives a NoneType and no Road"),
        (lambda: roads(ego=("west", "left")), "road has no path ('west', 'left'), which is its"),
        (lambda: roads(ground=lambda far_m: None).ground_within(9.0), "ground gives a NoneType"),
        (lambda: roads(goal_m=lambda p: 1 / 0).goal_m(1), "ZeroDivisionError: division by zero"),
        (lambda: roads(goal_m=lambda p: np.nan).goal_m(1), "ValidationError: Expected `float`"),
        (lambda: replace(SCENARIO, seats=lambda: None).seats(), "seats gives a NoneType and no M"),
        (lambda: replace(SCENARIO, seats=lambda: {1: 2}).seats(), "seats gives a int and no Seat"),
    ],
)
def test_what_a_scenario_returns_is_held_to_what_it_must_be(
    ask: Callable[[], Any], says: str
) -> None:
    with pytest.raises(UserError) as error:
        ask()
    assert str(error.value).startswith(f"scenario {SCENARIO.name} fails (")
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("scenario", "says"),
    [
        (replace(SCENARIO, name="other"), "its name is 'other'"),
        (replace(SCENARIO, parameters=cast(Any, 5)), "its parameters are no Parameters"),
        (replace(SCENARIO, description=""), "its description is no text"),
        (replace(SCENARIO, words={"task": cast(Any, 5)}), "its words hold what is no text"),
        (replace(SCENARIO, world=World), "it has a world of its own; make an environment"),
        (replace(SCENARIO, one_sided=cast(Any, 5)), "one_sided is no text"),
        (replace(SCENARIO, dials=("zork",)), "its dial 'zork' is no parameter"),
        (replace(SCENARIO, actions=()), "its actions are (), and not SLOWER, IDLE, FASTER, with"),
        (replace(SCENARIO, actions=("ZORK",)), "its actions are ('ZORK',), and not SLOWER"),
        (replace(SCENARIO, actions=(*SCENARIO.actions, "IDLE")), "or one is there twice"),
        (replace(SCENARIO, actions=cast(Any, 5)), "its actions are no tuple"),
    ],
)
def test_what_a_scenario_says_of_itself_is_checked(
    scenario: Scenario, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = type("Package", (), {"name": "by-hand"})
    entry = SimpleNamespace(value="packages:MINE", load=lambda: scenario, dist=package)
    monkeypatch.setattr(scenarios.PLUG_INS, "_entries", lambda: {SCENARIO.name: entry})
    monkeypatch.setattr(scenarios.PLUG_INS, "_loaded", {})
    with pytest.raises(UserError) as error:
        scenarios.PLUG_INS[SCENARIO.name]
    plug_in = f"plug-in '{SCENARIO.name}' (swarmdrive.scenarios) of package by-hand"
    named = f"{plug_in} fails (ValueError: "
    assert str(error.value).startswith(named)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_lanes_that_a_network_lacks_are_one_line() -> None:
    pytest.importorskip("highway_env")
    lane = ("nowhere", "west", 0)
    path = replace(crossing.road().ego_path, lanes=(lane,))
    road = roads(paths={crossing.road().ego: path})
    with pytest.raises(UserError, match=r"^scenario one-way-crossing fails \(KeyError: 'nowhere'"):
        road.network()


def test_a_scenario_that_ends_the_program_is_named_as_the_user_knows_it() -> None:
    copied = replace(SCENARIO, name="mine", layout=lambda seed, parameters: sys.exit())
    with pytest.raises(UserError, match=r"^scenario mine ends the program \(SystemExit at"):
        copied.layout(1, copied.parameters)


def test_a_scenario_is_the_same_behind_its_door_and_one_here_has_none() -> None:
    again = replace(SCENARIO)
    assert again == SCENARIO
    assert again.road() is SCENARIO.road()
    spawns: tuple[Spawn, ...] = SCENARIO.layout(1, SCENARIO.parameters).spawns
    assert spawns == LAYOUT.spawns
    for name in scenarios._files():
        here = scenarios.get(name)
        for function in (here.road, here.layout, here.cleared, here.seats):
            assert type(function).__module__ != "harness.world.scenario_of_package", name


def test_what_only_states_that_it_is_ours_has_a_door() -> None:
    here = scenarios.get("all-way-crossing")

    @wraps(here.cleared)
    def everywhere(*given: Any) -> Any:
        return 5

    wrapped = replace(here, name="mine", cleared=everywhere)
    with pytest.raises(UserError, match=r"^scenario mine fails \(ValueError: cleared of type int"):
        wrapped.cleared(np.zeros((1, 1, 2)), np.array([["s"]]), here.parameters)
    named = {"__module__": constant.Radio.__module__}
    ours, hidden = replace(NO_CHANNEL), replace(NO_CHANNEL)
    object.__setattr__(hidden, "deliver", lambda links, draws: 5)
    stated = type("Radio", (constant.Radio,), named)(**asdict(NO_CHANNEL))
    around = type("Around", (Wrapped,), {})(CHANNELS["mode4"])
    assert wrapped_is_ours(ours)
    for channel in (hidden, stated, around):
        assert not wrapped_is_ours(channel)
