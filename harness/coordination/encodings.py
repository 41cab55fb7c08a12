"""Compute the sizes of requests and replies by how messages are encoded.

`json` is compact JSON without a signature or headers, the paper's profiles' default. Encodings by
standards are an extension's; under a physical radio the headers of network and transport count as
well, and the background's packets are then their beacons. The radio's headers are its own.
"""

from typing import Literal, Protocol, runtime_checkable

import numpy as np

from harness.coordination.intents import Intents
from harness.core.arrays import Floats
from harness.core.plugins import Shipped

JSON = "json"
Held = Literal["intent", "objects", "request", "beacon"]


@runtime_checkable
class Encoding(Protocol):
    """Compute how large messages are as a standard encodes them; `json` needs no such class.

    An extension adds one under the name that the setting `encoding` gives.
    """

    def packet_bits(self, holds: Held, headers: bool, **counts: Floats | float) -> Floats:
        """Return the size in bits of messages as this standard encodes them, 0 where none is sent.

        The result has the shape of `counts`.

        Args:
            holds: what they are: an `intent` with its words, a list of `objects`, a `request`, or a
                `beacon`, the sender's pose.
            headers: whether those of network and transport count.
            counts: how much each holds, a number or an array with one value for each message:
                `actions` and `text_bytes` of an intent, `objects` that are listed, `helpers` whom a
                request asks.
        """

    def beacon_bytes(self, rate_hz: float) -> int:
        """Return the mean size in bytes of the messages in which a vehicle broadcasts its pose.

        They are beacons, sent `rate_hz` times a second; the channel's load follows from it.
        """


ENCODINGS = Shipped[Encoding]("swarmdrive.encodings", Encoding, {})  # those beside `json`
SAYS = '{"from":"v2","says":""}'  # what compact JSON puts around words


def intent_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's message with its intent and its words, `(..., H)`.

    An intent is probabilities of the ego's actions. `encoding` is how messages are written, `json`
    or one of `ENCODINGS`; `intents` has what H helpers say in decisions `(...)`. `headers` adds
    those of network and transport, except under `json`.
    """
    if encoding == JSON:
        return intents.payload_bits
    actions, text_bytes = intents.own.shape[-1], _text_bytes(intents)
    bits = ENCODINGS[encoding].packet_bits(
        "intent", headers, actions=actions, text_bytes=text_bytes
    )
    return np.broadcast_to(bits, intents.payload_bits.shape)


def words_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's message with its words alone, `(..., H)`.

    `encoding` is how messages are written, `json` or one of `ENCODINGS`; `intents` has what H
    helpers say in decisions `(...)`. `headers` adds those of network and transport, except under
    `json`.
    """
    if encoding == JSON:
        return 8 * (len(SAYS) + _text_bytes(intents))
    bits = ENCODINGS[encoding].packet_bits("intent", headers, text_bytes=_text_bytes(intents))
    return np.broadcast_to(bits, intents.payload_bits.shape)


def object_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's list of detected objects, `(..., H)`.

    `encoding` is how messages are written, `json` or one of `ENCODINGS`. `intents`, of decisions
    `(...)` with H helpers, must have `objects` and `object_bits`. `headers` adds those of network
    and transport, except under `json`.
    """
    assert intents.object_bits is not None
    assert intents.objects is not None
    if encoding == JSON:
        return intents.object_bits
    bits = ENCODINGS[encoding].packet_bits("objects", headers, objects=intents.objects)
    return np.broadcast_to(bits, intents.payload_bits.shape)


def request_bits(encoding: str, helpers: int, headers: bool) -> float:
    """Return the size in bits of the message in which the ego asks so many helpers.

    `encoding` is one of `ENCODINGS`, not `json`. `headers` says whether those of network and
    transport count.
    """
    return float(ENCODINGS[encoding].packet_bits("request", headers, helpers=helpers))


def beacon_bytes(encoding: str, rate_hz: float) -> int:
    """Return the mean size in bytes of the messages in which a vehicle broadcasts its pose.

    They are beacons, sent `rate_hz` times a second; the channel's load follows from it. `encoding`
    is one of `ENCODINGS`, the standards by which messages are written, not `json`.
    """
    return ENCODINGS[encoding].beacon_bytes(rate_hz)


def _text_bytes(intents: Intents) -> Floats:
    if intents.text_bytes is None:
        return np.zeros(intents.payload_bits.shape)
    return intents.text_bytes
