"""The page of a suite: the means over families first, then success by family and condition."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.formats import SUITE
from harness.core.multiplicity import LEVEL, holm
from harness.core.seeds import purposes
from harness.dataset.load import Dataset
from harness.report import words
from harness.report.compare.page import Place, beside
from harness.report.document import Section, Table, document, linked
from harness.report.drawing import colours
from harness.report.findings import LAST, Kind, findings
from harness.report.page import save
from harness.report.references import in_trees
from harness.runs.contradictions import refuse
from harness.runs.folder import Run
from harness.runs.leading import IN_WORDS, lead_of
from harness.runs.metrics import BASELINE, GAINS, entry
from harness.runs.records import Score
from harness.runs.run_dataset import dataset_of
from harness.runs.suite import SuiteRun, mean

# of the picture of a line: pixels from 0 to 100 %, and from a condition to the next
WIDTH, STEP = 130, 9
MEAN = "mean over families"


@dataclass(frozen=True)
class Cell:
    """One family under one condition."""

    success: Score | None  # success rate, balanced where dangers are known
    gain: Score | None  # over `BASELINE`, paired; None where there is none
    # `better` or `worse` where the gain is not chance, its p at most 0.05 by Holm's method
    verdict: str


@dataclass(frozen=True)
class Line:
    """One family, or the mean over families."""

    name: str  # the family's
    run: Run | None  # its run; None for the mean
    # success of each reference, which needs no model, in the same episodes
    drivers: Mapping[str, Score]
    cells: Mapping[str, Cell]  # by condition


def lines(suite: SuiteRun, datasets: Mapping[str, Dataset] | None = None) -> list[Line]:
    """The families, then their mean. Holm's method corrects families' gains together,
    and means' together.

    Args:
        suite: what was run.
        datasets: by family, of a suite that was just made; of others they are read.

    Raises UserError if a suite, or a run of it, contradicts itself.
    """
    if datasets is None:  # else they were just made
        refuse(suite)
        datasets = {family: dataset_of(run) for family, run in suite.runs.items()}
        for family, dataset in datasets.items():
            if dataset.scenario.name != family:
                raise UserError(
                    f"{printable(suite.path)} contradicts itself: {SUITE} has a run of "
                    f"{printable(dataset.scenario.name)} as that of {printable(family)}; make the "
                    "suite again"
                )
    gains, lead = BASELINE in suite.conditions, lead_of(suite)
    of_trees = {
        family: in_trees(datasets[family].of_episodes(run.grid.episodes))
        for family, run in suite.runs.items()
    }
    drivers = {
        family: {name: scores[lead] for name, scores in of.items()}
        for family, of in of_trees.items()
    }
    p_values = {
        (family, condition): p
        for family, run in suite.runs.items()
        if gains
        for condition, p in words.p_values(run, BASELINE).items()
    }
    of_mean = {(MEAN, c): p for c, p in words.p_values(suite, BASELINE).items()} if gains else {}
    corrected = {
        key: p
        for of in (p_values, of_mean)
        for key, p in zip(of, holm(list(of.values())), strict=True)
    }

    def cells(name: str, of: Run | SuiteRun) -> dict[str, Cell]:
        by_condition = {}
        for c in suite.conditions:
            gain, p = of.score(c, GAINS[lead]), corrected.get((name, c), 1.0)
            better = "better" if gain and (gain.value or 0.0) > 0 else "worse"
            by_condition[c] = Cell(of.score(c, lead), gain, better if p <= LEVEL else "")
        return by_condition

    names = [
        name for name in next(iter(drivers.values())) if all(name in of for of in drivers.values())
    ]
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
    """Write the page of one suite's run, or of several.
    Raises UserError if `out` cannot be written.
    """
    save([render(suites, beside(out))], out, "--out")
    return out


def render(suites: Sequence[tuple[SuiteRun, Sequence[Line]]], place: Place) -> str:
    """The page of one suite's run, or of several;
    `place` gives the link to the page of a family's run.
    """
    return document([_section(suite, rows, place) for suite, rows in suites])


def _section(suite: SuiteRun, lines: Sequence[Line], place: Place) -> Section:
    origins = ". ".join(finding.sentence for finding in findings(suite, *LAST))
    return Section(
        f"{suite.variant} on {suite.name}",
        [words.headline(suite)],
        [
            f"{suite.description}. {len(suite.runs)} families × "
            f"{amount(len(suite.manifest.seeds), 'channel seed')}; figures are means over "
            "families, with 95 % intervals over episodes."
        ],
        [_families(lines, place, lead_of(suite)), _metrics(suite)],
        warnings=[finding.sentence for finding in findings(suite, Kind.VOID)],
        caveats=[finding.sentence for finding in findings(suite, Kind.CAVEAT, Kind.LIMIT)],
        numbers=_numbers(suite),
        more=Markup('<p class="quiet">{}.</p>').format(origins),
    )


def _numbers(suite: SuiteRun) -> list[dict[str, str]]:
    """Return success under each condition, and the gain of the best."""
    best, base = words.compared(suite)
    lead = lead_of(suite)
    scores = {f"{IN_WORDS[lead]} with {c}": suite.score(c, lead) for c in suite.conditions}
    gain = suite.score(best, GAINS[lead]) if base == BASELINE else None
    scores[f"more with {best} than with {base}"] = gain
    return [{"what": what, **words.shown(score)} for what, score in scores.items() if score]


def _families(lines: Sequence[Line], place: Place, lead: str) -> Table:
    mean = lines[-1]
    of_conditions = colours.conditions(mean.cells)
    key = Markup('<span class="key-colour" style="background:{}"></span>{}')
    conditions = [key.format(colour, name) for name, colour in of_conditions.items()]
    rows = [
        (
            _named(line, place),
            *map(_cell, line.cells.values()),
            _picture(line, of_conditions),
            *(words.cell(line.drivers[name]) for name in mean.drivers),
        )
        for line in lines
    ]
    gains = (
        f"; below it the gain over {BASELINE}, paired by episode. ✓ and ✗ mark a gain and a loss "
        "beyond chance: p of the gain, from its interval, is at most 0.05 after Holm's "
        "correction, which is for all families and conditions of this table, and for the means "
        "for all conditions"
    )
    note = (
        f"{IN_WORDS[lead].capitalize()} with its 95 % "
        f"interval{gains * any(cell.gain for cell in mean.cells.values())}. The mean gives each "
        "family the same weight, however many episodes it has. Its interval is combined from the "
        "intervals of the families (Zou and Donner 2008), and that of a gain is of the episodes "
        "of all families together. It is about other episodes of these families, not about other "
        "families. Dashed lines and the last columns: references, which need no model, in the "
        "same episodes; constant always takes the action that did best in the family's tune "
        "layouts, and uniform takes every action equally often, computed from the trees; a run of "
        "this name draws its actions. Below each family: the number of episodes, and what its "
        "layout seeds are for; quote only numbers of report seeds."
    )
    heads = ["family", *conditions, "0 to 100 %", *mean.drivers]
    return Table("Families × conditions", heads, rows, note, left=True, total=True)


def _named(line: Line, place: Place) -> Markup:
    if line.run is None:
        return Markup(line.name)
    size = f"n = {len(line.run.grid.episodes)}, {seeds_of(line.run)} seeds"
    return Markup("{}<small>{}</small>").format(linked(line.name, place(line.run)), size)


def _cell(cell: Cell) -> Markup:
    success = words.cell(cell.success)
    if cell.gain is None:
        return success
    text, sign = words.shown(cell.gain), {"better": "✓ ", "worse": "✗ ", "": ""}[cell.verdict]
    value = f"{sign}{'+' if (cell.gain.value or 0.0) > 0 else ''}{text['value']}"
    interval = Markup("<small>{}</small>").format(text["interval"]) if text["interval"] else ""
    return Markup('{}<span class="gain {}">{}</span>{}').format(
        success, cell.verdict, value, interval
    )


def _metrics(suite: SuiteRun) -> Table:
    """Return the means over families of every metric, with its meaning."""
    metrics = [
        entry(m) for m in dict.fromkeys(s.metric for s in suite.scores if s.condition != "all")
    ]
    rows = [
        (
            Markup("{}<small>{}</small>").format(metric.label, metric.meaning),
            *(words.cell(suite.score(c, metric.name)) for c in suite.conditions),
        )
        for metric in metrics
    ]
    note = "A dash means that at least one family has no value."
    return Table(
        "All metrics, means over families", ["metric", *suite.conditions], rows, note, folded=True
    )


def _picture(line: Line, of_conditions: Mapping[str, str]) -> Markup:
    """Return the success rates of a line and their intervals, from 0 to 100 %;
    drivers are thin lines.
    """
    height = STEP * (len(line.cells) + 1)
    parts = [
        f'<path class="driver" d="M{WIDTH * (d.value or 0.0):.1f} 2V{height - 2}"/>'
        for d in line.drivers.values()
    ]
    for n, (condition, cell) in enumerate(line.cells.items(), 1):
        s = cell.success
        if s and s.value is not None and s.low is not None and s.high is not None:
            x, low, high = (WIDTH * end for end in (s.value, s.low, s.high))
            parts.append(
                f'<g style="color:{of_conditions[condition]}"><path d="M{low:.1f} '
                f'{n * STEP}H{high:.1f}"/>'
                f'<circle cx="{x:.1f}" cy="{n * STEP}" r="3"/></g>'
            )
    return Markup(
        f'<svg class="line" viewBox="-4 0 {WIDTH + 8} {height}" width="{WIDTH + 8}" '
        f'height="{height}" '
        'aria-hidden="true">'
        f'<path class="frame" d="M0 0V{height}M{WIDTH / 2} 0V{height}M{WIDTH} 0V{height}"/>'
        f"{''.join(parts)}</svg>"
    )
