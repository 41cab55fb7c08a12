"""The report's templates, and how they show values."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from jinja2 import Environment, FileSystemLoader, Undefined
from markupsafe import Markup

from harness.core.figures import Unit
from harness.core.places import nameless, text
from harness.report import words
from harness.report.drawing import colours

TEMPLATES = Path(__file__).parent / "templates"


@cache
def environment(*more: Path) -> Environment:
    """Return the Jinja environment with the report's templates and those of the folders `more`.

    Values are escaped as HTML and pass through `visible`. It is made once for each set of folders.
    """
    templates = Environment(
        loader=FileSystemLoader([*more, TEMPLATES]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=visible,
    )
    templates.globals["palette"] = Markup(colours.variables())
    templates.filters |= {
        "number": lambda value, decimals: Unit(decimals=decimals).number(value),
        "facts": words.facts,
        "shown": words.score_texts,
        "cell": words.cell,
        "p_value": words.p_value,
        "mapping": _mapping,
        "columns": _table,
        "nameless": text,
        "visible": visible,
    }
    return templates


def visible(value: Any) -> Any:
    """Return a value as a template shows it, so that nothing in it is invisible.

    In a text, invisible and bidirectional control characters are written as ⟨U+XXXX⟩; None and
    undefined become a dash, booleans yes or no. `Markup` and any other value are unchanged.
    """
    if value is None or isinstance(value, Undefined):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, str) or isinstance(value, Markup) or value.isprintable():
        return value
    return "".join(c if c.isprintable() or c in "\n\t" else f"⟨U+{ord(c):04X}⟩" for c in value)


def _mapping(record: Any) -> Any:
    """Return a record as plain values, without the folders of the machine that it was made on."""
    return nameless(msgspec.to_builtins(record))


def _table(rows: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return the head and body of a table with a column for every key."""
    head = list(dict.fromkeys(key for row in rows for key in row))
    body = []
    for row in rows:
        body.append([row.get(key) for key in head])
    return head, body
