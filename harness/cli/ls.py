"""`harness ls`: the runs in a folder."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.core.errors import printable

if TYPE_CHECKING:
    from harness.runs.listing import Listed

WIDTH = 80


def ls(
    folder: Path = typer.Argument(Path("reports"), metavar="DIR", help="Folder that holds them."),
    as_json: bool = typer.Option(False, "--json", help="Print JSON."),
) -> None:
    """List runs, sweeps and studies, newest first, each with the success of its best condition."""
    from harness.runs.listing import runs

    found = runs(folder)
    if as_json:
        typer.echo(json.dumps([{**asdict(one), "date": one.date.isoformat()} for one in found], indent=1))
        return
    for one in found:
        name, date = printable(one.name, WIDTH - 17), f"{one.date.astimezone():%Y-%m-%d %H:%M}"
        typer.echo(f"{name:<{WIDTH - 17}} {date}")
        said = _outcome(one)
        left = WIDTH - 9 - len(said)
        parts = " · ".join(part for part in (one.model, one.prompt, one.answer) if part is not None)
        typer.echo(f"  {one.kind:<6}{printable(parts, left):<{left}} {said}".rstrip())
        if one.tags:
            typer.echo(f"{'':8}{printable('tags: ' + ', '.join(one.tags), WIDTH - 8)}")
    if not found:
        typer.echo(f"no runs in {printable(folder)}; `harness eval` makes one")


def _outcome(one: "Listed") -> str:
    from harness.cli.estimates import interval

    if one.why is not None:
        return f"{one.state}: {one.why}"
    if one.success is None:
        return ""
    low, high = (float("nan") if end is None else end for end in (one.low, one.high))
    return f"{printable(one.condition, 24)} {interval(one.success, low, high, 100)} %"
