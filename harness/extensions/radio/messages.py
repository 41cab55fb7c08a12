"""The bits of messages by the encoding rules of the standards.

`messages.csv` lists the members of each message: what values a member may have, the bits of one,
how often it is there, and where it is defined. Messages are in unaligned PER (ITU-T X.691): an
integer of n values takes the bits of n - 1, as do an enumeration and a choice; an optional member
of a sequence takes one bit more, and so does whatever may be extended. An open type fills whole
octets, behind their number. The signed envelope is in OER (X.696), whole octets throughout. So no
size depends on values, only on how much is listed.

    etsi   CAM (TS 103 900, and bit for bit EN 302 637-2), CPM (TS 103 324), GeoNetworking and BTP-B
    sae    BSM (J2735), SDSM (J3224), WSMP (IEEE 1609.3)
    both   the envelope of IEEE 1609.2 by the profile of TS 103 097: a digest of the sender's
           certificate, and now and then the certificate

No standard has a message for an intent or for its request. Theirs are containers of our own, made
of the standards' elements. All sizes are held against an encoder (`benchmarks/message_sizes.py`).

A condition's `encoding` chooses one (`harness.coordination.encodings`).
"""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.core.files import text_of

Encoding = Literal["etsi", "sae"]
Count = Floats | Bools | float
# Message by encoding and content. A text is an intent without probabilities.
NAMES: Mapping[Encoding, Mapping[str, str]] = {
    "etsi": {"beacon": "CAM", "objects": "CPM", "intent": "etsi-intent", "request": "etsi-request"},
    "sae": {"beacon": "BSM", "objects": "SDSM", "intent": "sae-intent", "request": "sae-request"},
}
MOST = {"CPM": 255, "SDSM": 256}  # objects in one message
# Seconds after which a message has the certificate again: TS 103 097 7.1.1, and CertAttachInt of
# J2945/1 as Rostami, Krishnan and Gruteser (2018), table 1, give it. TS 103 097 adds one for new
# neighbours, left out.
CERTIFICATE_EVERY_S: Mapping[Encoding, float] = {"etsi": 1.0, "sae": 0.45}
# Number of an application (ITS-AID in TS 102 965, PSID in IEEE 1609.12). A container of ours has
# none yet: in its place is any that takes two octets.
PSIDS, OTHER_PSID = {"CAM": 36, "BSM": 32, "CPM": 639, "SDSM": 144}, 1000
# Sizes in octets from which the number of octets takes one octet more: X.691 11.9, X.696 8.6.
LENGTHS = {"open": (0, 128), "opaque": (0, 128, 256)}


class Counts(NamedTuple):
    """Hold how much a message lists: numbers, or arrays that broadcast against each other.

    A message uses those that apply to it. CAM and BSM are beacons, CPM and SDSM lists of `objects`
    that a vehicle sees, with `optional` members or without, each by ETSI and by SAE. An intent
    states the probabilities of so many `actions`, with `text_bytes` of words, and a request asks so
    many `helpers` for theirs. `points` are those of the path behind, in a beacon.
    """

    objects: Count = 0  # listed in a CPM or SDSM
    # whether objects have what is optional and scene graphs know: in a CPM speed, heading and
    # class, in an SDSM class and lights
    optional: Count = True
    points: Count = 0  # of the path behind, in a CAM's low-frequency container or a BSM's part II
    actions: Count = 0  # whose probabilities are in an intent
    text_bytes: Count = 0  # of an intent's evidence, the words beside its probabilities
    helpers: Count = 1  # whom a request asks


class Member(NamedTuple):
    """Hold a row of `messages.csv`: a member (field) of a message by its standard, and its bits.

    The `member` is one of the message or sequence `type`, may have the `values`, and takes `bits`,
    None if that follows from its type. There is one for `each` of what this names, such as a field
    of `Counts`; empty if there is one in all. `source` is where the standard defines it.
    """

    type: str  # the message or sequence that it is a member of
    member: str  # name of the member
    # what it may be; or its type, `open` or `opaque` if that is in octets behind their number
    values: str
    bits: int | None  # its size; None where that follows from its type
    # what there is one of it for, such as a field of `Counts`; empty if there is one in all
    each: str
    source: str  # where the standard defines it


class Share(NamedTuple):
    """Hold the bits of a member (field) in a message, all its occurrences together.

    `path` has the names of the member and of those that it is in, the outermost first. `bits` is an
    array if a number in `Counts`, on which it depends, is one. `source` is where the standard
    defines it.
    """

    path: tuple[str, ...]  # names of the member and of those that it is in, the outermost first
    bits: Floats  # their sum; an array where a count that it depends on is one
    source: str  # where the standard defines it


class Size(NamedTuple):
    """Hold the sizes of a message in bits: arrays where a count that it depends on is one.

    `message` is the message alone, `envelope` its signature and the digest of the sender's
    certificate, `headers` those of network and transport, and `packet` all three;
    `with_certificate` is the packet with the whole certificate.
    """

    message: Floats  # the message alone
    envelope: Floats  # its signed envelope, with the digest of the sender's certificate
    headers: Floats  # of network and transport
    packet: Floats  # all three
    with_certificate: Floats  # the packet with the whole certificate instead of its digest


@cache
def table() -> Mapping[str, tuple[Member, ...]]:
    """Return the rows of `messages.csv`: the members (fields) of each message or sequence type.

    The key is the type's name, such as `CAM`; members are in the order of the file.
    """
    members: dict[str, tuple[Member, ...]] = {}
    for row in csv.DictReader(text_of(Path(__file__).with_name("messages.csv")).splitlines()):
        bits = int(row.pop("bits") or -1)
        member = Member(**row, bits=None if bits < 0 else bits)
        members[member.type] = (*members.get(member.type, ()), member)
    return members


def message_bits(name: str, content: Counts) -> Floats:
    """Return the size of a message in bits, whole octets; 0 where none is sent.

    `name` is one of `NAMES`, such as CPM, and `content` what it lists, which gives the shape. An
    SDSM lists at least one object, so a vehicle that sees none sends none.

    Raises:
        ValueError: more objects than the message may list.
    """
    bits, objects = _total(shares(name, content)), np.asarray(content.objects)
    if name in MOST and np.any(objects > MOST[name]):
        raise ValueError(f"{name} of {np.max(objects):g} objects: it lists {MOST[name]} at most")
    return np.where(objects > 0, bits, 0.0) if name == "SDSM" else bits


def shares(name: str, content: Counts) -> list[Share]:
    """Return how many bits each member (field) of a message takes; the last entry is the padding.

    `name` is one of `NAMES`, such as CPM (a list of objects seen), and `content` says how much it
    lists, such as objects.
    """
    counts = {**content._asdict(), "path": np.asarray(content.points) > 0}
    members = list(_shares(name, counts, 1.0, ()))
    return [*members, Share(("filling",), -_total(members) % 8, "X.691 11.1")]


def packet_bits(
    name: str, bits: Floats | float, since_certificate_s: Floats | float = 0.0, headers: bool = True
) -> Floats:
    """Return the size of a message of so many bits with envelope and headers, bits; 0 stays 0.

    Args:
        name: a message of `NAMES`, such as CPM.
        bits: size of the message alone, a number or `(...)`, as is the result.
        since_certificate_s: seconds since the sender's last message with its whole certificate, by
            which this one has it or only its digest.
        headers: whether the headers of network and transport count.
    """
    bits = np.asarray(bits, dtype=float)
    return np.where(bits > 0, bits + _total(wraps(name, bits, since_certificate_s, headers)), 0.0)


def wraps(
    name: str, bits: Floats | float, since_certificate_s: Floats | float = 0.0, headers: bool = True
) -> list[Share]:
    """Return the bits of each member of a message's signed envelope, and of its headers.

    The headers are those of network and transport.

    Args:
        name: a message of `NAMES`, such as CPM.
        bits: the size of the message alone.
        since_certificate_s: seconds since the sender's last message with its certificate. From
            `CERTIFICATE_EVERY_S` on this one has it, else the certificate's digest.
        headers: whether those of GeoNetworking and BTP-B, or of WSMP, count. Those of the radio
            never do: a channel's model adds its own.
    """
    encoding = _encoding_of(name)
    certificate = np.asarray(since_certificate_s) >= CERTIFICATE_EVERY_S[encoding]
    psid = PSIDS.get(name, OTHER_PSID)
    counts: dict[str, Count] = {
        "psid": 1 + (psid > 255),
        "p_encoded_psid": 1 + (psid > 127),
        "certificate": certificate,
        "digest": ~certificate,
    }
    added, octets = list[Share](), np.asarray(bits, dtype=float) / 8
    for layer in (
        (f"{encoding}-network", "envelope", f"{encoding}-link") if headers else ("envelope",)
    ):
        inside = _shares(layer, {**counts, "payload": octets}, 1.0, (layer,))
        own_shares = [share for share in inside if share.path[-1] != "content"]
        octets = octets + _total(own_shares) / 8
        added += own_shares
    return added


def size(name: str, content: Counts) -> Size:
    """Return the size of a message in bits: alone, with its signed envelope, and with headers.

    `name` is one of `NAMES`, such as CPM (a list of objects seen), and `content` says how much it
    lists.
    """
    bits = message_bits(name, content)
    signed, packet = packet_bits(name, bits, headers=False), packet_bits(name, bits)
    return Size(bits, signed - bits, packet - signed, packet, packet_bits(name, bits, np.inf))


def beacon_bytes(encoding: Encoding, rate_hz: float) -> int:
    """Return the mean size of a vehicle's beacons, by which it tells its pose, bytes, rounded up.

    `encoding` names the standard (its beacon is a CAM or a BSM), and `rate_hz` is beacons a second.
    They have no path history. Now and then one has the certificate, by `CERTIFICATE_EVERY_S`.
    """
    beacon = size(NAMES[encoding]["beacon"], Counts())
    every = max(1, math.ceil(CERTIFICATE_EVERY_S[encoding] * rate_hz))
    return math.ceil((beacon.packet + (beacon.with_certificate - beacon.packet) / every) / 8)


@dataclass(frozen=True)
class Standard:
    """Compute the sizes of messages by a standard, ETSI's or SAE's, for radios that send them.

    The setting `encoding` of radio, asking and fusion names it. `packet_bits` returns the size of a
    packet by what it holds, and `beacon_bytes` that of a beacon, by which a vehicle tells its pose.
    """

    encoding: Encoding  # the standard's name

    def packet_bits(self, holds: str, headers: bool, **counts: Count) -> Floats:
        name = NAMES[self.encoding][holds]
        return packet_bits(name, message_bits(name, Counts(**counts)), headers=headers)

    def beacon_bytes(self, rate_hz: float) -> int:
        return beacon_bytes(self.encoding, rate_hz)


ETSI, SAE = Standard("etsi"), Standard("sae")


def _encoding_of(name: str) -> Encoding:
    return next(encoding for encoding, names in NAMES.items() if name in names.values())


def _total(shares: Iterable[Share]) -> Floats:
    return np.asarray(sum(share.bits for share in shares), dtype=float)


def _shares(
    kind: str, counts: Mapping[str, Count], times: Floats | float, path: tuple[str, ...]
) -> Iterator[Share]:
    """Yield the shares of a type's members;
    one in octets behind their number is there once at most.
    """
    for member in table()[kind]:
        here = (*path, member.member)
        number = np.asarray(times * (counts.get(member.each, 0) if member.each else 1), dtype=float)
        if member.bits is not None:
            yield Share(here, number * member.bits, member.source)
            continue
        wrap, _, inner = member.values.rpartition(" ")
        inside = list(_shares(inner, counts, number, here))
        yield from inside
        if wrap:
            bits = _total(inside)
            octets = np.ceil(bits / 8)
            length = np.searchsorted(LENGTHS[wrap], octets, side="right")
            yield Share(
                (*here, "length"), number * (8 * (length + octets) - bits), "X.691 11.9, X.696 8.6"
            )
