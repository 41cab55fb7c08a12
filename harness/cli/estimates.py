"""Tables and JSON in a terminal."""

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 80  # columns of a terminal


def echo_json(value: Any, indent: int | None = 1) -> None:
    """Print JSON."""
    typer.echo(json.dumps(value, indent=indent))


def console() -> "Console":
    """Plain text in 80 columns."""
    from rich.console import Console

    class Plain(Console):
        def on_broken_pipe(self) -> None:
            raise  # to `main`, and not the end of the program here

    return Plain(width=WIDTH, markup=False, highlight=False)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], tight: bool = False) -> None:
    """Print columns, the first folded and the others aligned right; `tight` ones are one space apart."""
    from rich.table import Table

    drawn = Table(box=None, width=WIDTH, pad_edge=False, padding=(0, 1, 0, 0) if tight else (0, 1))
    drawn.add_column(heads[0], overflow="fold")
    for head in heads[1:]:
        drawn.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        drawn.add_row(*row)
    console().print(drawn)
