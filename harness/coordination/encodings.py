"""Compute the sizes of requests and replies by how messages are encoded.

    json  compact JSON without a signature or headers, the paper's profiles' default
    etsi  CPMs, and containers of our own for intents and requests, in PER; signed, with a digest of
          the certificate, which beacons carry now and then
    sae   SDSMs, and the same

The background's packets are then CAMs or BSMs. Under a physical radio the headers of network and
transport count as well; those of the radio are its own.
"""

import numpy as np

from harness.coordination.intents import Intents
from harness.core.arrays import Floats
from harness.radio import messages
from harness.radio.messages import NAMES, Counts, Encoding, message_bits, packet_bits

JSON = "json"
ENCODINGS = (JSON, *NAMES)
SAYS = '{"from":"v2","says":""}'  # what compact JSON puts around words


def intent_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's message with its intent and its words, `(..., H)`.

    `headers` adds those of network and transport, except under `json`.
    """
    if encoding == JSON:
        return intents.payload_bits
    counts = Counts(actions=intents.own.shape[-1], text_bytes=_text_bytes(intents))
    return _replies(encoding, "intent", counts, intents, headers)


def words_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's message with its words alone, `(..., H)`.

    `headers` adds those of network and transport, except under `json`.
    """
    if encoding == JSON:
        return 8 * (len(SAYS) + _text_bytes(intents))
    counts = Counts(text_bytes=_text_bytes(intents))
    return _replies(encoding, "intent", counts, intents, headers)


def object_bits(encoding: str, intents: Intents, headers: bool) -> Floats:
    """Return the size in bits of each helper's list of detected objects, `(..., H)`.

    `intents` must have `objects` and `object_bits`. `headers` adds those of network and transport,
    except under `json`.
    """
    assert intents.object_bits is not None
    assert intents.objects is not None
    if encoding == JSON:
        return intents.object_bits
    return _replies(encoding, "objects", Counts(objects=intents.objects), intents, headers)


def request_bits(encoding: str, helpers: int, headers: bool) -> float:
    """Return the size in bits of a request to `helpers` vehicles; `encoding` is `etsi` or `sae`."""
    return float(_packet(encoding, "request", Counts(helpers=helpers), headers))


def beacon_bytes(encoding: str, rate_hz: float) -> int:
    """Return the mean size in bytes of a vehicle's beacons, sent `rate_hz` times a second.

    `encoding` is `etsi` (CAM) or `sae` (BSM).
    """
    return messages.beacon_bytes(_standard(encoding), rate_hz)


def _text_bytes(intents: Intents) -> Floats:
    if intents.text_bytes is None:
        return np.zeros(intents.payload_bits.shape)
    return intents.text_bytes


def _replies(
    encoding: str, content: str, counts: Counts, intents: Intents, headers: bool
) -> Floats:
    """Return the size of a message of each helper, `(..., H)`, by a standard's encoding."""
    bits = _packet(encoding, content, counts, headers)
    return np.broadcast_to(bits, intents.payload_bits.shape)


def _standard(encoding: str) -> Encoding:
    return "sae" if encoding == "sae" else "etsi"


def _packet(encoding: str, content: str, counts: Counts, headers: bool) -> Floats:
    name = NAMES[_standard(encoding)][content]
    return packet_bits(name, message_bits(name, counts), headers=headers)
