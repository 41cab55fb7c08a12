"""One cooperative decision, from seeing to acting, for any number of scenes at once.

The timeline, in seconds from the start of the decision:

    0                     every vehicle sees the scene; ego and helpers infer in parallel
    infer_s[0]            the ego has its own intent. Sure enough, or nobody to ask: it acts now.
                          Unsure: it broadcasts its request to the nearest helpers in its radius
    max(infer_s[0],       a helper has the request and its own intent, and its reply can leave
        infer_s[1+h])
    + slots               replies are on air, one after another or at once, as the profile says
    arrival_s[h]          the end of the helper's slot, if request and reply crossed; else inf
    window_s              what has arrived by now is fused
    latency_s             the end of the last slot: the ego also waits out a lost or late reply

The paper counts the whole exchange as the decision's latency even when it outlasts the window, and so
does this. Everything here is a pure function of arrays; the ego is vehicle 0, helpers are 1..H.
"""

from dataclasses import dataclass, replace

import numpy as np

from harness.arrays import Bools, Floats, Ints
from harness.channel import NO_CHANNEL, PROFILES, Profile, density_coupled_loss, link_up, reply_delay_s
from harness.consensus import RULES, inverse_distance_weights
from harness.operating_point import OperatingPoint
from harness.trigger import entropy_nats, normalised_entropy, triggered


@dataclass(frozen=True)
class Luck:
    """The channel's draws in [0, 1); one operating point sees the same as another.

    Attributes:
        link: request and reply of each helper, `(..., H, 2)`. Equal for all steps of an episode under
            block fading.
        jitter: delay of each reply, `(..., H)`.
    """

    link: Floats
    jitter: Floats


@dataclass(frozen=True)
class Coordination:
    """What happened in each decision. Times are seconds from the start of the decision.

    Attributes:
        own: the ego's intent after the fallback, `(..., A)`.
        own_failed: the ego's answer was unusable and `own` is the fallback, `(...)`.
        entropy_nats: entropy of `own`, `(...)`.
        normalised_entropy: the same over ln A, `(...)`.
        triggered: the entropy is above tau and the point has a channel, `(...)`.
        asked: helpers asked, each a scheduled reply, `(..., H)`.
        loss: probability that one crossing was lost, `(...)`; NaN without a channel.
        delivered: asked, and request and reply crossed, `(..., H)`.
        arrival_s: end of the reply, `(..., H)`; inf where lost or not asked.
        on_time: arrived within the window, so fused, `(..., H)`.
        weights: each vehicle's weight in the policy, `(..., 1+H)`.
        fused: the policy, `(..., A)`.
        action: index of its most probable action, `(...)`. A tie goes to the earlier action, so list
            actions the most conservative first.
        latency_s: end of the whole exchange, `(...)`; the paper's `latency_proxy`.
        deadline_missed: the exchange outlasted the window, `(...)`.
        messages: replies scheduled, `(...)`. As in the paper's count, the request is none.
        lost: of these, how many did not arrive, `(...)`.
        late: of these, how many arrived after the window, `(...)`.
    """

    own: Floats
    own_failed: Bools
    entropy_nats: Floats
    normalised_entropy: Floats
    triggered: Bools
    asked: Bools
    loss: Floats
    delivered: Bools
    arrival_s: Floats
    on_time: Bools
    weights: Floats
    fused: Floats
    action: Ints
    latency_s: Floats
    deadline_missed: Bools
    messages: Ints
    lost: Ints
    late: Ints


def coordinate(
    point: OperatingPoint,
    own: Floats,
    helpers: Floats,
    valid: Bools,
    distance_m: Floats,
    range_m: Floats,
    payload_bits: Floats,
    infer_s: Floats,
    luck: Luck,
) -> Coordination:
    """Trigger, channel and consensus for decisions `(...)` with up to H helpers and A actions each.

    Args:
        point: the operating point.
        own: the ego's intent, `(..., A)`; a row with a NaN is a failed answer.
        helpers: helpers' intents, `(..., H, A)`.
        valid: the helper exists and its answer parsed, `(..., H)`. Any other sends nothing, takes no
            slot, and may hold NaN in every array.
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`, the ego first.
        range_m: distance to the ego, `(..., H)`.
        payload_bits: size of the reply, `(..., H)`.
        infer_s: seconds of inference, `(..., 1+H)`, the ego first.
        luck: the channel's draws.
    """
    profile = NO_CHANNEL if point.profile is None else PROFILES[point.profile]
    if point.profile is not None and point.latency_s is not None:
        profile = replace(profile, latency_s=point.latency_s)
    own_failed = np.any(np.isnan(own), axis=-1)
    own = np.where(own_failed[..., None], fallback_intent(point.fallback, own.shape[-1]), own)
    asks = triggered(own, point.tau_nats) & (point.profile is not None)

    in_radius = valid & (range_m <= point.radius_m)
    asked = asks[..., None] & nearest(in_radius, range_m, point.max_helpers)
    loss = crossing_loss(point, profile, in_radius, triggered(helpers, point.tau_nats))
    delivered = asked & link_up(luck.link, loss, point.roadside_edge)

    request_s = infer_s[..., :1]
    ready_s = np.maximum(infer_s[..., 1:] - request_s, 0.0)
    delay_s = reply_delay_s(profile, asked, ready_s, range_m, payload_bits, luck.jitter, point.roadside_edge)
    slot_end_s = request_s + delay_s
    arrival_s = np.where(delivered, slot_end_s, np.inf)
    on_time = arrival_s <= point.window_s
    ends_s = np.concatenate([request_s, np.where(asked, slot_end_s, request_s)], axis=-1)
    latency_s = np.max(ends_s, axis=-1)

    weights = inverse_distance_weights(distance_m, on_time, point.min_distance_m)
    fused = RULES[point.consensus](np.concatenate([own[..., None, :], helpers], axis=-2), weights)
    return Coordination(
        own=own,
        own_failed=own_failed,
        entropy_nats=entropy_nats(own),
        normalised_entropy=normalised_entropy(own),
        triggered=asks,
        asked=asked,
        loss=loss,
        delivered=delivered,
        arrival_s=arrival_s,
        on_time=on_time,
        weights=weights,
        fused=fused,
        action=np.argmax(fused, axis=-1),
        latency_s=latency_s,
        deadline_missed=latency_s > point.window_s,
        messages=np.sum(asked, axis=-1),
        lost=np.sum(asked & ~delivered, axis=-1),
        late=np.sum(delivered & ~on_time, axis=-1),
    )


def fallback_intent(fallback: str, n_actions: int) -> Floats:
    """What a failed ego answer becomes, `(A,)`: `uniform`, or `brake`, sure of the first action."""
    if fallback == "brake":
        first: Floats = np.eye(1, n_actions)[0]
        return first
    return np.full(n_actions, 1.0 / n_actions)


def nearest(candidates: Bools, range_m: Floats, most: int) -> Bools:
    """The `most` nearest of the candidates, `(..., H)`; of equals, the earlier ones."""
    order = np.argsort(np.where(candidates, range_m, np.inf), axis=-1, kind="stable")
    rank = np.argsort(order, axis=-1, kind="stable")
    return candidates & (rank < most)


def crossing_loss(point: OperatingPoint, profile: Profile, in_radius: Bools, unsure: Bools) -> Floats:
    """Probability that one crossing is lost, `(...)`: the point's, the swarm's or the profile's.

    Under density coupling every valid helper in the radius `(..., H)` is an active vehicle, asked or
    not, and so is the ego. Where helpers open rounds of their own, those that are unsure `(..., H)` are
    active beside the ego, and the loss is that of so many if it is the larger.
    """
    if point.profile is not None and point.density_coupled:
        return density_coupled_loss(1 + np.sum(in_radius, axis=-1))
    overridden = point.profile is not None and point.loss is not None
    loss = np.full(in_radius.shape[:-1], point.loss if overridden else profile.loss)
    if point.profile is not None and point.helper_rounds:
        loss = np.maximum(loss, density_coupled_loss(1 + np.sum(in_radius & unsure, axis=-1)))
    return loss
