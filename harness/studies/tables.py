"""Write tables as CSV and JSON Lines, the same bytes as pandas writes, but for formulas.

A study's episodes have many rows and few different values in a column. So each of these becomes text once,
and Arrow puts the rows together.
"""

import csv
from collections.abc import Iterator, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.core.arrays import Ints
from harness.core.files import neutral

if TYPE_CHECKING:
    import pandas as pd

ROWS = 100_000  # that are text in memory at a time


def as_csv(table: "pd.DataFrame") -> Iterator[memoryview]:
    """Yield the text of a table as CSV, part by part, as `to_csv(index=False)` has it."""
    yield memoryview((",".join(map(_cell, table)) + "\n").encode())
    columns = []
    for name in table:
        codes, distinct = _distinct(table[name])
        unknown = distinct.isna().tolist()
        cells = ["" if none else _cell(value) for value, none in zip(distinct.tolist(), unknown, strict=True)]
        columns.append((codes, cells))
    yield from _rows(columns)


def as_json_lines(table: "pd.DataFrame") -> Iterator[memoryview]:
    """Yield the text of a table as JSON Lines, part by part, as `to_json` has it."""
    columns = []
    for name in table:
        codes, distinct = _distinct(table[name])
        lines = distinct.to_frame(name).to_json(orient="records", lines=True)  # its text has no other breaks
        columns.append((codes, [line[1:-1] for line in lines.split("\n")[: len(distinct)]]))
    yield from _rows(columns, "{", "}")


def _distinct(values: "pd.Series[Any]") -> "tuple[Ints, pd.Series[Any]]":
    """Return the place of each value among the different ones, `(n,)`, and these."""
    import pandas as pd

    if values.dtype == float:  # compared by their bits: 0.0 and -0.0 are equal, but not as text
        codes, bits = pd.factorize(values.to_numpy().view(np.int64))
        return codes, pd.Series(bits.view(np.float64))
    if values.dtype == object:  # so are 1 and 1.0
        places: dict[tuple[type, str], int] = {}
        codes = np.array([places.setdefault((type(v), repr(v)), len(places)) for v in values], dtype=np.int64)
        first = np.unique(codes, return_index=True)[1]
        return codes, values.iloc[first].reset_index(drop=True)
    codes, distinct = pd.factorize(values, use_na_sentinel=False)
    return codes, pd.Series(distinct)


def _cell(value: Any) -> str:
    if not isinstance(value, str):
        return str(value)
    cells = [neutral(value), ""]  # one alone would be quoted
    csv.writer(line := StringIO(), lineterminator="\n").writerow(cells)
    return line.getvalue()[:-2]


def _rows(columns: Sequence[tuple[Ints, list[str]]], start: str = "", end: str = "") -> Iterator[memoryview]:
    """Yield rows from `start` to `end`; a column is the place of each row's text, `(n,)`, and the texts."""
    texts = [of_column for _, of_column in columns]
    texts[0] = [start + text for text in texts[0]]
    texts[-1] = [text + end + "\n" for text in texts[-1]]
    for row in range(0, len(columns[0][0]), ROWS):
        parts = [
            pa.array(of_column, pa.string()).take(pa.array(codes[row : row + ROWS]))
            for (codes, _), of_column in zip(columns, texts, strict=True)
        ]
        rows = pc.binary_join_element_wise(*parts, ",")
        _, ends, data = rows.buffers()
        yield memoryview(data)[: np.frombuffer(ends, np.int32)[len(rows)]]
