"""A study's tables as text, beside what pandas writes of them without formulas."""

from collections.abc import Callable, Iterator
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.files import neutral
from harness.studies import tables
from harness.studies.tables import as_csv, as_json_lines

TEXTS = st.text(alphabet="=-1aé,\"'\n\r\t/\\{}:😀\u2028 ", max_size=4)
COLUMNS: dict[str, st.SearchStrategy[Any]] = {
    "float": st.floats(width=64) | st.sampled_from([0.0, -0.0, 0.1 + 0.2, 1e16, 1e-5, float("nan")]),
    "int": st.integers(-(2**62), 2**62),
    "bool": st.booleans(),
    "text": TEXTS,
    "text or none": TEXTS | st.none(),
    "mixed": TEXTS | st.floats() | st.integers(0, 3) | st.booleans() | st.none(),
}


def whole(parts: Iterator[memoryview]) -> str:
    return b"".join(map(bytes, parts)).decode()


@st.composite
def frames(draw: Callable[[Any], Any]) -> pd.DataFrame:
    rows = draw(st.lists(st.tuples(*COLUMNS.values(), TEXTS), min_size=1, max_size=8))
    *columns, named = (list(column) for column in zip(*rows, strict=True))
    table = pd.DataFrame(dict(zip(COLUMNS, columns[:-1], strict=False)))
    table["mixed"] = pd.Series(columns[-1], dtype=object)
    return table.assign(**{'named, "so"': pd.Categorical(named)})


@given(frames())
def test_the_text_is_what_pandas_writes(table: pd.DataFrame) -> None:
    texts = ("text", "text or none", "mixed", 'named, "so"')
    safe = table.assign(**{name: pd.Series(list(map(neutral, table[name])), dtype=object) for name in texts})
    assert whole(as_csv(table)) == safe.to_csv(index=False, lineterminator="\n")
    assert whole(as_json_lines(table)) == table.to_json(orient="records", lines=True)


@given(table=frames(), rows=st.integers(1, 4))
def test_parts_are_the_whole(table: pd.DataFrame, rows: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "ROWS", rows)
        parts = [*map(bytes, as_csv(table))], [*map(bytes, as_json_lines(table))]
    assert [len(part) for part in parts] == [1 + -(-len(table) // rows), -(-len(table) // rows)]
    assert b"".join(parts[0]).decode() == whole(as_csv(table))
    assert b"".join(parts[1]).decode() == whole(as_json_lines(table))


def test_a_table_without_rows_has_its_names() -> None:
    table = pd.DataFrame({"a": [], "b": []})
    assert whole(as_csv(table)) == "a,b\n"
    assert whole(as_json_lines(table)) == ""
