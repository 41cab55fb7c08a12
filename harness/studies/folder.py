"""A study's folder: its figures, its tables and how it was made."""

import json
from collections.abc import Callable, Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from harness.core.files import replacing, write_whole
from harness.report.drawing.pictures import FORMATS, save

if TYPE_CHECKING:
    import pandas as pd

ROWS = 100_000  # that are text in memory at a time


def write(out: Path, figures: Mapping[str, Figure], tables: "Mapping[str, pd.DataFrame]") -> None:
    """Write figures as SVG, PDF and PNG, and tables as CSV and JSON Lines, each file whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    for stem, figure in figures.items():
        # Where things go is laid out once and not for every format: it is half of the work.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for kind in FORMATS:
            save(figure, out / f"{stem}.{kind}", kind, dpi=300)
    for stem, table in tables.items():
        parts = [table[first : first + ROWS] for first in range(0, len(table), ROWS)]
        with replacing(out / f"{stem}.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
            table[:0].to_csv(file, index=False)
            for part in parts:
                file.writelines(f"{row}\n" for row in _rows(part, _as_csv))
        with replacing(out / f"{stem}.jsonl") as path, path.open("w", encoding="utf-8") as file:
            for part in parts:
                file.writelines(f"{{{row}}}\n" for row in _rows(part, _as_json))


def _rows(table: "pd.DataFrame", text: "Callable[[pd.DataFrame], list[str]]") -> Iterator[str]:
    """What pandas writes of each row; what a column has many times is written once."""
    import pandas as pd

    columns = []
    for name, column in table.items():
        code: Any = slice(None)
        distinct: Any = column
        if column.dtype == float:  # by its bits, which 0.0 and -0.0 do not share
            code, bits = pd.factorize(column.to_numpy().view(np.int64))
            distinct = bits.view(float)
        elif column.dtype != object:  # in which 1, 1.0 and True would count as one
            code, distinct = pd.factorize(column, use_na_sentinel=False)
        columns.append(np.array(text(pd.DataFrame({name: distinct})), dtype=object)[code].tolist())
    return map(",".join, zip(*columns, strict=True))


class _Rows(StringIO):
    """What is written to it, piece by piece: of CSV each piece is a row."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[str] = []

    def write(self, row: str) -> int:
        self.rows.append(row)
        return len(row)


def _as_csv(column: "pd.DataFrame") -> list[str]:
    """Each field of a column; one that is empty is quoted only where it is alone."""
    written = _Rows()
    column.to_csv(written, index=False, header=False, lineterminator="\n")
    return ["" if row == '""\n' else row[:-1] for row in written.rows]


def _as_json(column: "pd.DataFrame") -> list[str]:
    """Each field of a column behind its name."""
    return [row[1:-1] for row in column.to_json(orient="records", lines=True).splitlines()]


def write_manifest(out: Path, kind: str, manifest: Mapping[str, Any]) -> None:
    """Write how a study was made as `<kind>.json`."""
    content = {"format": f"swarmdrive-{kind}/1", **manifest}
    write_whole(out / f"{kind}.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
