"""Sizes of messages: bit for bit those of an encoder,
and by the values that each member may have.
"""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.extensions.radio.messages import (
    NAMES,
    PSIDS,
    Counts,
    Member,
    beacon_bytes,
    message_bits,
    packet_bits,
    shares,
    size,
    table,
    wraps,
)

# What pycrate writes: benchmarks/message_sizes.py.
ENCODED = json.loads((Path(__file__).parents[2] / "golden/message-sizes.json").read_text())
MESSAGES = [name for names in NAMES.values() for name in names.values()]
ROWS = [member for members in table().values() for member in members]
counts = st.integers(0, 200)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_has_the_bits_that_an_encoder_writes(name: str):
    cases = [dict(case) for case in ENCODED["messages"] if case["message"] == name]
    assert len(cases) > 2
    for case in cases:
        bits, content = (
            case.pop("bits"),
            Counts(**{key: case[key] for key in case if key != "message"}),
        )
        assert sum(share.bits for share in shares(name, content)[:-1]) == bits, case
        assert message_bits(name, content) == 8 * math.ceil(bits / 8)


def test_an_envelope_has_the_bits_that_an_encoder_writes():
    names = {psid: name for name, psid in PSIDS.items()}
    for case in ENCODED["envelopes"]:
        age_s = math.inf if case["certificate"] else 0.0
        signed = packet_bits(names[case["psid"]], case["payload_bits"], age_s, headers=False)
        assert signed == case["bits"], case


def by_values(values: str) -> int:
    """Return the bits of a member by the values that it may have (X.691)."""
    extensible = values.endswith(", extensible")
    values = values.removesuffix(", extensible")
    if ends := re.fullmatch(r"(-?\d+)\.\.(-?\d+)", values):
        bits = (int(ends[2]) - int(ends[1])).bit_length()
    else:
        number, unit = re.fullmatch(r"(\d+) (bits|octets?|options|values)", values).groups()
        each = {"values": (int(number) - 1).bit_length(), "octets": 8 * int(number), "octet": 8}
        bits = each.get(unit, int(number))
    return bits + extensible


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.type}.{row.member}")
def test_a_row_has_the_bits_of_its_values_or_a_type_and_a_source(row: Member):
    assert row.source
    if row.bits is None:
        assert row.values.split()[-1] in table()
    elif row.bits:
        assert by_values(row.values) == row.bits
    else:
        assert row.each == "never"


def test_every_type_stands_in_a_message_or_a_layer():
    used = {row.values.split()[-1] for row in ROWS if row.bits is None}
    layers = {
        "envelope",
        *(f"{encoding}-{layer}" for encoding in NAMES for layer in ("network", "link")),
    }
    assert set(table()) == used | set(MESSAGES) | layers


@pytest.mark.parametrize("name", MESSAGES)
@given(
    st.tuples(counts, st.booleans(), st.integers(0, 23), counts, counts, st.integers(1, 200)),
    st.data(),
)
@settings(max_examples=40)
def test_more_content_never_takes_less_and_arrays_are_as_one_at_a_time(
    name: str, parts: Any, data: Any
):
    place = data.draw(st.sampled_from([0, 2, 3, 4, 5]))
    more = [part + (at == place and (part < 23 or at != 2)) for at, part in enumerate(parts)]
    both = message_bits(name, Counts(*map(np.array, zip(parts, more, strict=True))))
    assert np.broadcast_to(both, 2).tolist() == [
        message_bits(name, Counts(*c)) for c in (parts, more)
    ]
    assert np.all(np.diff(both) >= 0)
    assert np.all(both % 8 == 0)


def test_who_lists_nothing_sends_a_cpm_but_no_sdsm():
    none = Counts(objects=0)
    assert message_bits("CPM", none) > 0
    assert size("SDSM", none) == (0, 0, 0, 0, 0)
    with pytest.raises(ValueError, match="SDSM of 257 objects: it lists 256 at most"):
        message_bits("SDSM", Counts(objects=np.array([3, 257])))


def test_beacons_load_the_channel_with_the_size_that_their_encoding_gives():
    """By hand: one CAM in ten and one BSM in five has the 141 bytes of a certificate more."""
    assert beacon_bytes("etsi", 10) == math.ceil(178 + 141 / 10)
    assert beacon_bytes("sae", 10) == math.ceil(138 + 141 / 5)
    assert beacon_bytes("sae", 0) == 138 + 141


def test_the_certificate_goes_along_when_it_is_due():
    age_s = np.array([0.0, 0.9, 1.0, 5.0])
    packets = packet_bits("CAM", 328, age_s) / 8
    assert packets.tolist() == [178, 178, 319, 319]
    signed = packet_bits("CAM", np.array([328, 0, 328, 328]), age_s, headers=False) / 8
    assert signed.tolist() == [134, 0, 275, 275]
    assert (packet_bits("BSM", 320, np.array([0.44, 0.45])) / 8).tolist() == [138, 279]


@pytest.mark.parametrize("name", MESSAGES)
def test_headers_are_those_of_network_and_transport_and_no_radios(name: str):
    taken = wraps(name, 800.0)
    headers = sum(
        share.bits for share in taken if share.path[0] != "envelope" and share.path[-1] != "length"
    )
    etsi = name in NAMES["etsi"].values()
    assert headers / 8 == (44 if etsi else 3 if name == "BSM" else 4)
    assert packet_bits(name, 800.0) == 800 + sum(share.bits for share in taken)
