"""`harness eval --dataset suite:NAME`: a run of each dataset, and the means over families."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer

from harness.cli import brief
from harness.cli.next_command import after_suite
from harness.cli.run import RunGroup, as_mapping, free_folder
from harness.cli.terminal import console, echo_json, echo_text, table
from harness.core.errors import UserError, printable
from harness.core.figures import amount, interval_of
from harness.core.formats import SUITE, WORK

if TYPE_CHECKING:
    from harness.dataset.load import Dataset
    from harness.dataset.suites import Suite
    from harness.evaluate.spec import Spec
    from harness.report.suite import Line
    from harness.runs.records import Score
    from harness.runs.suite import SuiteRun

MOST_INTERVALS = 3  # conditions whose intervals fit into a line


def check(suite: "Suite", specs: "Sequence[Spec]") -> None:
    """Raise UserError unless a model can be evaluated on a suite, several datasets at once.

    `specs` are the evaluations on them. Each scenario may have one dataset, latency must not be
    measured, and no model may be a replay.
    """
    from harness.runs.records import MEASURED

    families = [spec.scenario.name for spec in specs]
    if twice := {family for family in families if families.count(family) > 1}:
        raise UserError(
            f"suite {printable(suite.name)} has {' and '.join(sorted(twice))} twice; "
            "give each family one dataset"
        )
    first = specs[0]
    if first.settings.latency == MEASURED:
        raise UserError(
            f"--latency {MEASURED}: it needs an idle machine, which its own first runs keep busy; "
            "measure on one dataset, and give the seconds that its run.json has"
        )
    for agent in first.agents:
        if not agent.can.closed_loop:
            reason = "a replay has the answers of one run; replay its dataset"
            if agent.can.from_file:
                reason = "a file has the answers on one dataset; give --dataset"
            raise UserError(f"--model {printable(agent.card.name)}: {reason}")


def evaluate(
    suite: "Suite",
    specs: "Sequence[Spec]",
    datasets: "Sequence[Dataset]",
    out: Path | None,
    evaluated: Callable[..., Any],
    quiet: bool,
    as_json: bool,
    verbose: bool = False,
    edition: Sequence[object] = (),
) -> Path:
    """Evaluate on every dataset of a suite with one backend; write and print the means.

    A suite is several datasets, one for each family of scenes. Returns the suite's folder.

    Args:
        suite: the suite.
        specs: the evaluation on each of its datasets.
        datasets: these datasets, in the same order.
        out: the folder to write; None for a default one.
        evaluated: evaluates one of `specs`, and writes its run; it takes the evaluation, the run's
            folder, and what opens a backend.
        quiet: whether to show no progress.
        as_json: whether to print JSON instead of tables.
        verbose: whether to print all tables, and not only what the suite comes to.
        edition: words of the command that evaluates another model so, if it is not `harness eval`.
    """
    from harness.backends.registry import open_backend
    from harness.evaluate.run import finished_run
    from harness.report import suite as report
    from harness.runs.folder import read
    from harness.runs.suite import SUMMARY, SuiteRun, write

    by_name = {spec.source.name: spec for spec in specs}
    group = RunGroup(by_name, "a finished suite", SUITE, (SUMMARY, "report.html"))
    folder = out or free_folder(specs, suite.name, group.goes_on)
    group.check(folder)
    opens = cache(open_backend)
    for spec in specs:
        run = folder / spec.source.name
        if not (run / "run.json").is_file() or (run / WORK).is_dir():
            evaluated(spec, run, opens)
        else:
            finished_run(spec, run)
    by_family = {spec.scenario.name: dataset for spec, dataset in zip(specs, datasets, strict=True)}
    runs = {family: read(folder / dataset.name) for family, dataset in by_family.items()}
    done = SuiteRun(folder, suite.name, suite.description, runs)
    lines = report.lines(done, by_family)
    page = report.write([(done, lines)], folder / "report.html")
    write(done)
    if as_json:
        echo_json(_mapping(done, lines))
    elif not quiet:
        (_show if verbose else _show_briefly)(done, lines)
        typer.echo(f"wrote {printable(page)}")
        after_suite(done, edition)
    return folder


def _mapping(done: "SuiteRun", lines: "Sequence[Line]") -> dict[str, Any]:
    """Return a suite's run as plain values: each family's run, and the means over families."""
    drivers = {line.name: msgspec.to_builtins(line.drivers) for line in lines}
    families = {}
    for family, run in done.runs.items():
        families[family] = {**as_mapping(run), "drivers": drivers[family]}
    return {
        "suite": done.name,
        "folder": str(done.path),
        "families": families,
        "mean": {"summary": msgspec.to_builtins(done.scores), "drivers": drivers[lines[-1].name]},
    }


def _show(done: "SuiteRun", lines: "Sequence[Line]") -> None:
    """Print success, gains and what needs no model, each a table of families."""
    from harness.report.findings import LAST, Kind, findings
    from harness.report.suite import seeds_of
    from harness.runs.headline import IN_WORDS, headline_of
    from harness.runs.metric_names import BASELINE
    from harness.world.drivers import ALWAYS

    text, m = console(), done.variant
    text.print(
        f"{printable(m.model, 30)} · prompt {m.prompt} · {m.answer} · suite {printable(done.name)}"
    )
    for finding in findings(done, Kind.VOID, Kind.CAVEAT):
        text.print(finding.sentence)
    gaining = [c for c in done.conditions if c != BASELINE] if BASELINE in done.conditions else []
    _matrix(f"{IN_WORDS[headline_of(done)]}, % [95 % CI]", "success", done.conditions, lines)
    _matrix(f"gain over {BASELINE}, points", "gain", gaining, lines)
    # `constant` stands for the two that always take one action: a line has no room for all.
    drivers = [name for name in lines[-1].drivers if name not in ALWAYS]
    rows = []
    for line in lines:
        rates = [f"{100 * (line.drivers[driver].value or 0.0):.1f}" for driver in drivers]
        n, seeds = "", ""
        if line.run:
            n, seeds = str(len(line.run.grid.episodes)), seeds_of(line.run)
        rows.append((line.name, *rates, n, seeds))
    table(("references, %", *drivers, "n", "seeds"), rows)
    text.print("references are computed from the trees; a run of uniform draws, and may differ")
    text.print(
        f"n: episodes, each × {amount(len(done.manifest.seeds), 'channel seed')}; seeds: what the "
        "layout seeds are for; 95 % intervals over episodes; gains are paired; the mean gives "
        "each family the same weight, and its interval is about other episodes of these families, "
        "not about other families"
    )
    for finding in findings(done, *LAST):
        text.print(finding.sentence)


def _show_briefly(done: "SuiteRun", lines: "Sequence[Line]") -> None:
    """Print success of each family and of their mean, by condition, with the mean's gain."""
    from harness.runs.headline import IN_WORDS, headline_of
    from harness.runs.metrics import entry

    metric, beside = headline_of(done), done.conditions[:MOST_INTERVALS]
    brief.echo_title(done.manifest, done.variant, f"suite {printable(done.name)}")
    brief.echo_warnings(done)
    rows = []
    for line in lines:
        cells = [_cell(line.cells[condition].success) for condition in beside]
        rows.append((line.name, *cells))
    halves = zip(entry(metric).halves, ("  with a danger", "  without"), strict=False)
    for half, name in halves:
        rows.append((name, *(_cell(done.score(condition, half)) for condition in beside)))
    table((f"{IN_WORDS[metric]}, %", *beside), rows)
    references = []
    for name in brief.BESIDE:
        if name in lines[-1].drivers:
            references.append(f"{name} {interval_of(lines[-1].drivers[name])}")
    echo_text(f"without a model: {', '.join(references)}")
    brief.echo_gain(done)
    layouts = sum(len(run.grid.episodes) for run in done.runs.values())
    seeds = amount(len(done.manifest.seeds), "channel seed")
    echo_text(f"n = {layouts} episodes × {seeds}; all tables and notes: --verbose")
    brief.echo_cost(done)


def _matrix(head: str, what: str, conditions: "Sequence[str]", lines: "Sequence[Line]") -> None:
    """Print one score of every family and condition, with its interval."""
    for start in range(0, len(conditions), MOST_INTERVALS):
        beside = conditions[start : start + MOST_INTERVALS]
        rows = []
        for line in lines:
            scores = [getattr(line.cells[condition], what) for condition in beside]
            rows.append((line.name, *(_cell(score) for score in scores)))
        table((head, *beside), rows)
        typer.echo()


def _cell(score: "Score | None") -> str:
    return "-" if score is None else interval_of(score)
