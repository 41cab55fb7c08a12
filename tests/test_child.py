"""A backend in a process of its own: really killed, and what becomes of the run."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.backends.base import Request
from harness.backends.llama_cpp.backend import LOADS, Child
from harness.core.errors import UserError

TESTS = Path(__file__).parent
pytestmark = pytest.mark.slow


def ask(said: str, name: str = "r") -> Request:
    return Request(name, "ego", ({"role": "user", "content": said},), ("SLOWER", "IDLE"), 8)


def mortal(graves: Path, **options: object) -> Child:
    return Child("mortal", "mortal:open", graves, **options)


def born(graves: Path) -> int:
    return len(list(graves.iterdir()))


def alive(pid: int) -> bool:
    """Running: a zombie that nobody has buried yet is not."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def until_dead(pid: int) -> None:
    end = time.monotonic() + 30
    while alive(pid):
        assert time.monotonic() < end, f"process {pid} was left behind"
        time.sleep(0.02)


def test_answers_come_from_another_process_with_its_seconds_and_identity(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    [hello, again] = child.complete([ask("hello", "a"), ask("again", "b")])
    assert [(c.request_id, c.text, c.seconds, c.batch_size) for c in (hello, again)] == [
        ("a", "hello", 0.25, 2),
        ("b", "again", 0.25, 2),
    ]
    assert child.identity() == {"engine": "mortal"}
    assert child.call("pid") != os.getpid()
    child.close()


def test_who_kills_the_engine_time_after_time_is_an_error_and_the_others_are_answered(
    tmp_path: Path,
) -> None:
    child = mortal(tmp_path)
    first, killer, last = child.complete([ask("first", "a"), ask("die", "b"), ask("last", "c")])
    assert (first.text, last.text) == ("first", "last")
    assert (first.batch_size, last.batch_size) == (1, 1)
    assert (killer.request_id, killer.finish_reason, killer.text) == ("b", "error", "")
    assert (killer.error, killer.seconds) == ("engine died: signal 11", None)
    assert born(tmp_path) == 4, "two for the chunk, one for the killer alone, one for the last"
    assert [c.text for c in child.complete([ask("next")])] == ["next"]
    assert born(tmp_path) == 4
    child.close()


@pytest.mark.exhaustive
def test_a_death_by_company_costs_nobody_an_answer(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    answers = child.complete([ask("hello"), ask("die in company")])
    assert [c.text for c in answers] == ["hello", "die in company"]
    child.close()


@pytest.mark.exhaustive
def test_an_exit_is_a_death_too(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    assert [c.error for c in child.complete([ask("exit")])] == ["engine died: exit code 3"]
    child.close()


def test_an_engine_killed_while_idle_is_started_again(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    pid = child.call("pid")
    os.kill(pid, signal.SIGKILL)
    until_dead(pid)
    assert child.identity() == {"engine": "mortal"}
    assert child.call("pid") != pid
    child.close()


@pytest.mark.exhaustive
def test_an_engine_that_somebody_stops_is_ended_and_its_question_asked_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.backends.llama_cpp.backend.LOOK_S", 0.05)
    child = mortal(tmp_path)
    pid = child.call("pid")
    os.kill(pid, signal.SIGSTOP)
    assert [c.text for c in child.complete([ask("hello " * 200_000), ask("again")])][1] == "again"
    assert child.call("pid") != pid
    until_dead(pid)
    stopped, last = child.complete([ask("stop", "a"), ask("last", "b")])
    assert (stopped.error, last.text) == ("engine died: signal 9", "last")
    child.close()


def test_an_engine_that_is_stopped_for_a_moment_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.backends.llama_cpp.backend.LOOK_S", 0.5)
    child = mortal(tmp_path)
    pid = child.call("pid")
    os.kill(pid, signal.SIGSTOP)
    os.kill(pid, signal.SIGCONT)
    time.sleep(1.2)
    assert (child.complete([ask("hello")])[0].text, child.call("pid")) == ("hello", pid)
    child.close()


def test_deaths_while_loading_are_tried_again(tmp_path: Path) -> None:
    child = mortal(tmp_path, deaths=LOADS - 1)
    assert born(tmp_path) == LOADS
    child.close()


@pytest.mark.exhaustive
def test_deaths_while_loading_that_do_not_end_are_said(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=f"'mortal': engine died: signal 9 while it loaded, {LOADS} times"
    ):
        mortal(tmp_path, deaths=1000)
    assert born(tmp_path) == LOADS


def test_what_the_user_got_wrong_is_said_here_as_it_was_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^no such file; give another$"):
        mortal(tmp_path, complaint="no such file; give another")
    child = mortal(tmp_path)
    with pytest.raises(UserError, match=r"^the template refuses it; use another$"):
        child.complete([ask("complain")])
    assert child.complete([ask("hello")])[0].text == "hello"
    child.close()


def test_a_bug_there_is_a_bug_here_with_its_traceback(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    with pytest.raises(RuntimeError, match=r"(?s)in _answer.*KeyError: 'a bug'"):
        child.complete([ask("fail")])
    child.close()


def test_a_question_that_kills_is_not_asked_for_ever(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    with pytest.raises(UserError, match="engine died: signal 11 of complete"):
        child.call("complete", [ask("die")])
    child.close()


def test_closed_or_forgotten_it_leaves_no_process(tmp_path: Path) -> None:
    closed, forgotten = mortal(tmp_path), mortal(tmp_path)
    pids = closed.call("pid"), forgotten.call("pid")
    closed.close()
    closed.close()
    del forgotten
    for pid in pids:
        until_dead(pid)


SCRIPT = textwrap.dedent("""
    import sys
    from pathlib import Path
    sys.path.insert(0, {tests!r})
    from test_child import ask, mortal
    if __name__ == "__main__":
        child = mortal(Path({graves!r}))
        print(child.call("pid"), flush=True)
        child.complete([ask("dawdle")])
""")


@pytest.fixture
def interruptible() -> Iterator[None]:
    """A shell's background job ignores Ctrl-C, and so would all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    "blow",
    [
        signal.SIGKILL,
        *(
            pytest.param(each, marks=pytest.mark.exhaustive)
            for each in (signal.SIGINT, signal.SIGTERM)
        ),
    ],
)
def test_whatever_ends_the_run_ends_the_engine(tmp_path: Path, blow: signal.Signals) -> None:
    """Ctrl-C goes to all processes of a terminal: the engine's hears nothing, and says nothing."""
    script = tmp_path / "run.py"
    (tmp_path / "graves").mkdir()
    script.write_text(SCRIPT.format(tests=str(TESTS), graves=str(tmp_path / "graves")))
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    assert alive(pid)
    [blocked] = re.findall(r"SigBlk:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    assert int(blocked, 16) >> (signal.SIGINT - 1) & 1
    if blow == signal.SIGINT:
        os.killpg(process.pid, blow)
    else:
        os.kill(process.pid, blow)
    _, said = process.communicate(timeout=60)
    assert process.returncode != 0
    assert said.count("Traceback") <= (blow == signal.SIGINT), said
    until_dead(pid)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_in_an_answer_leaves_a_child_that_answers_the_next_question(tmp_path: Path) -> None:
    child = mortal(tmp_path)
    pid = child.call("pid")
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        child.complete([ask("dawdle")])
    until_dead(pid)
    assert child.complete([ask("hello")])[0].text == "hello"
    child.close()
