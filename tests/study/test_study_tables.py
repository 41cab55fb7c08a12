"""A study's folder: its tables as pandas writes them without formulas, and its page."""

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from markupsafe import Markup

from harness.core.errors import UserError
from harness.core.files import Refused
from harness.core.seals import seal
from harness.report.document import Table, strong
from harness.studies.study import Cells, Study, p_cell, refuse_other, write_study, write_table

HOSTILE = "=cmd()</script>\u202e"


def test_texts_are_no_formulas_in_csv_and_whole_in_json(tmp_path: Path) -> None:
    table = pd.DataFrame({
        "text": ["=1+1", "a,\"b\"", None], "number": [-1.5, 0.1 + 0.2, float("nan")], "n": [1, 2, 3],
        "mixed": pd.Series(["-x", -2.0, True], dtype=object), "named": pd.Categorical(["@a", "b", "@a"]),
    })  # fmt: skip
    write_table(table, tmp_path / "table")
    assert (tmp_path / "table.csv").read_text() == (
        "text,number,n,mixed,named\n'=1+1,-1.5,1,'-x,'@a\n"
        '"a,""b""",0.30000000000000004,2,-2.0,b\n,,3,True,\'@a\n'
    )
    rows = [json.loads(line) for line in (tmp_path / "table.jsonl").read_text().splitlines()]
    assert rows[0] == {"text": "=1+1", "number": -1.5, "n": 1, "mixed": "-x", "named": "@a"}
    assert rows[2]["number"] is None


def test_a_table_is_written_as_pandas_writes_it(tmp_path: Path) -> None:
    table = pd.DataFrame({
        "real": [0.0, -0.0, 1 / 3, 1e20, float("inf"), float("nan")], "whole": range(6),
        "same": pd.Series([1, True, 1.0, "1", None, "/"], dtype=object), "flag": [True, False] * 3,
        "text": ["a", "", "l\nm", "ü\u2028", "q\"", None],
    })  # fmt: skip
    for names in (list(table), ["text"]):
        write_table(table[names], tmp_path / "table")
        lines = table[names].to_json(orient="records", lines=True)
        assert (tmp_path / "table.jsonl").read_text() == lines
        cells = table[names].to_csv(index=False)
        assert (tmp_path / "table.csv").read_text() == cells


def test_a_table_without_rows_has_its_names(tmp_path: Path) -> None:
    write_table(pd.DataFrame({"a": [], "b": []}), tmp_path / "table")
    assert (tmp_path / "table.csv").read_text() == "a,b\n"


def test_a_page_shows_text_as_text_and_a_terminal_no_markup(tmp_path: Path) -> None:
    table = Table(
        HOSTILE, ("name", "value", "p"), [(HOSTILE, strong("1.0"), p_cell(0.0))], terminal=(0, 1)
    )
    study = Study(
        "sweep", HOSTILE, [HOSTILE], [HOSTILE], [table], {}, {"a": 1}, {}, caveats=[HOSTILE]
    )
    page = write_study(study, tmp_path).read_text()
    assert "<strong>1.0</strong>" in page
    assert "&lt; 0.001" in page
    assert "=cmd()&lt;/script&gt;⟨U+202E⟩" in page
    assert "</script>" not in page
    assert table.in_terminal == (["name", "value"], [[HOSTILE, "1.0"]])
    assert not isinstance(table.in_terminal[1][0][1], Markup)
    assert json.loads((tmp_path / "sweep.json").read_text()) == {
        "format": "swarmdrive-sweep/1",
        "a": 1,
        "caveats": [HOSTILE],
    }


def test_a_column_of_sentences_begins_at_the_left_in_every_row(tmp_path: Path) -> None:
    rows = [("a", "1.0", "short"), ("b", "22.0", "a sentence " * 4)]
    table = Table("t", ("name", "value", "text"), rows)
    assert table.words == [False, False, True]
    page = write_study(Study("sweep", "a", ["b"], ["c"], [table], {}, {}, {}), tmp_path).read_text()
    assert page.count('<td class="words">') == 2
    assert '<th scope="col" class="number">value</th><th scope="col">text</th>' in page


def test_a_study_is_not_written_over_a_run_or_another_study(tmp_path: Path) -> None:
    """Their tables may have the names of its own: a sweep's and a run's are `episodes.csv`."""
    study = Study("sweep", "a", ["b"], ["c"], [], {"episodes": pd.DataFrame({"a": [1]})}, {}, {})
    for name in ("run", "trust"):
        out = tmp_path / name
        out.mkdir()
        (out / f"{name}.json").write_text("{}")
        (out / "episodes.csv").write_text("kept")
        said = f"holds something else, as its {name}.json says; name another"
        with pytest.raises(UserError, match=said):
            write_study(study, out)
        with pytest.raises(UserError, match=said):
            refuse_other(out, "sweep", {})
        assert {path.name: path.read_text() for path in out.iterdir()} == {
            f"{name}.json": "{}", "episodes.csv": "kept",
        }  # fmt: skip
    out = tmp_path / "sweep"
    assert write_study(study, out) == write_study(study, out) == out / "index.html"


def test_parts_are_kept_to_the_last_bit_but_those_of_something_else_and_torn_ones(
    tmp_path: Path,
) -> None:
    path, computed = tmp_path / "cells.jsonl", list[str]()

    def part(depends_on: str, n: int) -> object:
        values = {"n": n, "array": np.array([[0.1 + 0.2, np.nan]])}
        kept = Cells(path, depends_on).part(
            ("a", n), lambda: computed.append(f"{depends_on}{n}") or values
        )
        np.testing.assert_array_equal(kept["array"], values["array"])
        return kept["n"]

    assert [part("this", 1), part("this", 2), part("this", 1)] == [1, 2, 1]
    path.write_bytes(path.read_bytes()[:-5])
    assert [part("that", 2), part("this", 1), part("this", 2), part("that", 2)] == [2, 1, 2, 2]
    assert computed == ["this1", "this2", "that2", "this2"]


class Watched:
    """A source that has come upon some gaps."""

    def __init__(self, *names: str) -> None:
        self.names, self.new = set(names), set(names)

    def new_gaps(self) -> Mapping[str, Collection[str]]:
        new, self.new = sorted(self.new), set()
        return {"left-out": new}

    def recall_gaps(self, gaps: Mapping[str, Collection[str]]) -> None:
        self.names |= set(gaps["left-out"])


def test_gaps_are_kept_with_the_part_that_came_upon_them_and_recalled(tmp_path: Path) -> None:
    path, first = tmp_path / "cells.jsonl", Watched("a")
    cells = Cells(path, "this", source=first)
    cells.part(("one",), dict)
    first.new.add("b")
    cells.part(("two",), dict)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["gaps"] for line in lines] == [{"left-out": ["a"]}, {"left-out": ["b"]}]
    again = Watched()
    Cells(path, "this", source=again)
    assert again.names == {"a", "b"}
    Cells(path, "that").part(("one",), dict)  # as older versions kept it
    assert ("one",) in Cells(path, "that")
    assert ("one",) not in Cells(path, "that", source=Watched())


def test_no_part_is_computed_where_a_pipe_would_keep_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "cells.jsonl")
    with pytest.raises(Refused, match="it is no file, so nothing is appended to it"):
        Cells(tmp_path / "cells.jsonl", "this")


@pytest.mark.parametrize("forged", ["its value", "another's key", "no seal"])
def test_a_part_that_was_not_computed_here_is_computed_again(
    forged: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cells.jsonl"
    with monkeypatch.context() as elsewhere:
        if forged == "another's key":
            elsewhere.setenv("SWARMDRIVE_CACHE", str(tmp_path / "another"))
        assert Cells(path, "this").part(("a",), lambda: {"n": 0.5}) == {"n": 0.5}
    line = json.loads(path.read_text())
    if forged == "its value":
        line["cell"]["n"] = 1.0
    if forged == "no seal":
        del line["seal"]
    path.write_text(json.dumps(line) + "\n")
    assert Cells(path, "this").part(("a",), lambda: {"n": 0.25}) == {"n": 0.25}
    assert Cells(path, "this").part(("a",), lambda: {"n": 0.75}) == {"n": 0.25}
    assert Cells(path, "this", computed=False).part(("a",), lambda: {"n": 0}) == {"n": 0.25}


@pytest.mark.parametrize("broken", ["empty", "a link", "too long"])
def test_a_broken_key_is_made_again(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path))
    key = tmp_path / "seal.key"
    if broken == "a link":
        key.symlink_to(tmp_path / "nowhere")
    else:
        key.write_bytes(b"x" * (broken == "too long") * 99)
    assert seal({"a": b"b"}, "here") == seal({"a": b"b"}, "here") is not None
    assert len(key.read_bytes()) == 32
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "folder").mkdir()
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "seal.key"))
    assert seal({"a": b"b"}, "here") is None
