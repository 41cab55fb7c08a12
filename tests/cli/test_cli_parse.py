"""`harness prompt parse`, run as a user does."""

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.core import resources

COMPLETIONS = Path(__file__).parents[1] / "completions"
Parse = Callable[..., tuple[int, str, str]]


@pytest.fixture
def parse(harness: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch) -> Parse:
    """The command as typed, with these bytes on stdin: its exit code, and what it said."""

    def typed(*arguments: str, stdin: bytes = b"") -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin)))
        return harness("prompt", "parse", *arguments)

    return typed


def test_a_table_says_status_repairs_and_distribution(parse: Parse) -> None:
    file = COMPLETIONS / "y_recovered_fence_json.txt"
    code, out, _ = parse(str(file), "--scenario", "occluded-intersection")
    rows = dict(line.split(None, 1) for line in out.splitlines())
    assert code == 0
    assert rows["status"].startswith("recovered:")
    assert rows["repair"].startswith("code_fence:")
    assert [rows[name] for name in ("SLOWER", "IDLE", "FASTER", "mass")] == [
        "0.7000",
        "0.2000",
        "0.1000",
        "1.0000",
    ]


def test_json_has_the_intent_by_action_and_the_helpers_message(parse: Parse) -> None:
    _, out, _ = parse(
        str(COMPLETIONS / "y_strict_helper_distribution.txt"), "--role", "helper", "--json"
    )
    parsed = json.loads(out)
    assert parsed["verdict"] == "strict"
    assert parsed["intent"] == {"SLOWER": 0.5, "IDLE": 0.4, "FASTER": 0.1}
    assert parsed["message"]["risk"] == "medium"
    assert parsed["repairs"] == []


@pytest.mark.parametrize(
    ("version", "role", "text", "status"),
    [
        ("v4", "ego", '{"maneuver": "IDLE", "confidence": 0.8}', "label_only"),
        ("v9", "ego", '{"maneuver": "IDLE", "confidence": 0.8}', "strict"),
        (
            "v5",
            "ego",
            'So: {"action_distribution": {"SLOWER": 1, "IDLE": 0, "FASTER": 0}}',
            "strict",
        ),
        (
            "v4",
            "ego",
            'So: {"action_distribution": {"SLOWER": 1, "IDLE": 0, "FASTER": 0}}',
            "recovered",
        ),
        ("mine", "ego", '{"sure": true, "maneuver": "IDLE", "confidence": 0.8}', "strict"),
        ("mine", "ego", '{"sure": 2, "maneuver": "IDLE", "confidence": 0.8}', "recovered"),
    ],
)
def test_a_prompt_says_what_was_asked_for(
    version: str, role: str, text: str, status: str, parse: Parse, tmp_path: Path
) -> None:
    (tmp_path / resources.MARKER).touch()
    shutil.copytree(resources.find("prompts", "v9"), tmp_path / "prompts/mine")
    (tmp_path / "prompts/mine/answer.json").write_text('{"ego": {"sure": {"type": "boolean"}}}')
    _, out, _ = parse("-", "--prompt", version, "--role", role, "--json", stdin=text.encode())
    parsed = json.loads(out)
    assert parsed["status"] == status
    assert parsed["extension"] == ({"sure": True} if "true" in text else None)
    rows = dict(
        line.split(None, 1)
        for line in parse("-", "--prompt", version, stdin=text.encode())[1].splitlines()
    )
    assert rows.get("sure") == ("true" if "true" in text else None)


def test_a_failed_verdict_is_data_and_exits_with_zero(parse: Parse) -> None:
    text = b'{"action_distribution": {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}'
    code, out, _ = parse("-", "--finish-reason", "length", "--json", stdin=text)
    assert code == 0
    assert json.loads(out)["status"] == "truncated_json"
    assert (
        json.loads(parse("-", "--thinking", "--json", stdin=text)[1])["status"]
        == "truncated_reasoning"
    )


def test_bytes_that_are_no_utf8_are_replaced_and_said_so() -> None:
    command = [sys.executable, "-m", "harness", "prompt", "parse", "-"]
    said = b'\xff{"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}'
    done = subprocess.run(command, input=said, capture_output=True)
    assert done.returncode == 0
    assert b"note: not UTF-8 from byte 0 on" in done.stderr
    assert b"prose_around" in done.stdout


def test_hostile_text_cannot_reach_the_terminal(parse: Parse) -> None:
    text = (
        rb'{"evidence": "\u001b[31mred", "risk": "low", "recommended_maneuver": "\u001b[2J", '
        rb'"confidence": 1}'
    )
    assert "\x1b" not in parse("-", "--role", "helper", stdin=text)[1]
    assert (
        "\x1b" not in parse("-", "--role", "helper", stdin=text.replace(rb"\u001b[2J", b"IDLE"))[1]
    )


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["absent.txt"],
            "harness: cannot read completion file 'absent.txt': No such file or directory;",
        ),
        (["."], "harness: cannot read completion file '.': Is a directory;"),
        (
            ["-", "--role", "egg"],
            "harness: unknown role 'egg'; did you mean 'ego'? known: ego, helper",
        ),
        (
            ["-", "--scenario", "roundabout-entri"],
            "harness: unknown scenario 'roundabout-entri'; did you mean 'roundabout-entries'? "
            "known: ",
        ),
        (
            ["-", "--finish-reason", "lenght"],
            "harness: unknown finish reason 'lenght'; did you mean 'length'?",
        ),
    ],
)
def test_bad_input_is_one_line_and_exits_with_two(
    parse: Parse, arguments: list[str], line: str
) -> None:
    code, out, err = parse(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith(line)
    assert len(err.splitlines()) == 1


def test_a_device_without_an_end_is_one_line(parse: Parse) -> None:
    code, out, err = parse("/dev/zero")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith("harness: ")


def test_a_pipe_is_read_where_the_shell_hands_it_over_and_refused_by_its_name(parse: Parse) -> None:
    os.mkfifo("pipe")
    code, out, err = parse("pipe")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert (
        "it is no file, but a pipe or a device; give a text file, or - for what is piped in" in err
    )
    reads, writes = os.pipe()
    os.write(writes, (COMPLETIONS / "y_recovered_fence_json.txt").read_bytes())
    os.close(writes)
    code, out, _ = parse(f"/dev/fd/{reads}")
    os.close(reads)
    assert (code, out.split()[0]) == (0, "status")


def test_a_byte_order_mark_is_no_part_of_an_answer(parse: Parse) -> None:
    text = (COMPLETIONS / "y_recovered_fence_json.txt").read_bytes()
    assert parse("-", stdin=b"\xef\xbb\xbf" + text) == parse("-", stdin=text)
