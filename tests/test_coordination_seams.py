"""Channels and rules that the harness does not have, one of each, and what holds for every plug-in.

The two are of `tests/plugin`, here put where an entry point would put them.
"""

import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from channel_checks import check_channel
from packaged import register
from swarm_extras import FOG, SMOOTHING, Fog

from harness.coordination.claims import Claims
from harness.coordination.consensus import Messages, Pool, Rule, linear_pool
from harness.coordination.coordinate import Coordination, FusionInputs, coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.plans import Plans
from harness.coordination.rules import RULES
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import Formula, ScheduleInputs
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.plugins import Plugins
from harness.radio.channel import Channel, Delivery, Draws, Links
from harness.radio.constant import Radio
from harness.radio.profiles import CHANNELS, NO_CHANNEL


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CHANNELS._loaded, "fog", FOG)
    monkeypatch.setitem(RULES._loaded, "smoothing", SMOOTHING)


def step(
    point: OperatingPoint, helper, crosses, state=None, own=(0.5, 0.5), range_m=(10.0,), link=None
) -> Coordination:
    """One step of episodes (E,), each with one helper as far from the conflict zone as the ego."""
    helper, crosses = np.array(helper, dtype=float), np.array(crosses)
    shape = crosses.shape
    intents = Intents(
        own=np.broadcast_to(own, (*shape, 2)),
        helpers=helper[..., None, :],
        valid=np.ones((*shape, 1), dtype=bool),
        distance_m=np.full((*shape, 2), 10.0),
        range_m=np.broadcast_to(range_m, (*shape, 1)),
        payload_bits=np.zeros((*shape, 1)),
        inference_s=np.full((*shape, 2), 0.1),
    )
    link = np.where(crosses, 0.99, 0.0)[..., None, None] * np.ones(2)
    return coordinate(point, intents, Draws(link, np.zeros((*shape, 1))), FusionInputs(state=state))


def test_a_rule_with_memory_is_driven_step_by_step():
    """Now it is .75, then .5 as nobody is heard, then .25:
    means with what was before are .75, .625, .4375.

    The ego that hears nobody acts on its own intent, and the rule remembers that it did.
    A second episode in the same arrays hears (.5, .5) throughout and stays where it is.
    """
    point = OperatingPoint.of("x", "6g", tau_nats=0.5, consensus="smoothing")
    first = step(point, [(1.0, 0.0), (0.5, 0.5)], [True, True])
    assert first.fused.tolist() == [[0.75, 0.25], [0.5, 0.5]]
    second = step(point, [(1.0, 0.0), (0.5, 0.5)], [False, True], first.state)
    assert second.lost.tolist() == [1, 0]
    assert second.fused.tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert second.state.tolist() == [[0.625, 0.375], [0.5, 0.5]]
    third = step(point, [(0.0, 1.0), (0.5, 0.5)], [True, True], second.state)
    assert third.fused.tolist() == [[0.4375, 0.5625], [0.5, 0.5]]
    assert third.action.tolist() == [1, 0]


def test_an_episode_takes_its_memory_along_wherever_its_row_is():
    point = OperatingPoint.of("x", "6g", tau_nats=0.5, consensus="smoothing")
    state = step(point, [(1.0, 0.0), (0.0, 1.0)], [True, True]).state
    alone = step(point, [(0.0, 1.0)], [True], state[[1]])
    assert alone.fused.tolist() == [[0.25, 0.75]]
    single = step(point, (0.0, 1.0), True, state[1])
    assert single.fused.tolist() == [0.25, 0.75]


def test_a_rule_with_memory_also_sees_the_steps_in_which_the_ego_asks_nobody():
    """Sure of the first action, it does not ask.
    The rule keeps half of (.9, .1) and half of (.25, .75).
    """
    point = OperatingPoint.of("x", "6g", tau_nats=0.5, consensus="smoothing")
    doubt = step(point, (0.0, 1.0), True)
    sure = step(point, (0.0, 1.0), True, doubt.state, own=(0.9, 0.1))
    assert not sure.triggered
    assert sure.fused.tolist() == [0.9, 0.1]
    assert sure.state == pytest.approx([0.575, 0.425])


def test_a_rule_without_memory_leaves_no_state():
    assert step(OperatingPoint.of("x", "6g", tau_nats=0.5), [(1.0, 0.0)], [True]).state.shape == (
        1,
        0,
    )


def three(range_m=(10.0, 30.0, 50.0), link=0.8) -> tuple[Intents, Draws]:
    """An unsure ego and three helpers; their draws are all the same."""
    intents = Intents(
        np.full(2, 0.5), np.full((3, 2), 0.5), np.ones(3, bool), np.ones(4), np.array(range_m), np.zeros(3),
        np.full(4, 0.1),
    )  # fmt: skip
    return intents, Draws(np.full((3, 2), link), np.zeros(3))


def test_a_channel_may_lose_each_link_by_itself():
    """1 % a metre: where all draws are .35,
    the links of 10 and 30 m are up and that of 50 is not.
    """
    point = OperatingPoint.of("x", "fog", tau_nats=0.5)
    decision = coordinate(point, *three(link=0.35))
    assert decision.delivered.tolist() == [True, True, False]
    assert decision.arrival_s == pytest.approx([0.11, 0.11, np.inf])
    assert decision.loss == pytest.approx(0.3), "the mean over those asked"
    assert coordinate(point.changed(max_helpers=2), *three()).loss == pytest.approx(0.2)
    assert np.isnan(coordinate(point.changed(max_helpers=0), *three()).loss)


def test_a_points_overrides_are_fields_of_its_channel():
    point = OperatingPoint.of("x", "fog", tau_nats=0.5, latency_s=0.05)
    assert point.channel == Fog(latency_s=0.05)
    assert coordinate(point, *three()).arrival_s == pytest.approx([0.15, 0.15, 0.15])
    v2x = OperatingPoint.of("x", "v2x", loss=0.0)
    assert v2x.channel == replace(CHANNELS["v2x"], loss=0.0)
    assert OperatingPoint.of("x", None, loss=0.5).channel == NO_CHANNEL


@pytest.mark.parametrize("override", [{"loss": 0.0}, {"density_coupled": True}])
def test_an_override_that_a_channel_does_not_have_is_refused(override):
    [name] = override
    with pytest.raises(
        UserError, match=f"'x': {name} is .*; it must be left out: channel profile fog has no"
    ):
        OperatingPoint.of("x", "fog", **override)


# -- every plug-in, those of installed packages included -------------------------------------------


@pytest.mark.parametrize("name", [*CHANNELS, "fog", "mode2:loss=0.3"])
def test_every_channel_gives_each_link_a_fate_and_no_row_another_rows(name: str):
    check_channel(named_point(name).channel)


@pytest.mark.parametrize("name", [*RULES, "smoothing"])
def test_every_rule_gives_distributions_and_no_episode_anothers(name: str):
    rule, rng = RULES[name], np.random.default_rng(1)
    state = rule.start((20,), 3, 4)
    alone = rule.start((), 3, 4)
    for step in range(3):
        heard = rng.random((20, 3)) < 0.6
        weights = np.insert(heard, 0, True, axis=-1) * rng.uniform(0.1, 1, (20, 4))
        weights /= weights.sum(axis=-1, keepdims=True)
        intents = np.where((weights > 0)[..., None], rng.dirichlet(np.ones(4), (20, 4)), np.nan)
        messages = Messages(
            intents, weights, heard, np.where(heard, 0.1, np.inf), np.ones((20, 4)), np.ones((20, 3)),
            Claims(
                rng.normal(0, 20, (20, 4, 2)), rng.uniform(0, 14, (20, 3)), np.full(20, float(step)),
                np.full(20, 0.2), np.where(rng.random((20, 3)) < 0.5, 1.0, np.nan),
                lambda xy_m: np.abs(xy_m[..., 0]) / 10,
            ),
            Plans(
                np.tile(np.arange(3), (20, 1)), np.tile(np.arange(4), (20, 1)), rng.uniform(0, 9, (20, 4)),
                rng.uniform(0, 3, (20, 4)),
            ),
            np.tile(np.arange(3), (20, 1)),
        )  # fmt: skip
        fused = rule.fuse(messages, state)
        assert fused.policy.sum(axis=-1) == pytest.approx(1.0)
        assert (fused.policy >= 0).all()
        arrays = {field: getattr(messages, field) for field in messages.__dataclass_fields__}
        more = {name: arrays.pop(name).take(7) for name in ("claims", "plans")}
        row = Messages(**{name: array[7] for name, array in arrays.items()}, **more)
        single = rule.fuse(row, alone)
        assert single.policy == pytest.approx(fused.policy[7])
        order = [2, 0, 1]
        with_ego = [0, 3, 1, 2]
        shuffled = replace(
            messages, intents=intents[:, with_ego], weights=weights[:, with_ego], heard=heard[:, order],
            plans=messages.plans.of_helpers(np.tile(order, (20, 1))),
        )  # fmt: skip
        if state.shape[-1] == 0:  # a rule with memory may remember who said what
            assert rule.fuse(shuffled, state).policy == pytest.approx(fused.policy)
        state, alone = fused.state, single.state


# -- how packages add them -------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package with a channel, and with four entries that do not work."""
    register(
        tmp_path,
        "[swarmdrive.channels]\nslow-radio = radios:SLOW\nv2x = radios:SLOW\n"
        "broken = radios:NONE\nodd = radios:ODD\nunmade = radios:Radio\nearly = radios:EARLY\n"
        "never = radios:NEVER\n",
        radios="from harness.radio.constant import Radio\n"
        "SLOW = Radio(latency_s=0.5, loss=0.0, bandwidth_bps=1e6, access='serial', jitter_s=0.0)\n"
        "ODD = 7\nEARLY = Radio(-5.0, 0.0, 1e6, 'serial', 0.0)\n"
        "NEVER = Radio(float('nan'), 0.0, 1e6, 'serial', 0.0)\n",
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(CHANNELS, "_loaded", dict(CHANNELS.built_in))


@pytest.mark.usefixtures("installed")
def test_a_package_adds_a_channel_and_replaces_none():
    slow, v2x = (OperatingPoint.of("x", name).channel for name in ("slow-radio", "v2x"))
    assert isinstance(slow, Radio)
    assert isinstance(v2x, Radio)
    assert (slow.latency_s, v2x.latency_s) == (0.5, 0.025)
    assert {"v2x", "6g", "slow-radio"} < set(CHANNELS)
    with pytest.raises(
        UserError, match=r"did you mean 'slow-radio'\? known: 6g, broken, .*slow-radio, unmade, v2x"
    ):
        OperatingPoint.of("x", "slowradio")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            "broken",
            r"plug-in 'broken' \(swarmdrive.channels\): radios:NONE does not load \(.*'NONE'.*\); "
            r"repair",
        ),
        (
            "odd",
            r"plug-in 'odd' \(swarmdrive.channels\): radios:ODD is of type int and no Channel; "
            r"repair",
        ),
        (
            "early",
            r"plug-in 'early' \(swarmdrive.channels\) of package .*latency_s",
        ),
        (
            "never",
            r"plug-in 'never' \(swarmdrive.channels\) of package .*latency_s",
        ),
        (
            "unmade",
            r"plug-in 'unmade' \(swarmdrive.channels\): radios:Radio is of type type and no "
            r"Channel; repair",
        ),
    ],
)
def test_a_package_that_does_not_work_is_one_line(name: str, says: str):
    with pytest.raises(UserError, match=says) as error:
        OperatingPoint.of("x", name)
    assert "\n" not in str(error.value)


def writes(array: Any) -> None:
    """Write into an array that somebody else reads, as a package's code may."""
    array[...] = 0.5


def pooled(p: Floats, weights: Floats) -> Floats:
    writes(p)
    return linear_pool(p, weights)


@pytest.mark.parametrize(
    ("pool", "says"),
    [
        (
            lambda p, w: linear_pool(p, w) * np.nan,
            "fused policies that are no distributions, such as [nan",
        ),
        (
            lambda p, w: linear_pool(p, w) * 2,
            "fused policies that are no distributions, such as [1.0, 1.0",
        ),
        (lambda p, w: [[0.5, 0.5]], "fused policies of type list, not an array"),
        (pooled, "assignment destination is read-only"),
    ],
)
def test_a_packages_rule_returns_distributions_and_writes_to_nothing(
    pool: Any, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RULES._loaded, "mine", Pool(pool))
    usual = type(RULES).__iter__
    listed = lambda self: iter(self._loaded) if self is RULES else usual(self)  # noqa: E731
    monkeypatch.setattr(type(RULES), "__iter__", listed)
    with pytest.raises(UserError, match=re.escape(f"rule mine fails (ValueError: {says}")):
        coordinate(OperatingPoint.of("x", "6g", tau_nats=0.0, consensus="mine"), *three(link=0.99))


def not_a_number(known: ScheduleInputs) -> Floats:
    return known.range_m * np.nan


def reaching(known: ScheduleInputs) -> Floats:
    writes(known.may_ask)
    return known.range_m


@pytest.mark.parametrize(
    ("worth", "says"),
    [(not_a_number, "a worth that is NaN for"), (reaching, "assignment destination is read-only")],
)
def test_a_packages_schedule_says_what_asking_is_worth_and_writes_to_nothing(
    worth: Any, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCHEDULES._loaded, "mine", Formula(worth, 0.1))
    monkeypatch.setattr(type(SCHEDULES), "__iter__", lambda self: iter(self._loaded))
    with pytest.raises(UserError, match=re.escape(f"schedule mine fails (ValueError: {says}")):
        coordinate(OperatingPoint.of("x", "6g", schedule="mine"), *three())


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        ("threshold=float('nan')", "has threshold nan; allowed: a finite number, or None"),
        ("threshold='much'", "has threshold 'much'; allowed: a finite number, or None"),
        ("needs=('luck',)", "has needs ('luck',); allowed: a tuple of in_time, outlook, lot"),
        ("needs='lot'", "has needs 'lot'; allowed: a tuple of in_time, outlook, lot"),
    ],
)
def test_what_a_packages_schedule_states_is_what_it_may_be(
    stated: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = (
        f"from harness.extend import Formula\nODD = Formula(lambda known: known.range_m, {stated})"
    )
    register(tmp_path, "[swarmdrive.schedules]\nodd = odd_schedule:ODD\n", odd_schedule=source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "odd_schedule", raising=False)
    with pytest.raises(UserError, match=re.escape(says)):
        SCHEDULES["odd"]


@dataclass(frozen=True)
class Bent(Fog):
    """A channel that fails, or says what cannot be."""

    way: str = ""

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        right = super().deliver(links, draws)
        if self.way == "read-only":
            writes(links.asked)
        ways = {
            "integers": right._replace(up=right.up.astype(int)),
            "delay": right._replace(delay_s=-right.delay_s),
            "loss": right._replace(loss=right.loss + 1.0),
            "shape": right._replace(up=right.up[..., :1]),
        }
        return ways[self.way]


@pytest.mark.parametrize(
    ("way", "says"),
    [
        ("integers", 
            "ValueError: up of "
            "type int64, not bool"), ("read-only", "ValueError: assignment"),
        ("delay", 
            "ValueError: a delay "
            "that is negative"), ("loss", "ValueError: a loss that is no"),
        ("shape", "ValueError: up of shape (1,), not (3,)"), ("other", "KeyError: 'other'"),
    ],
)  # fmt: skip
def test_a_packages_channel_delivers_what_can_be_or_is_one_line(
    way: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CHANNELS._loaded, "fog", Bent(way=way))
    with pytest.raises(UserError, match=re.escape(f"channel profile fog fails ({says}")):
        coordinate(OperatingPoint.of("x", "fog", tau_nats=0.0), *three())


def test_what_is_built_in_needs_no_look_at_the_packages(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Plugins, "_entries", lambda self: pytest.fail("looked"))
    OperatingPoint.of("x", "6g", consensus="median")
    assert isinstance(CHANNELS["6g"], Radio)
    assert isinstance(Radio(0.0, 0.0, 1.0, "serial", 0.0), Channel)
    assert isinstance(RULES["linear"], Rule)
