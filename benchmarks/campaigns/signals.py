"""Commands in real processes, stopped by SIGTERM or SIGINT at any moment from their start to their
end.

    python benchmarks/campaigns/signals.py [--count 200] [--seed 0]

A third of the signals come while the interpreter and the command start, a third anywhere, and a
third around the end. SIGTERM must end with exit code 143 and SIGINT with 130, or by the signal
itself, with one line or none; a command that has ended already, with 0. SIGINT before the program's
first line is Python's own, and counted apart. `kills.py` forks its commands from a process that has
loaded the harness: it sees no start.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass

from judging import Tally, counted, dataset, of_session, typed, workshop

ENTRY = (sys.executable, "-m", "harness")
SIGNALS = {signal.SIGTERM: 143, signal.SIGINT: 130}
START_S = 0.6
BEGUN = "harness/__main__.py"  # in a traceback that begins in the program


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code, what it said on stderr, and how long it took."""

    code: int
    err: str
    took_s: float


def stopped(
    command: Sequence[object], number: signal.Signals | None, after_s: float
) -> tuple[Ended, list[int]]:
    """Run a command and send it a signal after some time;
    also the processes that it leaves behind.
    """
    with tempfile.TemporaryFile() as err:
        begun_s = time.monotonic()
        process = subprocess.Popen(
            [*ENTRY, *map(str, command)],
            stdout=subprocess.DEVNULL,
            stderr=err,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        if number:
            try:
                process.wait(after_s)
            except subprocess.TimeoutExpired:
                os.kill(process.pid, number)  # it is not waited for yet, so its number is its own
        code = process.wait(120)
        took_s = time.monotonic() - begun_s
        left = of_session(process.pid)
        err.seek(0)
        return Ended(code, err.read().decode("utf-8", "replace"), took_s), left


def faults(ended: Ended, number: signal.Signals, left: Sequence[int]) -> list[str]:
    """What is wrong with how a stopped command ended."""
    wrong = [] if ended.code in (0, SIGNALS[number], -number) else [f"exit code {ended.code}"]
    if "Traceback" in ended.err or "Exception ignored" in ended.err:
        wrong.append(f"traceback: {ended.err[-600:]}")
    said = [line for line in ended.err.splitlines() if line.startswith("harness: ")]
    if len(said) > 1:
        wrong.append(f"{len(said)} lines: {ended.err[-300:]}")
    return wrong + ([f"{len(left)} processes left"] if left else [])


def main() -> None:
    """Start, stop, count."""
    given = counted(__doc__, 200)
    rng, tally = random.Random(given.seed), Tally()
    with workshop() as here:
        small, run = dataset(here / "small"), here / "run"
        assert typed("eval", "--dataset", small, "--seeds", "0", "--out", run).code == 0
        commands = {
            "--help": ("--help",),
            "ls": ("run", "ls", here),
            "model list": ("model", "list"),
            "radio show": ("radio", "show", "mode4"),
            "eval": ("eval", "--dataset", small, "--seeds", "0:2"),
            "drive": (
                "drive",
                "--episodes",
                16,
                "--seeds",
                "0",
                "--condition",
                "6g",
                "--workers",
                2,
            ),
            "report": ("report", run),
            "sweep": ("study", "sweep", run, "--over", "tau", "--grid", "0.2,0.7"),
            "dataset build": (
                "dataset",
                "build",
                "occluded-intersection",
                "--episodes",
                2,
                "--workers",
                2,
            ),
        }
        writes = {"eval", "drive", "sweep", "dataset build"}
        took_s = {}
        for name, command in commands.items():
            out = (
                ("--out", here / "whole" / name.replace(" ", "-") / "set") if name in writes else ()
            )
            ended, _ = stopped((*command, *out), None, 0.0)
            assert ended.code == 0, ended
            took_s[name] = ended.took_s
        codes: dict[str, int] = {}
        for n in range(given.count):
            name = list(commands)[n % len(commands)]
            number = list(SIGNALS)[n // len(commands) % 2]
            whole_s = took_s[name]
            after_s = rng.choice(
                [
                    rng.uniform(0.0, min(START_S, whole_s)),
                    rng.uniform(0.0, whole_s),
                    rng.uniform(0.85 * whole_s, 1.1 * whole_s),
                ]
            )
            out = ("--out", here / str(n) / "set") if name in writes else ()
            ended, left = stopped((*commands[name], *out), number, after_s)
            early = number == signal.SIGINT and "Traceback" in ended.err and BEGUN not in ended.err
            what = f"{number.name} {'before the first line' if early else ended.code}"
            codes[what] = codes.get(what, 0) + 1
            wrong = [] if early else faults(ended, number, left)
            tally.add(f"{name}, {number.name}", f"after {after_s:.3f} s", wrong)
        print()
        for what, count in sorted(codes.items()):
            print(f"exit code of {what:<27}{count:>8}")
        tally.end()


if __name__ == "__main__":
    main()
