"""Golden tables: how they are kept, and where another table first differs from one."""

import csv
import io
import os
from itertools import zip_longest
from pathlib import Path

from adapter import Row, Table

UPDATE = os.environ.get("UPDATE_GOLDEN") == "1"
# NumPy on another machine may differ in a number's last bits.
RELATIVE, ABSOLUTE = 1e-9, 1e-12
TEXT = (
    "model",
    "prompt",
    "answer",
    "condition",
    "source",
    "scene",
    "id",
    "raw",
    "from",
    "prompt_sha256",
)
PLACE = (
    "source", "panel", "variable", "value", "scene", "episode", "condition", "seed", "id", "from", "metric",
    "interval", "name",
)  # fmt: skip
HOW = "if the change is meant, run again with UPDATE_GOLDEN=1 and read the difference"


def read(text: str) -> Table:
    """A CSV file's rows, every cell as its text."""
    return list(csv.DictReader(io.StringIO(text, newline="")))


def read_file(file: Path) -> Table:
    """The rows of a CSV file, line ends inside of cells as they are."""
    return read(file.read_bytes().decode())


def write(table: Table) -> str:
    """The CSV text of a table."""
    file = io.StringIO(newline="")
    lines = csv.DictWriter(file, columns(table), lineterminator="\n")
    lines.writeheader()
    lines.writerows(table)
    return file.getvalue()


def columns(table: Table) -> list[str]:
    """All columns that some row has, in the order in which they first come."""
    return list(dict.fromkeys(name for row in table for name in row))


def difference(golden: Table, table: Table, more: bool = False) -> str | None:
    """The first difference, by row and column; None if there is none.
    The columns' order does not count.

    With `more`, neither do columns that are new.
    """
    old, new = columns(golden), columns(table)
    if set(old) != set(new) and not (more and set(old) <= set(new)):
        lost, added = [n for n in old if n not in new], [n for n in new if n not in old]
        return f"columns: lost {lost}, new {added}"
    for n, (a, b) in enumerate(zip_longest(golden, table), 1):
        if a is None or b is None:
            kind = "a row more" if a is None else "a row less"
            return (
                f"row {n} ({_place(a or b or {})}): {kind}; {len(golden)} rows before, "
                f"{len(table)} now"
            )
        for name in old:
            if not same(name, a.get(name, ""), b.get(name, "")):
                return f"row {n} ({_place(a)}), column {name}: {a[name]!r} before, {b[name]!r} now"
    return None


def same(column: str, a: str, b: str) -> bool:
    """Whether two cells say the same: by text,
    and by value where both are numbers and the column no name.
    """
    if a == b:
        return True
    if column in TEXT:
        return False
    try:
        x, y = float(a), float(b)
    except ValueError:
        return False
    return abs(x - y) <= max(ABSOLUTE, RELATIVE * max(abs(x), abs(y)))


def held(file: Path, table: Table, more: bool = False) -> None:
    """Hold a table against its golden file, or make that of it.
    Raises AssertionError where they differ.
    """
    if UPDATE:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(write(table), encoding="utf-8", newline="")
        return
    assert file.is_file(), f"no golden {file}; {HOW}"
    found = difference(read_file(file), read(write(table)), more)
    assert found is None, f"{file.parent.name}/{file.name}, {found}; {HOW}"


def _place(row: Row) -> str:
    """What tells a row from its neighbours."""
    return ", ".join(f"{name} {row[name][:40]}" for name in PLACE if row.get(name))
