"""`harness run export`: decisions and answers as text, and episodes as test cases."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pyarrow as pa
import pytest
from run_on_disk import Row, answers_of, made_up, rows_of

from harness.runs import export
from harness.runs.folder import read

Said = tuple[int, str, str]
HOSTILE = 'a "b", \n=1+1 \u202e ü'


@pytest.fixture
def run(tmp_path: Path) -> Path:
    def spoil(row: Row) -> None:
        if row["viewer"] == "v1":
            row["raw"] = HOSTILE
        if row["viewer"] == "v2":
            row |= {
                "verdict": "failed",
                "status": "no_json",
                "intent": None,
                "mass": None,
                "message": None,
            }
        if row["viewer"] == "v3":
            row |= {
                "repairs": ("code_fence", "prose"),
                "extension": {"why": HOSTILE, "gaps": [0.5]},
            }
        if row["viewer"] == "v4":
            row |= {"viewer": "v1", "heard": ("v2", "v4"), "role": "merge"}

    return made_up(tmp_path / "run", answer=spoil)


def test_a_spreadsheet_finds_no_formula(tmp_path: Path, harness: Callable[..., Said]) -> None:
    """Texts of models, names of conditions;
    numbers are what they were, and so are the run's own files.
    """
    texts = [
        "=1+1",
        "+1-1",
        "-cmd|' /C calc'!A0",
        "@SUM(1)",
        "\t=1",
        "\r=1",
        "-0.5",
        "+7",
        "a=1",
        "",
        "'=1",
    ]
    said = iter(texts)

    def spoil(row: Row) -> None:
        row["raw"] = next(said, "{}")

    run = made_up(tmp_path / "run", answer=spoil)
    before = (run / "answers.jsonl").read_bytes()
    assert harness("run", "export", run, "--csv")[0] == 0
    with (run / "answers.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    written = [row["raw"] for row in rows[: len(texts)]]
    assert written == [f"'{text}" if n < 6 else text for n, text in enumerate(texts)]
    assert (run / "answers.jsonl").read_bytes() == before
    made: Any = SimpleNamespace(rows=pa.table({"a": ["=1", "1", None], "b": [-1.5, 2.0, None]}))
    exported = export.decisions_csv(made, tmp_path / "decisions.csv")
    assert exported.read_text().splitlines()[1:] == ['"\'=1",-1.5', '"1",2', ","]


def test_csv_has_every_decision_and_answer(run: Path, harness: Callable[..., Said]) -> None:
    code, out, err = harness("run", "export", run, "--csv")
    assert (code, err) == (0, "")
    assert out.splitlines() == [str(run / "decisions.csv"), str(run / "answers.csv")]
    with (run / "decisions.csv").open(newline="") as file:
        told = list(csv.DictReader(file))
    rows = rows_of(run)
    assert [list(row) for row in told] == [list(row) for row in rows]
    for written, row in zip(told, rows, strict=True):
        for name, value in row.items():
            shown = written[name]
            if value is None:
                assert shown == ""
            elif isinstance(value, bool):
                assert shown == str(value).lower()
            else:
                assert type(value)(shown) == value
    with (run / "answers.csv").open(newline="", encoding="utf-8") as file:
        said = list(csv.DictReader(file))
    answers = answers_of(run)
    assert [row["raw"] for row in said] == [answer.raw for answer in answers]
    assert HOSTILE in [row["raw"] for row in said]
    assert {row["heard"] for row in said} == {"", "v2+v4"}
    assert {row["image_sha256"] for row in said} == {""}
    assert {row["repairs"] for row in said} == {"", "code_fence prose"}
    assert [row["intent_IDLE"] for row in said] == ["1.0" if a.intent else "" for a in answers]
    for name in ("message", "extension"):
        assert [json.loads(row[name]) if row[name] else None for row in said] == [
            answer.cell(name) for answer in answers
        ]
    assert any(row["extension"] for row in said)


def test_jsonl_has_an_object_a_decision(
    run: Path, harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "AT_ONCE", 5)
    code, out, err = harness("run", "export", run, "--jsonl", "--out", "text")
    assert (code, out, err) == (0, "text/decisions.jsonl\n", "")
    lines = Path("text/decisions.jsonl").read_text().splitlines()
    assert [json.loads(line, parse_constant=pytest.fail) for line in lines] == rows_of(run)
    assert [path.name for path in Path("text").iterdir()] == ["decisions.jsonl"]


def test_junit_has_a_case_an_episode_and_condition(
    tmp_path: Path, harness: Callable[..., Said]
) -> None:
    def end(row: Row) -> None:
        if row["condition"] == "6g" and row["episode"] in (1, 2):
            failed = row["episode"] == 1 or row["seed"] == 1
            row |= {"success": False, "failure": "col\x1blision"} if failed else {}

    run = made_up(tmp_path / "run", episode=end)
    code, out, err = harness("run", "export", run, "--junit", "run.xml")
    assert (code, out, err) == (0, "run.xml\n", "")
    suite = ElementTree.parse("run.xml").getroot()
    assert (suite.tag, suite.get("tests"), suite.get("failures")) == ("testsuite", "8", "2")
    cases = {(case.get("classname"), case.get("name")): case.find("failure") for case in suite}
    of = {name: f"made-up · made-up · v2 · json · {name}" for name in ("single-local", "6g")}
    assert list(cases) == [(of[name], f"episode {n}") for name in of for n in range(4)]
    failed = {where: case.get("message") for where, case in cases.items() if case is not None}
    assert failed == {
        (
            of["6g"],
            "episode 1",
        ): r"2 of 2 seeds: col\x1blision with seed 0, col\x1blision with seed 1",
        (of["6g"], "episode 2"): r"1 of 2 seeds: col\x1blision with seed 1",
    }


def test_csv_in_pieces_is_the_same(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decisions = read(run).decisions
    whole = export.decisions_csv(decisions, tmp_path / "whole.csv").read_bytes()
    monkeypatch.setattr(export, "AT_ONCE", 3)
    assert export.decisions_csv(decisions, tmp_path / "pieces.csv").read_bytes() == whole


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), ": give exactly one of them"),
        (("--csv", "--jsonl"), "--csv, --jsonl, --junit"),
        (("--csv", "--junit", "a.xml"), "give exactly one of them"),
        (
            ("--junit", "a.xml", "--out", "there"),
            "--out only goes with --csv and --jsonl; --junit names its own",
        ),
        (("--junit", "run/run.json/a.xml"), "--junit run/run.json/a.xml cannot be written ("),
        (("--junit", "."), "--junit . cannot be written (Is a directory); name another file"),
        (("--junit", "run"), "--junit run cannot be written (Is a directory); name another file"),
        (("--csv", "--out", "run/run.json"), "--out run/run.json cannot be written ("),
        (("--jsonl", "--out", "run/run.json/in"), "; choose another folder with --out"),
    ],
)
def test_bad_options_are_one_line(
    options: tuple[str, ...], said: str, run: Path, harness: Callable[..., Said]
) -> None:
    code, out, err = harness("run", "export", run, *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


def test_a_folder_that_is_no_run_or_broken_is_one_line(
    run: Path, harness: Callable[..., Said]
) -> None:
    code, out, err = harness("run", "export", "nowhere", "--csv")
    assert (code, out) == (2, "")
    assert "nowhere is no finished run: there is no such folder" in err
    (run / "decisions.parquet").write_text("PAR1")
    code, out, err = harness("run", "export", run, "--csv")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "decisions.parquet is broken" in err
    assert not (run / "decisions.csv").exists()
