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
from harness.runs.headline import IN_WORDS, headline_of
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.metrics import entry
from harness.runs.records import Score
from harness.runs.run_dataset import dataset_of
from harness.runs.suite import SuiteRun, mean

# of the picture of a line: pixels from 0 to 100 %, and from a condition to the next
WIDTH, STEP = 130, 9
MEAN = "mean over families"


@dataclass(frozen=True)
class Cell:
    """Hold the result of one family of scenes (one scenario's dataset) under one condition.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. `success` is balanced (the mean of that with a danger and without) where dangers are
    known. `gain` is the success less that of the condition without V2V, in which the ego hears
    nobody; `verdict` is `better` or `worse` if that is significant. A danger is a vehicle that
    would meet an ego which keeps its speed.
    """

    # share of episodes that succeed, balanced over episodes with a danger and without where known
    success: Score | None
    # that less the success of the same episodes without a radio; None where there is none
    gain: Score | None
    # `better` or `worse` where the gain is not chance (p at most 0.05 by Holm's method); else empty
    verdict: str


@dataclass(frozen=True)
class Line:
    """Hold one row of a suite's table: the results on one scenario, or the mean over scenarios.

    A suite is a run on each of several families, a family the scenes of one scenario; `name` is the
    family's and `run` its run, None for the mean. `drivers` has the success of reference drivers
    (rules without a model) by name, `cells` the result by condition.
    """

    name: str  # name of the family: the scenes of one scenario
    run: Run | None  # its run; None for the mean
    # success, in the same episodes, of each rule that needs no model, by its name
    drivers: Mapping[str, Score]
    cells: Mapping[str, Cell]  # by condition


def lines(suite: SuiteRun, datasets: Mapping[str, Dataset] | None = None) -> list[Line]:
    """Return a row for each family of a suite, then one for their mean.

    A family is the scenes of one scenario.

    Args:
        suite: the suite's finished run.
        datasets: each family's dataset by its name, already loaded and trusted; None to read them
            and check the suite.

    Raises UserError if a suite, or a run of it, contradicts itself.
    """
    if datasets is None:  # else they were just made
        refuse(suite)
        datasets = _datasets(suite)
    metric = headline_of(suite)
    p_values = _p_of_gains(suite)
    lines, drivers = list[Line](), list[dict[str, Score]]()
    for family, run in suite.runs.items():
        references = in_trees(datasets[family].of_episodes(run.grid.episodes))
        drivers.append({name: scores[metric] for name, scores in references.items()})
        cells = _cells(run, suite.conditions, metric, p_values.get(family, {}))
        lines.append(Line(family, run, drivers[-1], cells))
    means, together = {}, suite.shares_cluster
    for name in drivers[0]:
        if all(name in of_family for of_family in drivers):
            means[name] = mean([of_family[name] for of_family in drivers], together)
    cells = _cells(suite, suite.conditions, metric, p_values.get(MEAN, {}))
    return [*lines, Line(MEAN, None, means, cells)]


def _datasets(suite: SuiteRun) -> dict[str, Dataset]:
    """Return the dataset of each family's run.

    Raises UserError if one is of another family.
    """
    datasets = {family: dataset_of(run) for family, run in suite.runs.items()}
    for family, dataset in datasets.items():
        if dataset.scenario.name != family:
            raise UserError(
                f"{printable(suite.path)} contradicts itself: {SUITE} has a run of "
                f"{printable(dataset.scenario.name)} as that of {printable(family)}; make the "
                "suite again"
            )
    return datasets


def _p_of_gains(suite: SuiteRun) -> dict[str, dict[str, float]]:
    """Return by family, and `MEAN`, the p of each condition's gain over `BASELINE`.

    Holm's method corrects those of all families together, and those of the mean together.
    """
    if BASELINE not in suite.conditions:
        return {}
    keys, p_values = list[tuple[str, str]](), list[float]()  # family and condition
    for family, run in suite.runs.items():
        for condition, p in words.p_values(run, BASELINE).items():
            keys.append((family, condition))
            p_values.append(p)
    corrected: dict[str, dict[str, float]] = {}
    for (family, condition), p in zip(keys, holm(p_values), strict=True):
        corrected.setdefault(family, {})[condition] = p
    of_mean = words.p_values(suite, BASELINE)
    corrected[MEAN] = dict(zip(of_mean, holm(list(of_mean.values())), strict=True))
    return corrected


def _cells(
    run: Run | SuiteRun,
    conditions: Sequence[str],
    metric: str,
    p_values: Mapping[str, float],
) -> dict[str, Cell]:
    """Return by condition the cell of a run's line; a gain without a p-value has no verdict."""
    cells = {}
    for condition in conditions:
        gain = run.score(condition, GAINS[metric])
        verdict = ""
        if p_values.get(condition, 1.0) <= LEVEL:
            verdict = "better" if gain and (gain.value or 0.0) > 0 else "worse"
        cells[condition] = Cell(run.score(condition, metric), gain, verdict)
    return cells


def seeds_of(run: Run) -> str:
    """Return what a run's layout seeds are for, such as `tune` or `report`, by their range.

    A layout seed fixes who stands where at the start of an episode.
    """
    seeds = [episode.layout_seed for episode in run.episodes]
    return " and ".join(purposes(min(seeds), max(seeds) - min(seeds) + 1))


def write(suites: Sequence[tuple[SuiteRun, Sequence[Line]]], out: Path) -> Path:
    """Write the HTML page of the runs of one or several suites, and return the file.

    A suite is a run on each of several scenarios; it comes with its rows (`lines`). Raises
    UserError if `out` cannot be written.
    """
    save([render(suites, beside(out))], out, "--out")
    return out


def render(suites: Sequence[tuple[SuiteRun, Sequence[Line]]], place: Place) -> str:
    """Return the HTML page of the runs of one or several suites, each with its rows (`lines`).

    A suite is a run on each of several families (scenarios). `place` takes a run and returns the
    link to its page, or None.
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
        [_families(lines, place, headline_of(suite)), _metrics(suite)],
        warnings=[finding.sentence for finding in findings(suite, Kind.VOID)],
        caveats=[finding.sentence for finding in findings(suite, Kind.CAVEAT, Kind.LIMIT)],
        numbers=_numbers(suite),
        more=Markup('<p class="quiet">{}.</p>').format(origins),
    )


def _numbers(suite: SuiteRun) -> list[dict[str, str]]:
    """Return success under each condition, and the gain of the best."""
    best, base = words.compared(suite)
    metric = headline_of(suite)
    scores = {}
    for condition in suite.conditions:
        scores[f"{IN_WORDS[metric]} with {condition}"] = suite.score(condition, metric)
    gain = suite.score(best, GAINS[metric]) if base == BASELINE else None
    scores[f"more with {best} than with {base}"] = gain
    return [{"what": what, **words.score_texts(score)} for what, score in scores.items() if score]


def _families(lines: Sequence[Line], place: Place, metric: str) -> Table:
    """Return the table of families × conditions by the headline metric, a row for each line."""
    mean = lines[-1]
    of_conditions = colours.conditions(mean.cells)
    key = Markup('<span class="key-colour" style="background:{}"></span>{}')
    conditions = [key.format(colour, name) for name, colour in of_conditions.items()]
    rows = []
    for line in lines:
        cells = [_cell(cell) for cell in line.cells.values()]
        drivers = [words.cell(line.drivers[name]) for name in mean.drivers]
        rows.append((_named(line, place), *cells, _picture(line, of_conditions), *drivers))
    has_gains = any(cell.gain for cell in mean.cells.values())
    gains = (
        f"; below it the gain over {BASELINE}, paired by episode. ✓ and ✗ mark a gain and a loss "
        "beyond chance: p of the gain, from its interval, is at most 0.05 after Holm's "
        "correction, which is for all families and conditions of this table, and for the means "
        "for all conditions"
    )
    note = (
        f"{IN_WORDS[metric].capitalize()} with its 95 % interval{gains * has_gains}. "
        "The mean gives each "
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
    text, sign = words.score_texts(cell.gain), {"better": "✓ ", "worse": "✗ ", "": ""}[cell.verdict]
    value = f"{sign}{'+' if (cell.gain.value or 0.0) > 0 else ''}{text['value']}"
    interval = Markup("<small>{}</small>").format(text["interval"]) if text["interval"] else ""
    return Markup('{}<span class="gain {}">{}</span>{}').format(
        success, cell.verdict, value, interval
    )


def _metrics(suite: SuiteRun) -> Table:
    """Return the means over families of every metric, with its meaning."""
    names = dict.fromkeys(score.metric for score in suite.scores if score.condition != "all")
    rows = []
    for metric in map(entry, names):
        name = Markup("{}<small>{}</small>").format(metric.label, metric.meaning)
        scores = [suite.score(condition, metric.name) for condition in suite.conditions]
        rows.append((name, *(words.cell(score) for score in scores)))
    title, heads = "All metrics, means over families", ["metric", *suite.conditions]
    note = "A dash means that at least one family has no value."
    return Table(title, heads, rows, note, folded=True)


def _picture(line: Line, of_conditions: Mapping[str, str]) -> Markup:
    """Draw the success rates of a line and their intervals, from 0 to 100 %;
    drivers are thin lines.
    """
    height = STEP * (len(line.cells) + 1)
    parts = []
    for driver in line.drivers.values():
        x = WIDTH * (driver.value or 0.0)
        parts.append(f'<path class="driver" d="M{x:.1f} 2V{height - 2}"/>')
    for n, (condition, cell) in enumerate(line.cells.items(), 1):
        s = cell.success
        if s and s.value is not None and s.low is not None and s.high is not None:
            y = n * STEP
            interval = f'<path d="M{WIDTH * s.low:.1f} {y}H{WIDTH * s.high:.1f}"/>'
            value = f'<circle cx="{WIDTH * s.value:.1f}" cy="{y}" r="3"/>'
            parts.append(f'<g style="color:{of_conditions[condition]}">{interval}{value}</g>')
    size = f'viewBox="-4 0 {WIDTH + 8} {height}" width="{WIDTH + 8}" height="{height}"'
    frame = f"M0 0V{height}M{WIDTH / 2} 0V{height}M{WIDTH} 0V{height}"
    return Markup(
        f'<svg class="line" {size} aria-hidden="true">'
        f'<path class="frame" d="{frame}"/>{"".join(parts)}</svg>'
    )
