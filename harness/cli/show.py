"""A finished study in a terminal."""

import json
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import typer

from harness.cli.terminal import WIDTH, table
from harness.core.errors import printable

if TYPE_CHECKING:
    from harness.studies.study import Study

LONGEST = 2000  # characters of a sentence
CELL = 80


def finish(study: "Study", out: Path, as_json: bool = False, quiet: bool = False) -> None:
    """Write a study to a folder, and print it as JSON or as text.

    `out` is the folder to make. It is JSON if `as_json`, and nothing is printed as text if `quiet`.
    """
    from harness.studies.study import undrawn, write_study

    page = write_study(study, out)
    if (error := undrawn(study)) and not quiet:
        typer.echo(f"harness: {error}", err=True)
    if as_json:
        echo_answer(study)
    elif not quiet:
        show(study)
        typer.echo(f"wrote {printable(page)}")


def echo_answer(study: "Study") -> None:
    """Print a study's result, its `answer`, as JSON; a data frame as a list of records."""

    def records(frame: Any) -> Any:
        return json.loads(frame.to_json(orient="records"))

    if hasattr(study.answer, "to_json"):
        typer.echo(study.answer.to_json(orient="records"))
    else:
        typer.echo(json.dumps(study.answer, indent=1, default=records))


def show(study: "Study") -> None:
    """Print a study: its outcome, caveats, tables and how it was made."""
    for text in (study.title, *study.headline, *study.caveats):
        typer.echo(fill(printable(text, LONGEST), WIDTH))
    for each in study.tables:
        if each.terminal:
            typer.echo(f"\n{fill(printable(each.title, LONGEST), WIDTH)}")
            heads, rows = each.in_terminal
            lines = []
            for row in rows:
                lines.append([printable(cell, CELL) for cell in row])
            table(heads, lines)
    typer.echo()
    for text in study.about:
        typer.echo(fill(printable(text, LONGEST), WIDTH))
