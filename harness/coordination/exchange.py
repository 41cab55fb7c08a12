"""Compute who is heard and when: the timeline of decisions from seeing to the last reply.

In seconds from the start of the decision:

    0                     every vehicle sees the scene; the ego and its helpers infer in parallel
    inference_s[0]        the ego has its own intent. If it is sure enough, or has nobody to ask, it
                          acts now. If it is unsure, it broadcasts one request to the nearest
                          helpers in its radius
    heard                 the request was on air, and the helpers have it, each after its own link's
                          latency if the channel has one. Only now do they infer, if they infer on
                          demand
    ready                 a helper has the request and its own intent, and its reply can leave:
                          max(heard, inference_s[1+h]); on demand heard + inference_s[1+h]; and no
                          sooner than it may send, if it has sent something unasked just before
    + slots               replies are on air, one after another or at once, as the profile says; a
                          slot is nominal latency + payload / bandwidth + jitter
    arrival_s[h]          the end of the helper's slot if request and reply arrived; else inf
    window_s              what has arrived by now is fused
    exchange_s            the end of the last slot: the ego also waits for a lost or late reply

The nominal latency of a slot covers the way of the request, but not its time on air. Like the
paper, this counts the whole exchange as the decision's latency even if it outlasts the window.
Everything here is a pure function of arrays, for any number of decisions; the ego is vehicle 0,
helpers are 1..H.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from harness.coordination.contents import INTENTS
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import ScheduleInputs, chosen
from harness.coordination.trigger import entropy_nats, normalised_entropy, triggered
from harness.core.arrays import Bools, Floats, Ints, any_of, count_of, numbers, read_only
from harness.core.errors import UserError, printable
from harness.core.statistics import known_mean
from harness.core.strangers import worded
from harness.radio.channel import Channel, Draws, Links
from harness.radio.consulted import Consulted
from harness.radio.wrapped import broadcast, delivered, heard_s, is_ours


@dataclass(frozen=True)
class Exchange:
    """Hold who was asked, what was sent and who was heard in each decision.

    Made by `exchange`. Times are seconds from the start of the decision. Arrays are of decisions of
    any shape `(...)`, with H helpers, index h for helper h, and A actions. An intent, or policy, is
    the probabilities of the A actions. Another, such as an antenna beside the road, may ask the
    helpers for the ego and fuse what they reply.
    """

    own: Floats  # the ego's intent after the fallback, `(..., A)`
    # whether the ego's answer was unusable, so that `own` is the fallback that the settings name,
    # `(...)`
    own_failed: Bools
    entropy_nats: Floats  # entropy of `own` in nats, `(...)`: how unsure the ego is
    # whether the ego asks at least one helper, `(...)`; by default it asks those in the radius if
    # the entropy is above the threshold tau, and nobody without a channel
    triggered: Bools
    asked: Bools  # which helpers are asked; each has a scheduled reply, `(..., H)`
    # which helpers' models answer for this decision, `(..., H)`: those in the radius, asked or not,
    # or on demand those that are asked; none without a channel, or where messages hold no intents
    infers: Bools
    # number of requests broadcast, `(...)`: 1 for all who are asked together, plus 1 of another
    # that asks for the ego; 0 if nobody is asked
    requests: Ints
    request_bits: Floats  # size of all requests, bits, `(...)`; 0 if nobody is asked
    # size of all scheduled replies, and of the policy that another sends, bits, `(...)`
    reply_bits: Floats
    # seconds that the request and the scheduled replies are on air, `(...)`; NaN if the channel
    # model does not know it
    airtime_s: Floats
    # packet loss, the probability that one transmission was lost, `(...)`: the mean over the
    # helpers asked if links differ; NaN without a channel
    loss: Floats
    # whether the helper was asked, and request and reply arrived, `(..., H)`; if another fuses, its
    # policy must have arrived, too
    delivered: Bools
    # when each helper's reply ends where it is fused, by the ego or another, `(..., H)`; inf if it
    # is lost or not asked for
    arrival_s: Floats
    # whether the reply arrived within the decision window and so is fused, `(..., H)`
    on_time: Bools
    exchange_s: Floats  # end of the whole exchange, `(...)`
    # number of scheduled replies in further rounds of asking, as where agents answer each other's
    # plans, `(...)`
    repeats: Ints

    @cached_property
    def normalised_entropy(self) -> Floats:
        """Return how unsure the ego is, from 0 (sure) to 1 (uniform), `(...)`.

        It is the entropy of its intent `own` over A actions, divided by ln A.
        """
        return normalised_entropy(self.own)

    @cached_property
    def messages(self) -> Ints:
        """Return how many replies were asked for in each decision, in all rounds, `(...)`.

        Each helper that is asked has one a round of asking, whether or not it arrives. Requests are
        not counted, as in the paper that this harness follows.
        """
        return count_of(self.asked) + self.repeats

    @cached_property
    def lost(self) -> Ints:
        """Return how many helpers were asked whose reply did not reach the ego, `(...)`."""
        return count_of(self.asked & ~self.delivered)

    @cached_property
    def late(self) -> Ints:
        """Return how many replies came after the decision window, too late to be fused, `(...)`."""
        return count_of(self.delivered & ~self.on_time)

    @cached_property
    def observed_loss(self) -> Floats:
        """Return the share of asked helpers whose reply did not arrive, `(...)`.

        NaN if nobody was asked.
        """
        n_asked = count_of(self.asked)
        return np.where(n_asked > 0, self.lost / np.maximum(n_asked, 1), np.nan)


def exchange(
    point: OperatingPoint, intents: Intents, draws: Draws, asked_helpers: Bools | None = None
) -> Exchange:
    """Play whom the ego asks, and which replies arrive when, in decisions of any shape `(...)`.

    Nothing is fused. An unknown inference time counts as 0 s. Raises UserError if the point needs
    what `intents` or `draws` lack, or if a package's plug-in fails.

    Args:
        point: the operating point: the settings of the radio, of asking helpers and of fusing their
            messages.
        intents: what the ego and its H helpers intend, how far they are and how long they infer.
        draws: the channel's random numbers.
        asked_helpers: mask of the helpers to ask, as far as they are in the ego's radius, `(...,
            H)`; None leaves the choice to the point's schedule, the rule for whom to ask.
    """
    own_failed, inputs = _base_knowledge(point, intents)
    in_radius = inputs.may_ask
    if point.radio.profile is None:
        asked_helpers = np.zeros_like(in_radius)
    elif asked_helpers is None:
        asked_helpers = _chosen(point, inputs, intents, draws)
    else:
        asked_helpers = asked_helpers & in_radius
    request_s, outcome, waits_until_s = _ask_helpers(
        point, intents, asked_helpers, in_radius, draws
    )
    delivered = outcome.up if intents.silent is None else outcome.up & ~intents.silent
    loss, arrival_s = outcome.loss, np.where(delivered, request_s + outcome.end_s, np.inf)
    one_loss = loss.shape[-1] == 1
    # else they infer before they are asked
    in_turn = point.radio.profile is None or point.ask.on_demand
    return Exchange(
        own=inputs.own,
        own_failed=own_failed,
        entropy_nats=inputs.entropy_nats,
        triggered=any_of(asked_helpers),
        asked=outcome.asked,
        infers=point.content.asks_helpers
        & (outcome.asked if in_turn else intents.range_m <= point.ask.radius_m),
        requests=outcome.requests,
        request_bits=outcome.request_bits,
        reply_bits=np.sum(np.where(outcome.asked, intents.payload_bits, 0.0), axis=-1)
        + outcome.policy_bits,
        airtime_s=outcome.airtime_s,
        loss=loss[..., 0]
        if one_loss
        else known_mean(np.where(outcome.asked, loss, np.nan), axis=-1),
        delivered=delivered,
        arrival_s=arrival_s,
        on_time=outcome.fused & (arrival_s <= point.fusion.window_s),
        exchange_s=np.minimum(request_s[..., 0] + outcome.acts_s, waits_until_s),
        repeats=np.zeros(own_failed.shape, dtype=int),
    )


def needed(point: OperatingPoint, intents: Intents, draws: Draws) -> Bools:
    """Return which helpers' answers can change a decision's outcome, to ask no others, `(..., H)`.

    Once the models of all these have answered, the answers of others change nothing. They are the
    helpers that are asked; all in the radius, if the channel's load or the schedule (the rule for
    whom to ask) depends on who would answer; and all present ones, if a group of settings (such as
    an attack's) needs them. `point` has the settings, `intents` what vehicles intend as far as
    their models were asked, and `draws` the channel's random numbers. A helper whose model was not
    asked yet counts as one with a valid answer.
    """
    nobody = np.zeros(intents.range_m.shape, dtype=bool)
    if not point.asks:
        return nobody
    if point.needs_all:
        return nobody | np.isfinite(intents.range_m)
    inputs = _base_knowledge(point, intents)[1]
    if getattr(SCHEDULES[point.ask.schedule], "by_presence", True):
        return inputs.may_ask
    asked_helpers = _chosen(point, inputs, intents, draws)
    coupled = getattr(point.channel, "density_coupled", point.physical is None)
    return (
        any_of(asked_helpers)[..., None] & inputs.may_ask
        if coupled or point.radio.helper_rounds
        else asked_helpers
    )


def _chosen(point: OperatingPoint, inputs: ScheduleInputs, intents: Intents, draws: Draws) -> Bools:
    """Return who is asked by the point's schedule, `(..., H)`."""
    worth = _worth(point, _with_schedule_needs(point, inputs, intents, draws))
    name = point.ask.schedule
    with worded(f"schedule {name}", built_in=SCHEDULES.is_ours(name)):
        return chosen(
            worth, point.ask.above, inputs.may_ask, intents.range_m, point.ask.max_helpers
        )


def _ask_helpers(
    point: OperatingPoint, intents: Intents, asked_helpers: Bools, in_radius: Bools, draws: Draws
) -> tuple[Floats, Consulted, Floats]:
    """Return when the ego asks, `(..., 1)`, the outcome,
    and until when it waits at most, `(...)`.
    """
    intends = point.radio.helper_rounds and INTENTS in point.content.holds
    opens_round = (
        triggered(intents.helpers, point.ask.tau_nats) if intends else np.zeros_like(asked_helpers)
    )
    inference_s = np.nan_to_num(inferred_s(point, intents, draws))
    request_s, helpers_s = inference_s[..., :1], inference_s[..., 1:]

    def ready(has_request_s: Floats | float) -> Floats:
        if point.ask.on_demand:
            ready_s = has_request_s + helpers_s
        else:
            ready_s = np.maximum(helpers_s - request_s, has_request_s)
        if intents.allowed_s is None:
            return ready_s
        return np.maximum(ready_s, intents.allowed_s - request_s)

    links = Links(
        asked_helpers,
        ready(0.0),
        intents.range_m,
        intents.payload_bits,
        in_radius,
        in_radius & opens_round,
        point.request_bits,
        intents.site,
    )
    with worded(f"channel profile {point.radio.profile}", built_in=is_ours(point.channel)):
        until_s = np.maximum(point.fusion.window_s, request_s[..., 0])
        outcome = point.ask_for_ego(links, draws, ready, until_s - request_s[..., 0])
        if outcome is not None:
            return request_s, outcome, until_s
        return request_s, _ask_directly(point.channel, links, draws, ready), np.array(np.inf)


def worth_of(point: OperatingPoint, intents: Intents, draws: Draws) -> Floats:
    """Return what asking each helper is worth, by the operating point's schedule and in its unit.

    A schedule is the rule for whom to ask: helpers whose worth is above its threshold. The shape is
    `(..., H)`, or `(..., 1)` if it is the same for all helpers of a decision. `intents` has what
    the vehicles intend, and `draws` the channel's random numbers. Raises UserError if a package's
    schedule fails.
    """
    return _worth(point, known_of(point, intents, draws))


def _worth(point: OperatingPoint, inputs: ScheduleInputs) -> Floats:
    name, shape = point.ask.schedule, inputs.may_ask.shape
    if SCHEDULES.is_ours(name):
        return SCHEDULES[name].worth(inputs)
    with worded(f"schedule {name}"):
        worth = SCHEDULES[name].worth(read_only(inputs))
        worth = numbers("worths", worth, shape, (*shape[:-1], 1))
        if np.any(np.isnan(worth) & inputs.may_ask):
            raise ValueError("a worth that is NaN for a helper that may be asked")
    return worth


def known_of(point: OperatingPoint, intents: Intents, draws: Draws) -> ScheduleInputs:
    """Return what the ego knows before it asks anybody, by which a schedule says whom to ask.

    The schedule is that of the operating point `point`. `intents` has what vehicles intend, of
    which the ego knows its own, and `draws` the channel's random numbers. Raises UserError if it
    needs positions and the decisions have none, as in the study of the paper that this harness
    follows.
    """
    return _with_schedule_needs(point, _base_knowledge(point, intents)[1], intents, draws)


def _base_knowledge(point: OperatingPoint, intents: Intents) -> tuple[Bools, ScheduleInputs]:
    """Return whether the ego's answer failed, `(...)`, and what it knows under any schedule."""
    failed, n_actions = any_of(np.isnan(intents.own)), intents.own.shape[-1]
    braking = point.fusion.fallback == "brake"
    fallback = np.eye(n_actions)[0] if braking else np.full(n_actions, 1.0 / n_actions)
    ego_intent = np.where(failed[..., None], fallback, intents.own)
    in_radius = intents.valid & (intents.range_m <= point.ask.radius_m)
    return failed, ScheduleInputs(
        ego_intent, entropy_nats(ego_intent), in_radius, intents.range_m, intents.distance_m
    )


def _with_schedule_needs(
    point: OperatingPoint, inputs: ScheduleInputs, intents: Intents, draws: Draws
) -> ScheduleInputs:
    if (point.needs("outlook") and intents.outlook is None) or (
        point.needs("lot") and draws.trips is None
    ):
        raise UserError(NO_SCENE.format(printable(point.ask.schedule)))
    return replace(
        inputs,
        in_time=_in_time(point, intents, inputs.may_ask, draws) if point.needs("in_time") else None,
        outlook=intents.outlook if point.needs("outlook") else None,
        lot=draws.of(".lot").wait if point.needs("lot") else None,
    )


NO_SCENE = (
    "schedule {} needs vehicles that are somewhere, and the paper's study has none; "
    "take `harness eval` or `harness drive`"
)
IMAGINED = 8  # how many imagined exchanges the ego's expectation averages


def _in_time(point: OperatingPoint, intents: Intents, may_ask: Bools, draws: Draws) -> Floats:
    """Return the probability that a reply arrives in the window, `(..., H)`,
    over imagined exchanges.

    These have draws of their own. The transmissions of request and reply count as independent. A
    second path is left out.
    """
    total = np.zeros(may_ask.shape)
    for n in range(IMAGINED):
        own_draws = draws.of(f".imagined-{n}") if draws.trips else draws
        imagined = replace(own_draws, jitter=np.full_like(draws.jitter, (n + 0.5) / IMAGINED))
        request_s, outcome, _ = _ask_helpers(point, intents, may_ask, may_ask, imagined)
        total += (1.0 - outcome.loss) ** 2 * (request_s + outcome.end_s <= point.fusion.window_s)
    return total / IMAGINED


def _ask_directly(
    channel: Channel, links: Links, draws: Draws, ready: Callable[[Floats], Floats]
) -> Consulted:
    """Let the ego ask the helpers itself, and wait until the last slot has ended."""
    request = broadcast(channel, links.request_bits, draws)
    ready_s = ready(heard_s(channel, request, links, draws))
    up, end_s, loss, airtime_s = delivered(channel, replace(links, ready_s=ready_s), draws)
    requested, received = any_of(links.asked), links.asked & up
    replies_s = np.sum(np.where(links.asked, airtime_s, 0.0), axis=-1)
    return Consulted(
        asked=links.asked,
        up=received,
        end_s=end_s,
        fused=received,
        acts_s=np.max(np.where(links.asked, end_s, 0.0), axis=-1, initial=0.0),
        loss=loss,
        requests=requested.astype(int),
        request_bits=np.where(requested, links.request_bits, 0.0),
        policy_bits=np.zeros(requested.shape),
        airtime_s=np.where(requested, request.airtime_s, 0.0) + replies_s,
    )


def inferred_s(point: OperatingPoint, intents: Intents, draws: Draws) -> Floats:
    """Return the seconds from a decision's start until each vehicle has its intent, `(..., 1+H)`.

    Index 0 is the ego and 1+h is helper h. It is how long each one's model takes, by `intents`;
    where `point`, the settings, puts the ego's into a cloud, it has the round trip. Raises
    UserError if that is to be drawn and `draws` are of decisions without a scene, as in the paper's
    study.
    """
    ego_s: Floats | float = intents.inference_s[..., 0]
    if point.cloud.round_trip_s is not None:
        ego_s = point.cloud.round_trip_s
    elif point.network:
        if draws.trips is None:
            raise UserError(
                "round_trip needs layouts, and the paper's study has none; give round_trip_s"
            )
        ego_s = ego_s + point.network.round_trip_s(draws.of(".cloud").wait)
    return np.insert(intents.inference_s[..., 1:], 0, ego_s, axis=-1)
