"""`harness parse`, run as a user does."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

COMPLETIONS = Path(__file__).parents[1] / "completions"


def harness(*arguments: str, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "harness", "parse", *arguments], input=stdin, capture_output=True
    )


def test_a_table_says_status_repairs_and_distribution() -> None:
    done = harness(str(COMPLETIONS / "y_recovered_fence_json.txt"), "--scenario", "occluded-intersection")
    rows = dict(line.split(None, 1) for line in done.stdout.decode().splitlines())
    assert done.returncode == 0
    assert rows["status"].startswith("recovered:")
    assert rows["repair"].startswith("code_fence:")
    assert [rows[name] for name in ("SLOWER", "IDLE", "FASTER", "mass")] == [
        "0.7000",
        "0.2000",
        "0.1000",
        "1.0000",
    ]


def test_json_has_the_intent_by_action_and_the_helpers_message() -> None:
    done = harness(str(COMPLETIONS / "y_strict_helper_distribution.txt"), "--role", "helper", "--json")
    parsed = json.loads(done.stdout)
    assert parsed["verdict"] == "strict"
    assert parsed["intent"] == {"SLOWER": 0.5, "IDLE": 0.4, "FASTER": 0.1}
    assert parsed["message"]["risk"] == "medium"
    assert parsed["repairs"] == []


def test_a_failed_verdict_is_data_and_exits_with_zero() -> None:
    text = b'{"action_distribution": {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}'
    done = harness("-", "--finish-reason", "length", "--json", stdin=text)
    assert done.returncode == 0
    assert json.loads(done.stdout)["status"] == "truncated_json"
    assert (
        json.loads(harness("-", "--thinking", "--json", stdin=text).stdout)["status"] == "truncated_reasoning"
    )


def test_bytes_that_are_no_utf8_are_replaced_and_said_so() -> None:
    done = harness("-", stdin=b'\xff{"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}')
    assert done.returncode == 0
    assert b"note: not UTF-8 from byte 0 on" in done.stderr
    assert b"prose_around" in done.stdout


def test_hostile_text_cannot_reach_the_terminal() -> None:
    text = (
        rb'{"evidence": "\u001b[31mred", "risk": "low", "recommended_maneuver": "\u001b[2J", "confidence": 1}'
    )
    assert b"\x1b" not in harness("-", "--role", "helper", stdin=text).stdout
    assert b"\x1b" not in harness("-", "--role", "helper", stdin=text.replace(rb"\u001b[2J", b"IDLE")).stdout


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["absent.txt"], "harness: cannot read completion file 'absent.txt': No such file or directory;"),
        (["."], "harness: cannot read completion file '.': Is a directory;"),
        (["-", "--role", "egg"], "harness: unknown role 'egg'; did you mean 'ego'? known: ego, helper"),
        (
            ["-", "--scenario", "roundabout"],
            "harness: unknown scenario 'roundabout'; did you mean 'roundabout-entry'? known: blind-merge,",
        ),
        (
            ["-", "--finish-reason", "lenght"],
            "harness: unknown finish reason 'lenght'; did you mean 'length'?",
        ),
    ],
)
def test_bad_input_is_one_line_and_exits_with_two(arguments: list[str], line: str) -> None:
    done = harness(*arguments)
    assert done.returncode == 2
    assert done.stdout == b""
    assert done.stderr.decode().startswith(line)
    assert len(done.stderr.splitlines()) == 1


def test_a_device_without_an_end_is_one_line() -> None:
    done = harness("/dev/zero")
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, b"", 1)
    assert done.stderr.startswith(b"harness: ")
