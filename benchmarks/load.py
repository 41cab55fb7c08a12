"""How long `harness.load` takes to read a run of a million decisions, and how much memory.

    python benchmarks/load.py [RUN] [--decisions 1000000] [--repeats 5] [--layouts N]

The run is made of a real one, by default of the shipped dataset: its decisions, answers and
episodes stand in it again and again under new numbers of episodes. It is read in a process of its
own. The limit is what nobody can do without: imports of pandas and pyarrow, and the same Parquet
file as a data frame.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from copies import repeated
from rows import Row, finish

from harness.runs import folder

SMALLEST = "--decisions 100 --repeats 1 --layouts 1"
TABLE = "--repeats 1"
AIMS = {"decisions_s": 3.0, "decisions_mb": 2000.0}

# Each ends by printing wall seconds, CPU seconds and peak memory in MB of its own process.
MEASURED = """
import resource, sys, time
start = time.perf_counter()
{}
mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(time.perf_counter() - start, time.process_time(), mb)
"""
PROGRAMS = {
    "decisions": "import harness; assert len(harness.load(sys.argv[1]).decisions)",
    "all_tables": "import harness; run = harness.load(sys.argv[1]); "
    "assert all(map(len, (run.summary, run.episodes, run.decisions, run.answers)))",
    "limit": "import pandas, pyarrow.parquet as pq; "
    "assert len(pq.ParquetFile(sys.argv[1] + '/decisions.parquet').read().to_pandas())",
}


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("run", nargs="?", type=Path)
    arguments.add_argument("--decisions", type=int, default=1_000_000)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument(
        "--layouts", type=int, help="of the shipped dataset in the real run; else all"
    )
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        source = given.run or evaluated(Path(scratch) / "real", given.layouts)
        run = folder.read(source)
        times = -(-given.decisions // len(run.decisions))
        large = repeated(run, times, max(run.grid.episodes) + 1, Path(scratch) / "large").path
        size = {file.name: round(file.stat().st_size / 1e6, 1) for file in large.iterdir()}
        found: dict[str, float] = {}
        for name, program in PROGRAMS.items():
            times = [measured(program, large) for _ in range(given.repeats)]
            for unit, values in zip(("s", "cpu_s", "mb"), zip(*times, strict=True), strict=True):
                found[f"{name}_{unit}"] = statistics.median(values)
    for name, value in found.items():
        aim = f"   aim {AIMS[name]:g}" if name in AIMS else ""
        print(f"{name:<16}{value:9.2f}{aim}")
    ratio = found["decisions_s"] / found["limit_s"]
    print(f"{ratio:.2f} of the limit; medians of {given.repeats}; files in MB: {size}")
    what, n = f"{given.decisions} decisions as a table", given.repeats
    rows = [
        Row(
            f"{what}, wall",
            found["decisions_s"],
            "s",
            n,
            found["limit_s"],
            aim=f"≤ {AIMS['decisions_s']:g}",
        ),
        Row(f"{what}, peak memory", found["decisions_mb"], "MB", n, found["limit_mb"]),
    ]
    finish(rows, **found, over_limit=ratio, repeats=given.repeats, files_mb=size)


def evaluated(out: Path, layouts: int | None) -> Path:
    """A run of the proxy on the shipped dataset."""
    command = [sys.executable, "-m", "harness", "eval", "--model", "proxy", "--no-cache", "--quiet"]
    few = ["--limit", str(layouts)] if layouts else []
    subprocess.run([*command, *few, "--out", out], check=True, capture_output=True)
    return out


def measured(program: str, run: Path) -> list[float]:
    """What a program prints last, run in a new process."""
    command = [sys.executable, "-c", MEASURED.format(program), str(run)]
    return [
        float(value)
        for value in subprocess.run(command, check=True, capture_output=True).stdout.split()
    ]


if __name__ == "__main__":
    main()
