"""The V2V channel: which replies cross it, and when they have arrived.

A consultation is a round trip, so the request and the reply must both cross. A new model is a file beside
this one, with a frozen record that has `request_s` and `deliver`; its profiles are in `profiles.py`.
"""

from dataclasses import Field, dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.core.arrays import Bools, Floats


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
