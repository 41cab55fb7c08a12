"""Hooks that are told of a run."""

import _thread
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from threading import Event, get_ident
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from misbehaving import Asked, serving
from served import answer

from harness.core import plugins
from harness.extensions.interop import hooks
from harness.extensions.interop.hooks import HOOKS
from harness.runs.folder import read

pytestmark = pytest.mark.slow

Typed = Callable[..., tuple[int, str, str]]


class Note:
    """A hook that writes down what it is told."""

    def __init__(self, fails_at: str = "") -> None:
        self.told: list[tuple[Any, ...]] = []
        self._fails_at = fails_at

    def _note(self, what: str, *about: Any) -> None:
        print("what a hook prints is no result")
        self.told.append((what, *about))
        if what == self._fails_at:
            raise RuntimeError(f"{what}\nwent wrong")

    def begin(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self._note("begin", folder, settings)

    def answered(self, total: int) -> None:
        self._note("answered", total)

    def end(self, done: Any) -> None:
        self._note("end", done, done and (done.out / "report.html").is_file())


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Have a package register hooks by their names."""

    def installed(**hooks: Any) -> None:
        found = {
            name: SimpleNamespace(load=lambda hook=hook: hook, value="x:y")
            for name, hook in hooks.items()
        }
        entries = plugins.entries
        monkeypatch.setattr(
            plugins, "entries", lambda group: found if group == HOOKS.group else entries(group)
        )
        monkeypatch.setattr(HOOKS, "_loaded", dict(HOOKS.built_in))

    return installed


def typed_eval(data: Path, *more: str) -> tuple[str | Path, ...]:
    fixed = ("--condition", "6g", "--seeds", "0:2", "--limit", "1", "--out", "run")
    return "eval", "--dataset", data, *fixed, *more


def test_a_hook_is_told_when_a_run_begins_when_answers_arrive_and_when_it_ends(
    two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    note = Note()
    install(mine=note)
    code, out, _ = harness(*typed_eval(two_path, "--tracker", "mine", "--json"))
    assert code == 0
    assert json.loads(out)["run"] == "run", "what a hook prints is kept out of the result"
    (begin, folder, settings), *counts, (end, done, has_page) = note.told
    assert (begin, str(folder), settings["model"]["name"]) == ("begin", "run", "proxy")
    assert {what for what, _ in counts} == {"answered"}
    answers = len(Path("run/answers.jsonl").read_text().splitlines())
    assert [total for _, total in counts] == sorted(total for _, total in counts)
    assert counts[-1][1] == answers
    assert (end, has_page, done.manifest.name) == ("end", True, "run")


def test_a_hook_is_told_of_a_drive_from_the_environment(
    harness: Typed, install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    note = Note()
    install(mine=note)
    monkeypatch.setenv("SWARMDRIVE_TRACKERS", " mine,")
    drive = (
        "--condition",
        "single-local",
        "--episodes",
        "2",
        "--seeds",
        "0:1",
        "--workers",
        "1",
        "--quiet",
    )
    assert harness("drive", *drive, "--out", "driven")[0] == 0
    assert [told[:2] for told in note.told if told[0] == "answered"][-1] == ("answered", 2)
    assert [told[0] for told in note.told][:: len(note.told) - 1] == ["begin", "end"]


@pytest.mark.parametrize("fails_at", ["begin", "answered", "end"])
def test_a_hook_that_fails_costs_a_run_one_line(
    fails_at: str, two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    bad, good = Note(fails_at), Note()
    install(bad=bad, good=good)
    code, _, said = harness(
        *typed_eval(two_path, "--tracker", "bad", "--tracker", "good", "--quiet")
    )
    assert code == 0
    assert said.count("tracker bad") == 1
    assert f"harness: tracker bad: {fails_at} went wrong; the run goes on without it\n" in said
    assert bad.told[-1][0] == fails_at
    assert good.told[-1][0] == "end"
    assert read(Path("run")).scores


def leave_by_typer() -> None:
    raise typer.Exit(0)


def press_ctrl_c() -> None:
    """Raise what Ctrl-C does, which nobody typed."""
    raise KeyboardInterrupt


class Bad(Note):
    """A hook that ends the program, leaves its folder or hangs where it is told to."""

    def __init__(self, at: str, does: Callable[[], object]) -> None:
        super().__init__()
        self._at, self._does = at, does

    def _note(self, what: str, *about: Any) -> None:
        super()._note(what, *about)
        if what == self._at:
            self._does()


@pytest.mark.parametrize(
    "does", [partial(sys.exit, 0), leave_by_typer, press_ctrl_c], ids=["exit", "typer", "ctrl-c"]
)
@pytest.mark.parametrize("at", ["begin", "end"])
def test_a_hook_that_ends_the_program_costs_a_run_one_line(
    at: str,
    does: Callable[[], object],
    two_path: Path,
    harness: Typed,
    install: Callable[..., None],
) -> None:
    install(bad=Bad(at, does))
    code, _, said = harness(*typed_eval(two_path, "--tracker", "bad", "--quiet"))
    assert code == 0
    [line] = [line for line in said.splitlines() if "tracker bad" in line]
    assert line.startswith("harness: tracker bad: ")
    assert line.endswith("; the run goes on without it")
    assert read(Path("run")).scores


def close_numbers() -> None:
    os.close(1)
    os.close(2)


@pytest.mark.parametrize(
    "does",
    [partial(setattr, sys, "stdout", None), partial(setattr, sys, "stderr", None), close_numbers],
    ids=["stdout", "stderr", "numbers"],
)
def test_a_hook_that_takes_the_streams_away_gives_them_back(
    does: Callable[[], object], two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    install(bad=Bad("begin", does))
    code, out, said = harness(*typed_eval(two_path, "--tracker", "bad", "--quiet", "--json"))
    assert (code, json.loads(out)["run"]) == (0, "run")
    line = "harness: tracker bad closed or replaced output or error; both are as they were"
    assert said.splitlines().count(line) == 1


@pytest.mark.parametrize("at", ["begin", "answered"])
def test_a_run_whose_folder_a_hook_deletes_is_one_line(
    at: str, two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    install(bad=Bad(at, partial(shutil.rmtree, "run")))
    code, out, said = harness(*typed_eval(two_path, "--tracker", "bad", "--quiet"))
    assert (code, out) == (2, "")
    [line] = [line for line in said.splitlines() if line.startswith("harness:")]
    assert line.startswith("harness: --out run was deleted while it was written to, by a tracker")


@pytest.mark.parametrize(
    "sends",
    [
        _thread.interrupt_main,
        partial(signal.raise_signal, signal.SIGINT),
        lambda: os.kill(os.getpid(), signal.SIGINT),
    ],
    ids=["interrupt_main", "raise_signal", "kill"],
)
def test_an_interrupt_that_a_hook_sends_is_said_to_have_come_during_it(
    sends: Callable[[], object], two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    """Nothing tells it from Ctrl-C; the same command goes on."""
    install(bad=Bad("begin", sends))
    code, _, said = harness(*typed_eval(two_path, "--tracker", "bad", "--quiet"))
    assert code == 130
    [line] = [line for line in said.splitlines() if line.startswith("harness: interrupted")]
    assert "; it came during begin of tracker bad; " in line
    assert harness(*typed_eval(two_path, "--quiet"))[0] == 0


def test_a_hook_that_hangs_is_left_behind(
    two_path: Path, harness: Typed, install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hooks, "PATIENCE_S", 0.2)
    hangs, good = Bad("answered", Event().wait), Note()
    install(bad=hangs, good=good)
    typed = typed_eval(two_path, "--tracker", "bad", "--tracker", "good", "--json")
    code, out, said = harness(*typed, "--quiet")
    assert (code, json.loads(out)["run"]) == (0, "run"), "what is printed is printed where it was"
    line = "harness: tracker bad: its answered takes longer than 0.2 s; the run goes on without it"
    assert said.splitlines().count(line) == 1
    assert hangs.told[-1][0] == "answered"
    assert good.told[-1][0] == "end"


AWAY = """
import atexit, socket, sys, time
from harness.core import process
from harness.extensions.interop import hooks

port = int(sys.argv.pop())

class Away:
    def begin(self, folder, settings):
        atexit.register(time.sleep, 60)
        with socket.create_connection(("127.0.0.1", port)) as server:
            server.recv(1)

hooks.PATIENCE_S, process.GIVEN_UP_S = 0.4, 0.1
hooks.chosen = lambda names: {"away": Away()}

from harness import cli
process.run(cli.main)
"""


def test_the_process_does_not_wait_again_for_a_server_that_did_not_answer(
    two_path: Path, tmp_path: Path
) -> None:
    """A package's own handler at the end of the process waits for it as well."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        typed = [*map(str, typed_eval(two_path, "--quiet", "--json")), str(silent.getsockname()[1])]
        ended = subprocess.run(
            [sys.executable, "-c", AWAY, *typed], cwd=tmp_path, capture_output=True, text=True, timeout=45,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}, check=False,
        )  # fmt: skip
    assert (ended.returncode, json.loads(ended.stdout)["run"]) == (0, "run")
    assert (
        "tracker away: its begin takes longer than 0.4 s; the run goes on without it"
        in ended.stderr
    )


def test_a_hook_that_takes_long_is_waited_for_aloud(
    two_path: Path, harness: Typed, install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hooks, "SAID_S", 0.01)
    install(slow=Bad("begin", partial(time.sleep, 0.2)))
    code, _, said = harness(*typed_eval(two_path, "--tracker", "slow", "--quiet"))
    assert code == 0
    assert said.splitlines().count("harness: waiting for tracker slow, 20 s at most") == 1


def test_a_hook_that_leaves_the_folder_does_not_take_the_run_along(
    two_path: Path, harness: Typed, install: Callable[..., None], tmp_path: Path
) -> None:
    (tmp_path / "elsewhere").mkdir()
    install(bad=Bad("begin", partial(os.chdir, tmp_path / "elsewhere")))
    code, _, said = harness(*typed_eval(two_path, "--tracker", "bad", "--quiet"))
    assert code == 0
    assert f"tracker bad changed the working folder; it is {tmp_path} again" in said
    assert read(tmp_path / "run").scores
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_hook_is_called_in_one_thread(
    two_path: Path, harness: Typed, install: Callable[..., None]
) -> None:
    """MLflow keeps its run by thread."""
    threads = list[int]()
    note = Note()
    note._note = lambda *_: threads.append(get_ident())  # type: ignore[method-assign]
    install(mine=note)
    assert harness(*typed_eval(two_path, "--tracker", "mine", "--quiet"))[0] == 0
    assert len(threads) >= 3
    assert len(set(threads)) == 1


def test_a_hook_is_told_of_a_run_that_is_stopped(
    small_path: Path, harness: Typed, install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(asked: Asked) -> None:
        if asked.number < 70:
            answer(asked)
        else:
            asked.reply({"error": "gone"}, 400)

    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    note = Note()
    install(mine=note)
    with serving(dies, lambda asked: asked.reply({"data": [{"id": "m"}]})) as there:
        typed = typed_eval(
            small_path, "--tracker", "mine", "--model", there.url, "--ask", "all", "--no-cache"
        )
        assert harness(*typed, "--limit", "4")[0] == 3
    assert [told[0] for told in note.told[:2]] == ["begin", "answered"]
    assert note.told[-1] == ("end", None, None)
