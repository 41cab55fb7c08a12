"""Read tables that users bring, such as curves of another simulator."""

import csv
import math
from collections.abc import Collection
from io import StringIO
from pathlib import Path

from harness.core.errors import UserError, printable, unknown
from harness.core.files import text_of

# the most, and in words
DISTANCE_M, RECEPTION = (1e6, "metres, 0 to 1000000"), (1.0, "a share from 0 to 1")


def rows_of(
    path: Path, needed: Collection[str], known_columns: Collection[str]
) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the column names of a CSV file, and its rows, each with its line number in the file.

    A row is a dict of the cells' texts by column. Raises UserError if it is no table, lacks a
    column that is `needed`, or has one that is not in `known_columns`; nothing is checked of the
    cells.
    """
    file = printable(path)
    try:
        table = csv.DictReader(StringIO(text_of(path), newline=""))
        columns = list(table.fieldnames or ())
        if missing := [name for name in needed if name not in columns]:
            raise UserError(
                f"{file}: has no column {' or '.join(missing)}; its first line names "
                f"{printable(', '.join(columns) or 'none', 60)}, and may name "
                f"{', '.join(known_columns)}"
            )
        for name in columns:
            if name not in known_columns:
                raise unknown(f"column of {file}", name, known_columns)
        return columns, [(table.line_num, row) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise UserError(f"{file}: cannot be read as a table ({printable(problem)})") from None


def number_of(
    where: str, row: dict[str, str], column: str, most: float, allowed: str, least: float = 0.0
) -> float:
    """Return the number in a column of a row, if it is between `least` and `most`.

    `row` has the cells as texts by column. Raises UserError for any other value; `where` says in
    which file and line it is, and `allowed` in words what is allowed, for the message.
    """
    try:
        value = float(row[column])
    except (TypeError, ValueError):
        value = math.nan
    if not least <= value <= most:
        raise UserError(f"{where}: {column} is {printable(row[column])!r}; it must be {allowed}")
    return value


def refuse_ragged(where: str, row: dict[str, str]) -> None:
    """Raise UserError for a row that has more or fewer cells than there are columns.

    `row` is one of a `csv.DictReader`, and `where` says in which file and line it is.
    """
    if None in row or None in row.values():
        raise UserError(f"{where}: has other columns than the first line")
