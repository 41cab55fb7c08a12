"""`harness eval --repeats`: one evaluation several times, with other draws of the model's answers."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer

from harness.cli import options
from harness.cli.estimates import console, echo_json, table
from harness.cli.progress import bar
from harness.cli.run import Together, free_folder
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.figures import shown

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec
    from harness.studies.repeats import Repeats

MOST = 100


def check(spec: "Spec", repeats: int) -> None:
    """Raise UserError unless an evaluation can be repeated."""
    from harness.evaluate.latency import MEASURED

    options.in_range("--repeats", repeats, 2, MOST)
    if not spec.temperature:
        raise UserError(
            f"--repeats {repeats}: greedy answers are the same every time; give a --temperature above 0, "
            "such as 0.7"
        )
    if spec.latency == MEASURED:
        raise UserError(
            f"--latency {MEASURED}: it needs an idle machine, which its own first runs keep busy; measure "
            "once without --repeats, and give the seconds that its run.json has"
        )


def evaluate(
    spec: "Spec", repeats: int, out: Path | None, cache: Path | None, quiet: bool, as_json: bool
) -> None:
    """Evaluate every repeat; write and print what they have in common and what not."""
    from harness.studies.repeats import each, run_repeats
    from harness.studies.repeats_page import FIGURES, MARKER, PAGE, write_repeats

    together = Together(each(spec, repeats), "finished repeats", MARKER, (FIGURES, PAGE))
    folder = out or free_folder([spec], f"{spec.source.name}-repeats", together.goes_on)
    together.check(folder)
    name = printable(spec.ego.card.name, 30)
    with (
        work.going_on(folder),
        bar(f"asking {name}, {repeats} repeats", quiet=quiet or as_json, grows=True) as progress,
    ):
        done = run_repeats(spec, repeats, folder, progress, progress.more, cache)
    page = write_repeats(done)
    if as_json:
        echo_json(_mapping(done))
    elif not quiet:
        _show(done)
        typer.echo(f"wrote {printable(page)}")


def _mapping(done: "Repeats") -> dict[str, Any]:
    """Repeats for machines: their folder, their runs and all figures."""
    first = done.runs[0].manifest
    variant = msgspec.to_builtins(first.variant)
    return {
        "repeats": str(done.path),
        "runs": [str(run.path) for run in done.runs],
        "temperature": first.temperature,
        "figures": [{**variant, **msgspec.to_builtins(score)} for score in done.scores],
    }


def _show(done: "Repeats") -> None:
    """Print how often decisions flip, how episodes succeed, and what came out in sentences."""
    from harness.report.caveats import caveats, said
    from harness.runs.metrics import SUCCESS
    from harness.studies.repeats import BETWEEN, FLIPS, STABLE
    from harness.studies.repeats_page import in_sentences

    text, k, m = console(), done.k, done.runs[0].manifest
    text.print(f"{printable(str(m.variant), 60)} · {printable(done.runs[0].source)}")
    runs = {run.path.name: run for run in done.runs}
    for sentence in said(runs, lambda run: caveats(run.manifest, run.scores)):
        text.print(sentence)
    decisions = {"decisions flip": FLIPS, "same in all": STABLE}
    table(
        ("%", *decisions, "n", "variance between"),
        [
            (
                c,
                *(shown(done.estimate(c, metric)) for metric in decisions.values()),
                str(done.estimate(c, FLIPS).n),
                shown(done.estimate(c, BETWEEN)),
            )
            for c in done.conditions
        ],
    )
    typer.echo()
    episodes = {"episodes succeed": SUCCESS, f"pass^{k}": f"pass^{k}", f"any@{k}": f"any@{k}"}
    table(
        ("%", *episodes),
        [(c, *(shown(done.estimate(c, metric)) for metric in episodes.values())) for c in done.conditions],
    )
    for sentence in in_sentences(done):
        text.print(sentence)
    text.print(
        f"{k} repeats × {len(m.seeds)} channel seeds of {len(done.runs[0].grid.episodes)} episodes; flip: "
        "share of pairs of repeats that decide differently at a decision point that both reached; n: "
        "decision points; pass^k: all k repeats succeed; any@k: one or more do; variance between: share of "
        "the variance of success that lies between episodes; 95 % intervals over episodes"
    )
