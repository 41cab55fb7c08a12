"""Tables and JSON in a terminal."""

import json
from collections.abc import Iterable, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import typer

from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 80  # columns of a terminal
HEAD = 21  # of a table's column at most: three of them leave room for a name


def echo_wrong(name: str, error: UserError) -> None:
    """Print a thing of a list that cannot be used, and why."""
    typer.echo(f"{printable(name)} · wrong\n  {error}")


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


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print columns, the first aligned left and the others right.

    They are two spaces apart, or one where a name needs the room. A name that leaves no room for its row even
    so stands above it; heads longer than `HEAD` are folded.
    """
    from rich.cells import cell_len, chop_cells

    stacks = [wrap(head, HEAD) or [""] for head in heads[1:]]
    height = max(map(len, stacks))
    folded = zip(*([""] * (height - len(stack)) + stack for stack in stacks), strict=True)
    names_of_heads = [""] * (height - 1) + [heads[0]]
    lines = [*((name, *cells) for name, cells in zip(names_of_heads, folded, strict=True)), *rows]
    names, *values = ([cell_len(cell) for cell in column] for column in zip(*lines, strict=True))
    widths = [max(column) for column in values]
    rooms = {gap: WIDTH - sum(widths) - gap * len(widths) for gap in (2, 1)}
    gap, room = max(rooms.items(), key=lambda item: sum(length <= item[1] for length in names))
    first = max((length for length in names if length <= room), default=0)
    for (name, *cells), length in zip(lines, names, strict=True):
        if length > room:
            for piece in chop_cells(name, WIDTH):
                typer.echo(piece)
            name, length = "", 0
        figures = (f"{' ' * (gap + w - cell_len(cell))}{cell}" for w, cell in zip(widths, cells, strict=True))
        typer.echo(f"{name}{' ' * (first - length)}{''.join(figures)}".rstrip())
