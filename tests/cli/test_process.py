"""The program in a real process: stopped while it starts, without streams, in odd surroundings."""

import io
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from run_on_disk import made_up
from tiers import some

from harness.core.process import LEAST_MB

HARNESS = (sys.executable, "-m", "harness")
pytestmark = pytest.mark.slow
NO_UTF8 = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
# Says when it has come to an import, and waits there, in short steps: a signal may come just before
# one.
WAITS = """
import sys, time
print("here", flush=True)
try:
    for _ in range(600):
        time.sleep(0.05)
except {caught}:
    raise ImportError("a library makes another error of it")
"""


def ended(
    *command: str, cwd: Path, env: Mapping[str, str] | None = None, prepare: Callable[[], Any] | None = None,
    **streams: Any,
) -> "subprocess.CompletedProcess[bytes]":  # fmt: skip
    return subprocess.run(
        [*HARNESS, *command], cwd=cwd, env={**os.environ, **(env or {})}, preexec_fn=prepare, timeout=120,
        **{"capture_output": not streams, **streams},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("caught", "number", "code"),
    some(
        [("BaseException", signal.SIGTERM, 143), ("KeyboardInterrupt", signal.SIGINT, 130)],
        exhaustive=[
            ("BaseException", signal.SIGINT, 130),
            ("KeyboardInterrupt", signal.SIGTERM, 143),
        ],
    ),
)
def test_a_command_that_is_stopped_while_it_imports_ends_with_a_line(
    caught: str, number: int, code: int, tmp_path: Path
) -> None:
    """The first package that the command line imports stands in for any."""
    (tmp_path / "typer").mkdir()
    (tmp_path / "typer/__init__.py").write_text(WAITS.format(caught=caught))
    process = subprocess.Popen(
        [*HARNESS, "--help"], env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.pathsep.join(sys.path)}"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert process.stdout.readline() == b"here\n"
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert (process.returncode, said.count(b"\n"), said[:9]) == (code, 1, b"harness: ")


def test_a_signal_at_any_moment_of_a_command(tmp_path: Path) -> None:
    """From its start to its end; `benchmarks/campaigns/signals.py` does it hundreds of times."""
    made_up(tmp_path / "run")
    for n in range(8):
        process = subprocess.Popen(
            [*HARNESS, "run", "ls", "."],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        time.sleep(0.04 * (n + 1))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
        assert process.returncode in (143, -signal.SIGTERM, 0)
        assert said in (b"harness: terminated\n", b"")


# -- consoles and streams --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env",
    some(
        [
            {"PYTHONIOENCODING": "ascii:strict"},
            {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        ],
        exhaustive=[{"PYTHONIOENCODING": encoding} for encoding in ("ascii", "latin-1")],
    ),
    ids=lambda env: " ".join(env.values()),
)
def test_a_console_that_lacks_a_character_gets_another(env: dict[str, str], tmp_path: Path) -> None:
    done = ended("prompt", "list", cwd=tmp_path, env=env)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"?" in done.stdout
    done = ended("run", "ls", "nowhere-…", cwd=tmp_path, env=env)
    assert done.returncode == 2
    assert b"Traceback" not in done.stderr


@pytest.mark.exhaustive
@pytest.mark.parametrize("closed", [(0, 1, 2), *((number,) for number in range(3))])
def test_a_run_without_streams_is_whole(closed: tuple[int, ...], tmp_path: Path) -> None:
    def close() -> None:
        for number in closed:
            os.close(number)

    done = ended(
        "eval", "--limit", "1", "--seeds", "0", "--out", "run", cwd=tmp_path, prepare=close,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "answers.jsonl", "decisions.parquet", "episodes.csv", "report.html", "run.json", "run.toml",
        "sources", "summary.csv",
    }  # fmt: skip


def test_what_nobody_hears_still_has_its_exit_code(tmp_path: Path) -> None:
    done = ended(
        "run", "ls", "nowhere", cwd=tmp_path, prepare=lambda: os.close(2), stdout=subprocess.PIPE
    )
    assert (done.returncode, done.stdout) == (2, b""), "an error is no output"


# -- surroundings ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command", [("run", "ls", "."), ("prompt", "list"), ("--help",)], ids=" ".join
)
def test_a_folder_that_is_gone(command: tuple[str, ...], tmp_path: Path) -> None:
    here = tmp_path / "gone"
    here.mkdir()
    done = subprocess.run(
        ["sh", "-c", 'rmdir "$1"; shift; exec "$@"', "sh", here, *HARNESS, *command], cwd=here,
        capture_output=True, timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    assert done.returncode == 2
    reason = b"the current folder cannot be read (No such file or directory)"
    assert done.stderr == b"harness: %s; change to one that is there\n" % reason


@pytest.mark.parametrize("megabytes", some([100], exhaustive=[400, LEAST_MB]))
def test_little_memory(megabytes: int, tmp_path: Path) -> None:
    limit = megabytes << 20
    done = ended(
        "eval", "--limit", "1", "--seeds", "0", "--out", "run", cwd=tmp_path, env={"OMP_NUM_THREADS": "1"},
        prepare=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )  # fmt: skip
    if megabytes < LEAST_MB:
        assert done.returncode == 2
        assert done.stderr.startswith(b"harness: the address space is limited to")
    else:
        assert done.returncode in (0, 2)
    assert done.stderr.count(b"\n") <= 1


@pytest.mark.parametrize(
    "error", ["MemoryError()", "ImportError('x.so: failed to map segment from object')"]
)
def test_memory_that_runs_out_is_one_line(error: str, tmp_path: Path) -> None:
    """Wherever it does: here the first package that the command line imports cannot be loaded."""
    (tmp_path / "typer").mkdir()
    (tmp_path / "typer/__init__.py").write_text(f"raise {error}")
    done = ended(
        "run", "ls", cwd=tmp_path, env={"PYTHONPATH": f"{tmp_path}:{os.pathsep.join(sys.path)}"}
    )
    said = b"harness: memory ran out; give this command more, or less to do\n"
    assert (done.returncode, done.stderr) == (2, said)


@pytest.mark.parametrize("date", ["garbage", "1e999", "99999999999999999999", ""])
def test_a_date_of_the_environment_that_is_none(date: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from harness.report.drawing.pictures import FORMATS, save

    written = {}
    for now in (None, date):
        monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
        if now is not None:
            monkeypatch.setenv("SOURCE_DATE_EPOCH", now)
        for kind in FORMATS:
            save(Figure(), data := io.BytesIO(), kind)
            written.setdefault(kind, set()).add(data.getvalue())
    assert {kind: len(different) for kind, different in written.items()} == dict.fromkeys(
        FORMATS, 1
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("date", ["garbage", "99999999999999999999"])
def test_a_run_under_a_date_that_is_none(date: str, tmp_path: Path) -> None:
    """Some packages read it while they are imported."""
    done = ended(
        "eval", "--limit", "1", "--seeds", "0", "--condition", "6g", "--out", "run", "--quiet", cwd=tmp_path,
        env={"SOURCE_DATE_EPOCH": date},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
