"""A finished run in some fifteen lines, as `harness eval` and `harness drive` print it.

`--verbose` prints the tables of its page instead (`harness.cli.run.show`).
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from harness.cli.run import HALVES, Column, scores_table
from harness.cli.terminal import echo_text
from harness.core.errors import printable
from harness.core.figures import amount
from harness.runs import headline

if TYPE_CHECKING:
    from harness.runs.folder import Run
    from harness.runs.records import Manifest, Score, Variant
    from harness.runs.suite import SuiteRun

HEAD = "success, % [95 % CI]"
SUCCESS = Column("all", headline.SUCCESS, interval=True)
BALANCED = (Column("balanced", headline.BALANCED, interval=True), *HALVES)
# references that need no model: what plans with the ego's own sensors, and two that are blind
BESIDE = ("local-view", "open-loop", "uniform")


def show(
    run: "Run", scenes: str, n: str, references: "Mapping[str, Mapping[str, Score]] | None" = None
) -> None:
    """Print who was asked, success by condition beside references, and one note.

    A condition is a set of settings, by its name, that the run scores.

    Args:
        run: the finished run.
        scenes: a phrase on its scenes.
        n: a phrase on its episodes and seeds.
        references: scores by metric of references that need no model, by name; None for none.
    """
    from harness.report.words import questions

    echo_title(run.manifest, run.manifest.variant, scenes)
    echo_text(questions(run))
    is_warned = echo_warnings(run)
    is_balanced = headline.headline_of(run) == headline.BALANCED
    columns: Sequence[Column] = BALANCED if is_balanced else (SUCCESS,)
    rows: dict[str, Mapping[str, Score | None]] = {}
    for name in run.conditions:
        rows[name] = {column.metric: run.score(name, column.metric) for column in columns}
    for name in BESIDE:
        if references and name in references:
            rows[name] = references[name]
    scores_table(columns, rows, HEAD)
    echo_gain(run)
    echo_text(f"n = {n}")
    echo_cost(run)
    echo_note(run, is_warned)


def echo_title(manifest: "Manifest", variant: "Variant", scenes: str) -> None:
    """Print who answered, how, and in which scenes.

    `manifest` is a run's record, or a suite's first, and `variant` its names of model and prompts;
    `scenes` is a phrase.
    """
    from harness.backends.registry import reads_prompts

    prompt = f"prompt {printable(variant.prompt)}"
    if not reads_prompts(str(manifest.model.get("engine"))):
        prompt += " (not read)"
    helpers = f" · helpers: {printable(variant.helpers)}" if manifest.helpers else ""
    model = printable(variant.model, 40)
    echo_text(f"{model} · {prompt} · {variant.answer} · {scenes}{helpers}")


def echo_gain(run: "Run | SuiteRun") -> None:
    """Print what success gains in the best condition of a run or suite over its baseline.

    A condition is a set of settings, by its name; a suite has a run on each of several scenarios.
    Nothing is printed where there is no baseline.
    """
    from harness.report.words import compared, gain, judged

    best, base = compared(run)
    if base:
        change = judged(*gain(run, best, base), bounded=False)
        echo_text(f"{printable(best)} over {printable(base)}: {change}")


def echo_cost(run: "Run | SuiteRun") -> None:
    """Print what the answers of a run or suite cost, if its card has a price.

    A suite has a run on each of several scenarios.
    """
    from harness.report.notes import cost

    for sentence in cost(run):
        echo_text(sentence)


def echo_warnings(run: "Run | SuiteRun") -> bool:
    """Print why a run or suite is no result and who decided; return whether there was a line.

    A suite has a run on each of several scenarios.
    """
    from harness.report.findings import Kind, findings

    warnings = findings(run, Kind.VOID, Kind.CAVEAT)
    for warning in warnings:
        echo_text(warning.sentence)
    return bool(warnings)


def echo_note(run: "Run", is_warned: bool) -> None:
    """Print the first note on a run's numbers, unless there was a warning; and how many more."""
    from harness.report.findings import Kind, findings
    from harness.report.words import first_note

    limits = findings(run, Kind.LIMIT)
    if not limits:
        return
    more = len(limits) - (not is_warned)
    beside = f"{amount(more, 'more note')} and " if more else ""
    rest = f"({beside}all tables: --verbose)"
    if is_warned:
        echo_text(rest)
    else:
        echo_text(f"{first_note(limits[0].sentence)} {rest}")
