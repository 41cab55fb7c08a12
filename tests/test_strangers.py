"""The code of packages can neither end nor move the program that calls it."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import typer
from packaged import register

from harness.backends.base import Completion, Request
from harness.coordination.consensus import Pool, linear_pool
from harness.coordination.rules import RULES
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import Formula
from harness.core import parallel
from harness.core import strangers as doors
from harness.core.errors import UserError
from harness.core.process import Stop
from harness.core.strangers import strangers

ROOT = Path(__file__).parents[1]
Typed = Callable[..., tuple[int, str, str]]


class Odd(BaseException):
    """What is no error, and no exit."""


def leave(raised: BaseException) -> None:
    raise raised


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (SystemExit(0), "SystemExit: 0"), (SystemExit(), "SystemExit"), (Odd("x\n\x1b"), r"Odd: x\n\x1b"),
        (typer.Exit(0), "Exit"), (GeneratorExit(), "GeneratorExit"),
    ],
)  # fmt: skip
def test_what_would_end_the_program_is_bad_input_and_says_where(
    raised: BaseException, words: str
) -> None:
    with pytest.raises(UserError) as error, strangers("rule mine"):
        leave(raised)
    assert str(error.value).startswith(f"rule mine ends the program ({words}")
    assert f" at {__file__}:" in str(error.value)
    assert "\n" not in str(error.value)


def test_what_signals_do_is_put_back() -> None:
    """A package that ignores them as it loads would take Ctrl-C from the command."""
    usual = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with strangers():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == usual


def test_what_does_not_come_back_is_named_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doors, "PATIENCE_S", 0.1)
    monkeypatch.setattr(doors, "LOOK_S", 0.01)
    monkeypatch.setattr(doors, "_watchers", set())
    for _ in range(2):
        with doors.worded("rule slow of mine"):
            time.sleep(0.3)
    assert capsys.readouterr().err.count("harness: rule slow of mine has not come back") == 1


@pytest.mark.parametrize("raised", [ValueError("x"), Stop(2), KeyboardInterrupt()])
def test_an_error_and_a_typed_ctrl_c_are_raised_as_they_are(raised: BaseException) -> None:
    """In a notebook, as here, what Ctrl-C raises is no `Stop`."""
    with pytest.raises(type(raised)) as error, strangers():
        leave(raised)
    assert error.value is raised


def test_a_ctrl_c_that_nobody_typed_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    # as in a command, which raises `Stop`
    monkeypatch.setattr("signal.getsignal", lambda number: None)
    with pytest.raises(UserError, match=r"ends the program \(KeyboardInterrupt at "), strangers():
        leave(KeyboardInterrupt())
    with pytest.raises(Stop), strangers():
        leave(Stop(2))


@pytest.mark.parametrize("raised", [None, ValueError("x"), SystemExit(1)])
def test_the_working_folder_is_put_back(
    raised: BaseException | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    try:
        with strangers("rule mine"):
            os.chdir("there")
            if raised:
                raise raised
    except (UserError, ValueError):
        assert raised
    assert Path.cwd() == tmp_path
    said = capsys.readouterr().err
    assert said == f"harness: rule mine changed the working folder; it is {tmp_path} again\n"


@pytest.mark.parametrize(
    "source", ["raise SystemExit(0)", "exit()", "class A(BaseException): ...\nraise A"]
)
def test_a_package_that_ends_at_its_import_is_one_line(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(tmp_path, "[swarmdrive.rules]\nmine = ends_at_import:RULE\n", ends_at_import=source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(RULES, "_loaded", dict(RULES.built_in))
    with pytest.raises(
        UserError, match=r"^plug-in 'mine' \(swarmdrive.rules\): .* ends the program \("
    ):
        RULES["mine"]
    sys.modules.pop("ends_at_import", None)


@pytest.mark.parametrize("workers", [1, 2])
def test_work_that_ends_the_program_is_bad_input_in_every_process(workers: int) -> None:
    with pytest.raises(UserError, match=r"^a package ends the program \(SystemExit: 0 at "):
        parallel.each(partial(sys.exit), [0, 0], workers, lambda place, result: None)


class Leaving:
    """An engine that ends the program once, and then answers."""

    def __init__(self) -> None:
        self.asked = 0

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += 1
        if self.asked == 1:
            sys.exit(0)
        return [Completion(r.id, "yes", None, 1, "stop", 0.0, 1) for r in requests]


def test_a_served_engine_that_ends_the_program_answers_the_next_question() -> None:
    async def ask() -> list[Completion]:
        desk: Any = pytest.importorskip("harness.extensions.decide.desk").Desk(Leaving(), 1)
        request = Request("a", "ego", (), ("SLOWER", "IDLE", "FASTER"), 1)
        with pytest.raises(UserError, match="ends the program"):
            await asyncio.wait_for(desk.ask([request]), 10)
        return list(await asyncio.wait_for(desk.ask([request]), 10))

    assert [answer.text for answer in asyncio.run(ask())] == ["yes"]


@pytest.mark.slow
@pytest.mark.parametrize("ending", [SystemExit(0), typer.Exit(0), Odd()], ids=repr)
def test_a_rule_that_ends_the_program_is_bad_input_of_the_run(
    ending: BaseException, two_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RULES._loaded, "mine", Pool(lambda p, weights: leave(ending)))
    usual = type(RULES).__iter__
    listed = lambda self: iter(self._loaded) if self is RULES else usual(self)  # noqa: E731
    monkeypatch.setattr(type(RULES), "__iter__", listed)
    typed = (
        "eval",
        "--dataset",
        two_path,
        "--condition",
        "6g:consensus=mine",
        "--limit",
        "1",
        "--out",
        "run",
    )
    code, _, said = harness(*typed, "--out", "run", "--quiet")
    assert code == 2
    assert f"harness: rule mine ends the program ({type(ending).__name__}" in said
    assert not Path("run/run.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pool", "says"),
    [
        (lambda p, weights: 1 / 0, "rule mine fails (ZeroDivisionError: division by zero at "),
        (lambda p, weights: p, "rule mine fails (ValueError: fused policies of shape ("),
    ],
)
def test_a_rule_that_fails_is_one_line_and_the_answers_stay(
    pool: Callable[..., Any],
    says: str,
    two_path: Path,
    harness: Typed,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(RULES._loaded, "mine", Pool(pool))
    usual = type(RULES).__iter__
    listed = lambda self: iter(self._loaded) if self is RULES else usual(self)  # noqa: E731
    monkeypatch.setattr(type(RULES), "__iter__", listed)
    typed = (
        "eval",
        "--dataset",
        two_path,
        "--condition",
        "6g:consensus=mine",
        "--limit",
        "1",
        "--quiet",
    )
    code, out, said = harness(*typed, "--out", "run")
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert said.startswith(f"harness: {says}")
    assert said.endswith("repair or uninstall the package that registers it\n")
    monkeypatch.setitem(RULES._loaded, "mine", Pool(linear_pool))
    assert harness(*typed, "--out", "run")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("worth", "says"),
    [
        (lambda known: 1 / 0, "schedule mine fails (ZeroDivisionError: division by zero at "),
        (
            lambda known: known.may_ask[..., :2] * 1.0,
            "schedule mine fails (ValueError: worths of shape (",
        ),
    ],
)
def test_a_schedule_that_fails_is_one_line(
    worth: Callable[..., Any],
    says: str,
    two_path: Path,
    harness: Typed,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(SCHEDULES._loaded, "mine", Formula(worth, 0.1))
    monkeypatch.setattr(type(SCHEDULES), "__iter__", lambda self: iter(self._loaded))
    typed = (
        "eval",
        "--dataset",
        two_path,
        "--condition",
        "6g:schedule=mine",
        "--limit",
        "1",
        "--quiet",
    )
    code, out, said = harness(*typed, "--out", "run")
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert said.startswith(f"harness: {says}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "left",
    [
        "threading.Thread(target=threading.Event().wait).start()",
        "atexit.register(threading.Event().wait)",
    ],
)
def test_what_a_package_leaves_behind_does_not_keep_the_process(left: str) -> None:
    code = (
        "import atexit, sys, threading\nfrom harness.core import process\nprocess.LEAVE_S = 0.2\n"
        f"def program():\n    {left}\n    print('done')\n    sys.exit(3)\nprocess.run(program)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert (done.returncode, done.stdout) == (3, "done\n")
    assert "took longer than 0.2 s; all is written, and it ends\n" in done.stderr
