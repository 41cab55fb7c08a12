"""A run as pandas tables."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from evaluating import live_spec_of, run, spec_of, with_ego
from run_on_disk import answers_of, made_up, rows_of

import harness
from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
ACTIONS = ("SLOWER", "IDLE", "FASTER")


@pytest.fixture(scope="module")
def frozen(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose answers fail in many ways,
    by a model whose name pandas takes for a missing value.
    """
    spec = spec_of(small, "proxy-faulty", points=(POINTS["single-local"], POINTS["6g"]))
    spec = with_ego(spec, card=replace(spec.ego.card, name="null"))
    return run(spec, tmp_path_factory.mktemp("tables") / "frozen").out


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = live_spec_of(points=(POINTS["6g"], POINTS["single-local"]))
    return run(spec, tmp_path_factory.mktemp("tables") / "live").out


@pytest.mark.parametrize("kind", ["frozen", "live"])
def test_every_decision_and_answer_is_in_the_tables(
    kind: str, request: pytest.FixtureRequest
) -> None:
    path: Path = request.getfixturevalue(kind)
    made, said = harness.load(path), answers_of(path)
    told = made.answers
    assert [*zip(told.scene, told.viewer, strict=True)] == [(a.scene, a.viewer) for a in said]
    for column in ("raw", "status", "role"):
        assert told[column].tolist() == [getattr(a, column) for a in said]
    assert told.repairs.tolist() == [" ".join(a.repairs) for a in said]
    valid = [list(a.intent) for a in said if a.intent]
    assert told[[f"intent_{a}" for a in ACTIONS]].dropna().to_numpy().tolist() == valid
    decided, table = rows_of(path), made.decisions
    place = {row["scene"]: (row["episode"], row["step"]) for row in decided}
    assert [*zip(told.episode, told.step, strict=True)] == [place[scene] for scene in told.scene]
    for column in ("condition", "seed", "action", "triggered", "latency_ms", "own_failed"):
        assert table[column].tolist() == [row[column] for row in decided]
    for action in ACTIONS:
        assert table[f"fused_{action}"].tolist() == [row[f"fused_{action}"] for row in decided]
    for n in (1, 2, 3):
        on_time = [row[f"on_time_{n}"] for row in decided if row[f"helper_{n}"] is not None]
        assert table[f"on_time_{n}"].dropna().tolist() == on_time
        assert on_time


def test_what_each_action_leads_to_is_known_of_frozen_scenes_alone(
    frozen: Path, live: Path
) -> None:
    table, driven = harness.load(frozen).decisions, harness.load(live).decisions
    for action in ACTIONS:
        assert table[f"safe_{action}"].notna().all()
        assert driven[f"safe_{action}"].isna().all()
    assert driven.safe.isna().all()
    assert driven.acted.any()
    assert table.acted.isna().all()


def test_true_false_and_unknown_can_be_computed_with(frozen: Path) -> None:
    made = harness.load(frozen)
    table = made.decisions
    assert {str(table[c].dtype) for c in ("safe", "triggered", "on_time_1")} == {"boolean"}
    assert 0 < table[table.triggered & ~table.on_time_1.fillna(False)].shape[0] < len(table)
    assert made.answers.seconds.dtype == float  # the proxy takes no time, so that none is known
    assert made.answers.seconds.isna().all()
    assert made.answers.image_sha256.isna().all()


def test_names_stay_text_and_files_stay_whole(frozen: Path) -> None:
    made = harness.load(str(frozen))
    assert set(made.summary.model) == set(made.episodes.model) == {"null"}
    assert len(made.episodes) == len((frozen / "episodes.csv").read_text().splitlines()) - 1
    assert len(made.summary) == len((frozen / "summary.csv").read_text().splitlines()) - 1
    assert made.config == json.loads((frozen / "run.json").read_text())
    assert made.episodes.success.dtype == bool


def test_fusion_calls_have_a_row_each(tmp_path: Path) -> None:
    heard = {"v3": ("v2", "v4")}

    def fused(row: dict[str, object]) -> None:
        if row["viewer"] in heard:
            row |= {"viewer": "v1", "heard": heard[str(row["viewer"])], "role": "merge"}

    table = harness.load(made_up(tmp_path / "run", answer=fused)).answers
    again = table[table.role == "merge"]
    assert set(zip(again.viewer, again.heard, strict=True)) == {("v1", "v2+v4")}
    assert len(again) == 8
    assert set(table[table.role != "merge"].heard) == {""}


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, harness; print([m for m in ('numpy', 'pandas', 'typer', 'jinja2') if m in "
        "sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


@pytest.mark.parametrize("kind", ["frozen", "live"])
def test_every_column_and_key_is_documented(kind: str, request: pytest.FixtureRequest) -> None:
    text = (ROOT / "docs/fields.md").read_text()
    made = harness.load(request.getfixturevalue(kind))
    assert isinstance(made.config, dict)
    for name in (*made.summary, *made.episodes, *made.decisions, *made.answers, *made.config):
        for action in ACTIONS:
            name = name.replace(f"_{action}", "_ACTION")
        name = re.sub(r"_[1-3]$", "_N", name)
        assert f"`{name}`" in text
