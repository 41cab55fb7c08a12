"""The goldens can fail: what is changed in a table is found, and said by row and column."""

from pathlib import Path

import comparing
import pytest

FILES = sorted((Path(__file__).parent / "data").glob("*/*.csv"))
TABLE = [
    {"condition": "1", "metric": "a", "value": "0.25", "n": "3"},
    {"condition": "6g", "metric": "a", "value": "", "n": "4"},
]


def changed(at: int, **cells: str) -> comparing.Table:
    return [{**row, **(cells if i == at else {})} for i, row in enumerate(TABLE)]


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}/{file.stem}")
def test_any_changed_cell_of_any_golden_is_found(file: Path) -> None:
    golden = comparing.read_file(file)
    assert comparing.difference(golden, comparing.read(comparing.write(golden))) is None
    for column in comparing.columns(golden):
        n = max(range(len(golden)), key=lambda i: len(golden[i][column]))
        try:
            number = float(golden[n][column])
            other = repr(number + 1e-4 * max(1.0, abs(number)))
        except ValueError:
            other = golden[n][column] + "x"
        now = [{**row, column: other} if i == n else row for i, row in enumerate(golden)]
        found = comparing.difference(golden, now)
        assert found is not None
        assert found.startswith(f"row {n + 1} ")
        assert f", column {column}: {golden[n][column]!r} before, {other!r} now" in found
        assert comparing.difference(
            golden, [{k: v for k, v in row.items() if k != column} for row in golden]
        )
    if golden:
        assert comparing.difference(golden, golden[:-1])
        assert comparing.difference(golden, [*golden, golden[-1]])
        assert comparing.difference(golden[:-1], golden)


def test_a_difference_says_row_and_column() -> None:
    assert comparing.difference(TABLE, changed(1, n="5")) == (
        "row 2 (condition 6g, metric a), column n: '4' before, '5' now"
    )
    assert comparing.difference(TABLE, changed(1, value="0")) is not None
    assert comparing.difference(TABLE, TABLE[::-1]) is not None


def test_last_bits_and_the_way_a_number_is_written_are_no_difference() -> None:
    assert comparing.difference(TABLE, changed(0, value="0.25000000000000006", n="3.0")) is None
    assert comparing.difference(TABLE, changed(0, value="0.250001")) is not None


def test_names_are_text() -> None:
    assert comparing.difference(TABLE, changed(0, condition="1.0")) is not None


def test_a_new_column_counts_unless_more_may_be_said() -> None:
    wider = [{**row, "new": "1"} for row in TABLE]
    assert comparing.difference(TABLE, wider) == "columns: lost [], new ['new']"
    assert comparing.difference(TABLE, wider, more=True) is None
    assert comparing.difference(wider, TABLE, more=True) == "columns: lost ['new'], new []"


def test_a_golden_is_held_and_a_failure_names_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run" / "summary.csv"
    monkeypatch.setattr(comparing, "UPDATE", False)
    with pytest.raises(AssertionError, match="no golden"):
        comparing.held(file, TABLE)
    monkeypatch.setattr(comparing, "UPDATE", True)
    comparing.held(file, TABLE)
    monkeypatch.setattr(comparing, "UPDATE", False)
    comparing.held(file, TABLE)
    with pytest.raises(
        AssertionError, match=r"run/summary.csv, row 1 .*column n: '3' before, '9' now"
    ):
        comparing.held(file, changed(0, n="9"))
