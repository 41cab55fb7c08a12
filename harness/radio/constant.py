"""A channel with one latency and one loss for all links:
the paper's declared assumptions, no link budget.

Nothing here was measured on a radio. If the draws of a link are the same at every step of an
episode, fading is block fading: a blocked link stays blocked.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from harness.core.arrays import Bools, Floats, Ints, count_of
from harness.core.config import Seconds
from harness.radio.channel import Broadcast, Delivery, Draws, Links, served_s


@dataclass(frozen=True)
class Radio:
    """Define a channel with one nominal latency and one loss for all links, as the paper has it.

    Both are assumptions: nothing is computed from positions.
    """

    # nominal seconds of one exchange, the request included, without serialisation
    latency_s: Seconds
    # probability that one transmission is lost. If helpers open rounds of their own, it is the loss
    # with that many active vehicles, if that is larger.
    loss: Annotated[float, Meta(ge=0, le=1, description="a probability from 0 to 1")]
    # bits per second while a message is on air
    bandwidth_bps: Annotated[float, Meta(ge=1, le=1e15, description="bits per second, 1 or more")]
    # `serial`: replies share one medium and are served one after another, so the k-th pays k slots;
    # `parallel`: all replies are on air at once
    access: Literal["serial", "parallel"]
    # largest extra delay of a reply's hop; the delay is uniform in [0, jitter_s)
    jitter_s: Seconds = 0.0
    # whether the loss follows from the vehicles in the radius, the ego included, asked or not
    density_coupled: bool = False
    # whether replies also travel over a roadside edge node, in a second hop as long as the first,
    # with its jitter. The two paths are declared independent. Requests are direct.
    roadside_edge: bool = False

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Return when helpers have a request of `bits`: after these divided by the bandwidth.

        The rest of its time is in the nominal latency. `bits` is one number or `(...)`, and the
        times have its shape; `draws` are not used.
        """
        return Broadcast(bits / self.bandwidth_bps, bits / self.bandwidth_bps)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Return whether, and when, the reply of each helper asked, by `links`, is received.

        A serial medium serves the helper first that is ready first, so a slow one delays no other.
        `draws` are the channel's random numbers.
        """
        active = links.in_radius if self.density_coupled else links.rounds
        loss = density_coupled_loss(1 + count_of(active)[..., None])
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
    """Return the probability that one transmission is lost, `(...)`, by the number of vehicles.

    `n_active`, `(...)`, counts the vehicles that load the channel, the ego included. The loss is
    the line through the paper's panel 4 (0.6 % at 2, 6.6 % at 4, 18.6 % at 8 active vehicles),
    clipped to [0, 1]; a single vehicle loses nothing.
    """
    return np.where(n_active > 1, np.clip(0.006 + 0.03 * (n_active - 2), 0.0, 1.0), 0.0)


def link_up(uniforms: Floats, loss: Floats, roadside_edge: bool = False) -> Bools:
    """Return a mask of the helpers, of H, whose request and reply are both received, `(..., H)`.

    The probability is (1 - loss)^2. `uniforms` are draws in [0, 1) of each helper's request and
    reply, `(..., H, 2)`; `loss` is the probability that one transmission is lost, `(..., H)` or
    `(..., 1)`. With `roadside_edge`, an antenna beside the road, a reply has a second path, so that
    it is lost with probability loss^2.
    """
    return (uniforms[..., 0] >= loss) & (uniforms[..., 1] >= (loss**2 if roadside_edge else loss))
