"""CPU seconds from the start of a process to the first `complete`,
of `harness --help` and of lists.

And wall seconds from typing `harness eval --model swarm-tiny` to its first decision, one ego and
three helpers answered by llama.cpp: that works in a process of its own.

    python benchmarks/startup.py [DATASET] [--repeats 5]

The limit is what a process with these libraries cannot do without:
the interpreter, and imports of NumPy, Jinja2 and typer.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rows import Row, finish

from harness.core.resources import DATASET
from harness.dataset import load

SMALLEST = "--repeats 1"
TABLE = "--repeats 3"
NEEDS = "llama_cpp"
LISTS = ("model list", "prompt list", "dataset scenario list")
AIMS_S = {
    "help": 0.12,
    **dict.fromkeys(LISTS, 0.12),
    "first_call": 0.45,
    "first_decision_wall": 2.0,
}

# Each ends by printing the CPU seconds of its own process; CPU time starts with the process.
TYPED = """
import sys, time
from harness.cli import main
sys.argv[0] = "harness"
try:
    main()
finally:
    print(time.process_time())
"""
FIRST_CALL = """
import os, sys, time
from harness.backends.proxy import Proxy
from harness.cli import main

def complete(self, requests):
    print(time.process_time(), flush=True)
    os._exit(0)

Proxy.complete = complete
sys.argv = ["harness", "eval", "--model", "proxy", *sys.argv[1:]]
main()
"""
# Answers of the first scene's ego and its three helpers.
FIRST_DECISION = """
import os, sys
from harness.backends.llama_cpp.backend import Child
from harness.cli import main

complete = Child.complete

def answer_first(self, requests):
    answered = complete(self, requests[:4])
    assert all(c.finish_reason == "stop" for c in answered), answered
    os._exit(0)

Child.complete = answer_first
sys.argv = ["harness", "eval", "--model", "swarm-tiny", "--no-cache", *sys.argv[1:]]
main()
"""
WHAT = {
    "help": "`harness --help`, CPU",
    "first_call": "from the start to the first model call, CPU",
    "first_decision_wall": "from typing to the first decision of `swarm-tiny`, wall",
}
LIMIT = "import time, numpy, jinja2.sandbox, typer; print(time.process_time())"


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("dataset", nargs="?", default=DATASET)
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    dataset = str(load.find(given.dataset).resolve())

    names = (*AIMS_S, "first_call_one_episode", "limit")
    found: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(given.repeats):
        with tempfile.TemporaryDirectory() as folder:
            run, short, first = (
                ["--dataset", dataset, "--out", str(Path(folder) / name), *options]
                for name, options in (("all", []), ("one", ["--limit", "1"]), ("first", []))
            )
            found["help"].append(cpu_s(TYPED, "--help"))
            for name in LISTS:
                found[name].append(cpu_s(TYPED, *name.split()))
            found["first_call"].append(cpu_s(FIRST_CALL, *run))
            found["first_call_one_episode"].append(cpu_s(FIRST_CALL, *short))
            found["first_decision_wall"].append(wall_s(FIRST_DECISION, *first))
            found["limit"].append(cpu_s(LIMIT))
    medians = {name: statistics.median(values) for name, values in found.items()}
    for name, median_s in medians.items():
        aim = f"   aim {AIMS_S[name]}" if name in AIMS_S else ""
        print(f"{name:<24}{median_s:7.3f} s{aim}")
    ratio = medians["first_call"] / medians["limit"]
    print(f"to the first call is {ratio:.2f} of the limit; medians of {given.repeats}")
    n, limit_s = given.repeats, medians["limit"]
    rows = [
        Row(
            WHAT.get(name, f"`harness {name}`, CPU"),
            medians[name],
            "s",
            n,
            None if "wall" in name else limit_s,
            aim=f"≤ {aim:g}",
        )
        for name, aim in AIMS_S.items()
    ]
    finish(rows, **medians, first_call_over_limit=ratio, repeats=n)


def cpu_s(program: str, *arguments: str) -> float:
    """What a program prints last, run in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], check=True, capture_output=True, text=True
    )
    return float(done.stdout.splitlines()[-1])


def wall_s(program: str, *arguments: str) -> float:
    """How long a new process runs a program."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", program, *arguments], check=True, capture_output=True)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
