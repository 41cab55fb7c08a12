"""The setting `rounds` of a condition: agents send what they have decided, and decide again with
what they hear.

In seconds from the start of the decision: an agent that has decided by the window asks the same
others once more. Each replies once it has decided itself, with its policy after the round before.
What arrives in the window takes the place of the plan of the round before; who is not heard again
is taken at its last word. The agent decides again by its own intent and by what it now knows. A
fusion call delays what follows it, and who has heard nothing new makes no further one.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from msgspec import Meta

from harness.coordination.contents import PLANS
from harness.coordination.parts import ActsOn, Part, wrong
from harness.core.arrays import any_of, count_of

if TYPE_CHECKING:
    from harness.coordination.coordinate import Coordination
    from harness.coordination.exchange import Exchange
    from harness.coordination.intents import Intents
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.sent import SentIntents
    from harness.radio.channel import Draws

MOST_ROUNDS = 3


class Negotiated(Part, frozen=True, kw_only=True):
    """Hold the setting `rounds`: how often agents tell each other their plans before they act.

    Agents are vehicles that each decide for themselves; 1 is once. It is one of the settings of an
    operating point, which has those of radio, asking and fusion; in records it stands behind the
    setting `behind`.
    """

    behind: ClassVar[str] = "fallback"

    # with `content=plan`: how often agents tell each other their plans before they act
    rounds: Annotated[
        int, Meta(ge=1, le=MOST_ROUNDS, description=f"a whole number from 1 to {MOST_ROUNDS}")
    ] = 1

    @property
    def acts_on(self) -> Collection[ActsOn]:
        return (ActsOn("rounds", self.rounds, (PLANS,), "1"),) if self.rounds > 1 else ()

    def check_with(self, point: "OperatingPoint") -> None:
        in_a_cloud = point.cloud.round_trip or point.cloud.round_trip_s is not None
        if self.rounds > 1 and in_a_cloud:
            raise wrong("rounds", self.rounds, "1 where the ego's model runs in a cloud")

    def again(
        self,
        point: "OperatingPoint",
        sent: "SentIntents",
        heard: "Exchange",
        decide: "Callable[[Exchange, Intents], Coordination]",
    ) -> "tuple[SentIntents, Exchange]":
        return further_rounds(point, sent, heard, decide)


def further_rounds(
    point: "OperatingPoint",
    sent_intents: "SentIntents",
    heard: "Exchange",
    fused: "Callable[[Exchange, Intents], Coordination]",
) -> "tuple[SentIntents, Exchange]":
    """Play the negotiation rounds after the first, in which agents exchange revised plans.

    An agent is a vehicle that decides for itself; a plan is its probabilities of its own actions.
    Returns the last plans that each agent knows, and one exchange (what was sent, what arrived, and
    when) that sums all rounds.

    Args:
        point: the settings of radio, asking and fusion, with the number of rounds.
        sent_intents: what was sent in the first round, in n decisions.
        heard: the exchange of the first round.
        fused: returns the n decisions, given an exchange and the intents known after it.
    """
    from harness.coordination.exchange import exchange

    for number in range(2, point.setting("rounds") + 1):
        intents, draws = sent_intents.intents, sent_intents.draws
        assert intents.plans is not None
        senders = intents.plans.row
        decided, there = fused(heard, intents), senders >= 0
        policy = decided.fused
        # An attacker repeats what it said.
        newer = np.where(sent_intents.attackers[..., None], intents.helpers, policy[senders])
        # unknown where the inference is, which counts as 0
        call_s = np.nan_to_num(decided.fusion_s)
        decided_s = heard.exchange_s + call_s
        helpers_s = np.where(there, decided_s[senders], np.nan)
        more = exchange(
            point,
            replace(intents, inference_s=np.concatenate([decided_s[:, None], helpers_s], axis=1)),
            _of_round(draws, number),
            heard.asked & (decided_s < point.fusion.window_s)[:, None],
        )
        sent_intents = replace(
            sent_intents,
            intents=replace(
                intents, helpers=np.where(more.on_time[..., None], newer, intents.helpers)
            ),
        )
        # Who hears nothing new keeps the last decision, and its call counts once.
        repeated_s = np.where(any_of(more.on_time), 0.0, call_s)
        heard = replace(_together(heard, more), exchange_s=more.exchange_s - repeated_s)
    return sent_intents, heard


def _of_round(draws: "Draws", number: int) -> "Draws":
    """Return a round's draws: links and shadowing stay, each packet is drawn anew."""
    if draws.trips is None:
        return draws
    trips = replace(draws.trips, links=f".round-{number}")
    return replace(draws, given=trips.uniforms(draws.jitter.shape[-1]))


def _together(earlier: "Exchange", later: "Exchange") -> "Exchange":
    """Return the exchange of two rounds: what both cost, and who was heard in either."""
    return replace(
        earlier,
        requests=earlier.requests + later.requests,
        request_bits=earlier.request_bits + later.request_bits,
        reply_bits=earlier.reply_bits + later.reply_bits,
        airtime_s=earlier.airtime_s + later.airtime_s,
        delivered=earlier.delivered | later.delivered,
        arrival_s=np.where(later.on_time, later.arrival_s, earlier.arrival_s),
        on_time=earlier.on_time | later.on_time,
        repeats=earlier.repeats + count_of(later.asked),
    )
