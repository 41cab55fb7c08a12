"""Which answers changed from one run to another:
counted, the first one shown, and all side by side.
"""

import json
import shutil
from collections.abc import Callable
from html import unescape
from pathlib import Path

import pytest
from run_on_disk import Row, answers_of, change, configure

import harness as api
from harness.report.compare import words
from harness.report.compare.difference import AnswerChanged, AnswersHeld, compare
from harness.report.compare.pair import pair

Harness = Callable[..., tuple[int, str, str]]


def reworded(run: Path, viewer: str) -> None:
    """Let a vehicle say the same decision with a blank at the end: another text, read alike."""
    change(run, answer=lambda row: row["viewer"] == viewer and row.update(raw=f"{row['raw']} "))


def test_texts_that_changed_are_counted_where_no_verdict_did(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    reworded(runs[1], "v2")
    every, mine = answers_of(runs[0]), [a for a in answers_of(runs[0]) if a.viewer == "v2"]
    said = f"{len(mine)} of {len(every)} to the same questions changed in their text, none of them in their status"
    out = " ".join(harness("compare", "--verbose", *runs)[1].split())
    assert f"answers: {said} first: {mine[0].id}, helper A strict: " in out
    assert f"all, side by side: --html FILE --show {len(mine)}" in out
    assert said in harness("compare", *runs, "--markdown")[1]
    told = json.loads(harness("compare", *runs, "--json", "--show", "1")[1])["answers_changed"]
    [listed] = told.pop("listed")
    assert told == {
        "count": len(mine),
        "verdicts": 0,
        "of": len(every),
        "asked_otherwise": 0,
        "asked_otherwise_leaning": 0,
    }
    assert listed == {
        "request": mine[0].id, "role": "helper", "verdict_a": "strict", "verdict_b": "strict",
        "raw_a": mine[0].raw, "raw_b": f"{mine[0].raw} ",
    }  # fmt: skip
    assert (
        harness("compare", "--verbose", *runs, "--html", "page.html", "--show", str(len(mine)))[0]
        == 0
    )
    page = unescape(Path("page.html").read_text())
    assert said in page
    for answer in mine:
        shown = page.partition(f"<summary>{answer.id}, helper</summary>")[2].partition(
            "</details>"
        )[0]
        assert f"<pre>{answer.raw}<mark></mark></pre>" in shown
        assert f"<pre>{answer.raw}<mark> </mark></pre>" in shown


def test_python_has_all_of_them_side_by_side_and_a_short_repr(runs: tuple[Path, Path]) -> None:
    reworded(runs[1], "v1")
    mine = [a for a in answers_of(runs[0]) if a.viewer == "v1"]
    comparison = api.compare(*runs)
    table = comparison.answers
    assert list(table.request) == [a.id for a in mine]
    assert list(table.raw_a + " ") == list(table.raw_b)
    assert f"<p>answers: {len(mine)} of " in comparison._repr_html_()
    assert len(repr(comparison)) < 500
    same = api.compare(runs[0], runs[0])
    assert (list(same.answers.columns), len(same.answers)) == (list(table.columns), 0)


@pytest.mark.parametrize("told", ["prompt_sha256", "image_sha256"])
def test_an_answer_to_another_question_is_said_and_not_counted(
    told: str, runs: tuple[Path, Path], harness: Harness
) -> None:
    """Where only helpers were asked otherwise, the egos' answers still count;
    where all were, none does.
    """

    def otherwise(*roles: str) -> Callable[[Row], object]:
        return lambda row: (
            row["role"] in roles and row.update({told: "1" * 64, "raw": f"{row['raw']} "})
        )

    every = answers_of(runs[0])
    egos = sum(a.role == "ego" for a in every)
    change(runs[1], answer=otherwise("helper"))
    held = compare(pair(*runs)).held
    assert (held.same, held.other, held.changed) == (egos, len(every) - egos, ())
    out = " ".join(harness("compare", *runs)[1].split())
    rest = f"{len(every) - egos} questions asked otherwise (prompt, messages or picture), and "
    assert f"answers: 0 of {egos} to the same questions changed; {rest}" in out
    change(runs[1], answer=otherwise("ego"))
    out = " ".join(harness("compare", *runs)[1].split())
    whole = f"answers: {len(every)} questions asked otherwise (prompt, messages or picture), and "
    assert f"{whole}0 answers to them with another likeliest action or status" in out
    assert "first:" not in out


def test_a_verdict_that_changed_counts_where_the_text_did_not(runs: tuple[Path, Path]) -> None:
    one = answers_of(runs[0])[0]
    change(
        runs[1], answer=lambda row: row["scene"] == one.scene and row.update(verdict="recovered")
    )
    held = compare(pair(*runs)).held
    assert len(held.changed) == held.verdicts > 1
    assert {each.verdicts for each in held.changed} == {("strict", "recovered")}
    assert words.first_changed(held.changed[0])[1] == f"  A strict: {held.changed[0].a}"


def test_runs_without_a_question_in_common_say_so() -> None:
    assert words.answers_held(AnswersHeld(0, 0, 0, ())) == "the runs have no question in common"


def test_the_line_begins_a_little_before_the_texts_part() -> None:
    alike = "x" * 500
    lines = words.first_changed(
        AnswerChanged("s/v1", "ego", f"{alike}one", f"{alike}two", ("strict",) * 2)
    )
    assert lines[1:] == [f"  A strict: …{'x' * 20}one", f"  B strict: …{'x' * 20}two"]
    nothing = words.first_changed(AnswerChanged("s/v1", "ego", "one", "", ("strict", "failed")))
    assert nothing[1:] == ["  A strict: one", "  B failed: nothing"]


def test_where_there_is_no_interval_a_finding_says_so(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    from changing import ends

    twin = Path(shutil.copytree(runs[1], tmp_path / "twin"))
    configure(twin)
    ends(twin, "6g", [["late"] * 4] * 2)
    found = " ".join(sentence for sentence, _ in words.outcomes(compare(pair(runs[0], twin))))
    assert "points: not clear, since there is no interval" in found
    assert "–" not in found
