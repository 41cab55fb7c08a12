"""CPU seconds and peak memory of commands on a run of a million decisions, held by a limit.

    python benchmarks/many_decisions.py [--decisions 1000000] [--layouts N]

The run is of the shipped dataset under one condition and as many channel seeds as it takes; the
run that it is compared with is its copy. Above the limit of memory the benchmark fails: 1 GB for up
to a million decisions and a fifth, 2 GB for more.
"""

import argparse
import math
import shutil
import sys
import tempfile
from pathlib import Path

import pyarrow.parquet as pq
from commands import HERE, run
from rows import Row, finish

SMALLEST = "--decisions 50 --layouts 4"
TABLE = "--decisions 1000000"
SMALL, SMALL_MB, LARGE_MB = 1_200_000, 1000, 2000


def main() -> None:
    """Print each command's figures, and all as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--decisions", type=int, default=1_000_000)
    arguments.add_argument("--layouts", type=int, help="of the shipped dataset; else all")
    given = arguments.parse_args()
    few = ["--limit", str(given.layouts)] if given.layouts else []
    evaluated = ["eval", "--model", "proxy", "--condition", "6g", "--quiet", *few]
    rows, above = list[Row](), list[str]()
    with tempfile.TemporaryDirectory() as scratch:
        runs = Path(scratch) / "runs"
        run(HERE, [*evaluated, "--seeds", "0", "--out", "OUT"], runs)
        seeds = math.ceil(given.decisions / decisions_in(runs / "run"))
        again = Path(scratch) / "again"
        commands = {
            "eval with its page": [*evaluated, "--seeds", f"0:{seeds}", "--out", "OUT"],
            "report": ["report", "RUN", "--out", str(Path(scratch) / "page.html")],
            "compare": ["compare", "RUN", str(again)],
            "run export --csv": ["run", "export", "RUN", "--csv", "--out", scratch],
        }
        for name, command in commands.items():
            cpu_s, peak_mb = run(HERE, command, runs)
            if not again.exists():
                shutil.copytree(runs / "run", again)
            decisions = decisions_in(again)
            limit_mb = SMALL_MB if decisions <= SMALL else LARGE_MB
            what = f"{name} of {decisions} decisions of one condition"
            print(f"{name:<20}{cpu_s:>9.1f} CPU s{peak_mb:>8.0f} MB, limit {limit_mb}", flush=True)
            rows.append(Row(f"{what}, CPU", cpu_s, "s", 1))
            rows.append(Row(f"{what}, peak memory", peak_mb, "MB", 1, limit_mb))
            if peak_mb > limit_mb:
                above.append(f"{what} took {peak_mb:.0f} MB, above {limit_mb}")
    finish(rows, decisions=decisions, seeds=seeds)
    if above:
        sys.exit("; ".join(above))


def decisions_in(path: Path) -> int:
    """The rows of a run's table of decisions."""
    return int(pq.read_metadata(path / "decisions.parquet").num_rows)


if __name__ == "__main__":
    main()
