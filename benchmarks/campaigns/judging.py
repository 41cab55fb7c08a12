"""The command in a process of its own, and what is wrong with how it ended.

It must end with exit code 0, 1 (where that is its verdict) or 2 with one line on stderr, without a
traceback, and leave no process behind. The process is forked from one that has loaded the harness,
which saves a second.
"""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import harness.cli  # noqa: F401 (loaded before it is forked)
from harness import __main__ as entry

SCENARIO = "occluded-intersection"
LIMIT_S = 120.0
MEMORY = 8 << 30  # bytes of address space
TESTS = Path(__file__).parents[2] / "tests"


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code or negative signal, what it said,
    and the most memory, in bytes.
    """

    command: Sequence[str]
    code: int
    out: str
    err: str
    peak: int

    @property
    def faults(self) -> list[str]:
        """What is wrong with it."""
        wrong = [f"exit code {self.code}"] if self.code not in (0, 1, 2) else []
        if "Traceback" in self.err + self.out:
            wrong.append("traceback: " + self.err.strip().splitlines()[-1][:200])
        lines = [line for line in self.err.splitlines() if line.startswith("harness: ")]
        if self.code == 2 and (len(lines) != 1 or not lines[0].isprintable()):
            wrong.append(f"{len(lines)} lines: {self.err[:200]!r}")
        return wrong


class Running:
    """A command that runs, in a session of its own."""

    def __init__(
        self, command: Sequence[object], prepare: Callable[[], object] = lambda: None
    ) -> None:
        self.command = [str(part) for part in command]
        self._said = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            self._run(prepare)

    def _run(self, prepare: Callable[[], object]) -> None:
        code = 1
        try:
            os.setsid()
            for number, file in zip((1, 2), self._said, strict=True):
                os.dup2(file.fileno(), number)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            sys.argv = ["harness", *self.command]
            prepare()
            entry.main()
            code = 0
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
        except BaseException:
            traceback.print_exc()
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)

    def ended(self, within_s: float = LIMIT_S) -> Ended:
        """Wait for it; it is killed when it takes longer."""
        until_s = time.monotonic() + within_s
        while (done := os.wait4(self.pid, os.WNOHANG))[0] == 0:
            if time.monotonic() > until_s:
                os.killpg(self.pid, signal.SIGKILL)
            time.sleep(0.01)
        said = []
        for file in self._said:
            file.seek(0)
            said.append(file.read().decode("utf-8", "replace"))
        output, error = said
        return Ended(
            self.command, os.waitstatus_to_exitcode(done[1]), output, error, done[2].ru_maxrss << 10
        )

    def left(self, within_s: float = 5.0) -> list[int]:
        """Processes of its session that are still there so long after it ended;
        they are then killed.
        """
        return of_session(self.pid, within_s)


def typed(*command: object, prepare: Callable[[], object] = lambda: None) -> Ended:
    """Run a command to its end."""
    return Running(command, prepare).ended()


def of_session(leader: int, within_s: float = 5.0) -> list[int]:
    """Processes of a session that are still there after so many seconds; they are then killed."""
    until_s = time.monotonic() + within_s
    while (alive := list(_session(leader))) and time.monotonic() < until_s:
        time.sleep(0.05)
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    return alive


def _session(leader: int) -> Iterator[int]:
    """Processes of a session, but those that have ended and are not yet waited for."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(session) == leader and state not in "ZX":
            yield int(folder.name)


class Tally:
    """Counts cases and what was wrong with them."""

    def __init__(self) -> None:
        self.cases: dict[str, int] = {}
        self.faults: list[str] = []

    def add(self, kind: str, what: str, faults: Sequence[str]) -> None:
        """Count a case of some kind."""
        self.cases[kind] = self.cases.get(kind, 0) + 1
        print(".", end="", flush=True)
        for fault in faults:
            self.faults.append(f"{kind}, {what}: {fault}")
            print(self.faults[-1], flush=True)

    def end(self) -> None:
        """Print the counts, and one line of JSON; exit code 1 if anything was wrong."""
        print()
        for kind, count in self.cases.items():
            print(f"{kind:<40}{count:>8}")
        print(f"{'faults':<40}{len(self.faults):>8}")
        print(json.dumps({"cases": self.cases, "faults": len(self.faults)}))
        sys.exit(bool(self.faults))


def counted(doc: str | None, default: int) -> argparse.Namespace:
    """`--count` and `--seed` of a campaign."""
    arguments = argparse.ArgumentParser(description=(doc or "").split("\n")[0])
    arguments.add_argument("--count", type=int, default=default)
    arguments.add_argument("--seed", type=int, default=0)
    return arguments.parse_args()


@contextmanager
def workshop() -> Iterator[Path]:
    """A folder for a campaign, where its commands are typed, with a cache of its own."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["SWARMDRIVE_CACHE"] = str(Path(folder) / "cache")
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        (Path(folder) / "work").mkdir()
        os.chdir(Path(folder) / "work")
        yield Path.cwd()


def dataset(out: Path, episodes: int = 2) -> Path:
    """A small dataset."""
    ended = typed("dataset", "build", SCENARIO, "--episodes", episodes, "--out", out)
    if ended.code:
        sys.exit(ended.err)
    return out


def writing(here: Path, out: Path) -> dict[str, tuple[object, ...]]:
    """The commands that write, to `out` or a file of that name,
    of a dataset and runs made first.
    """
    small, run, driven = dataset(here / "small", 1), here / "run", here / "driven"
    one = ("--dataset", small, "--seeds", "0")
    drive = (
        "drive",
        "--episodes",
        2,
        "--first-seed",
        0,
        "--condition",
        "6g",
        "--seeds",
        "0",
        "--workers",
        2,
    )
    for ended in (typed("eval", *one, "--out", run), typed(*drive, "--out", driven)):
        if ended.code:
            sys.exit(ended.err)
    return {
        "eval": ("eval", *one, "--out", out),
        "drive": (*drive, "--out", out),
        "dataset build": ("dataset", "build", SCENARIO, "--episodes", 1, "--out", out),
        "sweep": ("study", "sweep", run, "--over", "tau", "--grid", "0.2,0.7", "--out", out),
        "report": ("report", run, "--out", out.with_suffix(".html")),
        "export": ("run", "export", run, "--csv", "--out", out),
        "fidelity": ("study", "fidelity", run, driven, "--out", out),
        "video": ("run", "video", driven, 0, "--out", out.with_suffix(".gif")),
        "study paper": (
            "study",
            "paper",
            "--episodes",
            10,
            "--sweep-episodes",
            10,
            "--seeds",
            "0:2",
            "--out",
            out,
        ),
        "init": ("init", out),
    }
