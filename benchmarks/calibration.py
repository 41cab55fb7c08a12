"""What calibrating a model's answers does: probabilities, trigger, bits, latency and success.

    python benchmarks/calibration.py [--only TEXT] [--layouts N] [--out reports/calibration]
                                     [--page benchmarks/measured/calibration.md]

For each row of `ROWS` it evaluates the model on tune layouts of `SCENES`, fits L0, L1 and both
there (`harness model calibrate`), and evaluates it on report layouts of the same scenes as it
answers and by each fit. All conditions share answers and draws, and differences are paired by
layout. It writes the tables of the page between its marks. What is finished is read and not made
again.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple, get_args

from pages import harness, markdown, options, write_tables

from harness.core.arrays import Floats
from harness.core.figures import PERCENT, POINTS, Unit, interval_of
from harness.core.resources import MARKER
from harness.core.statistics import Estimate
from harness.extensions.calibration.calibrations import FOLDER, Level
from harness.runs import reliability
from harness.runs.estimates import difference
from harness.runs.folder import Run, read
from harness.runs.headline import BALANCED
from harness.runs.metric_values import by_episode
from harness.runs.metrics import entry, metrics_of
from harness.runs.summary import judged_of

SMALLEST = "--only proxy --layouts 2"
SCENES = "occluded-intersection:witnesses=each,radio_share=0.25,limits=2,perception=2"
REPORT = "occluded-intersection-v3"  # report layouts of the same scenes
TUNE_LAYOUTS = 60
LEVELS = get_args(Level)
POINTS_PLAYED = ALONE, HELPED = "single-local", "6g"
HONEST = (
    "optimal_action_rate",
    "optimal_brier",
    "optimal_nll_nats",
    "entropy_nats",
    "calibration_error_one_optimal",
    "coverage_at_5_risk_one_optimal",
)
ECE = HONEST.index("calibration_error_one_optimal")
COSTS = ("trigger_rate", "bits_per_episode", "latency_proxy_ms", BALANCED)
UNITS = (PERCENT, Unit(factor=1e-3), Unit(), PERCENT, PERCENT)
SEEDS = "0,1,2,3,4"


class Row(NamedTuple):
    """A model, and how it is asked."""

    model: str
    prompt: str
    answer: str = "json"
    letters: str = ""  # where it answers by letters

    @property
    def name(self) -> str:
        return "-".join(filter(None, (self.model, self.letters)))


ROWS = (
    Row("proxy", "v4"),
    Row("sparrow-general", "v4", "decision"),
    Row("swarm-tiny-six", "v4", "readout", "raw"),
    Row("swarm-tiny-six", "v4", "readout", "cyclic"),
)


def main() -> None:
    """Make what is missing, and write the page's tables."""
    given = options(__doc__, "calibration").parse_args()
    page = given.page and given.page.resolve()
    (given.out / FOLDER).mkdir(parents=True, exist_ok=True)
    (given.out / MARKER).touch()
    os.chdir(given.out)  # a project, whose calibrations are found
    if not Path("tune/manifest.json").exists():
        harness(
            "dataset",
            "build",
            SCENES,
            "--episodes",
            str(given.layouts or TUNE_LAYOUTS),
            "--no-audit",
            "--out",
            "tune",
        )
    runs = [(row, evaluated(row, given.layouts)) for row in ROWS if given.only in row.name]
    text = "\n\n".join([probabilities(runs), cooperation(runs)])
    print(text)
    if page:
        write_tables(page, text)


def fit_of(row: Row, level: str) -> str:
    """Return the name of a row's calibration."""
    return f"{row.name}-{level.lower().replace('+', '-')}"


def evaluated(row: Row, layouts: int | None) -> Run:
    """Return a row's run on report layouts, made if it is missing."""
    if not Path(row.name, "report/run.json").exists():
        evaluate(row, "tune", POINTS_PLAYED, layouts)
        for level in LEVELS:
            file = Path(FOLDER, f"{fit_of(row, level)}.toml")
            if not file.exists():
                run = f"{row.name}/tune"
                harness(
                    "model",
                    "calibrate",
                    run,
                    "--dataset",
                    "tune",
                    "--level",
                    level,
                    "--out",
                    str(file),
                )
        corrected = [
            f"{point}:calibration={fit_of(row, level)}"
            for level, point in product(LEVELS, POINTS_PLAYED)
        ]
        evaluate(row, "report", [*POINTS_PLAYED, *corrected], layouts)
    return read(Path(row.name, "report"))


def evaluate(row: Row, purpose: str, conditions: Sequence[str], layouts: int | None) -> None:
    """Evaluate a row's model on layouts for a purpose, unless it is done; every helper answers."""
    out = Path(row.name, purpose)
    if not (out / "run.json").exists():
        harness(
            "eval",
            "--model",
            row.model,
            "--prompt",
            row.prompt,
            "--answer",
            row.answer,
            *(("--letters", row.letters) if row.letters else ()),
            *(("--limit", str(layouts)) if layouts else ()),
            "--dataset",
            "tune" if purpose == "tune" else REPORT,
            "--seeds",
            SEEDS,
            "--ties",
            "drawn",
            "--ask",
            "all",
            "--latency",
            "paper",
            "--quiet",
            "--out",
            str(out),
            *(word for condition in conditions for word in ("--condition", condition)),
        )


def variants(row: Row, point: str) -> Iterator[tuple[str, str]]:
    """Yield in words how answers are corrected, and the condition, as they are answered first."""
    yield "–", point
    yield from ((level, f"{point}:calibration={fit_of(row, level)}") for level in LEVELS)


def probabilities(runs: Sequence[tuple[Row, Run]]) -> str:
    """Return the table of how honest the ego's own answers are."""
    rows = []
    for row, run in runs:
        judged = judged_of(run.grid, run.decisions, run.grid.places(run.decisions))
        of_condition = dict(zip(run.conditions, judged, strict=True))
        for words, condition in variants(row, ALONE):
            scores = [run.score(condition, name) for name in HONEST]
            texts = [interval_of(s, entry(s.metric).unit) if s else "–" for s in scores]
            *_, change = reliability.difference(
                of_condition[ALONE],
                of_condition[condition],
                reliability.calibration_error,
                len(run.grid.episodes),
            )
            texts.insert(ECE, str(len(of_condition[condition].sure)))
            rows.append(
                [
                    row.name,
                    words,
                    *texts,
                    "–" if condition == ALONE else interval_of(change, POINTS),
                ]
            )
    head = (
        "alone",
        "calibration",
        "optimal action %",
        "Brier",
        "NLL nats",
        "entropy nats",
        "one optimal action, n",
        "ECE %",
        "coverage %",
        "change of ECE, points",
    )
    return markdown(head, rows)


def cooperation(runs: Sequence[tuple[Row, Run]]) -> str:
    """Return the table of what becomes of trigger, messages, latency and success."""
    rows = []
    for row, run in runs:
        values = by_episode(metrics_of(run.world), run.grid, run.decisions, run.episodes)
        for words, condition in variants(row, HELPED):
            scores = [run.score(condition, name) for name in COSTS]
            scores.append(run.score(condition.replace(HELPED, ALONE, 1), BALANCED))
            texts = [
                interval_of(s, unit) if s else "–" for s, unit in zip(scores, UNITS, strict=True)
            ]
            places = run.conditions.index(condition), run.conditions.index(HELPED)
            change = changed(values, places)
            n = str(len(run.grid.episodes))
            rows.append(
                [
                    row.name,
                    words,
                    n,
                    *texts,
                    "–" if condition == HELPED else interval_of(change, POINTS),
                ]
            )
    head = (
        HELPED,
        "calibration",
        "layouts",
        "asks %",
        "kbit an episode",
        "latency ms",
        "balanced success %",
        "the same alone %",
        "change under 6g, points",
    )
    return markdown(head, rows)


def changed(values: Mapping[str, Floats], places: tuple[int, int]) -> Estimate:
    """Return by how much balanced success is higher in the first condition, paired by layout."""
    first, second = places
    halves = entry(BALANCED).halves
    return difference(
        BALANCED, [(values[half][first].T, values[half][second].T) for half in halves]
    )


if __name__ == "__main__":
    main()
