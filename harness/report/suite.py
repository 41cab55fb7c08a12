"""The page of a suite: the means over families first, then success by family and condition."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from harness.core.multiplicity import LEVEL, holm
from harness.core.seeds import purposes
from harness.dataset.load import Dataset
from harness.report import caveats, words
from harness.report.compare.page import Place, beside
from harness.report.constancy import ignores_input
from harness.report.drawing import colours
from harness.report.page import environment, save
from harness.report.references import in_trees
from harness.runs.folder import Run, dataset_of
from harness.runs.metrics import BASELINE, GAIN, SUCCESS, entry
from harness.runs.records import Score
from harness.runs.suite import SuiteRun, mean

WIDTH, STEP = 130, 9  # of the picture of a line: pixels from 0 to 100 %, and from a condition to the next
MEAN = "mean over families"


@dataclass(frozen=True)
class Cell:
    """One family under one condition."""

    success: Score | None  # success rate
    gain: Score | None  # over `BASELINE`, paired; None where there is none
    verdict: str  # `better` or `worse` where the gain is not chance, its p at most 0.05 by Holm's method


@dataclass(frozen=True)
class Line:
    """One family, or the mean over families."""

    name: str  # the family's
    run: Run | None  # its run; None for the mean
    drivers: Mapping[str, Score]  # success of each reference, which needs no model, in the same episodes
    cells: Mapping[str, Cell]  # by condition


def lines(suite: SuiteRun, datasets: Mapping[str, Dataset] | None = None) -> list[Line]:
    """The families, then their mean. Holm's method corrects families' gains together, and means' together.

    Args:
        suite: what was run.
        datasets: by family, those that were read already; others are read.
    """
    datasets, gains = datasets or {}, BASELINE in suite.conditions
    drivers = {
        family: in_trees((datasets.get(family) or dataset_of(run)).of_episodes(run.grid.episodes))
        for family, run in suite.runs.items()
    }
    p_values = {
        (family, condition): p
        for family, run in suite.runs.items() if gains
        for condition, p in words.p_values(run, BASELINE).items()
    }  # fmt: skip
    of_mean = {(MEAN, c): p for c, p in words.p_values(suite, BASELINE).items()} if gains else {}
    corrected = {
        key: p for of in (p_values, of_mean) for key, p in zip(of, holm(list(of.values())), strict=True)
    }

    def cells(name: str, of: Run | SuiteRun) -> dict[str, Cell]:
        by_condition = {}
        for c in suite.conditions:
            gain, p = of.score(c, GAIN), corrected.get((name, c), 1.0)
            better = "better" if gain and (gain.value or 0.0) > 0 else "worse"
            by_condition[c] = Cell(of.score(c, SUCCESS), gain, better if p <= LEVEL else "")
        return by_condition

    names = [name for name in next(iter(drivers.values())) if all(name in of for of in drivers.values())]
    means = {name: mean([of[name] for of in drivers.values()]) for name in names}
    return [
        *(Line(name, run, drivers[name], cells(name, run)) for name, run in suite.runs.items()),
        Line(MEAN, None, means, cells(MEAN, suite)),
    ]


def seeds_of(run: Run) -> str:
    """Return what the layout seeds of a run's episodes are for."""
    seeds = [episode.layout_seed for episode in run.episodes]
    return " and ".join(purposes(min(seeds), max(seeds) - min(seeds) + 1))


def write(suites: Sequence[tuple[SuiteRun, Sequence[Line]]], out: Path) -> Path:
    """Write the page of one suite's run, or of several. Raises UserError if `out` cannot be written."""
    save([render(suites, beside(out))], out, "--out")
    return out


def render(suites: Sequence[tuple[SuiteRun, Sequence[Line]]], place: Place) -> str:
    """The page of one suite's run, or of several; `place` gives the link to the page of a family's run."""
    parts = [
        {
            "suite": suite,
            "lines": rows,
            "unread": [
                *caveats.merged(suite.runs, caveats.unanswered),
                *caveats.merged(suite.runs, lambda run: caveats.unread(run.scores)),
            ],
            "warnings": [
                *caveats.no_prompt(run.manifest for run in suite.runs.values()),
                *caveats.merged(suite.runs, ignores_input),
                *caveats.merged(suite.runs, caveats.of_run),
            ],
            "headline": words.headline(suite),
            "figures": _figures(suite),
            "metrics": _metrics(suite),
            "colours": colours.conditions(suite.conditions),
        }
        for suite, rows in suites
    ]
    return environment().get_template("suite.html.j2").render(
        parts=parts, place=place, picture=_picture, seeds_of=seeds_of, baseline=BASELINE,
    )  # fmt: skip


def _figures(suite: SuiteRun) -> list[dict[str, str]]:
    """Return success under each condition, and the gain of the best."""
    best, base = words.compared(suite)
    scores = {f"success with {c}": suite.score(c, SUCCESS) for c in suite.conditions}
    scores[f"more with {best} than with {base}"] = suite.score(best, GAIN) if base == BASELINE else None
    return [{"what": what, **words.shown(score)} for what, score in scores.items() if score]


def _metrics(suite: SuiteRun) -> list[tuple[str, str, list[Score | None]]]:
    """Return means over families of every metric: its name, its meaning, its value in each condition."""
    names = dict.fromkeys(s.metric for s in suite.scores if s.condition != "all")
    return [(entry(m).label, entry(m).meaning, [suite.score(c, m) for c in suite.conditions]) for m in names]


def _picture(line: Line, of_conditions: Mapping[str, str]) -> Markup:
    """Return the success rates of a line and their intervals, from 0 to 100 %; drivers are thin lines."""
    height = STEP * (len(line.cells) + 1)
    parts = [f'<path class="driver" d="M{WIDTH * (d.value or 0.0):.1f} 2V{height - 2}"/>'
             for d in line.drivers.values()]  # fmt: skip
    for n, (condition, cell) in enumerate(line.cells.items(), 1):
        s = cell.success
        if s and s.value is not None and s.low is not None and s.high is not None:
            x, low, high = (WIDTH * end for end in (s.value, s.low, s.high))
            parts.append(
                f'<g style="color:{of_conditions[condition]}"><path d="M{low:.1f} {n * STEP}H{high:.1f}"/>'
                f'<circle cx="{x:.1f}" cy="{n * STEP}" r="3"/></g>'
            )
    return Markup(
        f'<svg class="line" viewBox="-4 0 {WIDTH + 8} {height}" width="{WIDTH + 8}" height="{height}" '
        'aria-hidden="true">'
        f'<path class="frame" d="M0 0V{height}M{WIDTH / 2} 0V{height}M{WIDTH} 0V{height}"/>'
        f"{''.join(parts)}</svg>"
    )
