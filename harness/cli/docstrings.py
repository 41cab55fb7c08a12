"""What the source of a dataclass says of its fields."""

import inspect
import re
import textwrap
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import typer

from harness.core.errors import printable

_FIELD = re.compile(r"((?:^    # .*\n)*)^    (\w+): [^#\n]+?(?:  # (.*))?$", re.MULTILINE)


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
        shown = (f"{v:g}" if type(v) in (int, float) else printable(str(v).lower(), 60) for v in values)
        typer.echo(f"{name} = {', '.join(shown)}")
        typer.echo(textwrap.fill(meanings.get(name, ""), 80, initial_indent="    ", subsequent_indent="    "))
