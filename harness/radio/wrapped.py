"""Channels that wrap another one and change part of its behaviour."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.core import strangers
from harness.core.arrays import ROUNDING, Floats, Ints, check_shape, numbers, read_only
from harness.radio.channel import (
    REQUEST,
    Broadcast,
    ByLink,
    Channel,
    Delivery,
    Draws,
    Links,
    Physical,
    Site,
)


@dataclass(frozen=True)
class Wrapped:
    """Wrap `channel`, a physical one, and forward everything to it; a base class.

    A physical channel is one whose losses follow from the vehicles' positions. Subclasses change
    part of what the channel does.
    """

    channel: Physical  # the wrapped channel

    @property
    def decorrelation_m(self) -> float:
        return self.channel.decorrelation_m

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        return self.channel.request(bits, draws)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        return self.channel.deliver(links, draws)

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return self.channel.reception(distance_m, sight)

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        return self.channel.loss(site, shadow, bits)

    def busy_ratio(self) -> float:
        return self.channel.busy_ratio()


def innermost(channel: Channel) -> Channel:
    """Return the channel within all wrappers of `channel`, or itself if nothing wraps it.

    A wrapper is a `Wrapped`, which changes part of what another channel does.
    """
    return innermost(channel.channel) if isinstance(channel, Wrapped) else channel


def is_ours(channel: Channel) -> bool:
    """Return whether a channel's model, and what wraps it, are the harness's own code.

    If not, they are a package's, and what they return must be checked.
    """
    if not strangers.is_ours(channel):
        return False
    return not isinstance(channel, Wrapped) or is_ours(channel.channel)


def delivered(channel: Channel, links: Links, draws: Draws) -> Delivery:
    """Return which replies are received on a channel, and when, as `Channel.deliver` does.

    `links` has who was asked and what is sent; `draws` are the channel's random numbers. The model
    of another package gets arrays that it cannot write to, and its results are checked. Raises
    ValueError if one has a wrong shape or type, or an impossible value for a helper that was asked.
    """
    if is_ours(channel):
        return channel.deliver(links, draws)
    up, delay_s, loss, airtime_s = channel.deliver(read_only(links), read_only(draws))
    is_asked, shape = links.asked, links.asked.shape
    check_shape("up", up, shape)
    if up.dtype != bool:
        raise ValueError(f"up of type {up.dtype}, not bool")
    delay_s = numbers("delays", delay_s, shape)
    if not np.all((delay_s[is_asked] >= 0.0) & (delay_s[is_asked] < np.inf)):
        raise ValueError("a delay that is negative, infinite or NaN for a helper that was asked")
    early = is_asked & (delay_s < links.ready_s - ROUNDING)
    if early.any():
        raise ValueError(
            f"a reply that ends {delay_s[early][0]:g} s after the request, and is ready after "
            f"{links.ready_s[early][0]:g} s"
        )
    loss = numbers("losses", loss, shape, (*shape[:-1], 1))
    if not np.all(((loss >= 0.0) & (loss <= 1.0)) | ~is_asked):
        raise ValueError("a loss that is no probability for a helper that was asked")
    airtime_s = numbers("airtimes", airtime_s, shape)
    if np.any((airtime_s[is_asked] < 0.0) | np.isinf(airtime_s[is_asked])):
        raise ValueError("an airtime that is negative or infinite for a helper that was asked")
    return Delivery(np.array(up), delay_s, loss, airtime_s)


def broadcast(channel: Channel, bits: Floats | float, draws: Draws) -> Broadcast:
    """Return when a request of so many bits is received on a channel, as `Channel.request` does.

    `bits` is one number for all decisions or `(...)`; `draws` are the channel's random numbers.
    Times of another package's model are checked. Raises ValueError for one that is negative or
    infinite; NaN is one that is unknown.
    """
    if is_ours(channel):
        return channel.request(bits, draws)
    times = channel.request(bits, read_only(draws))
    given = map(np.asarray, (times.heard_s, times.airtime_s))
    heard_s, airtime_s = (numbers("times of a request", each, each.shape) for each in given)
    for each in (heard_s, airtime_s):
        if np.any((each < 0.0) | np.isinf(each)):
            raise ValueError("a request whose time is negative or infinite")
    return Broadcast(heard_s, airtime_s)


def heard_s(channel: Channel, request: Broadcast, links: Links, draws: Draws) -> Floats:
    """Return when each of H receivers has a broadcast, in s from the wish to send, `(..., H)`.

    It is `(..., 1)` if all have it at once. `request` is what `broadcast` returned for it; `links`
    has the receivers' positions, and `draws` are the channel's random numbers.
    """
    model = innermost(channel)
    if isinstance(model, ByLink):
        if is_ours(model):
            return model.latencies_s(links.where, draws, REQUEST)
        times_s = model.latencies_s(read_only(links.where), read_only(draws), REQUEST)
        return numbers("latencies", times_s, links.where.sight.shape)
    return np.asarray(request.heard_s)[..., None]


def link_loss(
    channel: Physical, site: Site, shadow: Callable[[float], Floats], bits: Floats | float
) -> Floats:
    """Return the probability that one transmission is lost on each of H links, `(..., H)`.

    The model of another package gets arrays that it cannot write to, and its results are checked.
    Raises UserError if it fails, or if a loss is no probability.

    Args:
        channel: the channel.
        site: the positions of both ends of each link; those of a missing helper are NaN.
        shadow: returns each link's shadowing, `(..., H)`, given the distance in m at which its
            correlation is 1/e (`Physical.loss`).
        bits: the transmission's size, one for all or `(..., H)`.
    """
    if is_ours(channel):
        return channel.loss(site, shadow(channel.decorrelation_m), bits)
    with strangers.worded(label(channel)):
        distance_m = float(channel.decorrelation_m)
        if not distance_m > 0.0:
            raise ValueError(f"decorrelation_m of {distance_m:g}")
        shadows = shadow(distance_m)
        given = channel.loss(read_only(site), read_only(shadows), read_only(bits))
        losses = numbers("losses", given, shadows.shape, (*shadows.shape[:-1], 1))
        is_there = ~np.isnan(site.xy_m[..., 1:, 0])
        if not np.all(((losses >= 0.0) & (losses <= 1.0)) | ~is_there):
            raise ValueError("a loss that is no probability")
    return losses


def busy_ratio(channel: Physical) -> float:
    """Return the share of time, 0 to 1, that a channel is busy; NaN where its model does not know.

    Raises UserError if the model of another package fails, or returns something else.
    """
    if is_ours(channel):
        return channel.busy_ratio()
    with strangers.worded(label(channel)):
        ratio = float(channel.busy_ratio())
        if not 0.0 <= ratio <= 1.0 and not np.isnan(ratio):
            raise ValueError(f"a busy ratio of {ratio:g}")
    return ratio


def label(channel: Channel) -> str:
    """Return what messages call a channel of a package, by its class and module."""
    return strangers.label("channel", innermost(channel))


@dataclass(frozen=True)
class AtLoss(Wrapped):
    """Wrap a physical channel so that each transmission is lost with the same `probability`.

    A physical channel is one whose losses follow from positions; its times stay as they are.
    """

    probability: float  # probability that one transmission is lost

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        _, delay_s, loss, airtime_s = self.channel.deliver(links, draws)
        up = np.all(draws.packet >= self.probability, axis=-1)
        return Delivery(up, delay_s, np.full_like(loss, self.probability), airtime_s)

    def idle(self, setting: str | None) -> str | None:
        return "its loss is given" if setting in getattr(self.channel, "of_loss", ()) else None

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return np.full(np.shape(distance_m), 1 - self.probability)

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        return np.full(site.sight.shape, self.probability)
