"""`harness run ls`: the runs in a folder."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.terminal import WIDTH, echo_json
from harness.core.errors import printable
from harness.core.figures import PERCENT

if TYPE_CHECKING:
    from harness.runs.listing import Listed


def command(folder: options.Reports = Path("reports"), as_json: options.Json = False) -> None:
    """List runs and studies, newest first.

    Each has the success of its best condition.
    """
    from harness.runs.listing import UNREAD, runs

    listed = runs(folder)
    if as_json:
        echo_json([{**asdict(run), "date": run.date.isoformat()} for run in listed])
        return
    for run in listed:
        name, date = printable(run.name, WIDTH - 17), f"{run.date.astimezone():%Y-%m-%d %H:%M}"
        typer.echo(f"{name:<{WIDTH - 17}} {date}")
        outcome = _outcome(run)
        kind = f"{run.kind:<5} "
        left = WIDTH - 3 - len(kind) - len(outcome)
        parts = " · ".join(part for part in (run.model, run.prompt, run.answer) if part is not None)
        typer.echo(f"  {kind}{printable(parts, left):<{left}} {outcome}".rstrip())
        if run.unread is not None and run.unread >= UNREAD:
            share = "none" if run.unread == 1 else f"only {100 * (1 - run.unread):.1f} %"
            typer.echo(f"{'':8}{share} of the ego's answers could be read: it drives by the fallback")
        if run.tags:
            typer.echo(f"{'':8}{printable('tags: ' + ', '.join(run.tags), WIDTH - 8)}")
    if not listed:
        typer.echo(f"no runs in {printable(folder)}; `harness eval` makes one")


def _outcome(run: "Listed") -> str:
    if run.why is not None:
        return f"{run.state}: {run.why}"
    if run.success is None:
        return ""
    return f"{printable(run.condition, 24)} {PERCENT.interval(run.success, run.low, run.high)} %"
