"""What `harness eval` and `harness drive` have in common:
a run's folder, its table and its JSON.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer

from harness.cli.progress import bar
from harness.cli.terminal import console, table
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.formats import WORK
from harness.runs import headline

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.dataset.load import Dataset
    from harness.evaluate.agent import Agent
    from harness.evaluate.command_options import Follow
    from harness.evaluate.lifecycle import Evaluated
    from harness.evaluate.run import Opens
    from harness.evaluate.spec import Spec
    from harness.runs.folder import Run
    from harness.runs.records import Score


@dataclass(frozen=True)
class Column:
    """Describe a column of a run's table: its head, and the metric whose scores stand below it.

    `metric` is the metric's name, as in `summary.csv`. With `interval`, a score is shown with its
    95 % interval, else with its unit.
    """

    head: str  # title of the column
    metric: str  # name of the metric, such as `success_rate`
    interval: bool = False  # whether a score is shown with its 95 % interval, else with its unit

    def cell(self, score: "Score | None") -> str:
        """Return a cell of the column as text, given a score of its metric; a dash for None."""
        if score is None or score.value is None:
            return "-"
        from harness.runs.estimates import written
        from harness.runs.metrics import entry

        return written(score) if self.interval else entry(score.metric).unit.text(score.value)


HALVES = (
    Column("with a danger", "success_dangerous_rate", interval=True),
    Column("without", "success_harmless_rate", interval=True),
)
BALANCED = (Column("balanced success % [95 % CI]", headline.BALANCED, interval=True), *HALVES)


# Rows of success by who can tell of the danger; the first stands for layouts without one.
BY_WITNESSES = {
    "no danger": "success_harmless_rate",
    "seen by 0": "success_dangerous_rate_0_witnesses",
    "seen by 1": "success_dangerous_rate_1_witness",
    "seen by 2": "success_dangerous_rate_2_witnesses",
    "seen by 3": "success_dangerous_rate_3_witnesses",
    "with a radio": "success_dangerous_rate_with_radio",
}
MOST_BESIDE = 3  # conditions of a table of intervals


def file_name(model: str) -> str:
    """Return a model's name with characters that suit a folder's name: others become hyphens."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in model).strip(".-") or "model"


def evaluate(
    spec: "Spec",
    folder: Path,
    opens: "Opens | None" = None,
    *,
    cache: Path | None,
    quiet: bool,
    workers: "Workers",
    full: bool = False,
    then: "Callable[[], object]" = lambda: None,
    follows: "Sequence[Follow]" = (),
) -> "tuple[Evaluated, Path]":
    """Evaluate with a progress bar, and write the run and its report; return the run and the page.

    Args:
        spec: what to evaluate, in frozen (recorded) scenes or in closed loop.
        folder: the run's folder.
        opens: opens a model's backend; None for the usual way.
        cache: file of stored completions; None for no cache.
        quiet: whether to show no progress.
        workers: worker processes.
        full: whether the report includes prompts of rules and all pictures.
        then: adds files to the run; if it is interrupted, the run can be resumed.
        follows: what is told of the run as it goes, such as a tracker.
    """
    from harness.cli.report import write
    from harness.evaluate.costs import Spending
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.run import evaluate as evaluated

    name, dataset = printable(spec.ego.card.name, 30), None
    if isinstance(spec.source, FrozenSource):
        dataset = spec.source.dataset
        progress = bar(f"asking {name}", quiet=quiet, grows=True)
    else:
        progress = bar(f"driving {name}", len(list(spec.source.layout_seeds)), quiet)
    with ExitStack() as stack:
        followers = [stack.enter_context(follow(folder, spec.record())) for follow in follows]
        with progress as done:
            done.spent = Spending(spec.record(), folder / WORK)
            count_new: Callable[[int], None] = done
            for follower in followers:
                count_new = follower.counting(count_new)
            run = evaluated(spec, folder, count_new, cache, done.more, workers, opens)
        dataset = dataset and walked(dataset, run)
        with work.going_on(folder):
            page = write(
                [folder], quiet=quiet, dataset=dataset, workers=workers if dataset else 1, full=full
            )
            then()
        work.tidy(folder)
        for follower in followers:
            follower.end(run)
    return run, page


def walked(dataset: "Dataset", run: "Evaluated") -> "Dataset":
    """Return the episodes of a dataset that a run evaluated, the first ones, as a dataset.

    A run may stop early, once it has seen enough; then they are fewer than were asked for.
    """
    numbers = dataset.episodes[: run.manifest.world.episodes]
    if len(numbers) == len(dataset.episodes):
        return dataset
    return dataset.of_episodes(frozenset(numbers))


def default_out(spec: "Spec") -> Path:
    """Return the default folder of an evaluation under reports/.

    It is a new one, named after model, prompt and dataset, or the one in which the same evaluation
    was stopped.
    """
    from harness.evaluate.lifecycle import resumable

    return free_folder([spec], spec.source.name, lambda folder: resumable(spec, folder))


def free_folder(specs: "Sequence[Spec]", scenes: str, goes_on: Callable[[Path], bool]) -> Path:
    """Return a folder under reports/ named after the models, the prompts and `scenes`.

    `specs` are the evaluations to be written there, with the same models. It is the first, with a
    number if needed, that does not exist or for which `goes_on` is true: the same evaluation was
    stopped there.
    """
    ego, *helpers = specs[0].agents
    prompts = "-".join(dict.fromkeys(spec.ego.prompt.version for spec in specs))
    name = f"{file_name(ego.card.name)}-{prompts}{_mode(ego)}"
    for helper in helpers:
        name += f"-with-{file_name(helper.card.name)}-{helper.prompt.version}{_mode(helper)}"
    name += f"-{scenes}"
    return first_folder(name, lambda folder: not folder.exists() or goes_on(folder))


def first_folder(name: str, usable: Callable[[Path], bool]) -> Path:
    """Return the first folder among reports/`name`, reports/`name`-2 and so on that is `usable`.

    `usable` takes a folder and says whether it may be taken. If the folder has a number, a line on
    stderr says so.
    """
    named = Path("reports") / name
    folders = (named if n == 1 else named.with_name(f"{name}-{n}") for n in count(1))
    folder = next(filter(usable, folders))
    if folder != named:
        typer.echo(
            f"{printable(named)} is there already; this goes to {printable(folder)}", err=True
        )
    return folder


@dataclass(frozen=True)
class RunGroup:
    """Describe several runs that a command makes in one folder, such as one on each dataset.

    `specs` has their evaluations by folder name. `marker` is the file that is written once all are
    done, `what` names the finished folder in messages, and `others` are files that may be there
    before.
    """

    specs: "Mapping[str, Spec]"  # by the name of the run's own folder in it
    what: str  # words for the folder when all is done, such as `a finished suite`
    marker: str  # name of the file that marks the folder as finished
    others: Sequence[str]  # names of files that are written to the folder before that one

    def check(self, out: Path) -> None:
        """Raise UserError unless a group's runs can be made in a folder.

        It must be new or empty, or these runs were stopped in it.
        """
        from harness.evaluate.lifecycle import finished, unfinished

        if (out / self.marker).is_file():
            raise UserError(
                f"--out {printable(out)} already holds {self.what}; choose another folder or "
                "delete it"
            )
        if out.exists() and not out.is_dir():
            raise UserError(f"--out {printable(out)} is no folder; choose an empty or a new one")
        names = [path.name for path in out.iterdir()] if out.is_dir() else []
        others = [name for name in names if name not in (*self.others, *self.specs)]
        if any(name[0] != "." for name in others):
            raise UserError(
                f"--out {printable(out)} is a folder with other files in it; choose an empty or a "
                "new one"
            )
        for name, spec in self.specs.items():
            (finished if (out / name / "run.json").is_file() else unfinished)(spec, out / name)

    def goes_on(self, out: Path) -> bool:
        """Return whether these runs were stopped in a folder, and no process works there now."""
        try:
            self.check(out)
        except UserError:
            return False
        runs = [out / name for name in self.specs]
        return not any(work.held(run) for run in runs if (run / WORK).is_dir())


def _mode(agent: "Agent") -> str:
    answer = "" if agent.answer == "json" else f"-{agent.answer}"
    return answer + ("" if agent.image == "own" else f"-{agent.image}-image")


def as_mapping(run: "Run") -> dict[str, Any]:
    """Return a finished run as plain values for JSON.

    The keys are `run` (its folder), `manifest`, `caveats`, `notes` and `summary`, a row for each
    score.
    """
    from harness.report.findings import FIRST, LAST, Kind, findings

    variant = msgspec.to_builtins(run.manifest.variant)
    return {
        "run": str(run.path),
        "manifest": run.manifest.as_file(),
        "caveats": [finding.sentence for finding in findings(run, *FIRST)],
        "notes": [finding.sentence for finding in findings(run, Kind.FIGURE, *LAST)],
        "summary": [{**variant, **msgspec.to_builtins(score)} for score in run.scores],
    }


def show(
    done: "Evaluated",
    run: "Run",
    scenes: str,
    columns: Sequence[Column],
    notes: Sequence[str],
    beside: "Mapping[str, Mapping[str, Score]] | None" = None,
) -> None:
    """Print a run's table, a row for each condition, with its caveats and notes.

    A condition is a set of settings, by its name, that the run scores; caveats are what a reader
    must know first.

    Args:
        done: the run as it was just evaluated.
        run: the same, as it was read from its folder.
        scenes: a phrase on its scenes.
        columns: the table's columns; a run with balanced success has a table of that first.
        notes: sentences to print below.
        beside: rows of references without a model: scores by name and metric; None for none.
    """
    from harness.report.findings import FIRST, LAST, Kind, findings

    manifest = done.manifest
    figures = {(s.condition, s.metric): s for s in done.scores if s.interval != "seed means"}
    names = [point["name"] for point in manifest.conditions]
    text = console()
    model, prompt = printable(manifest.model["name"], 40), manifest.prompt["version"]
    text.print(f"{model} · prompt {prompt} · {manifest.answer} · {scenes}")
    if manifest.helpers:
        text.print(f"helpers: {printable(manifest.variant.helpers)}")
    for finding in findings(run, *FIRST):
        text.print(finding.sentence)
    rows: dict[str, Mapping[str, Score | None]] = {}
    for name in names:
        every_column = (*BALANCED, *columns)
        rows[name] = {each.metric: figures.get((name, each.metric)) for each in every_column}
    rows |= beside or {}
    if headline.headline_of(done) == headline.BALANCED:
        scores_table(BALANCED, rows)
        halves = [rows[names[0]][column.metric] for column in BALANCED[1:]]
        episodes = " and ".join(str(half.n) for half in halves if half)
        text.print(f"balanced: mean of both, of {episodes} episodes\n")
    scores_table(columns, rows)
    by_witnesses(figures, names)
    below = [finding.sentence for finding in findings(run, Kind.FIGURE, *LAST)]
    for note in (*notes, *below):
        text.print(note)


def scores_table(
    columns: Sequence[Column],
    rows: "Mapping[str, Mapping[str, Score | None]]",
    head: str = "condition",
) -> None:
    """Print scores as a table, a row for each condition or reference.

    A condition is a set of settings, by its name, that a run scores; a reference needs no model.
    `rows` has the scores of each by metric, and `head` stands above the names of the rows.
    """
    lines = []
    for name, scores in rows.items():
        cells = [column.cell(scores.get(column.metric)) for column in columns]
        lines.append((name, *cells))
    table((head, *(column.head for column in columns)), lines)


def by_witnesses(figures: "Mapping[tuple[str, str], Score]", conditions: Sequence[str]) -> None:
    """Print success by how many helpers see the danger at first, if the scenario declares it.

    The danger is the vehicle that would meet an ego which keeps its speed. `figures` holds scores
    by condition and metric, `conditions` the names of the conditions (sets of settings) to print.
    """
    metrics = {}
    for name, metric in BY_WITNESSES.items():
        if (conditions[0], metric) in figures:
            metrics[name] = metric
    if metrics.keys() <= {"no danger"}:
        return
    for start in range(0, len(conditions), MOST_BESIDE):
        beside = conditions[start : start + MOST_BESIDE]
        rows = []
        for name, metric in metrics.items():
            column = Column("", metric, interval=True)
            cells = [column.cell(figures.get((condition, metric))) for condition in beside]
            rows.append((name, str(figures[beside[0], metric].n), *cells))
        typer.echo()
        table(("success %", "n", *beside), rows)
    typer.echo("seen by: helpers, at the first decision; with a radio: it tells of itself\n")
