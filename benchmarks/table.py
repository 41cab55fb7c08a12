"""The table of benchmarks/README.md, all of it from this commit:
runs the benchmarks that have rows in it.

    python benchmarks/table.py [--only TEXT] [--smallest] [--page benchmarks/README.md]

A benchmark says in constants with which options it is run: `TABLE` for the table (some minutes in
all), and `SMALLEST` in seconds, as the tests run it. Its last line is JSON with `rows` (rows.py).
Others' load is the mean number of cores that other processes took meanwhile. Before is the figure
on the page that is committed, and what is 10 % worse than it is marked. What fails is named under
the table.
"""

import argparse
import ast
import json
import os
import platform
import re
import resource
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from pages import write_tables
from rows import Row

SMALLEST = "--smallest --only coordinate"
HERE = Path(__file__).parent
HEADS = (
    *("what", "measured", "before", "n", "aim", "limit", "measured / limit", "peer"),
    "others' load",
)
WORSE = 1.1  # times as much, or as little where more is better, is marked
MORE = ("/s", "times")  # units of which more is better
BUSY = ("user", "nice", "system", "irq", "softirq")  # of the times in /proc/stat
TIMES = ("user", "nice", "system", "idle", "iowait", "irq", "softirq")


def main() -> None:
    """Run, print the table, and write it; exit with 1 if a benchmark failed."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--only", default="", help="only benchmarks whose name has this text")
    arguments.add_argument("--smallest", action="store_true", help="at their smallest, to try them")
    arguments.add_argument(
        "--page", type=Path, help="page between whose marks the table is written"
    )
    given = arguments.parse_args()
    lines, failed = [heads(HEADS)], []
    before = figures(committed(given.page)) if given.page else {}
    start = perf_counter()
    for script, stated in scripts().items():
        if "TABLE" not in stated or given.only not in script.stem:
            continue
        size = "SMALLEST" if given.smallest else "TABLE"
        if size not in stated:
            failed.append(f"`{script.name}` has no {size}.")
            continue
        options = shlex.split(stated[size])
        print(" ".join(["benchmarks/" + script.name, *options]), file=sys.stderr, flush=True)
        busy_s, began_s = busy(), perf_counter()
        done = subprocess.run(
            [sys.executable, str(script), *options], stdout=subprocess.PIPE, text=True
        )
        load = (busy() - busy_s) / (perf_counter() - began_s)
        if done.returncode:
            failed.append(f"`{script.name}` failed.")
        else:
            found = json.loads(done.stdout.splitlines()[-1])["rows"]
            lines += [line(Row(**row), load, before) for row in found]
    took = f"{perf_counter() - start:.0f} s in all."
    text = "\n".join([machine(), "", *lines, "", " ".join([took, *failed])])
    print(text)
    if given.page:
        write_tables(given.page, text)
    if failed:
        raise SystemExit(1)


def scripts() -> Mapping[Path, Mapping[str, Any]]:
    """Return each program of this folder,
    and the constants in capitals that it states as they stand.
    """
    found = {}
    for path in sorted(HERE.glob("*.py")):
        parts = ast.parse(path.read_text("utf-8")).body
        if any(isinstance(part, ast.If) for part in parts):  # if __name__ == "__main__"
            found[path] = {
                part.targets[0].id: part.value.value
                for part in parts
                if isinstance(part, ast.Assign)
                and isinstance(part.targets[0], ast.Name)
                and isinstance(part.value, ast.Constant)
            }
    return found


def heads(cells: Sequence[str]) -> str:
    """Return a table's first two lines."""
    return f"| {' | '.join(cells)} |\n|{'---|' * len(cells)}"


def committed(page: Path) -> str:
    """Return a page as it is committed; nothing of one that is not."""
    words = ["git", "-C", str(page.parent), "show", f"HEAD:./{page.name}"]
    printed: str = subprocess.run(words, capture_output=True, text=True).stdout
    return printed


def figures(text: str) -> dict[str, str]:
    """Return what a page's table says was measured, by the row's name."""
    return dict(re.findall(r"^\| ([^|]+) \| (\d[^|]*) \|", text, flags=re.MULTILINE))


def line(row: Row, load: float, before: Mapping[str, str]) -> str:
    """Return a row's line; `before` has former figures by the row's name."""
    limit, ratio = "", ""
    if row.limit is not None:
        limit, ratio = (
            shown(row.limit, row.unit),
            f"{row.measured / row.limit:.2g}" if row.limit else "",
        )
    former = before.get(row.what, "")
    mark = ", **worse**" if is_worse(row, former) else ""
    figure = shown(row.measured, row.unit)
    cells = (row.what, figure, former + mark, str(row.n), row.aim, limit, ratio, row.peer)
    return f"| {' | '.join(cells)} | {load:.1f} |"


def is_worse(row: Row, former: str) -> bool:
    """Return whether a figure is `WORSE` than a former one, such as `2 ms`, in the same unit."""
    number, _, unit = former.partition(" ")
    if not number or unit != row.unit or not row.measured:
        return False
    is_more_better = unit in MORE or "of ideal" in row.what
    ratio = row.measured / float(number)
    return (1 / ratio if is_more_better else ratio) > WORSE


def shown(value: float, unit: str) -> str:
    """Return a value with two digits or more, and its unit."""
    return f"{value:.0f} {unit}" if value >= 100 else f"{value:.2g} {unit}"


def busy() -> float:
    """Return CPU seconds that processes which this one did not start have taken since the machine
    started.
    """
    own = resource.getrusage(resource.RUSAGE_CHILDREN)
    ticks = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:])
    of = dict(zip(TIMES, ticks, strict=False))
    return sum(of[name] for name in BUSY) / os.sysconf("SC_CLK_TCK") - own.ru_utime - own.ru_stime


def machine() -> str:
    """Return on what, and of which commit, all is measured."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", HERE, *words], capture_output=True, text=True
        ).stdout.strip()

    names = [
        s for s in Path("/proc/cpuinfo").read_text().splitlines() if s.startswith("model name")
    ]
    processor = names[0].partition(": ")[2] if names else platform.machine()
    changed = " with changes" if git("status", "--porcelain", "--untracked-files=no") else ""
    python = f"Python {platform.python_version()}"
    commit = git("rev-parse", "--short", "HEAD")
    return f"{os.cpu_count()} cores of {processor}, {python}, commit {commit}{changed}:"


if __name__ == "__main__":
    main()
