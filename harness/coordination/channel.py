"""The V2V channel: which replies cross it, and when they have arrived.

A channel is a frozen record with one method. The two built in are the paper's declared assumptions, not link
budgets: nothing here was measured on a radio. A consultation is a round trip, so the request and the reply
must both cross. Fading is block fading when the caller passes the same uniforms for every step of an episode:
a blocked link then stays blocked.

A new profile is an entry of `CHANNELS`; a new model is a class with `deliver`. A package adds either by an
entry point in the group `swarmdrive.channels`.
"""

from dataclasses import Field, dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.plugins import Plugins


@dataclass(frozen=True)
class Draws:
    """The channel's draws in [0, 1); every operating point has the same.

    Attributes:
        link: request and reply of each helper, `(..., H, 2)`. Equal for all steps of an episode under
            block fading.
        jitter: delay of each reply, `(..., H)`.
    """

    link: Floats
    jitter: Floats

    def take(self, at: Any) -> "Draws":
        """The draws at these places of the leading dimension."""
        return Draws(self.link[at], self.jitter[at])


@dataclass(frozen=True)
class Links:
    """What a channel may need to know of the links between the ego and its helpers.

    Attributes:
        asked: who was asked, `(..., H)`. What is said of the others may be anything, NaN included.
        ready_s: seconds from the start of the request until the helper has heard it and has its own answer,
            `(..., H)`.
        range_m: ego-helper distance, `(..., H)`, as the ego knows it: a beacon's error off the true one.
        payload_bits: size of the reply, `(..., H)`.
        in_radius: who is there and in the ego's radius, asked or not, `(..., H)`.
        rounds: which of these open a round of their own, `(..., H)`.
    """

    asked: Bools
    ready_s: Floats
    range_m: Floats
    payload_bits: Floats
    in_radius: Bools
    rounds: Bools


class Delivery(NamedTuple):
    """What a channel does to the replies.

    Attributes:
        up: request and reply cross, `(..., H)`; anything where not asked.
        delay_s: seconds from the request to the end of the reply's slot, `(..., H)`; inf where not asked. A
            lost reply keeps its slot.
        loss: probability that one crossing (request or reply) is lost, `(..., H)`, or `(..., 1)` where all
            links have the same.
        airtime_s: seconds that the reply occupies the medium, `(..., H)`; anything where not asked, NaN where
            the model does not know.
    """

    up: Bools
    delay_s: Floats
    loss: Floats
    airtime_s: Floats


@runtime_checkable
class Channel(Protocol):
    """A frozen dataclass. The operating point's overrides replace the fields of these names."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def request_s(self, bits: float) -> float:
        """Seconds that a broadcast request of so many bits is on air; then the helpers have it."""

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """What happens to the request and the reply of each link."""


@dataclass(frozen=True)
class Radio:
    """A channel with a nominal latency and one loss for all links.

    Attributes:
        latency_s: nominal seconds of one exchange, the request included, without serialisation.
        loss: probability that one crossing is lost. Where helpers open rounds of their own, the loss under
            so many active vehicles, if that is larger.
        bandwidth_bps: bits per second while a message is on air.
        access: `serial`, replies share one medium and are served one after another, so that the k-th
            pays k slots; `parallel`, all replies are on air at once.
        jitter_s: largest extra delay of a reply's hop; the delay is uniform in [0, jitter_s).
        density_coupled: the loss follows from the vehicles in the radius, the ego included, asked or not.
        roadside_edge: replies also travel over a roadside edge node, in a second hop as long as the first,
            its jitter included. The two paths are declared independent. Requests are direct.
    """

    latency_s: float
    loss: float
    bandwidth_bps: float
    access: Literal["serial", "parallel"]
    jitter_s: float
    density_coupled: bool = False
    roadside_edge: bool = False

    def request_s(self, bits: float) -> float:
        """Serialisation alone: the rest of a request's time is in the nominal latency."""
        return bits / self.bandwidth_bps

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """A serial medium serves whoever is ready first, so a slow helper holds nobody up."""
        active = links.in_radius if self.density_coupled else links.rounds
        loss = density_coupled_loss(1 + np.sum(active, axis=-1, keepdims=True))
        loss = loss if self.density_coupled else np.maximum(self.loss, loss)
        hops = 2 if self.roadside_edge else 1
        airtime_s = hops * links.payload_bits / self.bandwidth_bps
        slot_s = hops * (self.latency_s + self.jitter_s * draws.jitter) + airtime_s
        slot_s = np.where(links.asked, slot_s, 0.0)
        ready_s = np.where(links.asked, links.ready_s, np.inf)
        serial = self.access == "serial"
        delay_s = served_s(ready_s, slot_s, links.range_m) if serial else ready_s + slot_s
        return Delivery(link_up(draws.link, loss, self.roadside_edge), delay_s, loss, airtime_s)


def density_coupled_loss(n_active: Ints) -> Floats:
    """Loss of one crossing when `n_active` vehicles `(...)`, the ego included, share the channel.

    The line through the paper's panel 4 (0.6 % at 2, 6.6 % at 4, 18.6 % at 8 active vehicles), clipped
    to [0, 1]; a vehicle alone loses nothing.
    """
    return np.where(n_active > 1, np.clip(0.006 + 0.03 * (n_active - 2), 0.0, 1.0), 0.0)


def link_up(uniforms: Floats, loss: Floats, roadside_edge: bool = False) -> Bools:
    """Which helpers are reached and heard, `(..., H)`: both crossings succeed, probability (1 - loss)^2.

    Args:
        uniforms: draws in [0, 1), `(..., H, 2)`: the request's and the reply's.
        loss: probability that one crossing is lost, `(..., H)` or `(..., 1)`.
        roadside_edge: a reply has a second path, and so is lost with probability loss^2.
    """
    return (uniforms[..., 0] >= loss) & (uniforms[..., 1] >= (loss**2 if roadside_edge else loss))


def served_s(ready_s: Floats, slot_s: Floats, range_m: Floats) -> Floats:
    """When each slot `(..., H)` on a serial medium ends: first come, first served; of equals, the nearest."""
    order = np.lexsort((range_m, ready_s), axis=-1)
    served_slot_s = np.take_along_axis(slot_s, order, axis=-1)
    busy_s = np.cumsum(served_slot_s, axis=-1)
    # A slot starts when the one before it ends or its helper is ready, whichever is later: the end of
    # slot k is the largest, over j <= k, of ready_j plus the slots j..k.
    waits_s = np.take_along_axis(ready_s, order, axis=-1) - (busy_s - served_slot_s)
    end_s = np.empty_like(busy_s)
    np.put_along_axis(end_s, order, busy_s + np.maximum.accumulate(waits_s, axis=-1), axis=-1)
    return end_s


CHANNELS: Plugins[Channel] = Plugins(
    "swarmdrive.channels",
    Channel,
    {
        "v2x": Radio(latency_s=0.025, loss=0.08, bandwidth_bps=10e6, access="serial", jitter_s=0.0),
        # Jitter is declared, not measured: the slowest of three replies waits 3/4 of it on average, which
        # puts the mean decision at 145 + 5 + 1.4 = 151.4 ms, the paper's figure.
        "6g": Radio(latency_s=0.005, loss=0.012, bandwidth_bps=200e6, access="parallel", jitter_s=0.0019),
    },
)

# A vehicle without a radio: no comparison with a NaN loss holds, so nothing ever crosses.
NO_CHANNEL = Radio(latency_s=0.0, loss=np.nan, bandwidth_bps=np.inf, access="parallel", jitter_s=0.0)
