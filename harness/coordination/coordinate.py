"""Make cooperative decisions, from seeing to acting, for any number of scenes at once.

First comes the exchange of messages (its timeline is in `exchange.py`), then fusion. A consensus
rule is arithmetic and takes no time. `ego-prompt` makes a fusion call: after the exchange the ego's
model answers with the messages in its prompt, and the decision takes that much longer; so does a
content that makes the ego's scene graph larger. An ego that has heard nobody acts on its own intent
at once.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from harness.coordination.consensus import Fused, Messages, capped, inverse_distance_weights
from harness.coordination.contents import INTENTS
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.parts_of_packages import after_call, after_fusion
from harness.coordination.rules import EGO_PROMPT, RULES
from harness.core.arrays import (
    Bools,
    Floats,
    Ints,
    any_of,
    check_distributions,
    check_shares,
    count_of,
    numbers,
    read_only,
)
from harness.core.strangers import worded
from harness.radio.channel import Draws

# From who was heard, `(..., H)`, to the fusion call's answer: the ego's intent `(..., A)`, NaN if
# it failed or nobody was heard, and the seconds `(...)` that it took.
FusionCall = Callable[[Bools], tuple[Floats, Floats]]
# From where several actions are the likeliest, `(...)`, to a draw in [0, 1) for each such decision,
# `(k,)`.
TieDraws = Callable[[Bools], Floats]

TIES = ("drawn", "first")  # how a tie between the likeliest actions falls, the default first
TIE = 1e-9  # probabilities that differ by less are equal: pooling rounds


@dataclass(frozen=True)
class FusionInputs:
    """Hold what `coordinate` and `fuse` need besides intents and draws; each may be None.

    An intent is the probabilities of the ego's A actions. Arrays are of decisions of any shape
    `(...)`, with H helpers.
    """

    # asks the ego's model once more, with what the ego has heard: takes which helpers were heard,
    # `(..., H)`, and returns the ego's intent, `(..., A)`, NaN if that failed or nobody was heard,
    # and the seconds that it took, `(...)`; required where the operating point makes such a fusion
    # call, as with consensus `ego-prompt`
    call: FusionCall | None = None
    # the consensus rule's memory of each decision's episode, `(..., K)`, K numbers of the rule's
    # own: `Coordination.state` of the episode's last decision. None if all are first decisions.
    state: Floats | None = None
    # draws to decide between actions that are equally likely: takes where several are, `(...)`, and
    # returns a draw in [0, 1) for each such decision, `(k,)`; None takes the first of the actions
    ties: TieDraws | None = None
    # which decisions are the first of their episodes, `(...)`, whatever `state` has there; None if
    # none is, or all are
    first: Bools | None = None


@dataclass(frozen=True)
class Coordination(Exchange):
    """Hold all that happened in each decision: exchange, fused policy, action and latency.

    Made by `coordinate` and `fuse`; the fields of `Exchange` are its, too. Arrays are of decisions
    of any shape `(...)`, with H helpers and A actions; of 1+H vehicles the ego is first. A fusion
    call is a second question to the ego's model, with what it has heard; the window is how long
    replies are waited for. Times are s from the start of the decision.
    """

    # each vehicle's weight in the policy, `(..., 1+H)`, the ego first; NaN where a fusion call
    # answered
    weights: Floats
    fused: Floats  # the policy: probabilities of the ego's actions after fusion, `(..., A)`
    # index of its most probable action, `(...)`; a tie is drawn, and without draws it goes to the
    # earlier action, the more careful one
    action: Ints
    # whether the fusion call's answer was unusable, so that `fused` is the ego's own intent,
    # `(...)`
    fusion_failed: Bools
    # when the ego acts, `(...)`: the end of exchange and fusion, the paper's `latency_proxy`; NaN
    # where the ego's inference time is unknown
    latency_s: Floats
    deadline_missed: Bools  # whether that is after the window, `(...)`
    # the rule's memory for the episode's next decision, `(..., K)`, K numbers of the rule's own; K
    # is 0 for a rule without memory
    state: Floats
    # how far the rule trusts each helper, from 0 to 1, `(..., H)`; NaN for one that was not heard,
    # and if the rule rates none (`consensus.Fused`)
    trust: Floats

    @property
    def fusion_s(self) -> Floats:
        """Return the seconds that fusion takes after the exchange, `(...)`; 0 for a rule.

        Only a fusion call, a second question to the ego's model, takes time.
        """
        return self.latency_s - self.exchange_s


def coordinate(
    point: OperatingPoint, intents: Intents, draws: Draws, fusion: FusionInputs | None = None
) -> Coordination:
    """Play decisions of any shape `(...)`, from asking helpers to the ego's action.

    Raises UserError if a package's plug-in fails.

    Args:
        point: the operating point: the settings of the radio, of asking helpers and of fusing their
            messages.
        intents: what the ego and up to H helpers intend over A actions in each decision.
        draws: the channel's random numbers.
        fusion: what else is needed; required where the point makes a fusion call (the ego's model
            answers once more, with what it has heard), its rule has memory, or ties are drawn.
    """
    return fuse(point, exchange(point, intents, draws), intents, fusion)


def fuse(
    point: OperatingPoint, heard: Exchange, intents: Intents, fusion: FusionInputs | None = None
) -> Coordination:
    """Fuse what egos intend with what they heard, and return policies, actions and latencies.

    The second half of `coordinate`, for decisions of any shape `(...)`. Raises UserError if a
    package's rule fails.

    Args:
        point: the operating point: the settings of the radio, of asking helpers and of fusing their
            messages.
        heard: what `exchange` returned for this point and these intents: who was asked and heard.
        intents: what the ego and up to H helpers intend over A actions in each decision.
        fusion: what else is needed; raises ValueError if the point makes a fusion call (the ego's
            model answers once more, with what it has heard) and it has none.
    """
    fusion = fusion or FusionInputs()
    p = np.concatenate([heard.own[..., None, :], intents.helpers], axis=-2)
    distance_m = intents.distance_m
    if point.fusion.ego_distance_m is not None:
        distance_m = np.insert(distance_m[..., 1:], 0, point.fusion.ego_distance_m, axis=-1)
    weights = inverse_distance_weights(distance_m, heard.on_time, point.fusion.min_distance_m)
    if point.fusion.weight_cap < 1:
        weights = capped(weights, point.fusion.weight_cap)
    heard_any = any_of(heard.on_time)
    trust = np.full(heard.on_time.shape, np.nan)
    latency_s, failed = heard.exchange_s, np.zeros_like(heard.own_failed)
    answers = point.has_fusion_call and (
        point.fusion.consensus == EGO_PROMPT or INTENTS not in point.content.holds
    )
    if point.has_fusion_call:
        if fusion.call is None:
            raise ValueError(f"operating point {point.name} needs a fusion call")
        fused, seconds = fusion.call(heard.on_time)
        for part in point.more:
            fused = after_call(part, fused, p, heard.on_time)
        failed = heard_any & np.any(np.isnan(fused), axis=-1)
        latency_s = latency_s + np.where(heard_any, seconds, 0.0)
        fused = np.where((heard_any & ~failed)[..., None], fused, heard.own)
    if answers:
        weights = np.where(heard_any[..., None], np.nan, weights)
        state = np.zeros((*failed.shape, 0))
    else:
        if point.has_fusion_call:  # the ego's own intent is its answer to the larger graph
            p[..., 0, :] = fused
        messages = Messages(
            p,
            weights,
            heard.on_time,
            heard.arrival_s,
            distance_m,
            intents.range_m,
            intents.claims,
            intents.plans,
            intents.numbers,
        )
        name = point.fusion.consensus
        fused, weights, state, rule_trust = _by_rule(name, messages, fusion.state, fusion.first)
        trust = trust if rule_trust is None else np.where(heard.on_time, rule_trust, np.nan)
    fused = np.where(heard_any[..., None], fused, heard.own)
    for part in point.more:
        fused = after_fusion(part, fused)
    unknown = np.isnan(intents.inference_s[..., 0]) & (point.cloud.round_trip_s is None)
    return Coordination(
        **{field.name: getattr(heard, field.name) for field in fields(Exchange)},
        weights=weights,
        fused=fused,
        action=likeliest(fused, fusion.ties),
        fusion_failed=failed,
        latency_s=np.where(unknown, np.nan, latency_s),
        deadline_missed=latency_s > point.fusion.window_s,
        state=state,
        trust=trust,
    )


def _by_rule(
    name: str, messages: Messages, state: Floats | None, first: Bools | None = None
) -> Fused:
    """Let a rule fuse, from the memory that it begins with at the `first` decisions of episodes.

    All are such if `state` is None.

    A package's rule cannot write to what it gets, nor later to what it returns. Raises UserError if
    it fails, or if what it returns where somebody was heard is no distribution.
    """
    *batch, vehicles, actions = messages.intents.shape
    with worded(f"rule {name}", built_in=name in RULES.built_in):
        rule, memory = RULES[name], state
        if memory is None:
            memory = rule.start(tuple(batch), vehicles - 1, actions)
        elif first is not None and first.any():
            start = rule.start(tuple(batch), vehicles - 1, actions)
            memory = np.where(first[..., None], start, memory)
        if name in RULES.built_in:
            return rule.fuse(messages, memory)
        memory = numbers("memory", memory, (*batch, *(np.shape(memory) or (0,))[-1:]))
        fused = rule.fuse(read_only(messages), read_only(memory))
        policy = numbers("fused policies", fused.policy, (*batch, actions))
        check_distributions("fused policies", policy, any_of(messages.heard))
        weights = numbers("weights", fused.weights, (*batch, vehicles))
        check_shares("weights", weights[..., 1:], messages.heard)
        check_shares("weights", weights[..., 0], any_of(messages.heard))
        trust = fused.trust
        if trust is not None:
            trust = numbers("trust", trust, (*batch, vehicles - 1))
            check_shares("trust", trust, messages.heard)
        return Fused(policy, weights, numbers("memory", fused.state, memory.shape), trust)


def likeliest(policy: Floats, ties: TieDraws | None) -> Ints:
    """Return the index of each policy's most probable action, `(...)`.

    `policy` has the probabilities of A actions, `(..., A)`. Of equally likely ones the first is
    taken, or that which `ties` draws.
    """
    action: Ints = np.argmax(policy, axis=-1)
    if ties is None:
        return action
    alike = policy >= np.max(policy, axis=-1, keepdims=True) - TIE
    tied = count_of(alike) > 1
    if not tied.any():
        return action
    among = np.cumsum(alike[tied], axis=-1)
    which = np.floor(ties(tied) * among[:, -1]) + 1
    action = np.array(action)
    action[tied] = np.argmax(among == which[:, None], axis=-1)
    return action
