"""A run as pandas tables."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from evaluating import rows_of, run, spec_of

import harness
from harness.backends import cards
from harness.coordination.operating_point import POINTS
from harness.dataset.load import Dataset
from harness.evaluate.drive import run as drive
from harness.evaluate.live_spec import spec_of as live_spec
from harness.prompts import versions as prompts

ROOT = Path(__file__).parent.parent
ACTIONS = ("SLOWER", "IDLE", "FASTER")


@pytest.fixture(scope="module")
def frozen(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose answers fail in many ways, by a model whose name pandas takes for a missing value."""
    spec = spec_of(small, "proxy-faulty", points=(POINTS["single-local"], POINTS["6g"]))
    spec = replace(spec, card=replace(spec.card, name="null"))
    return run(spec, tmp_path_factory.mktemp("tables") / "frozen").out


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = (POINTS["6g"], POINTS["single-local"])
    spec = live_spec(cards.load("proxy"), prompts.load("v2"), points, (0, 1), episodes=2)
    out = tmp_path_factory.mktemp("tables") / "live"
    return drive(spec, out, False, 1, lambda done: None).out


@pytest.mark.parametrize("kind", ["frozen", "live"])
def test_every_decision_and_answer_of_the_rows_is_in_the_tables(
    kind: str, request: pytest.FixtureRequest
) -> None:
    path: Path = request.getfixturevalue(kind)
    made, rows = harness.load(path), rows_of(path)
    said = [(row["scene"], viewer, a) for row in rows for viewer, a in row["answers"].items()]
    told = made.answers
    assert [*zip(told.scene, told.viewer, strict=True)] == [(scene, viewer) for scene, viewer, _ in said]
    for column in ("raw", "status", "role"):
        assert told[column].tolist() == [a[column] for *_, a in said]
    assert told.repairs.tolist() == [" ".join(a["repairs"]) for *_, a in said]
    valid = [a["intent"] for *_, a in said if a["intent"]]
    assert told[[f"intent_{a}" for a in ACTIONS]].dropna().to_numpy().tolist() == valid
    decided = [(row["scene"], d) for row in rows for d in row["decisions"]]
    table = made.decisions
    for column in ("condition", "seed", "action", "triggered", "latency_ms", "own_failed"):
        assert table[column].tolist() == [d[column] for _, d in decided]
    assert table[[f"fused_{a}" for a in ACTIONS]].to_numpy().tolist() == [d["fused"] for _, d in decided]
    for viewer in ("v2", "v3", "v4"):
        on_time = [m["on_time"] for _, d in decided for m in d["messages"] if m["from"] == viewer]
        assert table[f"on_time_{viewer}"].dropna().tolist() == on_time
        assert on_time


def test_what_each_action_leads_to_is_known_of_frozen_scenes_alone(frozen: Path, live: Path) -> None:
    table, rows = harness.load(frozen).decisions, rows_of(frozen)
    first = table.drop_duplicates("scene")
    for i, action in enumerate(ACTIONS):
        assert first[f"safe_{action}"].tolist() == [row["safe"][i] for row in rows]
    driven = harness.load(live).decisions
    assert "safe_IDLE" not in driven
    assert "safe" not in driven
    assert driven.acted.any()


def test_true_false_and_unknown_can_be_computed_with(frozen: Path) -> None:
    made = harness.load(frozen)
    table = made.decisions
    assert {str(table[c].dtype) for c in ("safe", "triggered", "on_time_v2")} == {"boolean"}
    assert 0 < table[table.triggered & ~table.on_time_v2.fillna(False)].shape[0] < len(table)
    assert made.answers.seconds.dtype == float  # the proxy takes no time, so that none is known
    assert made.answers.seconds.isna().all()


def test_names_stay_text_and_files_stay_whole(frozen: Path) -> None:
    made = harness.load(str(frozen))
    assert set(made.summary.model) == set(made.episodes.model) == {"null"}
    assert len(made.episodes) == len((frozen / "episodes.csv").read_text().splitlines()) - 1
    assert len(made.summary) == len((frozen / "summary.csv").read_text().splitlines()) - 1
    assert made.config == json.loads((frozen / "run.json").read_text())
    assert made.episodes.success.dtype == bool


def test_second_answers_have_a_row_each(small: Dataset, tmp_path: Path, frozen: Path) -> None:
    shutil.copytree(frozen, tmp_path / "run")
    rows = rows_of(frozen)
    for row in rows[:3]:
        row["merged"] = {"v1+v2+v4": {**row["answers"]["v1"], "role": "merge"}}
    (tmp_path / "run/rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    table = harness.load(tmp_path / "run").answers
    again = table[table.role == "merge"]
    assert set(zip(again.viewer, again.heard, strict=True)) == {("v1", "v2+v4")}
    assert len(again) == 3
    assert set(table[table.role != "merge"].heard) == {""}


@pytest.mark.parametrize(
    ("file", "text", "table"),
    [
        ("run.json", None, "config"),
        ("run.json", "{", "config"),
        ("run.json", '{"format": "\x1b"}', "config"),
        ("summary.csv", None, "summary"),
        ("summary.csv", "", "summary"),
        ("episodes.csv", "a\n1,2,3\n\"", "episodes"),
        ("rows.jsonl", None, "decisions"),
        ("rows.jsonl", "{}", "answers"),
        ("rows.jsonl", "[" * 100_000, "answers"),
        ("rows.jsonl", "\udcff", "decisions"),
    ],
)  # fmt: skip
def test_a_broken_file_is_an_error_that_can_be_caught(
    frozen: Path, tmp_path: Path, file: str, text: str | None, table: str
) -> None:
    shutil.copytree(frozen, tmp_path / "run")
    if text is None:
        (tmp_path / "run" / file).unlink()
    else:
        (tmp_path / "run" / file).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(harness.UserError) as raised:
        getattr(harness.load(tmp_path / "run"), table)
    assert str(raised.value).isprintable()
    assert file in str(raised.value)


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, harness; print([m for m in ('numpy', 'pandas', 'typer', 'jinja2') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


@pytest.mark.parametrize("kind", ["frozen", "live"])
def test_every_column_and_key_is_documented(kind: str, request: pytest.FixtureRequest) -> None:
    text = (ROOT / "docs/files.md").read_text()
    made = harness.load(request.getfixturevalue(kind))
    assert isinstance(made.config, dict)
    for name in (*made.summary, *made.episodes, *made.decisions, *made.answers, *made.config):
        for action in ACTIONS:
            name = name.replace(f"_{action}", "_ACTION")
        for viewer in ("v2", "v3", "v4"):
            name = name.replace(f"_{viewer}", "_VIEWER")
        assert f"`{name}`" in text
