"""A command that somebody or the machine stops says so in one line, and how to go on."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tiers import some

EVAL = ("eval", "--model", "proxy", "--seeds", "0:1", "--out", "stopped")


def started(
    *args: str, cwd: Path, limit: Callable[[], object] | None = None
) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "harness", *args], cwd=cwd, text=True, stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, preexec_fn=limit,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("number", "code", "word"),
    some([(signal.SIGINT, 130, "interrupted")], exhaustive=[(signal.SIGTERM, 143, "terminated")]),
)
def test_who_stops_a_command_hears_that_the_same_one_goes_on(
    tmp_path: Path, number: int, code: int, word: str
) -> None:
    # A shell starts what runs in the background with Ctrl-C ignored.
    process = started(
        *EVAL, cwd=tmp_path, limit=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    )
    kept = tmp_path / "stopped/.work/answers.jsonl"
    while not kept.is_file() and process.poll() is None:
        time.sleep(0.01)
    os.kill(process.pid, number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code
    how = f"type the same command to continue: harness {' '.join(EVAL)}"
    assert said.splitlines()[-1] == f"harness: {word}; stopped keeps what is done; {how}"


@pytest.mark.exhaustive
def test_a_stopped_trust_study_says_what_it_keeps(
    harness: Callable[..., tuple[int, str, str]], small_path: Path, tmp_path: Path
) -> None:
    options = (
        "--dataset",
        small_path,
        "--condition",
        "6g",
        "--seeds",
        "0:1",
        "--out",
        tmp_path / "run",
    )
    assert harness("eval", "--model", "proxy", *options)[0] == 0
    typed = ("study", "trust", "run", "--out", "study")
    process = started(*typed, cwd=tmp_path)
    kept = tmp_path / "study/cells.jsonl"
    while not kept.is_file() and process.poll() is None:
        time.sleep(0.01)
    process.terminate()
    _, said = process.communicate(timeout=60)
    assert process.returncode == 143
    how = f"type the same command to continue: harness {' '.join(typed)}"
    assert said.splitlines()[-1] == f"harness: terminated; study keeps what is done; {how}"


@pytest.mark.slow
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    """No file may grow beyond 1000 bytes, which ends a write as a full disk does."""
    process = started(
        *EVAL, "--limit", "1", cwd=tmp_path,
        limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
    )  # fmt: skip
    _, said = process.communicate(timeout=60)
    assert (process.returncode, len(said.splitlines())) == (2, 1)
    assert said.startswith("harness: ")
    assert "File too large" in said
