"""What does it bring to answer faster? The same answers at several latencies,
under several conditions.

    python benchmarks/speed_of_answers.py [--only TEXT] [--layouts N] [--dataset D]
                                          [--out reports/speed]
                                          [--page benchmarks/measured/speed-of-answers.md]
                                          [--picture docs/pictures/speed-of-answers.svg]

For each row of `ROWS` it evaluates the model on report layouts of a suite, once at each of
`LATENCIES_MS`. The first run asks; the others find its answers in the completion cache, and the
page is refused if one question was answered in two ways. `proxy`, a rule, also drives the same
layouts in closed loop, where an action begins when its decision is ready. It writes the page's
tables between its marks, and the picture. What is finished is read and not made again; a stopped
one goes on with the same command.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pages
from families import Families, Row
from matplotlib.figure import Figure
from pages import harness, markdown, write_tables

from harness.core.figures import interval_of
from harness.dataset.load import find, load
from harness.report.drawing.colours import GREY, MARKERS, conditions
from harness.report.drawing.pictures import save, styled
from harness.runs.headline import BALANCED
from harness.runs.metric_names import BASELINE, GAINS
from harness.world import scenarios

SMALLEST = "--only proxy --layouts 1 --dataset blind-merge-v2"
LATENCIES_MS = (145, 50, 26, 16, 5)
ASKING = ("v2x", "6g", "mode2", "cloud")
SHOWN = ("v2x", "6g", "mode2")  # conditions in which helpers are asked, in the picture


ROWS = (
    Row("proxy", "v4", "json"),
    Row("swarm-tiny-six", "v4", "readout", limit=20),
    Row("sparrow-general", "v9", "decision", limit=60),
)
DRIVES = "proxy"
DRIVEN, DRIVEN_MS = "occluded-intersection-v3", (145, 50, 5)


def main() -> None:
    """Make what is missing, and write the page's tables and its picture."""
    arguments = pages.options(__doc__, "speed", picture=True)
    arguments.add_argument("--dataset", help="instead of each row's own")
    given = arguments.parse_args()
    rows = [row.asked(given.layouts, given.dataset) for row in ROWS]
    for row in (row for row in rows if given.only in row.name):
        for ms in LATENCIES_MS:
            row.evaluate(given.out / row.name / f"frozen-{ms}", *options(ms))
        for ms in DRIVEN_MS if row.model == DRIVES else ():
            drive(row, ms, given.out / row.name / f"driven-{ms}")
    done = {
        f"{row}{how}": timed
        for row in rows
        for kind, how in (("frozen", ""), ("driven", ", driven in one family"))
        if (timed := timed_of(given.out / row.name, kind))
    }
    text = "\n\n".join(written(name, timed) for name, timed in done.items())
    print(text)
    if given.page:
        write_tables(given.page, text)
    if given.picture:
        save(drawn(done), given.picture, "svg")


def options(ms: int) -> list[str]:
    """Return the options of a latency and of all conditions."""
    points = [word for point in (BASELINE, *ASKING) for word in ("--condition", point)]
    return ["--latency", f"ego={ms / 1000}", *points]


def drive(row: Row, ms: int, out: Path) -> None:
    """Drive the layouts of `DRIVEN` at one latency, unless it is done."""
    if not (out / "run.json").exists():
        data = load(find(DRIVEN))
        scenario = ("--scenario", scenarios.argument(data.scenario), "--seeds", "0:2")
        layouts = (
            "--episodes",
            str(row.limit or len(data.episodes)),
            "--first-seed",
            str(data.seeds[0]),
        )
        harness("drive", *row.who, *scenario, *layouts, *options(ms), "--out", str(out), "--quiet")


@cache
def timed_of(here: Path, kind: str) -> dict[int, Families] | None:
    """Read a model's runs by latency; None unless all are there.
    Ends the program if answers differ.
    """
    latencies = DRIVEN_MS if kind == "driven" else LATENCIES_MS
    read = {ms: Families.read(here / f"{kind}-{ms}") for ms in latencies}
    found = {ms: families for ms, families in read.items() if families}
    answered: dict[tuple[str, str], str] = {}
    for family, run in (
        (f, run) for families in found.values() for f, run in families.runs.items()
    ):
        for answer in run.answers if kind == "frozen" else ():
            if answered.setdefault((family, answer.id), answer.raw) != answer.raw:
                raise SystemExit(
                    f"{run.path}: {answer.id} was answered otherwise at another latency"
                )
    return found if len(found) == len(latencies) else None


def written(name: str, timed: Mapping[int, Families]) -> str:
    """Return a model's tables: gains over alone, what a faster answer adds, late decisions."""
    first = timed[LATENCIES_MS[0]]
    gains, late = GAINS[BALANCED], "deadline_miss_rate"
    heads = ["ms", "alone", *(f"{c} over alone" for c in ASKING)]
    over = {ms: [at.shown(c, gains, "+") for c in ASKING] for ms, at in timed.items()}
    rows = [[f"{ms}", at.shown(BASELINE, BALANCED), *over[ms]] for ms, at in timed.items()]
    every = (BASELINE, *ASKING)
    faster = [
        [f"{ms}", *(interval_of(at.over(first, c), sign="+") for c in every)]
        for ms, at in timed.items()
        if at is not first
    ]
    lates = [[f"{ms}", *(at.shown(c, late) for c in every)] for ms, at in timed.items()]
    return "\n\n".join(
        [
            f"### {name}",
            f"Balanced success, %, of {first.counted}:",
            markdown(heads, rows),
            f"The same, less that at {LATENCIES_MS[0]} ms in the same condition:",
            markdown(["ms", *every], faster),
            "Decisions that outlast the window, %:",
            markdown(["ms", *every], lates),
        ]
    )


@styled
def drawn(done: Mapping[str, Mapping[int, Families]]) -> Figure:
    """Draw what asking helpers brings over alone at the same latency; one panel a model."""
    figure = Figure(figsize=(2.3 * len(done) + 0.3, 2.6), layout="constrained")
    panels = figure.subplots(1, len(done), sharey=True, squeeze=False)[0]
    for axes, (name, timed) in zip(panels, done.items(), strict=True):
        axes.axhline(0, color=GREY, linewidth=0.8)
        for n, (condition, colour) in enumerate(conditions(SHOWN).items()):
            points = [each.estimate(condition, GAINS[BALANCED]) for each in timed.values()]
            value, low, high = 100 * np.array([(p.value, p.low, p.high) for p in points if p]).T
            axes.errorbar(
                np.array(list(timed)) * 1.07 ** (n - 1),
                value,
                yerr=[value - low, high - value],
                label=condition,
                color=colour,
                marker=MARKERS[n],
                markersize=3,
                capsize=2,
                linewidth=1.0,
            )
        axes.set(xscale="log", xlabel="one answer, ms")
        axes.set_xticks(LATENCIES_MS, [str(ms) for ms in LATENCIES_MS])
        axes.minorticks_off()
        axes.set_title(name, fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("balanced success over alone, points")
    figure.axes[0].legend(fontsize=6, frameon=False)
    return figure


if __name__ == "__main__":
    main()
