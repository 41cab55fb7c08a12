"""Channels that wrap another one and change part of its behaviour."""

from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats, Ints, check_shape, read_only
from harness.radio.channel import REQUEST, Broadcast, ByLink, Channel, Delivery, Draws, Links, Physical, Site


@dataclass(frozen=True)
class Wrapped:
    """A physical channel that forwards everything to another one."""

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
    """Return the innermost channel, without wrappers."""
    return innermost(channel.channel) if isinstance(channel, Wrapped) else channel


def is_ours(channel: Channel) -> bool:
    """Return whether a channel's model is the harness's own, and no package's."""
    return type(innermost(channel)).__module__.startswith("harness.")


def delivered(channel: Channel, links: Links, draws: Draws) -> Delivery:
    """Let a channel deliver. A package's cannot write to what it gets, and what it returns is checked.

    Raises ValueError if that has a wrong shape or type, or states what cannot be of helpers that were asked.
    """
    if is_ours(channel):
        return channel.deliver(links, draws)
    delivery = Delivery(*channel.deliver(read_only(links), read_only(draws)))
    asked, shape = links.asked, links.asked.shape
    check_shape("up", delivery.up, shape)
    if delivery.up.dtype != bool:
        raise ValueError(f"up of type {delivery.up.dtype}, not bool")
    check_shape("delays", delivery.delay_s, shape)
    if not np.all(delivery.delay_s[asked] >= 0.0):
        raise ValueError("a delay that is negative or NaN for a helper that was asked")
    check_shape("losses", delivery.loss, shape, (*shape[:-1], 1))
    if np.any(((delivery.loss < 0.0) | (delivery.loss > 1.0)) & asked):
        raise ValueError("a loss that is no probability")
    check_shape("airtimes", delivery.airtime_s, shape)
    if np.any(delivery.airtime_s[asked] < 0.0):
        raise ValueError("a negative airtime")
    return delivery


def heard_s(channel: Channel, broadcast: Broadcast, links: Links, draws: Draws) -> Floats:
    """Return when each receiver has a broadcast, `(..., H)`, or `(..., 1)` if all have it at once."""
    model = innermost(channel)
    if isinstance(model, ByLink):
        return model.latencies_s(links.where, draws, REQUEST)
    return np.asarray(broadcast.heard_s)[..., None]


@dataclass(frozen=True)
class AtLoss(Wrapped):
    """A physical channel that loses every transmission with one probability, wherever its ends are."""

    probability: float  # probability that one transmission is lost

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        _, delay_s, loss, airtime_s = self.channel.deliver(links, draws)
        up = np.all(draws.packet >= self.probability, axis=-1)
        return Delivery(up, delay_s, np.full_like(loss, self.probability), airtime_s)

    def idle(self, setting: str | None) -> str | None:
        return "its loss is given" if setting == "beyond" else None

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return np.full(np.shape(distance_m), 1 - self.probability)

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        return np.full(site.sight.shape, self.probability)
