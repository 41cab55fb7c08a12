"""Read suites: datasets that are evaluated together, one for each family of scenes (a scenario).

`datasets/suites.toml` has one table for each suite: its description and the names of its datasets.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from harness.core.config import convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.resources import each, entries

PREFIX = "suite:"  # marks a suite's name where a dataset's name is expected


class Suite(Struct, frozen=True, forbid_unknown_fields=True):
    """Describe a suite: datasets of several scenarios that are evaluated together."""

    name: str  # the suite's name
    description: str  # its purpose
    # the names of its datasets, in the order of tables
    datasets: Annotated[
        tuple[str, ...], Meta(min_length=1, description="a list of datasets' names, one or more")
    ]


def named(text: str) -> Suite | None:
    """Return the suite that a text `suite:NAME` names, one that ships or the project's; else None.

    A suite is datasets of several scenarios. Raises UserError if there is no such suite, or two, or
    its table is wrong.
    """
    if not text.startswith(PREFIX):
        return None
    name, files = text.removeprefix(PREFIX), entries("datasets", "suites.toml")
    results = each(map(str, files), lambda file: _tables(Path(file)))
    errors: list[UserError] = []
    names: set[str] = set()
    matches: list[tuple[str, Any]] = []
    for file, tables in results.items():
        if isinstance(tables, UserError):
            errors.append(tables)
            continue
        names |= tables.keys()
        if name in tables:
            matches.append((file, tables[name]))
    if not matches and errors:
        raise errors[0]
    if not matches:
        raise unknown("suite", name, names)
    if len(matches) > 1:
        raise UserError(
            f"suite {printable(name)} is in this project and ships with the harness; give yours "
            "another name"
        )
    [(file, table)] = matches
    where = f"suite {printable(name)} in {printable(file)}"
    if not isinstance(table, Mapping):
        raise UserError(f"{where} is no table; give it a description and datasets")
    return convert(table, Suite, where, name=name)


def datasets(text: str) -> Sequence[str]:
    """Return the names of the datasets that a user means by `--dataset`: one, or a suite's.

    A suite, `suite:NAME`, is datasets of several scenarios. `text` is what was typed there. Raises
    UserError if there is no such suite, or two, or its table is wrong.
    """
    suite = named(text)
    return suite.datasets if suite else (text,)


def _tables(file: Path) -> dict[str, Any]:
    return toml(file, f"file of suites {printable(file)}")
