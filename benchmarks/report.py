"""What a report weighs, how long it takes to write, and how long a browser takes to open it.

The proxy's run on the shipped dataset; for more decisions all its scenes are repeated as further
episodes. A page is *readable* at its first contentful paint, *ready* when every decision can be
filtered and opened, *drawn* when the last chart is. The limit is a page of the same bytes whose
script is taken out.

    python benchmarks/report.py [--layouts N] [--decisions 1440 20160] [--repeats 5]
"""

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from copies import copies, repeated
from playwright.sync_api import Browser, sync_playwright
from rows import Row, finish

from harness.backends import cards
from harness.coordination.named_points import POINTS
from harness.core.resources import DATASET
from harness.dataset.load import find, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.report.page import render
from harness.report.runs import Runs, gather

SMALLEST = "--layouts 1 --decisions 1 --repeats 1"
TABLE = "--decisions 1440 --repeats 3"
NEEDS = "playwright"
FLAGS = ["--no-sandbox", "--disable-gpu"]
READY = "() => document.body.dataset.ready ?? document.readyState === 'complete'"
PAINT = "() => performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? 0"


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, help="of the shipped dataset; else all")
    arguments.add_argument("--decisions", type=int, nargs="+", default=[1440, 20160])
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no chromium here; `make browser` installs it")
    found = []
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        base = Path(scratch)
        spec = Spec(
            Agent(cards.resolve("proxy"), prompts.load("v2")),
            FrozenSource(load(find(DATASET), given.layouts)),
            tuple(POINTS.values()),
            tuple(range(5)),
        )
        evaluate(spec, base / "run", lambda done: None)
        runs = gather([base / "run"])
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for n in given.decisions:
            many = many_times(runs, n, base / str(n))
            found.append(measured(many, base / f"{n}.html", browser, given.repeats))
        browser.close()
    names = list(found[0])
    for name in names:
        print(f"{name:<42}" + "".join(f"{one[name]:>12}" for one in found))
    rows = []
    for one in found:
        what = f"a report of {one['decisions (scenes)']} decision points"
        rows += [
            Row(f"{what}, written, wall", one["written, s"], "s", 1),
            Row(f"{what}, size", one["size, MB"], "MB", 1),
            Row(
                f"{what}, ready, wall",
                one["ready, s"],
                "s",
                given.repeats,
                one["limit: same bytes without script, s"],
            ),
        ]
    finish(rows, reports=found)


def many_times(runs: Runs, decisions: int, out: Path) -> Runs:
    """The same run on at least so many scenes: those it has, again and again as other episodes."""
    [run], dataset = runs.runs, runs.dataset
    assert dataset is not None
    times = -(-decisions // len(run.decisions.scenes))
    many = repeated(run, times, len(dataset.trees), out)
    _ = many.decisions, many.answers, many.scores  # reading is not timed
    return replace(runs, runs=(many,), dataset=copies(dataset, times))


def measured(runs: Runs, out: Path, browser: Browser, repeats: int) -> dict[str, Any]:
    """Weight and times of one report, each the median of the repeats."""
    start = perf_counter()
    page = render(runs)
    written_s = perf_counter() - start
    out.write_text(page, encoding="utf-8")
    bare = out.with_suffix(".bare.html")
    bare.write_text(page[: page.rindex("<script>")] + "</body></html>", encoding="utf-8")
    decisions = runs.runs[0].decisions
    last = list(decisions.scenes)[-1]
    opened = [times(browser, out, "body[data-drawn]") for _ in range(repeats)]
    alone = [times(browser, out, "#decision[data-drawn]", f"#scene={last}") for _ in range(repeats)]
    plain = [times(browser, bare, "body") for _ in range(repeats)]
    readable, ready, drawn = (median(of) for of in zip(*opened, strict=True))
    limit = median(of[1] for of in plain)
    return {
        "decisions (scenes)": len(decisions.scenes),
        "with conditions and seeds": len(decisions),
        "written, s": round(written_s, 1),
        "size, MB": round(out.stat().st_size / 1e6, 1),
        "readable, s": round(readable, 2),
        "ready, s": round(ready, 2),
        "every chart drawn, s": round(drawn, 2),
        "one decision opened by its link, s": round(median(of[2] for of in alone), 2),
        "limit: same bytes without script, s": round(limit, 2),
        "ready / limit": round(ready / limit, 1),
    }


def times(browser: Browser, file: Path, drawn: str, where: str = "") -> tuple[float, float, float]:
    """Seconds until a page is readable, ready and drawn."""
    context = browser.new_context(offline=True)
    page = context.new_page()
    start = perf_counter()
    page.goto(f"file://{file}{where}")
    while not page.evaluate(READY):
        pass
    ready = perf_counter() - start
    page.wait_for_selector(drawn, state="attached")
    done = perf_counter() - start
    readable = float(page.evaluate(PAINT)) / 1000
    context.close()
    return readable, ready, done


if __name__ == "__main__":
    main()
