"""Compute the sizes of requests and replies by how messages are encoded.

    json  compact JSON without a signature or headers, the paper's profiles' default
    etsi  CPMs, and containers of our own for intents and requests, in PER; signed, with a digest of
          the certificate, which beacons carry now and then
    sae   SDSMs, and the same

The background's packets are then CAMs or BSMs. Under a physical radio the headers of network and
transport count as well; those of the radio are its own.
"""

import numpy as np

from harness.coordination.contents import Content
from harness.coordination.intents import Intents
from harness.core.arrays import Floats
from harness.radio import messages
from harness.radio.messages import NAMES, Counts, Encoding, message_bits, packet_bits

JSON = "json"
ENCODINGS = (JSON, *NAMES)
SAYS = '{"from":"v2","says":""}'  # what compact JSON puts around words


def reply_bits(encoding: str, content: Content, intents: Intents, headers: bool) -> Floats:
    """Return the size of each helper's reply, `(..., H)`; one that holds both is two messages."""
    bits = np.zeros(intents.payload_bits.shape)
    text_bytes = 0.0 if intents.text_bytes is None else intents.text_bytes
    if content.words and encoding == JSON:
        bits += 8 * (len(SAYS) + text_bytes)
    elif content.asks_helpers or content.plan:
        holds_intent = content.intent or content.plan
        counts = Counts(actions=intents.own.shape[-1] * holds_intent, text_bytes=text_bytes)
        bits += (
            intents.payload_bits
            if encoding == JSON
            else _packet(encoding, "intent", counts, headers)
        )
    if content.graph:
        assert intents.object_bits is not None
        assert intents.objects is not None
        counts = Counts(objects=intents.objects)
        bits += (
            intents.object_bits
            if encoding == JSON
            else _packet(encoding, "objects", counts, headers)
        )
    return bits


def request_bits(encoding: str, helpers: int, headers: bool) -> float:
    """Return the size of a request to so many helpers, by an encoding that is not `json`."""
    return float(_packet(encoding, "request", Counts(helpers=helpers), headers))


def beacon_bytes(encoding: str, rate_hz: float) -> int:
    """Return the mean size of a vehicle's beacons by an encoding that is not `json`,
    at so many a second.
    """
    return messages.beacon_bytes(_standard(encoding), rate_hz)


def _standard(encoding: str) -> Encoding:
    return "sae" if encoding == "sae" else "etsi"


def _packet(encoding: str, content: str, counts: Counts, headers: bool) -> Floats:
    name = NAMES[_standard(encoding)][content]
    return packet_bits(name, message_bits(name, counts), headers=headers)
