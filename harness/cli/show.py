"""A finished study in a terminal."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill, wrap
from typing import TYPE_CHECKING, Any

import typer

from harness.cli.terminal import WIDTH, table
from harness.core.errors import printable
from harness.core.figures import amount

if TYPE_CHECKING:
    from harness.report.document import Table
    from harness.studies.study import Study

LONGEST = 2000  # characters of a sentence
CELL = 80
OUTCOME, ROWS = 5, 3  # lines of sentences, and rows of a table, that --verbose is not needed for
BASIS = (re.compile(r"\bn (=|is) "), re.compile("95 % interval"))
SENTENCE = re.compile(r"(?<=[.;]) ")


def finish(
    study: "Study",
    out: Path,
    as_json: bool = False,
    quiet: bool = False,
    verbose: bool = False,
    pictures: bool = True,
) -> None:
    """Write a study to a folder, and print it as JSON or as text.

    `out` is the folder to make. It is JSON if `as_json`, and nothing is printed as text if `quiet`;
    `verbose` prints all tables and how the study was made. With `pictures`, figures are
    also written as files.
    """
    from harness.studies.study import undrawn, write_study

    page = write_study(study, out, pictures)
    if pictures and not quiet and (error := undrawn(study)):
        typer.echo(f"harness: {error}", err=True)
    if as_json:
        echo_answer(study)
    elif not quiet:
        show(study, verbose)
        typer.echo(f"wrote {printable(page)}")


def echo_answer(study: "Study") -> None:
    """Print a study's result, its `answer`, as JSON; a data frame as a list of records.

    What a reader must know first, its `caveats`, is in it, except beside records.
    """

    def records(frame: Any) -> Any:
        return json.loads(frame.to_json(orient="records"))

    if hasattr(study.answer, "to_json"):
        typer.echo(study.answer.to_json(orient="records"))
    else:
        answer = study.answer
        if isinstance(answer, Mapping):
            answer = {**answer, "caveats": list(study.caveats)}
        typer.echo(json.dumps(answer, indent=1, default=records))


def show(study: "Study", verbose: bool) -> None:
    """Print a study's outcome and its first table; with `verbose`, all tables and how it was made.

    Without, it is some fifteen lines, with n and what intervals are over among them.
    """
    tables = [table for table in study.tables if table.terminal]
    if verbose:
        _echo_texts((study.title, *study.headline, *study.verdicts, *study.caveats))
        for each in tables:
            typer.echo()
            _echo_texts([each.title])
            _echo_table(each)
        typer.echo()
        _echo_texts(study.about)
        return
    _echo_texts([study.title, *_outcome(study), *study.verdicts])
    for each in tables[:1]:
        _echo_table(each, ROWS)
    _echo_texts(_basis(study))
    typer.echo("all tables and notes: the page, or --verbose")


def _outcome(study: "Study") -> list[str]:
    """Return the first sentence of a study's outcome and its first caveat, then more that fit."""
    first, *rest = study.headline
    chosen = [first, *study.caveats[:1]]
    for text in rest:
        if sum(len(wrap(each, WIDTH)) for each in (*chosen, text)) <= OUTCOME:
            chosen.append(text)
    return chosen


def _basis(study: "Study") -> list[str]:
    """Return the first sentence on how a study was made with n, and that on its intervals."""
    sentences = SENTENCE.split(" ".join(study.about))
    basis = []
    for mark in BASIS:
        having = [each.rstrip(".;") for each in sentences if mark.search(each)]
        basis += [f"{each}." for each in having[:1] if f"{each}." not in basis]
    return basis


def _echo_texts(texts: Sequence[str]) -> None:
    for text in texts:
        typer.echo(fill(printable(text, LONGEST), WIDTH))


def _echo_table(each: "Table", most: int | None = None) -> None:
    """Print a table, only so many of its rows if `most` is given, and how many more there are."""
    heads, rows = each.in_terminal
    lines = []
    for row in rows[:most]:
        lines.append([printable(cell, CELL) for cell in row])
    table(heads, lines)
    if more := len(rows) - len(lines):
        typer.echo(f"and {amount(more, 'more row')}")
