"""Commands killed at any moment, and typed again until they are done:
the same files, and nobody left.

    python benchmarks/campaigns/kills.py [--count 200] [--seed 0]

In turn `eval` (asking and writing), `drive` (driving) and `dataset build`, both with two workers;
in turn by SIGKILL of the main process alone, by SIGKILL of all of them, and by SIGTERM. When is
drawn from the time that the command takes undisturbed. A third of them are killed twice.
"""

import os
import random
import shutil
import signal
import time
from pathlib import Path

from judging import Running, Tally, counted, dataset, typed, workshop

from harness.runs import folder

MANNERS = ("SIGKILL of the main process", "SIGKILL of all", "SIGTERM")
TEXTS = ("answers.jsonl", "episodes.csv", "summary.csv")


def main() -> None:
    """Kill, go on, compare."""
    given = counted(__doc__, 200)
    rng = random.Random(given.seed)
    tally = Tally()
    with workshop() as here:
        dataset(here / "small")
        commands = {
            "eval": ("eval", "--dataset", here / "small", "--seeds", "0:2", "--out"),
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
                "--out",
            ),
            "dataset build": (
                "dataset",
                "build",
                "occluded-intersection",
                "--episodes",
                2,
                "--workers",
                2,
                "--out",
            ),
        }
        whole, took_s = {}, {}
        for name, command in commands.items():
            whole[name] = here / "whole" / "set"
            whole[name] = whole[name].with_name(name) if name != "dataset build" else whole[name]
            begun_s = time.monotonic()
            assert typed(*command, whole[name]).code == 0
            took_s[name] = time.monotonic() - begun_s
        unfinished = 0
        for n in range(given.count):
            name = list(commands)[n % 3]
            manner = MANNERS[n // 3 % 3]
            out = here / str(n) / "set"
            faults = []
            for _ in range(2 if rng.random() < 1 / 3 else 1):
                running = Running((*commands[name], out))
                time.sleep(rng.uniform(0.0, took_s[name]))
                kill(running.pid, manner)
                ended = running.ended()
                faults += [f"{len(left)} processes left"] if (left := running.left()) else []
                if ended.code not in (0, 2, -signal.SIGKILL, 128 + signal.SIGTERM, -signal.SIGTERM):
                    faults.append(f"exit code {ended.code}")
                if "Traceback" in ended.err:
                    faults.append(f"traceback: {ended.err[-300:]}")
            done = (out / ("manifest.json" if name == "dataset build" else "report.html")).is_file()
            unfinished += not done
            again = typed(*commands[name], out)
            if again.code != 0 and "already holds a finished" not in again.err:
                faults.append(f"does not go on: {again.err}")
            else:
                faults += differences(name, whole[name], out)
            tally.add(f"{name}, {manner}", f"kill {n}", faults)
            shutil.rmtree(out.parent)
        print(f"{unfinished} of {given.count} killed before they were done")
        tally.end()


def kill(pid: int, manner: str) -> None:
    """End a command, if it is still there: it is not waited for yet, so its number is its own."""
    number = signal.SIGTERM if manner == "SIGTERM" else signal.SIGKILL
    if manner == "SIGKILL of all":
        try:
            os.killpg(pid, number)
        except ProcessLookupError:  # not yet a group of its own
            os.kill(pid, number)
    else:
        os.kill(pid, number)


def differences(name: str, whole: Path, out: Path) -> list[str]:
    """Files that are not those of an undisturbed command, or that should not be there."""
    names, others = ({p.name for p in where.iterdir()} for where in (whole, out))
    wrong = sorted(names ^ others)
    same = names if name == "dataset build" else {*TEXTS}
    wrong += [
        file for file in same & others if (whole / file).read_bytes() != (out / file).read_bytes()
    ]
    if name != "dataset build":
        tables = [folder.read(run).decisions.table for run in (whole, out)]
        wrong += [] if tables[0].equals(tables[1]) else ["decisions.parquet"]
    return [f"differs: {', '.join(wrong)}"] if wrong else []


if __name__ == "__main__":
    main()
