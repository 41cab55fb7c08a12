"""The V2V channel: which replies cross it, and when they have arrived.

The profiles are the paper's declared assumptions, not link budgets: nothing here was measured on a
radio. A consultation is a round trip, so the request and the reply must both cross. Fading is block
fading when the caller passes the same uniforms for every step of an episode: a blocked link then
stays blocked.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.core.arrays import Bools, Floats, Ints


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
class Profile:
    """How one radio behaves.

    Attributes:
        name: what operating points call it.
        latency_s: nominal seconds of one exchange, the request included, without serialisation.
        loss: probability that one crossing (request or reply) is lost.
        bandwidth_bps: bits per second while a reply is on air.
        access: `serial`, replies share one medium and are served one after another, so that the k-th
            pays k slots; `parallel`, all replies are on air at once.
        jitter_s: largest extra delay of a reply; the delay is uniform in [0, jitter_s).
    """

    name: str
    latency_s: float
    loss: float
    bandwidth_bps: float
    access: Literal["serial", "parallel"]
    jitter_s: float


PROFILES = {
    profile.name: profile
    for profile in (
        Profile("v2x", latency_s=0.025, loss=0.08, bandwidth_bps=10e6, access="serial", jitter_s=0.0),
        # Jitter is declared, not measured: the slowest of three replies waits 3/4 of it on average, which
        # puts the mean decision at 145 + 5 + 1.4 = 151.4 ms, the paper's figure.
        Profile("6g", latency_s=0.005, loss=0.012, bandwidth_bps=200e6, access="parallel", jitter_s=0.0019),
    )
}

# A vehicle without a radio: no comparison with a NaN loss holds, so nothing ever crosses.
NO_CHANNEL = Profile(
    "none", latency_s=0.0, loss=np.nan, bandwidth_bps=np.inf, access="parallel", jitter_s=0.0
)


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
        loss: probability that one crossing is lost, `(...)`.
        roadside_edge: replies also travel over a roadside edge node. The two paths are declared
            independent, so a reply is lost with probability loss^2. Requests are direct.
    """
    per_helper = np.asarray(loss)[..., None]
    request_up = uniforms[..., 0] >= per_helper
    reply_up = uniforms[..., 1] >= (per_helper**2 if roadside_edge else per_helper)
    return request_up & reply_up


def reply_delay_s(
    profile: Profile,
    asked: Bools,
    ready_s: Floats,
    range_m: Floats,
    payload_bits: Floats,
    jitter_uniforms: Floats,
    roadside_edge: bool = False,
) -> Floats:
    """Seconds from the request to the end of each reply's slot, `(..., H)`; inf where not asked.

    A slot is kept whether or not its reply gets through. On a serial medium slots go to whoever is ready
    first, the nearest first among equals, so a slow helper holds nobody up.

    Args:
        profile: the radio.
        asked: who was asked, `(..., H)`. The other arguments may hold anything where nobody was.
        ready_s: seconds from the request until the helper has its answer, `(..., H)`, 0 if it waits.
        range_m: ego-helper distance, `(..., H)`.
        payload_bits: size of the reply, `(..., H)`.
        jitter_uniforms: draws in [0, 1), `(..., H)`.
        roadside_edge: a reply takes a second hop over a roadside edge node, as long as the first.
    """
    hops = 2 if roadside_edge else 1
    slot_s = hops * (profile.latency_s + payload_bits / profile.bandwidth_bps)
    slot_s = np.where(asked, slot_s + profile.jitter_s * jitter_uniforms, 0.0)
    ready_s = np.where(asked, ready_s, np.inf)
    if profile.access == "parallel":
        return ready_s + slot_s
    order = np.lexsort((range_m, ready_s), axis=-1)
    served_slot_s = np.take_along_axis(slot_s, order, axis=-1)
    busy_s = np.cumsum(served_slot_s, axis=-1)
    # A slot starts when the one before it ends or its helper is ready, whichever is later: the end of
    # slot k is the largest, over j <= k, of ready_j plus the slots j..k.
    waits_s = np.take_along_axis(ready_s, order, axis=-1) - (busy_s - served_slot_s)
    delay_s = np.empty_like(busy_s)
    np.put_along_axis(delay_s, order, busy_s + np.maximum.accumulate(waits_s, axis=-1), axis=-1)
    return delay_s
