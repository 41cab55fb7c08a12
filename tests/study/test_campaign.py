"""The paper's study: the ledger inside its aims, and the folder that a user opens."""

import json
from pathlib import Path

import pandas as pd
import pytest

from harness.studies.ledger import ledger, paper_numbers, tally, verdict
from harness.studies.paper import panels, run_paper

EPISODES = 1500  # a seed: at 69 % a mean of five seeds has a standard error of 0.5 points


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "paper"
    run_paper(panels(core=EPISODES, sweep=EPISODES), out, lambda done: None)
    return out


@pytest.fixture(scope="module")
def found(study: Path) -> pd.DataFrame:
    return pd.read_csv(study / "ledger.csv")


def test_every_number_of_the_paper_is_in_the_ledger(found: pd.DataFrame) -> None:
    assert set(found.id) == {row["id"] for row in paper_numbers()}
    assert set(found.verdict) <= {"within", "unclear", "misses", "cited"}
    assert found[found.kind == "cited"].id.tolist() == ["A1"]


def test_the_ledger_is_inside_its_aims(found: pd.DataFrame) -> None:
    """One row is known to miss (docs/studies.md): at 40 % loss more is heard than in the paper."""
    assert set(found[found.verdict == "misses"].id) <= {"B12"}
    ran = found[found.kind != "cited"]
    noise = ran.metric.map({"success": 1.0}).fillna(0.0)
    off = ran[(abs(ran.difference) > ran.allowed + noise) & (ran.id != "B12")]
    assert off.empty, off[["id", "value", "difference"]]


def test_a_verdict_looks_at_the_interval() -> None:
    """Paper 90, aim 1."""
    assert verdict(90.9, 88.0, 93.0, 89.0, 91.0) == "within"
    assert verdict(91.5, 90.8, 92.2, 89.0, 91.0) == "unclear"
    assert verdict(91.5, 91.2, 91.8, 89.0, 91.0) == "misses"
    assert verdict(88.5, 88.2, 88.8, 89.0, 91.0) == "misses"


def test_most_rows_are_predictions(found: pd.DataFrame) -> None:
    told = tally(found)
    assert told["total"] == 30
    assert told["predicted"] >= told["total"] / 2


def test_grid_points_that_are_the_same_point_give_the_same_number(found: pd.DataFrame) -> None:
    """N = 4 with density-coupled loss, 6.6 %, is tau at its lowest, where all helpers load the channel."""
    size = found[(found.id == "B4")].ours.item()
    low = found[(found.id == "B15")].ours.iloc[0]
    assert size == pytest.approx(low)


def test_the_folder_holds_figures_tables_and_what_was_fitted(study: Path) -> None:
    names = {f"figure-{f}.{kind}" for f in "ab" for kind in ("svg", "pdf", "png")}
    assert {p.name for p in study.iterdir()} == names | {
        *(f"{t}.{kind}" for t in ("conditions", "episodes", "ledger") for kind in ("csv", "jsonl")),
        "study.json", "index.html",
    }  # fmt: skip
    manifest = json.loads((study / "study.json").read_text())
    assert manifest["source"]["proxy_model_version"]
    assert "predictions" in manifest["source"]["calibration_label"]
    assert len(manifest["source"]["parameters"]) <= 10


def test_episodes_add_up_to_the_conditions(study: Path) -> None:
    episodes, conditions = (
        pd.read_csv(study / f"{name}.csv", dtype={"value": float}) for name in ("episodes", "conditions")
    )
    core = episodes[episodes.panel == "core"]
    for condition, rows in core.groupby("condition"):
        [mean] = conditions[
            (conditions.panel == "core") & (conditions.condition == condition)
            & (conditions.metric == "success_rate")
        ]["mean"]  # fmt: skip
        assert rows.success.mean() == pytest.approx(mean)
        assert len(rows) == 5 * EPISODES


def test_a_study_without_a_row_of_the_paper_has_none_in_its_ledger() -> None:
    empty = pd.DataFrame(columns=["panel", "condition", "metric", "interval", "value"])
    assert ledger(empty).id.tolist() == ["A1"]
