"""A command whose reader has left, as `| head` does, ends without a word;
one whose disk is full says so.
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from run_on_disk import made_up

SPEAK = (("--help",), ("run", "ls", "."))
TOO = (
    ("eval", "--limit", "1", "--seeds", "0"),
    ("eval", "--help"), ("compare", "run", "run"), ("model", "doctor"),
    ("prompt", "show", "v2", "--scene", "00000-0"),
)  # fmt: skip


def started(here: Path, command: tuple[str, ...], **out: Any) -> "subprocess.Popen[str]":
    made_up(here / "run")
    return subprocess.Popen(
        [sys.executable, "-m", "harness", *command],
        cwd=here,
        text=True,
        stderr=subprocess.PIPE,
        **out,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [*SPEAK, *(pytest.param(command, marks=pytest.mark.exhaustive) for command in TOO)],
    ids=" ".join,
)
def test_nobody_reads(command: tuple[str, ...], tmp_path: Path) -> None:
    process = started(tmp_path, command, stdout=subprocess.PIPE)
    process.stdout.close()
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (141, "")


def test_nobody_hears_what_is_wrong(tmp_path: Path) -> None:
    process = started(tmp_path, ("run", "ls", "nowhere"))
    process.stderr.close()
    assert process.wait(60) == 141


@pytest.mark.parametrize("command", [("run", "ls", "."), ("eval", "--help")])
def test_a_full_disk(command: tuple[str, ...], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        process = started(tmp_path, command, stdout=full)
        _, said = process.communicate(timeout=60)
    what, repair = "the output, or a temporary file", "fix that, and type the same command again"
    said_of = f"{what}: No space left on device; {repair}"
    assert (process.returncode, said) == (2, f"harness: {said_of}\n")
