"""Studies that are really killed.

Each command of `COMMANDS` is typed once by nobody disturbed; and once it dies by SIGKILL in the middle of its
writes to the disk, counted, and is typed again.
"""

import os
import shutil
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from evaluating import Scripted, sure
from former import DRIVE

from harness import cli
from harness.backends.base import Completion, Request
from harness.backends.card import Card
from harness.evaluate import lifecycle
from harness.evaluate import run as evaluation
from harness.report.drawing import pictures
from harness.studies import repeats

RUN, DRIVEN, SEEDS = "run", "driven", ("--seeds", "0:4")
POINTS = ("--condition", "single-local", "--condition", "6g")
COMMANDS = {
    "trust": (
        "study", "trust", RUN, "--attacks", "liar,liar+spoof", "--rules", "median,trust",
        "--share", "1/3", *SEEDS,
    ),
    "sweep": ("study", "sweep", RUN, "--over", "loss", "--grid", "0,0.5", *SEEDS),
    "schedule": ("study", "schedule", "compare", RUN, "--schedule", "entropy", *SEEDS),
    "attribute": ("study", "attribute", RUN, "--sample", "6"),
    "fidelity": ("study", "fidelity", RUN, DRIVEN, "--out", "out"),
    "twins": ("study", "twins", "--dataset", "data", "--sample", "3", "--workers", "1", "--out", "out"),
    "grid": (
        "study", "grid", "--prompt", "v2,v3", "--helper-prompt", "v2", "--dataset", "data", *POINTS,
        "--out", "out",
    ),
    "repeats": (
        "eval", "--repeats", "3", "--temperature", "0.7", "--model", "swarm-tiny", "--dataset", "data",
        *POINTS, "--no-cache", "--out", "out",
    ),
    "paper": ("study", "paper", "--episodes", "10", "--sweep-episodes", "10", "--out", "out"),
    "closed-loop": (
        "study", "closed-loop", "--model", "proxy", "--episodes", "2", "--seeds", "0", "--workers", "1",
        "--out", "out",
    ),
}  # fmt: skip


class Then(datetime):
    """A clock that stands still: runs say when they began."""

    @classmethod
    def now(cls, tz=None):
        return cls(2026, 1, 1, tzinfo=tz)


class Wanderer(Scripted):
    """Decides by the question and by which answer it is, in the place of an engine."""

    def __init__(self) -> None:
        super().__init__({})

    def _say(self, request: Request) -> Completion:
        action = request.actions[(len(request.id) + sum(map(ord, request.id)) + request.sample) % 3]
        return Completion(request.id, sure(action, request.role), 1, 1, "stop", None, 1)


class Writes:
    """Counts what changes the disk below a folder; kills this process in place of the `last`."""

    def __init__(self, below: Path, last: int | None) -> None:
        self._below, self._last, self.count = os.fspath(below), last, 0

    def __call__(self, event: str, args: tuple) -> None:
        if event == "open":
            path, _, flags = args
            counts = bool(flags & (os.O_WRONLY | os.O_RDWR))
        elif event in ("os.rename", "os.remove", "os.mkdir", "os.truncate", "os.rmdir"):
            path, counts = args[0], True
        else:
            return
        if counts and isinstance(path, str | Path) and os.path.abspath(path).startswith(self._below):
            self.count += 1
            if self.count == self._last:
                os.kill(os.getpid(), signal.SIGKILL)


def typed(words: Sequence[str], here: Path, last: int | None = None) -> int:
    """Type a command in a folder and a process of its own; how often it changed the disk."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1  # whatever happens, a child must not go on as its parent
        try:
            os.chdir(here)
            sys.argv = ["harness", *words, "--quiet"] if words[1] != "fidelity" else ["harness", *words]
            sys.addaudithook(writes := Writes(here, last))
            try:
                cli.main()
            except SystemExit as ended:
                status = int(ended.code or 0)
            os.write(write, str(writes.count).encode())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    _, status = os.waitpid(child, 0)
    os.close(write)
    with os.fdopen(read) as counted:
        count = int(counted.read() or 0)
    if status and not (last and os.WIFSIGNALED(status)):
        pytest.fail(f"{' '.join(words)} ended with status {status}")
    return count


def base(dataset: Path, folder: Path) -> None:
    """A dataset and a run of it, which studies read."""
    shutil.copytree(dataset, folder / "data")
    with stands_still():
        typed(("eval", "--dataset", "data", "--seeds", "0:1", *POINTS, "--out", RUN), folder)


def study_of(name: str, base: Path, folder: Path) -> None:
    """Type a study's command twice, each in a copy of `base`: in `folder`/whole, and killed in /resumed."""
    here, command = folder / "here", COMMANDS[name]
    with stands_still():
        for kind in ("whole", "resumed"):
            shutil.copytree(base, here)  # at the same place, since manifests name it
            if DRIVEN in command:
                driven = (*DRIVE, "--episodes", "4", "--first-seed", "100", "--seeds", "0:1", *POINTS)
                typed((*driven, "--out", DRIVEN), here)
            if kind == "whole":
                count = typed(command, here)
            else:
                typed(command, here, max(1, count // 2))
                typed(command, here)
            here.rename(folder / kind)


@contextmanager
def stands_still() -> Iterator[None]:
    """What runs state about themselves is the same each time, and they are made in many small parts."""
    backend = repeats.open_backend  # type: ignore[attr-defined]

    def opens(card: Card, **options: Any) -> Any:
        return Wanderer() if card.name == "swarm-tiny" else backend(card, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "EPISODES_AT_ONCE", 1)
        patch.setattr(lifecycle, "datetime", Then)
        patch.setattr(repeats, "open_backend", opens)
        patch.setattr(pictures, "FORMATS", ("svg",))  # the pictures of a study take longer than all else
        yield
