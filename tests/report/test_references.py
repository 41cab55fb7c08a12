"""What needs no model beside a model: the drivers, the best constant action,
and any action at all.
"""

import csv
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
from evaluating import live_spec_of, run, spec_of

from harness.coordination.named_points import POINTS
from harness.core.seeds import purpose
from harness.dataset.load import Dataset
from harness.report.charts import success_latency
from harness.report.references import in_trees, label, sentences
from harness.runs.folder import read
from harness.runs.headline import SUCCESS
from harness.world import scenarios
from harness.world.drivers import CONSTANTS, OPEN_LOOPS, choose, constant, open_loop

ALONE = POINTS["single-local"]


def by_hand(dataset: Dataset, point: int, tree: int) -> float:
    """With what probability an episode succeeds from a decision point,
    if every action is equally likely.
    """
    forest = dataset.forest
    return fmean(
        by_hand(dataset, int(child), tree)
        if child >= 0
        else float(forest.succeeds(np.array(edge), np.array(tree)))
        for child, edge in zip(forest.child[point], forest.edge[point], strict=True)
    )


def test_what_any_action_at_all_clears_is_exact(small: Dataset) -> None:
    expected = [by_hand(small, int(root), tree) for tree, root in enumerate(small.forest.root)]
    assert small.reference_success()["uniform"].tolist() == pytest.approx(expected)
    assert 0 < fmean(expected) < 1


def test_words_tell_what_trees_say_of_uniform_from_what_a_run_drew(small: Dataset) -> None:
    found = {name: of[SUCCESS] for name, of in in_trees(small).items()}
    exact, drawn = (sentences(found, small.scenario, exact) for exact in (True, False))
    assert "equally likely, by the trees; a run of it draws" in exact
    assert "equally likely, drawn in its run." in drawn


@pytest.mark.slow
def test_the_model_uniform_comes_to_what_the_trees_say(small: Dataset, tmp_path: Path) -> None:
    """Over many seeds, of which each has draws of its own."""
    of = run(
        spec_of(small, "uniform", points=(ALONE,), seeds=tuple(range(300))), tmp_path / "run"
    ).out
    ends = read(of).episodes
    for episode, expected in zip(small.episodes, small.reference_success()["uniform"], strict=True):
        share = fmean(e.success for e in ends if e.episode == episode)
        assert share == pytest.approx(expected, abs=0.09)  # three standard deviations of a half


@pytest.mark.slow
def test_the_model_constant_is_the_row_frozen_and_driven(small: Dataset, tmp_path: Path) -> None:
    how: dict[str, Any] = {"points": (ALONE,), "seeds": (0,)}
    live = live_spec_of("constant", len(small.episodes), small.manifest.seed, **how)
    expected = small.reference_success()["constant"].astype(bool).tolist()
    for name, spec in (("frozen", spec_of(small, "constant", **how)), ("driven", live)):
        done = read(run(spec, tmp_path / name).out)
        assert [e.success for e in done.episodes] == expected
        assert {d.action for d in done.decisions.records(0, len(done.decisions))} == {"IDLE"}


@pytest.mark.slow
def test_the_model_open_loop_is_the_row_frozen_and_driven(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actions = ("IDLE", "SLOWER", "FASTER")
    for module in ("harness.backends.driver", "harness.dataset.load"):
        monkeypatch.setattr(f"{module}.open_loop", lambda scenario: actions)
    how: dict[str, Any] = {"points": (ALONE,), "seeds": (0,)}
    live = live_spec_of("open-loop", len(small.episodes), small.manifest.seed, **how)
    expected = small.reference_success()["open-loop"].astype(bool).tolist()
    for name, spec in (("frozen", spec_of(small, "open-loop", **how)), ("driven", live)):
        done = read(run(spec, tmp_path / name).out)
        assert [e.success for e in done.episodes] == expected
        taken = [d.action for d in done.decisions.records(0, len(done.decisions)) if d.episode == 0]
        assert taken == [*actions, *["FASTER"] * len(taken)][: len(taken)]


def test_the_sequence_of_each_scenario_was_chosen_on_tune_layouts() -> None:
    rows = list(csv.DictReader(OPEN_LOOPS.read_text(encoding="utf-8").splitlines()))
    assert len({(row["scenario"], row["limits"]) for row in rows}) == len(rows) == 7
    for row in rows:
        scenario = scenarios.get(f"{row['scenario']}:limits={row['limits']}")
        assert purpose(int(row["first_seed"]), int(row["layouts"])) == "tune"
        assert open_loop(scenario) == tuple(row["actions"].split())
        assert set(row["actions"].split()) <= set(scenario.actions)
    assert open_loop(scenarios.get("do-not-pass:limits=1")) is None


def test_a_constant_action_clears_what_the_driver_of_that_action_does(small: Dataset) -> None:
    for driver, action in (("cruise", "IDLE"), ("brake", "SLOWER")):
        assert (small.forest.constant_success(action) == small.forest.driver_success(driver)).all()


def test_the_constant_of_each_scenario_was_chosen_on_tune_layouts() -> None:
    rows = list(csv.DictReader(CONSTANTS.read_text(encoding="utf-8").splitlines()))
    for name, limits in product({row["scenario"] for row in rows} | scenarios._files(), (1, 2)):
        scenario = scenarios.get(f"{name}:limits={limits}")
        best = {}
        for row in (row for row in rows if (row["scenario"], row["limits"]) == (name, str(limits))):
            cleared, layouts, safely, harmless = (
                int(row[column])
                for column in ("cleared", "layouts", "harmless_cleared", "harmless")
            )
            assert layouts >= 200
            assert purpose(int(row["first_seed"]), layouts) == "tune"
            halves = (cleared - safely) / (layouts - harmless), safely / harmless
            best[row["action"]] = cleared / layouts if limits == 1 else fmean(halves)
        assert list(best) == list(scenario.actions)
        assert best[str(constant(scenario))] == pytest.approx(max(best.values()))


def test_a_scenario_in_which_nobody_measured_has_no_constant() -> None:
    somebodys = replace(scenarios.get("do-not-pass"), name="of-somebody-else")
    assert constant(somebodys) is None
    assert label("constant", somebodys) == "constant"


def test_a_driver_may_be_an_action() -> None:
    scenario = scenarios.get("do-not-pass")
    assert choose(scenario, "LANE_RIGHT", None, None) == "LANE_RIGHT"


def test_references_have_intervals_and_n_as_a_model_has(small: Dataset) -> None:
    for name, scores in in_trees(small).items():
        score, balanced = scores["success_rate"], scores["balanced_success_rate"]
        with_danger, without = scores["success_dangerous_rate"], scores["success_harmless_rate"]
        assert (balanced.n, with_danger.n, without.n) == (4, 3, 1)
        assert balanced.value == fmean([with_danger.value or 0.0, without.value or 0.0])
        assert (score.metric, score.n, score.interval) == ("success_rate", 4, "episodes"), name
        assert score.low is not None
        assert score.high is not None
        assert score.low <= (score.value or 0.0) <= score.high


def test_names_of_near_lines_stand_together() -> None:
    rows = [
        {
            "run": "a",
            "condition": "6g",
            "latency_ms": 150.0,
            "success": 0.5,
            "low": 0.4,
            "high": 0.6,
        }
    ]
    heights = {
        "brake": 0.0,
        "full-view": 0.97,
        "constant IDLE": 0.52,
        "cruise": 0.55,
        "local-view": 0.93,
    }
    spec = success_latency(rows, heights, [], "success")
    [layer] = [x for x in spec["layer"] if "layer" in x and "data" in x["layer"][0]]
    lines, names = (part["data"]["values"] for part in layer["layer"])
    assert {line["reference"]: line["success"] for line in lines} == heights
    assert names == [
        {"named": "full-view, local-view", "success": 0.97},
        {"named": "cruise, constant IDLE", "success": 0.55},
        {"named": "brake", "success": 0.0},
    ]


@pytest.mark.slow
def test_the_command_shows_both_beside_the_model(small_path: Path, harness: Any) -> None:
    code, out, _ = harness(
        "eval", "--dataset", small_path, "--seeds", "0:1", "--condition", "single-local",
        "--verbose",
    )  # fmt: skip
    assert code == 0
    rows = {line.split("  ")[0]: line for line in out.splitlines()}
    assert "[" in rows["constant IDLE"]
    assert "[" in rows["uniform"]
    assert "constant: always the action that did best in the scenario's tune layouts" in out


@pytest.mark.slow
def test_a_scenario_without_a_constant_is_refused_in_one_line(harness: Any, tmp_path: Path) -> None:
    typed = (
        "drive",
        "--env",
        "merge-v0",
        "--model",
        "constant",
        "--episodes",
        "1",
        "--seeds",
        "0:1",
    )
    code, _, said = harness(*typed, "--out", tmp_path / "run")
    assert code == 2
    assert (
        said.startswith("harness: driver constant: none was chosen for highway-env:merge-v0")
        or "none" in said
    )
    assert said.count("\n") == 1
