"""What a dataclass's docstring says of its fields."""

import inspect
import re
import textwrap
from dataclasses import asdict
from typing import Any

import typer

from harness.core.errors import printable


def attributes(kind: type) -> dict[str, str]:
    """Meaning of each field, those of its bases included, out of the sections `Attributes:`."""
    meanings: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        section = str(inspect.getdoc(each)).partition("Attributes:\n")[2]
        meanings |= re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in meanings.items()}


def echo_fields(record: Any) -> None:
    """Print each field's value and meaning."""
    meanings = attributes(type(record))
    for name, value in asdict(record).items():
        values = value if isinstance(value, tuple) else (value,)
        shown = (f"{v:g}" if type(v) in (int, float) else printable(str(v).lower(), 60) for v in values)
        typer.echo(f"{name} = {', '.join(shown)}")
        typer.echo(textwrap.fill(meanings.get(name, ""), 80, initial_indent="    ", subsequent_indent="    "))
