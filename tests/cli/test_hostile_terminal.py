"""What others wrote reaches a terminal escaped:
nothing moves the cursor, colours or turns the text round.
"""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

Said = tuple[int, str, str]
HOSTILE, SHOWN = "\x1b[31m\u202e\x9b2J", r"\x1b[31m\u202e\x9b2J"


@pytest.fixture
def project(harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    assert harness("init", "project")[0] == 0
    monkeypatch.chdir("project")
    return tmp_path / "project"


@pytest.mark.slow
def test_prompt_show(harness: Callable[..., Said], project: Path) -> None:
    [ego] = project.glob("prompts/*/ego.j2")
    ego.write_text(ego.read_text().replace("You drive", f"{HOSTILE} You drive"))
    code, out, err = harness("prompt", "show", ego.parent.name, "--scene", "00000-0")
    assert (code, err) == (0, "")
    assert f"{SHOWN} You drive" in out
    assert all(line.isprintable() for line in out.splitlines())


def test_doctor(
    harness: Callable[..., Said], project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (project / f"models/{HOSTILE}.toml").write_text("engine = 3\n")
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(project / HOSTILE))
    program = project / "bin/nvidia-smi"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho 'GPU {HOSTILE}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    code, out, err = harness("model", "doctor")
    assert (code, err) == (0, "")
    assert out.isascii()
    assert all(line.isprintable() for line in out.splitlines())
    said = "".join(out.split())  # lines are folded anywhere
    for part in (f"GPU{SHOWN}", f"{SHOWN}/completions.sqlite", f"{SHOWN}.toml"):
        assert part in said
