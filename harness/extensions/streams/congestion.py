"""How soon a station may send again on a busy channel: congestion control by ETSI TS 102 687.

The rules are those of TS 102 687 V1.2.1, for ITS-G5:

    reactive    (5.3; tables A.1 and A.2) the time between a station's packets by the busy ratio,
                the share of time in which the channel is busy. Of the two tables a packet takes
                that of the shorter packets that it still is: A.2 up to 0.5 ms on air, A.1 up to
                1 ms. A station goes one state at a time towards that of the busy ratio.
    adaptive    (5.4, table 3; annex B) LIMERIC: each 200 ms the share of time that a station may
                send is corrected by how far the busy ratio is from 0.68. Its packets may be 4 ms
                long (EN 302 571).

The numbers were not read in the standard, but where others state them by clause. Those of
`adaptive` agree in Vanetza (`limeric.hpp`, `limeric_budget.cpp`), ms-van3t (`DCC.h`) and DCC-ns3
(`dcc.cc`), but that ms-van3t smooths the busy ratio otherwise than the two. Of `reactive` DCC-ns3
has table A.2, and ms-van3t the times of A.1, with other busy ratios; both tables whole, and the 4
ms, are in a simulator in Rust that cites the annex (its model `dcc/etsi/reactive-ts102687`).

`settled` is where a channel comes to rest if all its stations obey. The adaptive rule has one such
point. The reactive one may have none: where a state's interval makes the channel busier than the
state's own bounds and the next state's makes it emptier, stations swing between the two. That it
can oscillate is known (Rostami, Cheng, Bansal, Sjöberg, Gruteser and Kenney, "Stability
Challenges and Enhancements for Vehicular Channel Congestion Control Approaches", 2016).

Sidelinks have rules of their own (ETSI TS 103 574), which are not here: on `mode4` and `mode2`
these show what ITS-G5's would do, with a slot as the time on air.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

from harness.core.arrays import Floats
from harness.core.config import settable
from harness.core.errors import UserError, printable, unknown
from harness.core.strangers import worded
from harness.radio import wrapped
from harness.radio.channel import Channel, Physical

NONE, REACTIVE, ADAPTIVE = "none", "reactive", "adaptive"
RULES = (REACTIVE, ADAPTIVE)

ROUNDING_S = 1e-9


class State(NamedTuple):
    """Hold a state of reactive control: from which busy ratio on it is, and what it allows."""

    name: str
    least: float  # busy ratio from which on a station is in this state, 0 to 1
    off_s: float  # time from one packet of a station to its next (T_off)


class Table(NamedTuple):
    """Hold a table of reactive control: the states of stations whose packets are not longer."""

    name: str  # in TS 102 687 V1.2.1
    longest_s: float  # of a packet on air (T_on)
    states: tuple[State, ...]  # by busy ratio, the emptiest channel first


def _above(ratio: float) -> float:
    """Return the least busy ratio that is more than this one."""
    return math.nextafter(ratio, 1.0)


REACTIVE_TABLES = (
    Table(
        "A.2",
        0.0005,
        (
            State("Relaxed", 0.0, 0.05),
            State("Active 1", 0.3, 0.1),
            State("Active 2", 0.4, 0.2),
            State("Active 3", 0.5, 0.25),
            State("Restrictive", _above(0.65), 1.0),
        ),
    ),
    Table(
        "A.1",
        0.001,
        (
            State("Relaxed", 0.0, 0.1),
            State("Active 1", 0.3, 0.2),
            State("Active 2", 0.4, 0.4),
            State("Active 3", 0.5, 0.5),
            State("Restrictive", _above(0.6), 1.0),
        ),
    ),
)

# Of the adaptive rule, TS 102 687 V1.2.1, table 3: its names are alpha, beta, CBR_target, delta_min
# and delta_max, G_max- and G_max+.
FORGOTTEN, GAIN, TARGET = 0.016, 0.0012, 0.68
LEAST_SHARE, LARGEST_SHARE = 0.0006, 0.03
LARGEST_FALL, LARGEST_RISE = -0.00025, 0.0005
SHORTEST_S, LONGEST_S = 0.025, 1.0  # of an interval (annex B)
LONGEST_PACKET_S = 0.004  # on air (EN 302 571)


@runtime_checkable
class Loaded(Physical, Protocol):
    """Describe a physical channel that other vehicles load with packets of one size and rate."""

    @property
    def rate_hz(self) -> float:
        """Return how many packets each of the other vehicles sends a second.

        It is a field of a frozen dataclass: `replace` makes the channel with another rate.
        """

    @property
    def packet_bits(self) -> int:
        """Return the size of such a packet in bits."""

    def message_s(self, bits: Floats | float) -> Floats:
        """Return the time on air of a message of so many bits, s."""


class Gate(NamedTuple):
    """Hold what a station under the adaptive rule keeps from one update to the next."""

    share: float  # of the time that it may send (delta)
    busy_ratio: float  # of the channel, smoothed (CBR_ITS-S)


class Phase(NamedTuple):
    """Hold what all stations of a channel do, and how busy they make it."""

    state: str  # name of the reactive rule's state; empty for the adaptive rule
    allowed_s: float  # from one packet of a station to the next at least, by the rule
    interval_s: float  # from one packet to the next: longer where stations have less to send
    busy_ratio: float  # of the channel, when all send so


class Settled(NamedTuple):
    """Hold where a channel comes to rest under a rule: one phase, or two that follow each other."""

    rule: str  # one of `RULES`, or `NONE`
    airtime_s: float  # of a packet
    phases: tuple[Phase, ...]  # one; or two in turn, the one with more packets first

    @property
    def interval_s(self) -> float:
        """Return the mean time from one packet of a station to its next.

        Of two phases each is taken to last as long as the other: it is by the mean of their rates.
        """
        return len(self.phases) / sum(1 / phase.interval_s for phase in self.phases)

    @property
    def allowed_s(self) -> float:
        """Return the mean time from one packet of a station to its next that the rule allows."""
        return len(self.phases) / sum(1 / phase.allowed_s for phase in self.phases)

    @property
    def busy_ratio(self) -> float:
        """Return the mean share of time in which the channel is busy, 0 to 1."""
        return sum(phase.busy_ratio for phase in self.phases) / len(self.phases)


def interval_s(rule: str, busy_ratio: float, airtime_s: float) -> float:
    """Return the seconds that a rule wants from one packet of a station to its next, at least.

    It is for a channel that stays as busy as it is. `rule` is one of `RULES`, or `NONE`;
    `busy_ratio` is the share of time in which the channel is busy, 0 to 1, and `airtime_s` a
    packet's time on air. Raises UserError if there is no such rule, or none for packets of that
    length.
    """
    if rule == NONE:
        return 0.0
    if rule == REACTIVE:
        return state_of(table_of(airtime_s).states, busy_ratio).off_s
    if rule != ADAPTIVE:
        raise unknown("rule of congestion control", rule, (NONE, *RULES))
    if airtime_s > LONGEST_PACKET_S + ROUNDING_S:
        raise _too_long(airtime_s, LONGEST_PACKET_S, "EN 302 571 allows", "")
    return min(max(airtime_s / settled_share(busy_ratio), SHORTEST_S), LONGEST_S)


def table_of(airtime_s: float) -> Table:
    """Return the table of reactive control for packets that are so long on air, in s.

    Raises UserError if they are too long for both.
    """
    for table in REACTIVE_TABLES:
        if airtime_s <= table.longest_s + ROUNDING_S:
            return table
    longest_s = REACTIVE_TABLES[-1].longest_s
    allows = "the tables of reactive control (ETSI TS 102 687) are for"
    raise _too_long(airtime_s, longest_s, allows, f", or take the rule {ADAPTIVE}")


def state_of(states: Sequence[State], busy_ratio: float) -> State:
    """Return the state whose bounds a busy ratio, 0 to 1, is within, one of a table's `states`."""
    return [state for state in states if state.least <= busy_ratio][-1]


def step(gate: Gate, busy_ratio: float, before: float) -> Gate:
    """Return what a station under the adaptive rule has after an update, one every 200 ms.

    `gate` is what it had. `busy_ratio` is the share of time in which the channel was busy in the
    last 100 ms, and `before` that in the 100 ms before them.
    """
    smoothed = 0.5 * gate.busy_ratio + 0.5 * (busy_ratio + before) / 2
    share = (1 - FORGOTTEN) * gate.share + _correction(smoothed)
    return Gate(_within_bounds(share), smoothed)


def settled_share(busy_ratio: float) -> float:
    """Return the share of time that a station may send if the channel stays as busy as it is.

    It is what the adaptive rule comes to after many updates.
    """
    return _within_bounds(_correction(busy_ratio) / FORGOTTEN)


def settled(channel: Channel, rule: str, name: str) -> Settled:
    """Return where a channel comes to rest if all stations on it obey a rule.

    All send what the channel's background vehicles send, and these obey, too: each has `rate_hz`
    packets a second to send, and sends as many of them as the rule allows.

    Where no state of the reactive rule makes the channel as busy as its own bounds say, two that
    follow each other are returned: between them all stations swing if they go a state in step.

    Args:
        channel: the channel, without what wraps it.
        rule: one of `RULES`, or `NONE`: nobody obeys any.
        name: the channel's, for messages.

    Raises:
        UserError: nobody loads the channel, it does not know how busy it is, or there is no such
            rule for packets of its length.
    """
    if not isinstance(channel, Loaded) or "rate_hz" not in settable(channel):
        raise UserError(
            f"{printable(name)} has no packets of other vehicles, which congestion control would "
            "thin; give a physical radio, such as its-g5"
        )
    if not channel.rate_hz:
        raise UserError(f"{printable(name)}: nobody sends at rate_hz = 0; give a larger one")
    airtime_s = _airtime_s(channel)
    if rule == NONE:
        phases: tuple[Phase, ...] = (_phase(name, channel, 0.0),)
    elif rule == REACTIVE:
        phases = _swing(name, channel, table_of(airtime_s).states)
    else:
        phases = (_rest(name, channel, rule, airtime_s),)
    return Settled(rule, airtime_s, phases)


def _swing(name: str, channel: Loaded, states: Sequence[State]) -> tuple[Phase, ...]:
    """Return the phase of the one state that fits itself, or of the two on both sides of none.

    From one state to the next fewer packets are sent, so the state of the busy ratio that they make
    falls while the state itself rises: it passes it once.
    """
    phases = []
    for state in states:
        phases.append(_phase(name, channel, state.off_s, state.name))
    wanted = [state_of(states, phase.busy_ratio) for phase in phases]
    first = next(n for n, state in enumerate(states) if wanted[n].least <= state.least)
    if wanted[first] == states[first]:
        return (phases[first],)
    return (phases[first - 1], phases[first])


def _rest(name: str, channel: Loaded, rule: str, airtime_s: float) -> Phase:
    """Return the phase in which a rule allows as much as makes the channel so busy, by bisection.

    The more often all send, the busier is the channel, and the less often each may.
    """
    shortest_s, longest_s = SHORTEST_S, LONGEST_S
    for _ in range(60):
        between_s = (shortest_s + longest_s) / 2
        phase = _phase(name, channel, between_s)
        if interval_s(rule, phase.busy_ratio, airtime_s) > between_s:
            shortest_s = between_s
        else:
            longest_s = between_s
    return _phase(name, channel, longest_s)


def _phase(name: str, channel: Loaded, allowed_s: float, state: str = "") -> Phase:
    """Return what happens if every station sends what it has to, and no sooner than allowed.

    Raises UserError if the channel's model does not know its busy ratio.
    """
    sent_s = max(allowed_s, 1 / channel.rate_hz)
    thinned = replace(cast("Any", channel), rate_hz=1 / sent_s)
    busy_ratio = wrapped.busy_ratio(thinned)
    if not 0 <= busy_ratio <= 1:
        raise UserError(
            f"{printable(name)}: its busy ratio is {busy_ratio:g}, so nobody can control it; "
            "give a channel that knows it, 0 to 1, such as its-g5"
        )
    return Phase(state, allowed_s, sent_s, busy_ratio)


def _airtime_s(channel: Loaded) -> float:
    """Return the time on air of a packet, s. Raises UserError if a package's channel has none."""
    with worded(wrapped.label(channel), built_in=wrapped.is_ours(channel)):
        airtime_s = float(channel.message_s(channel.packet_bits))
        if not 0.0 < airtime_s < math.inf:
            raise ValueError(f"a time on air of {airtime_s:g} s")
    return airtime_s


def _correction(busy_ratio: float) -> float:
    """Return by how much an update of the adaptive rule changes a station's share of time."""
    return min(max(GAIN * (TARGET - busy_ratio), LARGEST_FALL), LARGEST_RISE)


def _within_bounds(share: float) -> float:
    return min(max(share, LEAST_SHARE), LARGEST_SHARE)


def _too_long(airtime_s: float, longest_s: float, allows: str, instead: str) -> UserError:
    return UserError(
        f"packets of {1000 * airtime_s:g} ms on air: {allows} {1000 * longest_s:g} ms at most; "
        f"make them shorter{instead}"
    )
