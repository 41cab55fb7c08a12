"""A roadside unit: an antenna with a link to each vehicle, which relays replies or fuses them.

Its links are the channel's: the unit is one end, with its own antenna height and its own obstacles
to each vehicle. Their shadowing and packets are drawn separately, so a unit changes no other link.
In both modes `delay_s` lies between the end of what the unit receives and what it sends for that:
its processing and its backhaul.

As a relay it sends every reply that reaches it once more. As a place of fusion it gets the ego's
request and intent, asks the helpers, fuses, and sends the ego a policy. An intent or a policy alone
counts as large as a request: a distribution over three actions is about 50 bytes of compact JSON.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from harness.core.arrays import Floats
from harness.radio.channel import Antenna, ByLink, Delivery, Draws, Links, Physical
from harness.radio.consulted import Consulted
from harness.radio.wrapped import (
    Wrapped,
    broadcast,
    delivered,
    heard_s,
    innermost,
    link_loss,
)

EGO, HELPERS = slice(0, 1), slice(1, None)  # a unit's link to the ego, and those to the helpers


@dataclass(frozen=True)
class Relay(Wrapped):
    """Add to a channel a roadside unit, an antenna beside the road, that sends replies once more.

    A helper's reply arrives if it reaches the ego, or the unit and from there the ego. The ego
    takes the one that comes first: the direct one, unless latencies depend on the positions. The
    unit repeats every reply, needed or not, since it cannot know, and what it sends does not wait
    for other messages.
    """

    unit: Antenna  # position and antenna height of the unit
    delay_s: float  # seconds from a reply's end at the unit until its copy is to be sent

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Return which replies arrive, directly or by the unit, and when the first of both does.

        `links` has, for the ego and each helper, who was asked and what is sent; `draws` are the
        channel's random numbers. A lost reply keeps its slot on the medium, and that of its
        repetition if there is one.
        """
        up, delay_s, loss, airtime_s = delivered(self.channel, links, draws)
        shadow = partial(draws.shadow, links.where.xy_m)
        has_request = draws.packet[..., 0] >= link_loss(
            self.channel, links.where, shadow, links.request_bits
        )
        at_unit = links.where.antennas[self.unit]
        there = delivered(
            self.channel,
            replace(links, asked=links.asked & has_request, site=at_unit.select(HELPERS)),
            draws.of(".roadside").requested,
        )
        heard = there.up & links.asked & has_request
        copies = draws.of(".roadside-ego")
        copy = broadcast(self.channel, links.payload_bits, replace(copies, given=copies.packet))
        ego_site = at_unit.select(EGO)
        to_ego, shadow = replace(links, site=ego_site), partial(copies.of_one.shadow, ego_site.xy_m)
        copied = heard & (
            copies.packet[..., 1] >= link_loss(self.channel, ego_site, shadow, links.payload_bits)
        )
        if isinstance(innermost(self.channel), ByLink):
            at_unit_s, copy_s = there.delay_s, heard_s(self.channel, copy, to_ego, copies)
        else:  # all links are as slow, and each copy waits for a turn of its own
            at_unit_s, copy_s = delay_s, np.asarray(copy.heard_s)
        copy_end_s = at_unit_s + self.delay_s + copy_s
        first_s = np.where(copied, np.minimum(delay_s, copy_end_s), delay_s)
        return Delivery(
            up | copied,
            np.where(heard & ~up, copy_end_s, first_s),
            loss,
            airtime_s + np.where(heard, copy.airtime_s, 0.0),
        )


def by_unit(
    channel: Physical,
    unit: Antenna,
    delay_s: float,
    links: Links,
    draws: Draws,
    ready: Callable[[Floats], Floats],
    left_s: Floats,
) -> Consulted:
    """Play a roadside unit, an antenna beside the road, that asks helpers and fuses for the ego.

    It sends the ego a policy, the probabilities of the ego's actions. It does so when the last
    reply's slot has ended, but not so late that its own wait and time on air take the policy out of
    the window: it knows the slot that it has taken, or a table's latency, and until when the ego
    waits. An ego without a policy by then acts alone. Returns whom the unit heard, and when the ego
    has the policy.

    Args:
        channel: the channel between vehicles.
        unit: position and antenna height of the unit.
        delay_s: seconds from the end of what the unit receives until it sends what follows.
        links: the links of the ego and its H helpers; their `ready_s` is not used.
        draws: the channel's random numbers.
        ready: returns when replies can leave, `(..., H)`, from when helpers have the request, of
            the same shape or `(..., 1)`; both in s from the start of the ego's request.
        left_s: seconds from the start of the ego's request until the ego waits for a policy no
            longer, `(...)`.
    """
    bits, at_unit = links.request_bits, links.where.antennas[unit]
    ego_link, helper_links = (replace(links, site=at_unit.select(ends)) for ends in (EGO, HELPERS))
    to_ego, to_helpers = draws.of(".roadside-ego"), draws.of(".roadside")
    one_link = to_ego.of_one
    back_draw = one_link.wait
    request_draw, policy_draw = np.moveaxis(one_link.packet[..., 0, :], -1, 0)

    def lost(size_bits: float) -> Floats:
        shadow = partial(one_link.shadow, ego_link.where.xy_m)
        return link_loss(channel, ego_link.where, shadow, size_bits)[..., 0]

    wanted = np.any(links.asked, axis=-1)
    to_unit = broadcast(channel, 2 * bits, draws)
    reached = wanted & (request_draw >= lost(2 * bits))
    ask = broadcast(channel, bits, to_helpers)
    unit_s = heard_s(channel, to_unit, ego_link, one_link)
    ready_s = ready(unit_s + delay_s + heard_s(channel, ask, helper_links, to_helpers))
    is_asked = links.asked & reached[..., None]
    replies = delivered(channel, replace(helper_links, asked=is_asked, ready_s=ready_s), to_helpers)
    back = broadcast(channel, bits, replace(to_ego, given=back_draw[..., None]))
    back_s = delay_s + heard_s(channel, back, ego_link, draws.of(".roadside-policy").of_one)[..., 0]
    latest_s = left_s - back_s
    sent = reached & (latest_s >= unit_s[..., 0])
    crossed = sent & (policy_draw >= lost(bits))
    replied_s = np.max(np.where(is_asked, replies.delay_s, 0.0), axis=-1, initial=0.0)
    up = is_asked & replies.up & (crossed | ~sent)[..., None]
    parts = ((wanted, to_unit), (reached, ask), (sent, back))
    airtime_s = sum(np.where(happened, part.airtime_s, 0.0) for happened, part in parts)
    return Consulted(
        asked=is_asked,
        up=up,
        end_s=replies.delay_s,
        fused=up & crossed[..., None] & (replies.delay_s <= latest_s[..., None]),
        acts_s=np.where(
            wanted, np.where(crossed, np.minimum(replied_s + back_s, left_s), left_s), 0.0
        ),
        loss=replies.loss,
        requests=wanted.astype(int) + reached,
        request_bits=bits * (2.0 * wanted + reached),
        policy_bits=bits * sent,
        airtime_s=airtime_s + np.sum(np.where(is_asked, replies.airtime_s, 0.0), axis=-1),
    )
