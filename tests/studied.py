"""How each kind of study is tried, and what was typed and said of it; some are really killed.

Each command is typed in a process of its own, in the same folder, since manifests name it.
"""

import io
import json
import os
import shlex
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cache
from importlib import import_module
from pathlib import Path
from runpy import run_path
from typing import Any

import pytest
from evaluating import Scripted, live_spec_of, run, sure

from harness import cli
from harness.backends import registry
from harness.backends.base import Completion, Request
from harness.backends.card import Card
from harness.coordination.named_points import POINTS
from harness.core import resources
from harness.core.files import sha256_file
from harness.dataset import rebuilt
from harness.evaluate import lifecycle
from harness.evaluate import run as evaluation

Once = Callable[..., Path]  # fills a folder of a name once, as `conftest.once` does
BOTH = "--condition single-local --condition 6g"
PROMPT = "{% block system -%}\n"
CHOICE = "{% either pace %}Creep.{% or %}Go.{% endeither %}\n"


@dataclass(frozen=True)
class Trial:
    """How a kind of study is tried in what `laid` lays out."""

    command: str  # with what it needs
    few: str  # options that keep it short
    other: str  # options of another study
    refused: str  # what is said of that one in the folder of the first
    wrong: Mapping[str, str]  # options that cannot be, and what is said of them
    about: str  # the words on what its outcome is conditional on
    out: str = "--out out"  # where it writes, as an option; nothing if that is in its run's folder
    folder: str = "out"
    beside: Collection[str] = ()  # what else it writes
    dry: bool = False  # whether it has --dry-run
    ends: bool = True  # whether the same command ends at once where it is done, or is refused
    lays: Callable[[Path, Once], object] = lambda here, once: None  # lays out what it alone needs

    @property
    def names(self) -> list[str]:
        """What is typed, in this order; `json` only where the same command again prints none."""
        return [*["dry"] * self.dry, "whole", "again", "other", *["json"] * (not self.ends)]

    def typed(self, name: str) -> str:
        """Return a command by its name."""
        usual = f"{self.command} {self.few} {self.out}"
        return {
            "dry": f"{usual} --dry-run",
            "whole": usual,
            "again": f"{usual} --json",
            "other": f"{self.command} {self.other} {self.out}",
            "json": f"{usual}-2 --json",
        }[name]


MORE = "run/more-answers.jsonl"
ASKED = ("run/.more-answers.jsonl.lock", MORE)  # what is written in a run that lacks answers
KILLED = -signal.SIGKILL
TRIALS = {  # of the core; of an extension, `tests/extensions/NAME/trials.py` has them
    "sweep": Trial(
        "study sweep run", "--over loss --grid 0,0.5", "--over loss --grid 0,0.5 --seeds 7:8",
        "run/sweep-loss holds another sweep, with other seeds; name another folder",
        {
            "--over speed": "unknown --over 'speed'",
            "--over tau --grid a": "--grid a: give numbers",
            "--over tau --grid ''": "--grid",
            "--over tau --grid 1 --grid 2": "--grid: 2 given for 1 of --over",
            "--over tau --condition 6g:taus=1": "unknown setting of operating point 6g 'taus'",
            "--over tau --condition single-local": "has no channel; nothing of it can be varied",
            "--over consensus --grid ego-prompt": "proxy is no language model",
            "--latency mine": "unknown --latency 'mine'",
        },
        "All points share their random draws", out="", folder="run/sweep-loss", beside=ASKED,
    ),
    "contents": Trial(
        "study contents run", "--condition 6g --over loss --grid 0,1", "--condition v2x",
        "run/contents holds another contents, with other panels; name another folder",
        {
            "run": "run and run are both proxy · v2 · json on occluded-intersection; give one of",
            "--grid 1,2": "--grid: 1 given for 0 of --over; give one for each, in order",
            "--condition single-local": "--condition single-local has no channel",
            "--condition 6g:consensus=ego-prompt": "proxy · v2 · json: ",
        },
        "about these families alone", out="", folder="run/contents", beside=ASKED, dry=True,
    ),
    "schedule": Trial(
        "study schedule compare run", "--schedule entropy", "--schedule entropy --seeds 7:8",
        "run/schedules holds another schedule, with other seeds; name another folder",
        {
            "--schedule coverag": "unknown --schedule 'coverag'; did you mean 'coverage'?",
            "--budget 0": "--budget 0: give a share above 0, 1 at most",
            "--condition single-local": "has no channel",
            "--latency mine": "unknown --latency 'mine'",
            "--tune run --tune run": 
                "--tune: 2 given for 1 runs; give one "
                "for each, in order, or none",
            "--tune run": "and numbers are reported of that; build one of other seeds",
        },
        "it is a bound and no schedule", out="", folder="run/schedules", beside=ASKED,
    ),
}  # fmt: skip


def laid(here: Path, run: Path, driven: Path | None, data: Path) -> None:
    """Lay out a project: copies of a run, one driven and their dataset; a prompt with a choice."""
    shutil.copytree(run, here / "run")
    shutil.copytree(run, here / "copy")
    shutil.copytree(data, here / "data")
    if driven:
        shutil.copytree(driven, here / "driven")
    shutil.copytree(resources.folder("prompts") / "v3", here / "prompts/mine")
    ego = here / "prompts/mine/ego.j2"
    ego.write_text(ego.read_text().replace(PROMPT, PROMPT + CHOICE, 1))
    (here / resources.MARKER).touch()


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
        return Completion(request.id, sure(action, request.role), 1000, 100, "stop", None, 1)


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
        if (
            counts
            and isinstance(path, str | Path)
            and os.path.abspath(path).startswith(self._below)
        ):
            self.count += 1
            if self.count == self._last:
                os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True)
class Said:
    """What a command said and left."""

    code: int
    out: str
    err: str
    writes: int  # how often it changed the disk
    files: Mapping[str, str]  # the digest of every file of the folder, by its path there


def said(words: str, here: Path, last: int | None = None) -> Said:
    """Type a command in a folder and a process of its own."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1  # whatever happens, a child must not go on as its parent
        try:
            os.chdir(here)
            sys.argv = ["harness", *shlex.split(words)]
            sys.addaudithook(writes := Writes(here, last))
            with redirect_stdout(io.StringIO()) as shown, redirect_stderr(io.StringIO()) as told:
                try:
                    cli.main()
                except SystemExit as ended:
                    code = int(ended.code or 0)
            with os.fdopen(write, "w") as pipe:
                json.dump([code, shown.getvalue(), told.getvalue(), writes.count], pipe)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(write)
    with os.fdopen(read) as pipe:
        text = pipe.read()
    _, status = os.waitpid(child, 0)
    if not text and not (last and os.WIFSIGNALED(status)):
        pytest.fail(f"{words} ended with status {status}")
    code, out, err, count = json.loads(text or f'[{KILLED}, "", "", 0]')
    return Said(code, out, err, count, digests(here))


def digests(here: Path) -> dict[str, str]:
    files = sorted(path for path in here.rglob("*") if path.is_file())
    return {str(path.relative_to(here)): sha256_file(path) for path in files}


@contextmanager
def stands_still() -> Iterator[None]:
    """What runs state about themselves is the same each time,
    and they are made in many small parts.
    """
    backend = registry.open_backend

    def opens(card: Card, **options: Any) -> Any:
        return Wanderer() if card.name == "swarm-tiny" else backend(card, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "EPISODES_AT_ONCE", 1)
        patch.setattr(lifecycle, "datetime", Then)
        patch.setattr(registry, "open_backend", opens)
        # which takes seconds each time
        patch.setattr(rebuilt, "differences", lambda dataset: iter(()))
        patch.setattr(rebuilt, "_reported", lambda scenario: iter(()))
        # the pictures of a study take longer than all else
        patch.setattr("harness.studies.study.DRAWN", ("svg",))
        yield


@cache
def trials() -> dict[str, Trial]:
    """Every kind's trial, those of extensions last."""
    found = dict(TRIALS)
    for file in sorted((Path(__file__).parent / "extensions").glob("*/trials.py")):
        found |= run_path(str(file))["TRIALS"]
    return found


@dataclass(frozen=True)
class Tried:
    """What was said to each command of a kind, by its name, and the project that is left."""

    trial: Trial
    said: dict[str, Said]
    path: Path

    @property
    def folder(self) -> Path:
        return self.path / self.trial.folder


Tries = Callable[[str], Tried]


@pytest.fixture(scope="session")
def lay(once: Once, proxy_run: Path, small_path: Path) -> Callable[[Path, Trial], None]:
    """Lays out a project that a study is tried in."""
    points = (POINTS["single-local"], POINTS["6g"])
    spec = live_spec_of(episodes=2, first_seed=100, points=points)
    driven = once("driven-to-study", lambda out: run(spec, out))

    def lay(here: Path, trial: Trial) -> None:
        laid(here, proxy_run, driven, small_path)
        trial.lays(here, once)

    return lay


@pytest.fixture(scope="session")
def tries(
    lay: Callable[[Path, Trial], None], once: Once,
    shared_work: Callable[[], AbstractContextManager[None]],
) -> Tries:  # fmt: skip
    """Types what is typed of a kind, once for all tests."""
    # here, and not in every process that types a command
    for heavy in ("matplotlib", "pandas", "scipy.stats"):
        pytest.importorskip(heavy)
    import_module("harness.report.drawing.pictures")

    def filled(folder: Path, trial: Trial) -> None:
        here = folder / "here"  # at the same place as one that is killed, since manifests name it
        lay(here, trial)
        typed = {"before": Said(0, "", "", 0, digests(here))}
        with stands_still():
            for name in trial.names:
                typed[name] = said(trial.typed(name), here)
        here.rename(folder / "done")
        (folder / "said.json").write_text(json.dumps(typed, default=asdict))

    def tried(kind: str) -> Tried:
        if kind not in trials():
            pytest.fail(f"study {kind} has no trial: test_every_study.py says how to give it one")
        trial = trials()[kind]
        with shared_work():
            folder = once(f"study-{kind}", lambda folder: filled(folder, trial))
        typed = json.loads((folder / "said.json").read_text())
        return Tried(trial, {name: Said(**each) for name, each in typed.items()}, folder / "done")

    return tried
