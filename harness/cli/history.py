"""`harness run history`: a metric over the runs in a folder."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.terminal import WIDTH, echo_json, echo_wrong
from harness.core.errors import UserError, printable
from harness.core.figures import DASH
from harness.runs.listing import SUCCESS

if TYPE_CHECKING:
    from harness.report.history import Line

VARIANT = 32  # columns of model, prompt and answer mode


def command(
    folder: options.Reports = Path("reports"),
    metric: str = typer.Option(SUCCESS, help="Metric to show, by its name in summary.csv."),
    condition: str | None = typer.Option(
        None, help="Condition to show. Default: the last of those that most runs have."
    ),
    dataset: str | None = typer.Option(
        None, help="Show only runs on this dataset, or driven in this scenario."
    ),
    html: Path | None = typer.Option(None, help="Also write a page to this file."),
    as_json: options.Json = False,
) -> None:
    """Show a metric over runs, by date, prompt version and model.

    Runs on the same scenes are grouped, since only those compare.
    """
    from harness.report import history
    from harness.runs.metrics import entry, written

    wrong: dict[str, UserError] = {}
    groups = history.history(folder, metric, condition, dataset, wrong.__setitem__)
    if html:
        history.write(groups, metric, html)
    if as_json:
        echo_json([
            {"scenes": group.of, "condition": group.condition, "metric": metric,
             "runs": [_mapping(line) for line in group.lines]}
            for group in groups
        ] + [{"run": name, "error": str(error)} for name, error in wrong.items()])  # fmt: skip
        return
    percent = " %" if entry(metric).unit.name == "%" else ""
    typer.echo(f"{metric}{percent} with its 95 % interval")
    for group in groups:
        typer.echo(f"\n{printable(f'{group.of}, {group.condition}', WIDTH)}")
        for line in group.lines:
            value = n = DASH
            if score := line.score:
                value, n = written(score), str(score.n)
            who = printable(line.run.manifest.variant, VARIANT)
            typer.echo(f"{line.date.astimezone():%Y-%m-%d %H:%M} {who:<{VARIANT}} {value:<22} n {n:>4}")
    for name, error in wrong.items():
        typer.echo()
        echo_wrong(name, error)
    if len(groups) > 1:
        typer.echo("\nruns on different scenes do not compare, so each group has its own table")


def _mapping(line: "Line") -> dict[str, object]:
    variant, score = line.run.manifest.variant, line.score
    numbers = {key: getattr(score, key, None) for key in ("value", "low", "high", "n", "n_excluded")}
    return {
        "run": line.name, "date": line.date.isoformat(), "model": variant.model, "prompt": variant.prompt,
        "answer": variant.answer, "tags": line.run.manifest.tags, **numbers,
    }  # fmt: skip
