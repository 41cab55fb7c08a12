"""Messages over physical radios: their time on air, beacons that load a channel,
and `harness radio messages`.
"""

import json
import math
import re
from collections.abc import Callable
from dataclasses import asdict

import pytest
from reference import DOCS

from harness.coordination.operating_point import OperatingPoint
from harness.extensions.radio.its_g5 import ItsG5
from harness.extensions.radio.messages import NAMES, packet_bits
from harness.radio.profiles import CHANNELS


def test_beacons_load_the_channel_with_the_size_that_their_encoding_gives():
    for profile in ("its-g5", "mode2"):
        declared = OperatingPoint.of("p", profile)
        at_20_hz = declared.changed(encoding="etsi").of_radio({"rate_hz": "20"})
        written_out = at_20_hz.of_radio({"packet_bytes": "300"})
        assert asdict(at_20_hz.channel)["packet_bytes"] == math.ceil(178 + 141 / 20)
        assert asdict(written_out.channel)["packet_bytes"] == 300
        assert declared.channel == CHANNELS[profile]
    assert OperatingPoint.of("p", "mode4", encoding="etsi").channel == CHANNELS["mode4"]


@pytest.mark.parametrize("name", [name for names in NAMES.values() for name in names.values()])
def test_a_radio_adds_headers_of_its_own(name: str):
    radio, packet = ItsG5(), packet_bits(name, 800.0)
    assert radio.message_s(packet) == radio.airtime_s(packet / 8 + radio.header_bytes)


def test_the_command_shows_bytes_members_and_time_on_air(
    harness: Callable[..., tuple[int, str, str]],
):
    code, out, _ = harness("radio", "messages", "--objects", "2", "--channel", "its-g5")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    assert re.search(r"^CPM +77 +94 +44 +215 +356 +0\.38$", out, re.MULTILINE)
    code, out, _ = harness("radio", "messages", "CPM", "--no-optional", "--json")
    found = json.loads(out)
    assert found["content"]["optional"] is False
    (row,) = found["messages"]
    assert sum(member["bits"] for member in found["members"]) == row["packet_bits"]
    assert all(member["source"] for member in found["members"])
    code, out, _ = harness("radio", "messages", "CPM")
    assert max(map(len, out.splitlines())) <= 80
    assert re.search(r"^envelope\.signature\.r +256$", out, re.MULTILINE)


def test_the_page_on_radios_states_what_the_command_counts(
    harness: Callable[..., tuple[int, str, str]],
):
    page = " ".join((DOCS / "radio.md").read_text().split())
    rows = json.loads(harness("radio", "messages", "--channel", "its-g5", "--json")[1])["messages"]
    cpm, intent = (row for row in rows if row["message"] in ("CPM", "etsi-intent"))
    cpm_bytes, intent_bytes = (row["packet_bits"] / 8 for row in (cpm, intent))
    times = f"{cpm['airtime_s'] * 1000:.2f} and {intent['airtime_s'] * 1000:.2f} ms on air"
    assert f"takes {cpm_bytes:.0f} bytes and one of an intent {intent_bytes:.0f}, {times}" in page
    assert f"{cpm['envelope_bits'] / 8:.0f} of these are the envelope" in page


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (["CPN"], "unknown message 'CPN'; did you mean 'CPM'?"),
        (["--objects", "300"], "--objects 300 is out of range; give 0 to 255"),
        (["--channel", "6g"], "--channel 6g: give a physical radio, such as its-g5"),
    ],
)
def test_a_wrong_argument_is_one_line(
    harness: Callable[..., tuple[int, str, str]], typed: list[str], message: str
):
    code, out, err = harness("radio", "messages", *typed)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
