"""The paper's study: the ledger inside its aims, and the folder that a user opens."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.extensions.paper.calibrated import Calibrated
from harness.extensions.paper.ledger import ledger, marks, tally, verdict
from harness.extensions.paper.panels import panels, run_paper
from harness.studies.figures.bars import operating_points
from harness.studies.figures.lines import along
from harness.studies.paper_numbers import paper_numbers
from harness.studies.play import joined, over_own_episodes, play
from harness.studies.study import Study, write_study

EPISODES = 1500  # a seed
SEEDS = range(5)


@pytest.fixture(scope="module")
def paper() -> Study:
    return run_paper(panels(core=EPISODES, sweep=EPISODES), SEEDS, lambda done: None)


@pytest.fixture(scope="module")
def study(paper: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "paper"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.studies.study.DRAWN", ("svg",))  # of which others take longest
        write_study(paper, out)
    return out


@pytest.fixture(scope="module")
def found(paper: Study) -> pd.DataFrame:
    return paper.data["ledger"]


@pytest.mark.slow
def test_every_number_of_the_paper_is_in_the_ledger(found: pd.DataFrame) -> None:
    assert set(found.id) == {row["id"] for row in paper_numbers()}
    assert set(found.verdict) <= {"within", "unclear", "misses", "cited"}
    assert found[found.kind == "cited"].id.tolist() == ["A1"]


@pytest.mark.slow
def test_the_ledger_is_inside_its_aims(found: pd.DataFrame) -> None:
    """One row misses (benchmarks/measured/studies.md):
    at 40 % loss more is heard than in the paper.
    """
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


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", [100, 105, 110])
def test_on_any_seeds_28_rows_hold_at_the_papers_own_sizes(first: int) -> None:
    """Sets that the table of benchmarks/measured/studies.md does not have."""
    parts = [
        play(Calibrated(p.episodes), p.name, p.settings, range(first, first + 5), lambda done: None)
        for p in panels()
    ]
    assert tally(ledger(joined(parts).summary))["within"] >= 28


@pytest.mark.slow
def test_twelve_rows_are_predictions(found: pd.DataFrame) -> None:
    predicted = found[found.kind == "predicted"].id.unique()
    assert " ".join(predicted) == "A4 A5 A7 B1 B4 B5 B10 B11 B12 B14 B17 B19"
    assert tally(found)["total"] == 30


def test_five_seeds_that_round_alike_are_not_taken_for_exact() -> None:
    """2 of 10 episodes in each: half an episode is .05, times t(4) = 2.776 over the root of 5."""
    alike = np.zeros((5, 10))
    alike[:, :2] = 1.0
    share = over_own_episodes("success_rate", alike)
    assert (share.low, share.high) == pytest.approx((0.2 - 0.0621, 0.2 + 0.0621), abs=1e-4)
    one = over_own_episodes("success_rate", alike[:1])
    assert np.isnan([one.low, one.high]).all()
    assert verdict(30.0, np.nan, np.nan, 89.0, 91.0) == "unclear"


@pytest.mark.slow
def test_seeds_are_the_studys_own() -> None:
    one, again, other = (
        run_paper(panels(10, 10), seeds, lambda done: None) for seeds in ((7,), (7,), (3,))
    )
    assert one.data["ledger"].equals(again.data["ledger"])
    assert not one.data["ledger"].equals(other.data["ledger"])
    assert "100.0 [–, –] %" in " ".join(other.about)
    assert other.manifest["seeds"] == [3]


@pytest.mark.slow
def test_what_equation_2_does_is_measured(study: Path) -> None:
    """The witness has 1/6 of 1/6 + 1/25 + 2/20, more than half;
    of equal weights it has a quarter.
    """
    rows = pd.read_csv(study / "conditions.csv", dtype={"value": float})
    rows = rows[(rows.panel == "min_distance_m") & (rows.metric == "success_rate")].set_index(
        "value"
    )
    with_it, without = rows["mean"][1.0], rows["mean"][1000.0]
    assert with_it > 0.9
    assert without < 0.8
    page = (study / "index.html").read_text()
    assert f"{100 * with_it:.1f} [" in page
    assert f"{100 * without:.1f} [" in page


@pytest.mark.slow
def test_the_papers_values_are_drawn_in_every_panel(study: Path) -> None:
    numbers = pd.read_csv(study / "ledger.csv")
    numbers["value"] = numbers["value"].fillna("")
    summary = pd.read_csv(study / "conditions.csv")
    core, *sweeps = (summary[summary.panel == name] for name in ("core", "size", "loss", "tau"))
    theirs = marks(numbers)
    for bare, crossed in (
        (operating_points(core), operating_points(core, theirs)),
        (along(sweeps), along(sweeps, theirs)),
    ):
        for before, after in zip(bare.axes, crossed.axes, strict=True):
            assert len(after.lines) > len(before.lines), after.get_ylabel()


@pytest.mark.slow
def test_grid_points_that_are_the_same_point_give_the_same_number(found: pd.DataFrame) -> None:
    """N = 4 with density-coupled loss, 6.6 %, is tau at its lowest,
    where all helpers load the channel.
    """
    size = found[(found.id == "B4")].ours.item()
    low = found[(found.id == "B15")].ours.iloc[0]
    assert size == pytest.approx(low)


@pytest.mark.slow
def test_the_folder_holds_figures_tables_and_what_was_fitted(study: Path) -> None:
    assert {p.name for p in study.iterdir()} == {
        "figure-a.svg", "figure-b.svg",
        *(f"{t}.{kind}" for t in ("conditions", "episodes", "ledger") for kind in ("csv", "jsonl")),
        "study.json", "index.html",
    }  # fmt: skip
    manifest = json.loads((study / "study.json").read_text())
    assert manifest["source"]["proxy_model_version"]
    assert "predictions" in manifest["source"]["calibration_label"]
    assert len(manifest["source"]["parameters"]) <= 10


@pytest.mark.slow
def test_episodes_add_up_to_the_conditions(study: Path) -> None:
    episodes, conditions = (
        pd.read_csv(study / f"{name}.csv", dtype={"value": float})
        for name in ("episodes", "conditions")
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
