"""Congestion control: the tables at their edges, LIMERIC's steps, and where channels come to rest."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.extensions.radio.its_g5 import ItsG5
from harness.extensions.streams.congestion import (
    ADAPTIVE,
    NONE,
    REACTIVE,
    REACTIVE_TABLES,
    Gate,
    interval_s,
    settled,
    settled_share,
    state_of,
    step,
    table_of,
)
from harness.radio.profiles import CHANNELS

SHORT, LONG = 237, 687  # bytes of packets of .4 and 1 ms on air


@dataclass(frozen=True)
class Counted(ItsG5):
    """A radio on which so many stations hear each other, and packets never overlap."""

    stations: float = 100.0
    packet_bytes: int = SHORT

    def busy_ratio(self):
        return min(self.stations * self.rate_hz * self.packet_s, 1.0)


def short(stations, rate_hz=10.0):
    return Counted(stations=stations, rate_hz=rate_hz)


def long(stations, rate_hz=10.0):
    return Counted(stations=stations, rate_hz=rate_hz, packet_bytes=LONG)


def shipped(name, **settings):
    return replace(CHANNELS[name], **settings)


EDGES = [(0.0, 0), (0.299, 0), (0.3, 1), (0.399, 1), (0.4, 2), (0.499, 2), (0.5, 3)]


@pytest.mark.parametrize(
    ("airtime_s", "name", "intervals_ms", "last"),
    [
        (0.0004, "A.2", [50, 100, 200, 250, 1000], 0.65),
        (0.0005, "A.2", [50, 100, 200, 250, 1000], 0.65),
        (0.00051, "A.1", [100, 200, 400, 500, 1000], 0.60),
        (0.001, "A.1", [100, 200, 400, 500, 1000], 0.60),
    ],
)
def test_the_reactive_tables_at_their_edges(airtime_s, name, intervals_ms, last):
    assert table_of(airtime_s).name == name
    names = ["Relaxed", "Active 1", "Active 2", "Active 3", "Restrictive"]
    assert [state.name for state in table_of(airtime_s).states] == names
    above = [(last, 3), (last + 0.001, 4), (0.9, 4), (1.0, 4)]
    for busy_ratio, place in EDGES + above:
        assert interval_s(REACTIVE, busy_ratio, airtime_s) == intervals_ms[place] / 1000
        assert state_of(table_of(airtime_s).states, busy_ratio).name == names[place]


@pytest.mark.parametrize(
    ("share", "smoothed", "busy_ratio", "before", "expected", "expected_smoothed"),
    [
        (0.01, 0.5, 0.5, 0.5, 0.010056, 0.5),  # .00984 + .0012 x .18
        (0.01, 0.68, 0.7, 0.6, 0.009858, 0.665),  # .34 + .325; .00984 + .0012 x .015
        (0.02, 0.0, 0.8, 0.4, 0.020136, 0.3),  # .01968 + .0012 x .38
        (0.01, 0.68, 0.68, 0.68, 0.00984, 0.68),  # no correction at the target
        (0.01, 0.2, 0.2, 0.2, 0.01034, 0.2),  # .0012 x .48 is more than .0005
        (0.01, 0.0, 0.0, 0.0, 0.01034, 0.0),
        (0.01, 0.85, 0.85, 0.85, 0.009636, 0.85),  # .00984 - .0012 x .17
        (0.01, 0.9, 0.9, 0.9, 0.00959, 0.9),  # .0012 x .22 is more than .00025
        (0.01, 1.0, 1.0, 1.0, 0.00959, 1.0),
        (0.0006, 1.0, 1.0, 1.0, 0.0006, 1.0),  # the least share
        (0.03, 0.0, 0.0, 0.0, 0.03, 0.0),  # .02952 + .0005 is above the largest
        (0.001, 1.0, 0.0, 0.0, 0.001200, 0.5),  # .000984 + .0012 x .18
    ],
)
def test_a_step_of_the_adaptive_rule(
    share, smoothed, busy_ratio, before, expected, expected_smoothed
):
    after = step(Gate(share, smoothed), busy_ratio, before)
    assert after == pytest.approx((expected, expected_smoothed), abs=1e-15)


@pytest.mark.parametrize(
    ("busy_ratio", "share", "short_ms", "long_ms"),
    [
        (0.0, 0.03, 25.0, 100 / 3),  # .4 ms would be 13.3 ms
        (0.2, 0.03, 25.0, 100 / 3),  # .0005 / .016 is above .03
        (0.28, 0.03, 25.0, 100 / 3),  # .0012 x .4 / .016
        (0.38, 0.0225, 25.0, 1 / 0.0225),
        (0.48, 0.015, 0.4 / 0.015, 1 / 0.015),
        (0.58, 0.0075, 0.4 / 0.0075, 1 / 0.0075),
        (0.66, 0.0015, 0.4 / 0.0015, 1 / 0.0015),
        (0.67, 0.00075, 0.4 / 0.00075, 1000.0),  # 1 ms would be 1333 ms
        (0.68, 0.0006, 0.4 / 0.0006, 1000.0),
        (1.0, 0.0006, 0.4 / 0.0006, 1000.0),
    ],
)
def test_the_adaptive_rule_where_the_channel_stays_as_it_is(busy_ratio, share, short_ms, long_ms):
    assert settled_share(busy_ratio) == pytest.approx(share)
    assert interval_s(ADAPTIVE, busy_ratio, 0.0004) == pytest.approx(short_ms / 1000)
    assert interval_s(ADAPTIVE, busy_ratio, 0.001) == pytest.approx(long_ms / 1000)
    gate = Gate(0.02, busy_ratio)
    for _ in range(1000):
        gate = step(gate, busy_ratio, busy_ratio)
    assert gate.share == pytest.approx(share, rel=1e-4)
    assert interval_s(NONE, busy_ratio, 0.001) == 0


# Each channel, and where it comes to rest under the reactive rule: state, ms allowed, ms from one
# packet to the next, busy ratio.
RESTS = [
    (short(50), [("Relaxed", 50, 100, 0.2)]),
    (short(74), [("Relaxed", 50, 100, 0.296)]),
    (short(76), [("Active 1", 100, 100, 0.304)]),
    (short(99), [("Active 1", 100, 100, 0.396)]),
    (short(101), [("Active 1", 100, 100, 0.404), ("Active 2", 200, 200, 0.202)]),
    (short(210), [("Active 2", 200, 200, 0.42)]),
    (short(260), [("Active 2", 200, 200, 0.52), ("Active 3", 250, 250, 0.416)]),
    (short(320), [("Active 3", 250, 250, 0.512)]),
    (short(420), [("Active 3", 250, 250, 0.672), ("Restrictive", 1000, 1000, 0.168)]),
    (short(1700), [("Restrictive", 1000, 1000, 0.68)]),
    (short(30, 20.0), [("Relaxed", 50, 50, 0.24)]),
    (short(60, 20.0), [("Relaxed", 50, 50, 0.48), ("Active 1", 100, 100, 0.24)]),
    (short(520, 2.0), [("Active 2", 200, 500, 0.416)]),  # they have no more to send
    (long(25), [("Relaxed", 100, 100, 0.25)]),
    (long(70), [("Active 1", 200, 200, 0.35)]),
    (long(170), [("Active 2", 400, 400, 0.425)]),
    (long(270), [("Active 3", 500, 500, 0.54)]),
    (long(320), [("Active 3", 500, 500, 0.64), ("Restrictive", 1000, 1000, 0.32)]),
    (long(650), [("Restrictive", 1000, 1000, 0.65)]),
]


@pytest.mark.parametrize(("channel", "expected"), RESTS)
def test_where_a_channel_rests_under_the_reactive_rule(channel, expected):
    result = settled(channel, REACTIVE, "c")
    for phase, (state, allowed_ms, sent_ms, busy_ratio) in zip(
        result.phases, expected, strict=True
    ):
        numbers = allowed_ms / 1000, sent_ms / 1000, busy_ratio
        assert phase.state == state
        assert phase[1:] == pytest.approx(numbers)
    rates_hz = [1000 / sent_ms for _, _, sent_ms, _ in expected]
    assert result.interval_s == pytest.approx(len(rates_hz) / sum(rates_hz))
    assert result.busy_ratio == pytest.approx(np.mean([busy for *_, busy in expected]))


@pytest.mark.parametrize(("channel", "expected"), RESTS)
def test_stations_that_go_a_state_in_step_come_to_where_the_channel_rests(channel, expected):
    """Played from each state on; so the phases are all that is left after a while."""
    table = table_of(channel.packet_s).states
    for place in range(5):
        played = []
        for _ in range(12):
            rate_hz = min(channel.rate_hz, 1 / table[place].off_s)
            wanted = state_of(table, replace(channel, rate_hz=rate_hz).busy_ratio())
            played.append(table[place].name)
            place += int(np.sign(table.index(wanted) - place))
        assert {*played[-4:]} == {state for state, *_ in expected}
        assert len({*played[-2:]}) == len(expected)


@pytest.mark.parametrize(
    ("stations", "allowed_ms", "sent_ms", "busy_ratio"),
    [
        # The share is .075 (.68 - N share), so .051 / (1 + .075 N); else they have 10 packets a
        # second to send, the busy ratio is .004 N, and the share is that of this.
        (50, 25.0, 100.0, 0.2),
        (100, 25.0, 100.0, 0.4),  # .4 / (.075 x .28) = 19 ms
        (150, 0.4 / 0.006, 100.0, 0.6),
        (200, 0.4 / 0.0031875, 0.4 / 0.0031875, 0.6375),  # .051 / 16
        (400, 0.4 * 31 / 0.051, 0.4 * 31 / 0.051, 20.4 / 31),
        (1000, 0.4 * 76 / 0.051, 0.4 * 76 / 0.051, 51 / 76),
        (1500, 0.4 / 0.0006, 0.4 / 0.0006, 0.9),  # .051 / 113.5 is below the least share
    ],
)
def test_where_a_channel_rests_under_the_adaptive_rule(stations, allowed_ms, sent_ms, busy_ratio):
    result = settled(short(stations), ADAPTIVE, "c")
    numbers = allowed_ms / 1000, sent_ms / 1000, busy_ratio
    assert result.phases[0][1:] == pytest.approx(numbers)
    assert (result.interval_s, result.busy_ratio) == result.phases[0][2:]
    for share in (0.0006, 0.03):  # and stations that step come there, from either end
        gate = Gate(share, 0.0)
        for _ in range(600):
            rate_hz = min(10.0, gate.share / 0.0004, 40.0)
            busy = replace(short(stations), rate_hz=rate_hz).busy_ratio()
            gate = step(gate, busy, busy)
        assert max(0.025, 0.0004 / gate.share) == pytest.approx(allowed_ms / 1000, rel=1e-3)


def test_stations_that_step_come_to_where_its_g5_rests():
    """By the parabola of Sepulcre et al. (35) and the stations within reach, solved by hand."""
    channel = shipped("its-g5", density_per_km=600.0)
    one = replace(channel, rate_hz=1.0).busy_ratio() - 0.003844
    load = (0.913 - math.sqrt(0.913**2 - 4 * 0.2481 * one)) / (2 * 0.2481)
    reach = load / channel.packet_s  # stations that one hears
    # load = reach share = .075 reach (.68 - .003844 - .913 load + .2481 load²)
    pull = 0.075 * reach
    a, b, c = 0.2481 * pull, -(1 + 0.913 * pull), 0.676156 * pull
    share = (-b - math.sqrt(b * b - 4 * a * c)) / (2 * a) / reach
    [phase] = settled(channel, ADAPTIVE, "its-g5").phases
    assert phase.interval_s == pytest.approx(channel.packet_s / share, rel=1e-9)
    assert phase.busy_ratio == pytest.approx(0.68 - share / 0.075, rel=1e-9)
    gate, before = Gate(0.015, 0.5), 0.5
    for _ in range(300):
        rate_hz = min(channel.rate_hz, gate.share / channel.packet_s)
        busy_ratio = replace(channel, rate_hz=rate_hz).busy_ratio()
        gate = step(gate, busy_ratio, before)
        before = busy_ratio
    assert gate == pytest.approx((share, phase.busy_ratio), rel=1e-6)


@pytest.mark.parametrize("name", ["its-g5", "mode4", "mode2"])
@pytest.mark.parametrize("density_per_km", [0.0, 100.0, 300.0, 1000.0, 10_000.0])
def test_what_a_rule_says_of_the_busy_ratio_is_what_makes_it(name, density_per_km):
    channel = shipped(name, density_per_km=density_per_km)
    assert settled(channel, NONE, name).phases[0][1:] == (0, 0.1, channel.busy_ratio())
    for rule in (REACTIVE, ADAPTIVE):
        result = settled(channel, rule, name)
        wanted_s = [interval_s(rule, phase.busy_ratio, result.airtime_s) for phase in result.phases]
        allowed_s = [phase.allowed_s for phase in result.phases]
        if len(allowed_s) == 1:
            assert wanted_s == pytest.approx(allowed_s, rel=1e-3), rule
        else:
            assert wanted_s[0] >= allowed_s[1], "in the first of two more is sent than it allows"
            assert wanted_s[1] <= allowed_s[0]
        for phase in result.phases:
            thinned = replace(channel, rate_hz=1 / phase.interval_s)
            assert phase.busy_ratio == thinned.busy_ratio() <= channel.busy_ratio()


@pytest.mark.parametrize(
    ("channel", "rule", "words"),
    [
        (CHANNELS["v2x"], REACTIVE, "c has no packets of other vehicles"),
        (short(math.nan), ADAPTIVE, "c: its busy ratio is nan, so nobody can control it"),
        (short(math.nan), REACTIVE, "c: its busy ratio is nan, so nobody can control it"),
        (short(100, 0.0), ADAPTIVE, "c: nobody sends at rate_hz = 0"),
        (short(100), "quick", "unknown rule of congestion control 'quick'"),
        (
            shipped("mode4", transmissions=2),
            REACTIVE,
            "packets of 2 ms on air: the table",
        ),
        (shipped("mode4", transmissions=5), ADAPTIVE, "packets of 5 ms on air: EN 302"),
    ],
)
def test_what_cannot_be_controlled_is_refused_in_one_line(channel, rule, words):
    with pytest.raises(UserError) as refused:
        settled(channel, rule, "c")
    assert str(refused.value).startswith(words)
    assert "\n" not in str(refused.value)


def test_tables_are_as_written_down():
    """In ms and %, so that a slip in one entry shows."""
    rows = []
    for table in REACTIVE_TABLES:
        for state in table.states:
            rows.append((table.name, round(100 * state.least), round(1000 * state.off_s)))
    assert rows == [
        ("A.2", 0, 50), ("A.2", 30, 100), ("A.2", 40, 200), ("A.2", 50, 250), ("A.2", 65, 1000),
        ("A.1", 0, 100), ("A.1", 30, 200), ("A.1", 40, 400), ("A.1", 50, 500), ("A.1", 60, 1000),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "name", ["its-g5", "its-g5:density_per_km=400", "mode4:density_per_km=350", "mode2"]
)
def test_the_command_shows_what_is_sent(harness, name):
    code, out, err = harness("radio", "congestion", name)
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    told = json.loads(harness("radio", "congestion", name, "--json")[1])
    assert [rule["rule"] for rule in told["rules"]] == [NONE, REACTIVE, ADAPTIVE]
    swings = len(told["rules"][1]["phases"]) == 2
    assert ("swings between these two" in " ".join(out.split())) == swings
    for rule in told["rules"]:
        for phase in rule["phases"]:
            row = f"{1000 * phase['interval_s']:.1f}", f"{phase['busy_ratio']:.3f}"
            assert any(line.split()[-2:] == [*row] for line in out.splitlines())
    assert f"packets of {1000 * told['airtime_s']:.3f} ms on air" in out
    for line in told["outside"]:
        assert line in out
    alone = json.loads(harness("radio", "congestion", name, "--rule", ADAPTIVE, "--json")[1])
    assert alone["rules"] == [told["rules"][0], told["rules"][2]]


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (("6g",), "6g has no packets of other vehicles"),
        (("single-local",), "single-local has no channel"),
        (("mode5",), "unknown operating point"),
        (("its-g5", "--rule", "quick"), "unknown rule of congestion control"),
        (("mode4:transmissions=2",), "or take the rule adaptive"),
    ],
)
def test_the_command_refuses_in_one_line(harness, typed, words):
    code, out, err = harness("radio", "congestion", *typed)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
