"""A study's tables are those that pandas writes, to the last byte."""

import math
from pathlib import Path

import pandas as pd
import pytest

from harness.studies.folder import ROWS, write

MIXED = [1, 1.0, True, None, 'a,"b"\n', math.nan, "", "/é"]
TEXTS = ["a", "", "x,y", '"', "\n", "/", "é", None]
NUMBERS = [0.0, -0.0, math.nan, 1 / 3, 1e-300, 1e22, math.inf, 2.0]


@pytest.mark.parametrize("kind", ["str", "category"])
@pytest.mark.parametrize("times", [1, ROWS // 8 + 1])
def test_tables_are_as_pandas_writes_them(tmp_path: Path, kind: str, times: int) -> None:
    table = pd.DataFrame({
        "mixed": pd.Series(MIXED * times, dtype=object), "text": pd.Series(TEXTS * times, dtype=kind),
        "number": NUMBERS * times, "yes": [True, False] * 4 * times, "count": range(8 * times),
    })  # fmt: skip
    write(tmp_path, {}, {"table": table})
    assert (tmp_path / "table.csv").read_bytes() == table.to_csv(index=False, lineterminator="\n").encode()
    lines = table.to_json(orient="records", lines=True)
    assert (tmp_path / "table.jsonl").read_bytes() == lines.encode()


def test_an_empty_table_has_its_header_and_no_row(tmp_path: Path) -> None:
    write(tmp_path, {}, {"table": pd.DataFrame({"a": [1], "b": [2]})[:0]})
    assert (tmp_path / "table.csv").read_text() == "a,b\n"
    assert (tmp_path / "table.jsonl").read_text() == ""
