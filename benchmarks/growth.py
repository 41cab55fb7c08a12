"""How time and memory grow with the decisions of a run, and time with the workers.

Decisions: `harness eval --model proxy`, report included, on the first layouts of the shipped
dataset, and on all of them many times over where they are too few; beyond a million, under more
seeds of the channel. The limit of the time is what the proxy takes to answer all that is asked;
that of the memory, a process that only holds the decisions as a table and the page's text. Where
Chromium is, it opens the page: the time until every decision can be filtered and opened, the least
of three. Workers: chunks that wait for a second, four a worker, so that any number of them fits the
cores that are here; the limit is those four seconds.

    python benchmarks/growth.py [--decisions 1000 10000 100000 1000000 10000000]
                                [--workers 1 2 4 8 16 32 64] [--seconds 1] [--first 20]
                                [--picture growth.svg]
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import pyarrow.parquet as pq
from commands import HERE, copied, run
from executors import nap
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from playwright.sync_api import sync_playwright
from report import FLAGS, times
from rows import Row as Figures
from rows import finish

from harness.backends import cards
from harness.backends.registry import open_backend
from harness.core.parallel import spread
from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.report.drawing.colours import BAD, GREY, INK
from harness.report.drawing.pictures import save, styled
from harness.runs import folder

SMALLEST = "--decisions 10 --workers 1 2 --seconds 0.01 --first 1"
TABLE = "--decisions 1000 10000 100000 --workers 1 2 4 8"
NEEDS = "matplotlib playwright"
MOST = 1_000_000  # decisions under five seeds: ten times as many layouts would be 80 GB
A_WORKER = 4
AIM_MB = 2000
HOLDS = """
import resource, sys
from pathlib import Path
import pyarrow.parquet as pq
run = Path(sys.argv[1])
held = pq.read_table(run / "decisions.parquet"), (run / "report.html").read_text()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""
Row = Mapping[str, float]


def main() -> None:
    """Print two tables and one line of JSON, and draw them."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--decisions", type=int, nargs="*", default=[10**n for n in range(3, 8)])
    arguments.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4, 8, 16, 32, 64])
    arguments.add_argument("--seconds", type=float, default=1.0, help="that a chunk waits")
    arguments.add_argument(
        "--first", type=int, default=20, help="layouts that tell how much a layout is"
    )
    arguments.add_argument("--picture", type=Path)
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        decisions = of_decisions(given.decisions, given.first, Path(scratch))
    workers = [of_workers(n, given.seconds) for n in given.workers]
    for rows in filter(None, (decisions, workers)):
        print("".join(f"{name:>12}" for name in rows[0]))
        for row in rows:
            print(
                "".join(
                    f"{value:12.0f}" if value >= 100 else f"{value:12.2f}" for value in row.values()
                )
            )
    if given.picture:
        save(drawn(decisions, workers), given.picture, "svg")
    figures = []
    for row in decisions:
        what = f"{row['decisions']:.0f} decisions with their page"
        figures += [
            Figures(f"{what}, CPU", row["cpu_s"], "s", 1, row["limit_s"]),
            Figures(f"{what}, peak memory", row["peak_mb"], "MB", 1, row["limit_mb"]),
        ]
    for row in workers:
        took, what = (
            row["wall_s"] - row["start_s"],
            f"{row['workers']} workers that wait, after the start",
        )
        figures.append(Figures(what, took, "s", 1, row["limit_s"]))
    finish(figures, decisions=decisions, workers=workers)


def of_decisions(sizes: Sequence[int], first: int, scratch: Path) -> list[Row]:
    """Runs of about so many decisions: what each took, and its limits."""
    shipped = load(find(DATASET))
    each = len(evaluated(["--limit", str(first)], scratch)[0].decisions) / first
    answer_s = of_an_answer(first)
    rows: list[Row] = []
    for size in sizes:
        again = math.ceil(size / MOST)
        layouts = math.ceil(size / again / each)
        options = ["--limit", str(layouts), "--seeds", f"0:{5 * again}"]
        if layouts > len(shipped.episodes):
            large = scratch / f"large-{layouts}"
            if not large.exists():
                copied(math.ceil(layouts / len(shipped.episodes)), large)
            options += ["--dataset", str(large)]
        made, row = evaluated(options, scratch)
        command = [sys.executable, "-c", HOLDS, str(made.path)]
        held = subprocess.run(command, capture_output=True, check=True, text=True).stdout
        answers = (made.path / "answers.jsonl").read_bytes().count(b"\n")
        rows.append(
            {
                "decisions": pq.read_metadata(made.path / "decisions.parquet").num_rows,
                **row,
                "limit_s": answer_s * answers,
                "limit_mb": float(held),
                "opened_s": opened(made.path),
            }
        )
        print(json.dumps(rows[-1]), flush=True)  # the next may take long
    return rows


def evaluated(options: Sequence[str], scratch: Path) -> tuple[folder.Run, Row]:
    """`harness eval --model proxy` with some options:
    the run, its wall and CPU time and its memory.
    """
    start = perf_counter()
    cpu_s, peak_mb = run(
        HERE, ["eval", "--model", "proxy", "--quiet", *options, "--out", "OUT"], scratch
    )
    row = {"wall_s": perf_counter() - start, "cpu_s": cpu_s, "peak_mb": peak_mb}
    return folder.read(scratch / "run"), row


def opened(run: Path) -> float:
    """Seconds until a run's page is ready in Chromium, the least of three; NaN without one."""
    chromium = shutil.which("chromium")
    if chromium is None:
        return math.nan
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        return min(times(browser, run / "report.html", "body[data-drawn]")[1] for _ in range(3))


def of_an_answer(layouts: int) -> float:
    """CPU seconds that the proxy takes to answer."""
    dataset, card = load(find(DATASET), layouts), cards.resolve("proxy")
    spec = Spec(Agent(card, prompts.load("v2")), FrozenSource(dataset), (), (0,))
    asked = list(requests(spec, dataset.scenes(dataset.courses())))
    backend = open_backend(card)
    start = process_time()
    backend.complete(asked)
    return (process_time() - start) / len(asked)


def of_workers(workers: int, seconds: float) -> Row:
    """Wall time of four chunks a worker, after one each that pays for the start."""
    both = [[0.0] * workers + [seconds] * (A_WORKER * workers), [0.0] * workers]
    took = []
    for chunks in both:
        start = perf_counter()
        spread(nap, chunks, workers, lambda done: None, repeatable=False)
        took.append(perf_counter() - start)
    return {
        "workers": workers,
        "wall_s": took[0],
        "start_s": took[1],
        "limit_s": A_WORKER * seconds,
    }


@styled
def drawn(decisions: Sequence[Row], workers: Sequence[Row]) -> Figure:
    """Three charts, each with its limit."""
    figure = Figure(figsize=(7.2, 2.6))
    time, memory, hands = figure.subplots(1, 3)

    def line(
        axes: Any,
        rows: Sequence[Row],
        x: str,
        y: Callable[[Row], float],
        colour: str,
        label: str,
        end: str = "-",
    ) -> None:
        axes.plot(
            [row[x] for row in rows],
            [y(row) for row in rows],
            end,
            marker="o",
            ms=3,
            color=colour,
            label=label,
        )

    line(
        time, decisions, "decisions", lambda row: row["cpu_s"], INK, "harness eval, report included"
    )
    line(
        time,
        decisions,
        "decisions",
        lambda row: row["limit_s"],
        GREY,
        "limit: the proxy's answers",
        "--",
    )
    time.set(xscale="log", yscale="log", xlabel="decisions", ylabel="CPU seconds")
    line(memory, decisions, "decisions", lambda row: row["peak_mb"], INK, "peak of harness eval")
    line(
        memory,
        decisions,
        "decisions",
        lambda row: row["limit_mb"],
        GREY,
        "limit: table and page",
        "--",
    )
    memory.axhline(AIM_MB, color=BAD, lw=0.8, label="aim")
    memory.set(xscale="log", yscale="log", xlabel="decisions", ylabel="MB")
    line(
        hands,
        workers,
        "workers",
        lambda row: row["wall_s"] - row["start_s"],
        INK,
        "after the start",
    )
    line(hands, workers, "workers", lambda row: row["wall_s"], INK, "with the start", ":")
    line(
        hands, workers, "workers", lambda row: row["limit_s"], GREY, "limit: the chunks' own", "--"
    )
    hands.set(
        xscale="log", xlabel="workers", ylabel="seconds of four chunks a worker", ylim=(0, None)
    )
    hands.set_xticks(
        [row["workers"] for row in workers],
        [f"{row['workers']:.0f}" for row in workers],
        minor=False,
    )
    hands.minorticks_off()
    powers = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
    for axes in (time, memory):
        axes.xaxis.set_major_formatter(
            lambda n, _: f"10{str(round(math.log10(n))).translate(powers)}"
        )
        axes.yaxis.set_major_formatter(lambda n, _: f"{n:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    memory.set_yticks([200, 500, 1000, 2000, 5000, 10000])
    for axes, corner in ((time, "lower right"), (memory, "upper left"), (hands, "lower left")):
        axes.legend(fontsize=6, frameon=False, loc=corner)
        axes.spines[["top", "right"]].set_visible(False)
    figure.subplots_adjust(left=0.085, right=0.99, bottom=0.17, top=0.97, wspace=0.34)
    return figure


if __name__ == "__main__":
    main()
