"""`--quiet`, and what a shell is told to complete a line."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("svg_alone")

Said = tuple[int, str, str]
DRIVE = ("--episodes", "1", "--seeds", "0", "--workers", "1")


@pytest.mark.exhaustive
def test_quiet_prints_nothing_and_writes_the_same(
    harness: Callable[..., Said], small_path: Path
) -> None:
    once = ("eval", "--dataset", small_path, "--limit", "1", "--seeds", "0", "--out")
    sweep = (
        "study",
        "sweep",
        "run",
        "--over",
        "tau",
        "--grid",
        "0.9",
        "--condition",
        "6g",
        "--out",
    )
    for args in (once, ("drive", *DRIVE, "--condition", "6g", "--out"), sweep):
        name = args[1] if args[0] == "study" else args[0]
        code, out, err = harness(*args, "loud" if args is not once else "run")
        assert code == 0
        assert not err or args is sweep  # which says its points as they are known
        assert "wrote" in out
        assert harness(*args, f"quiet-{name}", "--quiet") == (0, "", "")
        assert {p.name for p in Path(f"quiet-{name}").iterdir()} >= {
            "eval": {"run.json", "report.html"}, "drive": {"run.json"}, "sweep": {"sweep.json", "index.html"},
        }[name]  # fmt: skip
        if args is not once:
            Path("loud").rename(f"loud-{name}")
    assert harness("eval", "--dataset", small_path, "--dry-run", "--quiet") == (0, "", "")


@pytest.mark.slow
def test_a_quiet_study_prints_nothing(harness: Callable[..., Said], two_run: Path) -> None:
    shutil.copytree(two_run, "run")
    sweep = ("study", "sweep", "run", "--over", "tau", "--grid", "0.9", "--condition", "6g")
    assert harness(*sweep, "--seeds", "0", "--quiet", "--out", "swept") == (0, "", "")


@pytest.mark.slow
def test_quiet_says_errors_and_what_json_asks_for(
    harness: Callable[..., Said], small_path: Path
) -> None:
    code, out, err = harness("eval", "--model", "proxi", "--quiet")
    assert (code, out) == (2, "")
    assert err.startswith("harness: unknown model 'proxi'")
    args = ("eval", "--dataset", small_path, "--limit", "1", "--seeds", "0", "--quiet", "--json")
    assert json.loads(harness(*args)[1])["run"] == "reports/proxy-v2-small"


def completed(line: str) -> list[str]:
    """What bash is offered at the end of a line."""
    asked = {
        "_HARNESS_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(line.count(" ")),
    }
    code = "import sys, harness.cli; sys.argv = ['harness']; harness.cli.main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.slow
def test_a_shell_completes_commands_and_options() -> None:
    assert sorted(completed("harness d")) == ["dataset", "drive"]
    assert completed("harness eval --qu") == ["--quiet"]
    assert completed("harness study cl") == ["closed-loop"]
    assert completed("harness run hi") == ["history"]
    assert completed("harness campaign cl") == ["closed-loop"], (
        "the old spelling is understood, and silent"
    )
