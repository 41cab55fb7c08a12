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
    """Print a thing of a list that cannot be used, and why."""
    typer.echo(f"{printable(name)} · wrong\n  {error}")


def echo_prompt_tokens(counted: Mapping[str, Mapping[str, Any]] | None) -> None:
    """Print what a dry run counted of prompts, by role, or that there was nothing to count with."""
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
    """Print what a dry run says that so many repeats would cost, by model."""
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
    """Print a list of things by name, and of one that cannot be used why;
    as JSON, `plain` values of each.
    """
    if as_json:
        echo_json(
            [
                {"name": name}
                | ({"error": str(each)} if isinstance(each, UserError) else plain(each))
                for name, each in things.items()
            ]
        )
        return
    for name, each in things.items():
        if isinstance(each, UserError):
            echo_wrong(name, each)
        else:
            show(name, each)


def echo_json(value: Any, indent: int | None = 1) -> None:
    """Print JSON. Of an estimate it has the value, the interval and n;
    an unknown number is null.
    """
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
    """Print a text on lines as wide as the terminal, all but the first of them indented."""
    whole = printable(text, LONGEST)
    typer.echo(fill(whole, WIDTH, subsequent_indent="  ", break_on_hyphens=False))


def console() -> "Console":
    """Plain text in 80 columns."""
    from rich.console import Console

    class Plain(Console):
        def on_broken_pipe(self) -> None:
            raise  # to `main`, and not the end of the program here

    return Plain(width=WIDTH, markup=False, highlight=False)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print columns, the first aligned left and the others right.

    They are two spaces apart, or one where a name needs the room. A name that leaves no room for
    its row even so stands above it; heads longer than `HEAD` are folded.
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
    gap, room = max(
        rooms.items(), key=lambda of: (sum(length <= of[1] for length in names), of[1] >= 0)
    )
    first = max((length for length in names if length <= room), default=0)
    for (name, *cells), length in zip(lines, names, strict=True):
        if length > room:
            for piece in chop_cells(name, WIDTH):
                typer.echo(piece)
            name, length = "", 0
        figures = (
            f"{' ' * (gap + w - cell_len(cell))}{cell}"
            for w, cell in zip(widths, cells, strict=True)
        )
        typer.echo(f"{name}{' ' * (first - length)}{''.join(figures)}".rstrip())


def attributes(kind: type) -> dict[str, str]:
    """Return the meaning of each field, those of its bases included.

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
    """Print each field's value and meaning."""
    meanings = attributes(type(record))
    for name, value in asdict(record).items():
        values = value if isinstance(value, tuple) else (value,)
        shown = (
            f"{v:g}" if type(v) in (int, float) else printable(str(v).lower(), 60) for v in values
        )
        typer.echo(f"{name} = {', '.join(shown)}")
        typer.echo(
            fill(meanings.get(name, ""), 80, initial_indent="    ", subsequent_indent="    ")
        )
