"""Print tables, lists, JSON and fields in a terminal."""

import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass
from math import isfinite
from textwrap import fill, wrap
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from harness.core.errors import UserError, printable
from harness.core.figures import as_mapping

if TYPE_CHECKING:
    from rich.console import Console

Thing = TypeVar("Thing")

WIDTH = 80  # columns of a terminal
LONGEST = 1000  # characters of a text
HEAD = 21  # of a table's column at most: three of them leave room for a name
_FIELD = re.compile(r"((?:^    # .*\n)*)^    (\w+): [^#\n]+?(?:  # (.*))?$", re.MULTILINE)


def echo_wrong(name: str, error: UserError) -> None:
    """Print that an entry of a list cannot be used: its name and the error.

    Such is a file of the user's that describes a model and has a mistake.
    """
    typer.echo(f"{printable(name)} · wrong\n  {error}")


def echo_prompt_tokens(counted: Mapping[str, Mapping[str, Any]] | None) -> None:
    """Print a dry run's counts of prompt tokens by role (`ego`, `helper`).

    Each role has `least`, `most`, `mean` and `n`, the number of prompts. Without counts (None or
    empty), it prints that there is no tokenizer.
    """
    for role, s in (counted or {}).items():
        typer.echo(
            f"{role}: {s['least']} to {s['most']} prompt tokens, mean {s['mean']} (n = {s['n']})"
        )
    if not counted:
        typer.echo(
            "prompt tokens not counted: no tokenizer here; give --tokenizer (tokenizer.json or "
            "GGUF)"
        )


def echo_cost(counted: Mapping[str, Mapping[str, Any]], times: int) -> None:
    """Print a dry run's estimate of cost by model, of so many `times` the evaluation.

    Each model has `currency`, and the cost of `prompts` (None if not counted) and of `answers` at
    most.
    """
    for model, each in counted.items():
        prompts = each["prompts"]
        read = "prompts not counted" if prompts is None else f"{times * prompts:.4g} for prompts"
        typer.echo(
            f"cost of {printable(model, 40)}, {each['currency']}: {read}, "
            f"{times * each['answers']:.4g} for "
            "answers of the greatest length"
        )


def echo_each(
    things: Mapping[str, Thing | UserError],
    as_json: bool,
    plain: Callable[[Thing], dict[str, Any]],
    show: Callable[[str, Thing], None],
) -> None:
    """Print a list of entries by name, and the error of those that cannot be used.

    `things` has each entry, or the UserError that it raised, by its name; `plain` returns an
    entry's values for JSON, `show` prints it as text.
    """
    if as_json:
        rows = []
        for name, thing in things.items():
            values = {"error": str(thing)} if isinstance(thing, UserError) else plain(thing)
            rows.append({"name": name, **values})
        echo_json(rows)
        return
    for name, each in things.items():
        if isinstance(each, UserError):
            echo_wrong(name, each)
        else:
            show(name, each)


def echo_json(value: Any, indent: int | None = 1) -> None:
    """Print a value as JSON: an estimate as value, interval and n, an unknown number as null."""
    typer.echo(json.dumps(value, indent=indent, default=_plain))


def _plain(value: Any) -> Any:
    if hasattr(value, "n_excluded"):
        return as_mapping(value)
    if is_dataclass(value):
        values = {field.name: getattr(value, field.name) for field in fields(value)}
        return {
            k: None if isinstance(v, float) and not isfinite(v) else v for k, v in values.items()
        }
    return value.tolist()


def echo_text(text: str) -> None:
    """Print a text wrapped to `WIDTH` columns, all lines but the first indented."""
    whole = printable(text, LONGEST)
    typer.echo(fill(whole, WIDTH, subsequent_indent="  ", break_on_hyphens=False))


def console() -> "Console":
    """Return a Rich console that prints plain text in `WIDTH` columns."""
    from rich.console import Console

    class Plain(Console):
        def on_broken_pipe(self) -> None:
            raise  # to `main`, and not the end of the program here

    return Plain(width=WIDTH, markup=False, highlight=False)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table, the first column aligned left and the others right.

    `heads` are the columns' titles, and each of `rows` has a text for every column. Columns are two
    spaces apart, or one if a name needs the room. A name that is still too long stands on a line
    above its row; heads longer than `HEAD` are folded.
    """
    from rich.cells import cell_len, chop_cells

    lines = [*_folded(heads), *rows]
    names = [cell_len(name) for name, *_ in lines]
    widths = [0] * (len(heads) - 1)
    for _, *cells in lines:
        for n, cell in enumerate(cells):
            widths[n] = max(widths[n], cell_len(cell))

    def room_beside(gap: int) -> int:
        return WIDTH - sum(widths) - gap * len(widths)

    def fit(gap: int) -> tuple[int, bool]:
        room = room_beside(gap)
        return sum(length <= room for length in names), room >= 0

    gap = max((2, 1), key=fit)
    room = room_beside(gap)
    first = max((length for length in names if length <= room), default=0)
    for (name, *cells), length in zip(lines, names, strict=True):
        if length > room:
            for piece in chop_cells(name, WIDTH):
                typer.echo(piece)
            name, length = "", 0
        line = name + " " * (first - length)
        for width, cell in zip(widths, cells, strict=True):
            line += " " * (gap + width - cell_len(cell)) + cell
        typer.echo(line.rstrip())


def _folded(heads: Sequence[str]) -> list[Sequence[str]]:
    """Return a table's heads as lines, with heads longer than `HEAD` folded at the bottom."""
    name, *others = heads
    stacks = [wrap(head, HEAD) or [""] for head in others]
    height = max(len(stack) for stack in stacks)
    padded = [[""] * (height - len(stack)) + stack for stack in stacks]
    names = [""] * (height - 1) + [name]
    return list(zip(names, *padded, strict=True))


def attributes(kind: type) -> dict[str, str]:
    """Return the meaning of each field of a dataclass and its bases, as text by the field's name.

    It is the comment beside or above the field, or stands in the docstring's section `Attributes:`.
    """
    meanings: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        section = str(inspect.getdoc(each)).partition("Attributes:\n")[2]
        meanings |= re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
        with suppress(OSError):  # a class that has no source file
            for above, name, beside in _FIELD.findall(inspect.getsource(each)):
                if name in each.__annotations__ and (above or beside):
                    meanings[name] = beside or above.replace("#", " ")
    return {name: " ".join(meaning.split()).rstrip(".") + "." for name, meaning in meanings.items()}


def echo_fields(record: Any) -> None:
    """Print the value of each field of a dataclass, and its meaning from `attributes`."""
    meanings = attributes(type(record))
    for name, value in asdict(record).items():
        values = value if isinstance(value, tuple) else (value,)
        texts = (
            f"{v:g}" if type(v) in (int, float) else printable(str(v).lower(), 60) for v in values
        )
        typer.echo(f"{name} = {', '.join(texts)}")
        typer.echo(
            fill(meanings.get(name, ""), 80, initial_indent="    ", subsequent_indent="    ")
        )
