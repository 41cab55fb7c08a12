"""Which decisions flipped, which of them gave success away,
and what changed in the prompt beside them.
"""

import json
import re
from collections.abc import Callable
from html import unescape
from pathlib import Path

import pytest
from run_on_disk import Row, change, configure, rows_of

from harness.prompts import versions as prompts
from harness.report.compare.difference import DecisionFlip, compare
from harness.report.compare.pair import pair

Said = tuple[int, str, str]
Harness = Callable[..., Said]
# action and regret by decision point and seed
Acts = dict[tuple[str, int], tuple[str, bool | None]]


def act(run: Path, acts: Acts) -> None:
    def decide(row: Row) -> None:
        if row["condition"] == "6g" and (row["scene"], row["seed"]) in acts:
            row["action"], row["regret"] = acts[row["scene"], row["seed"]]

    change(run, decision=decide)


@pytest.fixture
def flipped(runs: tuple[Path, Path]) -> tuple[tuple[Path, Path], list[str]]:
    """Of five decision points B alone loses two, in one seed and in both, and A alone one."""
    scenes = list(
        dict.fromkeys(row["scene"] for row in rows_of(runs[0], "6g") if row["episode"] == 1)
    )[:5]
    one, both, other, safe, gone = scenes
    act(runs[0], {
        (one, 0): ("IDLE", False), (both, 0): ("IDLE", False), (both, 1): ("IDLE", False),
        (other, 1): ("FASTER", True), (safe, 0): ("SLOWER", False), (gone, 0): ("SLOWER", None),
    })  # fmt: skip
    act(runs[1], {
        (one, 0): ("FASTER", True), (both, 0): ("FASTER", True), (both, 1): ("FASTER", True),
        (other, 1): ("IDLE", False), (safe, 0): ("IDLE", False), (gone, 0): ("IDLE", None),
    })  # fmt: skip
    return runs, scenes


def reprompted(run: Path, version: str, sha256: str | None = None) -> None:
    configure(
        run,
        prompt={
            "version": version, "sha256": sha256 or prompts.load(version).sha256, "released": True,
        },
    )  # fmt: skip


def test_flips_by_hand_what_b_gave_away_first(flipped: tuple[tuple[Path, Path], list[str]]) -> None:
    runs, (one, both, other, safe, gone) = flipped
    alone, over_6g = compare(pair(*runs)).conditions
    assert alone.flips == ()
    assert over_6g.decisions == len(rows_of(runs[0], "6g"))
    assert over_6g.flips == (
        DecisionFlip(both, 1, (0, 1), "IDLE", "FASTER", "B"),
        DecisionFlip(one, 1, (0,), "IDLE", "FASTER", "B"),
        DecisionFlip(other, 1, (1,), "FASTER", "IDLE", "A"),
        *sorted(
            (DecisionFlip(at, 1, (0,), "SLOWER", "IDLE", None) for at in (safe, gone)),
            key=lambda f: f.scene,
        ),
    )
    turned = compare(pair(*reversed(runs))).conditions[1]
    assert [(f.scene, f.a, f.b) for f in turned.flips if f.lost_by == "B"] == [
        (other, "IDLE", "FASTER")
    ]
    assert [f.scene for f in turned.flips if f.lost_by == "A"] == [both, one]


def test_only_decisions_that_both_had_are_paired(
    small_path: Path, flipped: tuple[tuple[Path, Path], list[str]]
) -> None:
    """Where B is at another decision point there is nothing to flip."""
    runs, (one, *_) = flipped

    def elsewhere(row: Row) -> None:
        if row["scene"] == one:
            row["scene"] = f"{one}-elsewhere"

    n = len(rows_of(runs[0], "6g"))
    gone = sum(row["scene"] == one for row in rows_of(runs[0], "6g"))
    change(runs[1], decision=elsewhere, answer=elsewhere)
    c = compare(pair(*runs)).conditions[1]
    assert c.decisions == n - gone
    assert one not in {flip.scene for flip in c.flips}


def test_answers_are_listed_by_what_their_decisions_gave_away(
    flipped: tuple[tuple[Path, Path], list[str]],
) -> None:
    runs, (one, both, other, *_) = flipped
    change(runs[1], answer=lambda row: row["viewer"] == "v1" and row.update(verdict="failed"))
    [turned] = compare(pair(*runs)).answers
    assert {*turned.requests[:2]} == {f"{one}/v1", f"{both}/v1"}
    assert turned.requests[2] == f"{other}/v1"


@pytest.mark.slow
def test_the_text_that_changed_stands_beside_the_flips(
    flipped: tuple[tuple[Path, Path], list[str]], harness: Harness
) -> None:
    runs, (one, both, other, *_) = flipped
    reprompted(runs[1], "v3")
    for run in runs:
        (run / "report.html").touch()
    code, out, err = harness("compare", "--verbose", *runs, "--html", "page.html")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    said = " ".join(out.split())
    for part in (
        "prompt v2 → v3: ego.j2 3 words removed, 12 added",
        "id risk {{ actions | join(\" \") }} {+(%)+} evidence",
        "decisions: 6 flipped of the", "B alone gave success away in 3, A alone in 1",
        f"B alone gave success away: {both} IDLE → FASTER, {one} IDLE → FASTER (seeds 0)",
        f"A alone gave success away: {other} FASTER → IDLE (seeds 1)",
    ):  # fmt: skip
        assert part in said, part
    page = unescape(Path("page.html").read_text())
    assert "<ins> {+(%)+}</ins>" in page
    assert '<del> [-"%.2f"-]</del>' in page
    assert f"{both} IDLE → FASTER: B alone gave success away" in page
    assert "An episode that B alone lost" in page
    assert f"B lost episode {int(both.split('-')[0])} by FASTER, where A chose IDLE." in page
    assert page.index(both) < page.index(f"{other} FASTER → IDLE")
    links = re.findall(r'<a href="([^"]+)">([AB])', page)
    assert {name for href, name in links if f"scene={both}" in href} == {"A", "B"}
    told = json.loads(harness("compare", *runs, "--show", "1", "--json")[1])
    assert told["prompts"]["texts"]["ego.j2"]["added"] == 12
    flips = told["conditions"][1]["flips"]
    assert (flips["count"], [flip["scene"] for flip in flips["listed"]]) == (6, [both])
    markdown = harness("compare", *runs, "--markdown")[1]
    assert "- `prompt v2 → v3: ego.j2 3 words removed, 12 added, helper.j2 the same`" in markdown
    assert f"- A alone gave success away: `{other} FASTER → IDLE (seeds 1)`" in markdown


@pytest.mark.parametrize(
    ("version", "sha256", "shown"),
    [
        ("v3", "1" * 64, "B's v3 with sha256 111111111111…"),
        ("m\x1b[31mine", "2" * 64, "B's m\\x1b[31mine with "),
    ],
)
def test_a_prompt_that_is_not_here_as_it_was_is_one_line(
    version: str, sha256: str, shown: str, runs: tuple[Path, Path], harness: Harness
) -> None:
    reprompted(runs[1], version, sha256)
    code, out, _ = harness("compare", "--verbose", *runs, "--html", "page.html")
    assert code == 0
    assert f"what differs between the prompts is not known: {shown}" in " ".join(out.split())
    assert "@@" not in out
    assert "What differs between the prompts is not known: B's" in unescape(
        Path("page.html").read_text()
    )
    assert json.loads(harness("compare", *runs, "--json")[1])["prompts"].endswith(" is not here")


def test_helpers_with_a_prompt_of_their_own_have_their_own_difference(
    runs: tuple[Path, Path], harness: Harness
) -> None:
    prompt = {"version": "v4", "sha256": prompts.load("v4").sha256}
    model = json.loads((runs[1] / "run.json").read_text())["model"]
    configure(
        runs[1], helpers=[{"model": model, "prompt": prompt, "answer": "json", "thinking": False}]
    )
    texts = json.loads(harness("compare", *runs, "--json")[1])["prompts"]["texts"]
    assert not texts["ego.j2"]["hunks"]
    assert texts["helper.j2"]["added"] > 50
    said = " ".join(harness("compare", "--verbose", *runs)[1].split())
    assert "ego's prompt v2 → v2, helper's v2 → v4: ego.j2 the same, helper.j2 " in said
    assert "more changes: `harness prompt compare v2 v4`" in said
    assert "max_answer_tokens.helper: 128 → 160" in said
    assert "max_answer_tokens.ego" not in said


def test_the_same_prompt_has_no_difference(runs: tuple[Path, Path], harness: Harness) -> None:
    assert json.loads(harness("compare", *runs, "--json")[1])["prompts"] is None
    out = harness("compare", "--verbose", *runs, "--html", "page.html")[1]
    assert "prompt v2 →" not in out
    assert "decisions: 0 flipped of the" in out
    assert "What changed in the prompt" not in Path("page.html").read_text()
