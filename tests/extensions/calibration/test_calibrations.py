"""Calibration: what is fitted on tune layouts, and what it makes of answers."""

import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import run, spec_of
from hypothesis import given
from hypothesis import strategies as st
from run_on_disk import configure, damage

from harness.backends.replay import Replay
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.core.resources import MARKER
from harness.dataset.build import build
from harness.dataset.load import Dataset, load
from harness.evaluate.latency import PAPER
from harness.extensions.calibration.calibrations import Calibration, Correction, calibration
from harness.extensions.calibration.fitting import TEMPERATURES, calibrate, fit
from harness.runs.fit import OF_QUESTION, question_of, weights_of
from harness.runs.folder import read
from harness.world import scenarios

pytestmark = pytest.mark.usefixtures("svg_alone", "unrebuilt")

Typed = Callable[..., tuple[int, str, str]]


def test_a_prior_and_a_temperature_by_hand() -> None:
    """.6 .3 .1 over .6 .2 .2 is 1 : 1.5 : .5; its square is 4 : 9 : 1."""
    p, prior = np.array([0.6, 0.3, 0.1]), (0.6, 0.2, 0.2)
    assert Correction(1, prior=prior).of(p) == pytest.approx(np.array([2, 3, 1]) / 6)
    assert Correction(1, 0.5, prior).of(p) == pytest.approx(np.array([4, 9, 1]) / 14)
    assert Correction(1, 2.0).of(np.array([0.64, 0.36, 0.0])) == pytest.approx(
        [0.8 / 1.4, 0.6 / 1.4, 0.0]
    )


def test_answers_that_are_none_stay() -> None:
    p = np.array([[np.nan, np.nan, np.nan], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(Correction(1, 0.5, (0.2, 0.4, 0.4)).of(p), p)


@given(
    st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3).filter(lambda p: sum(p) > 0.01),
    st.sampled_from(TEMPERATURES.tolist()),
)
def test_a_temperature_changes_no_likeliest_action(p: list[float], temperature: float) -> None:
    intent = np.array(p) / sum(p)
    corrected = Correction(1, temperature).of(intent)
    assert corrected.sum() == pytest.approx(1.0)
    assert corrected[np.argmax(intent)] == pytest.approx(corrected.max())
    assert Correction(1).of(intent) == pytest.approx(intent)


@pytest.mark.slow
def test_the_temperature_that_was_used_is_found_again() -> None:
    """Answers that are honest, made three times as sure of themselves in log space."""
    draws = np.random.default_rng(0)
    honest = draws.dirichlet((1.0, 1.0, 1.0), 4000)
    truth = (draws.random((4000, 1)) > honest.cumsum(axis=1)).sum(axis=1)
    optimal = truth[:, None] == np.arange(3)
    boasting = Correction(1, 1 / 3).of(honest)
    assert fit(boasting, optimal, "L1").temperature == pytest.approx(3.0, rel=0.1)
    assert fit(honest, optimal, "L1").temperature == pytest.approx(1.0, rel=0.1)


def test_a_prior_is_the_mean_answer_and_needs_no_tree() -> None:
    p = np.array([[0.8, 0.1, 0.1], [0.6, 0.3, 0.1]])
    found = fit(p, np.zeros((2, 3), dtype=bool), "L0")
    assert found == Correction(2, 1.0, (0.7, 0.2, 0.1))
    assert np.argmax(found.of(p[1])) == 1


@pytest.fixture
def tuned(
    proxy_run: Path, small_path: Path, harness: Typed, tmp_path: Path, unrebuilt: None
) -> Path:
    """A project with a calibration of the proxy."""
    (tmp_path / MARKER).touch()
    for level in ("L0", "L1"):
        code, said, error = harness(
            "model", "calibrate", proxy_run, "--dataset", small_path, "--level", level,
            "--out", f"calibrations/{level.lower()}.toml",
        )  # fmt: skip
        assert (code, error) == (0, "")
        assert "layout seeds 100 to 103 (tune), 4 layouts" in said
    return tmp_path


def evaluated(harness: Typed, dataset: Path, *more: str) -> tuple[int, str, str]:
    return harness("eval", "--dataset", dataset, "--seeds", "0", "--quiet", "--no-cache", *more)


@pytest.mark.slow
def test_a_calibration_corrects_every_answer_of_a_condition(
    tuned: Path, small_path: Path, harness: Typed
) -> None:
    """Alone the policy is the ego's corrected answer;
    the run keeps the file, and a sweep plays it again.
    """
    conditions = ("single-local", "single-local:calibration=l1", "6g", "6g:calibration=l0")
    words = [word for name in conditions for word in ("--condition", name)]
    code, _, error = evaluated(harness, small_path, "--out", "run", *words)
    assert (code, error) == (0, "")
    played = read(tuned / "run")
    assert set(played.manifest.kept["calibrations"]) == {"l0", "l1"}
    assert (tuned / "run/sources/calibrations/l1.toml").exists()
    fitted = tomllib.loads((tuned / "calibrations/l1.toml").read_text())
    own = {a.scene: np.array(a.intent) for a in played.answers if a.role == "ego"}
    decisions = played.decisions
    corrected = Correction(1, fitted["ego"]["temperature"])
    condition = decisions.labels("condition")
    scenes, fused = decisions.labels("scene"), decisions.of_actions("fused")
    rows = [n for n, name in enumerate(condition) if name == "single-local:calibration=l1"]
    assert rows
    for n in rows:
        assert fused[n] == pytest.approx(corrected.of(own[str(scenes[n])]), abs=2e-6)
    entropy = {name: played.score(name, "entropy_nats").value for name in conditions}
    assert entropy["single-local"] != entropy["single-local:calibration=l1"]
    code, said, _ = harness("study", "sweep", "run", "--condition", "6g", "--over", "calibration", "--grid",
                            "none,l0", "--seeds", "0", "--json")  # fmt: skip
    assert code == 0
    swept = {
        row["value"]: row["mean"] for row in json.loads(said)
        if row["metric"] == "success_rate" and row["interval"] == "episodes"
    }  # fmt: skip
    for value, name in (("none", "6g"), ("l0", "6g:calibration=l0")):
        score = played.score(name, "success_rate")
        assert score is not None
        assert swept[value] == pytest.approx(score.value)
    file = tuned / "calibrations/l0.toml"
    file.write_text(file.read_text().replace('"answers" = ', '"answers" = 1'))
    assert (
        "calibration l0 has changed since" in harness("study", "sweep", "run", "--over", "tau")[2]
    )


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--prompt", "v4"), "fitted with prompt.version v2, not v4"),
        (("--model", "proxy-faulty"), "fitted with model.name proxy, not proxy-faulty"),
        (("--condition", "6g:calibration=none-such"), "unknown calibration 'none-such'"),
        (("--condition", "6g:calibration=l1,content=both"), "the second question has no fit"),
    ],
)
def test_what_a_calibration_does_not_fit_is_refused(
    tuned: Path, small_path: Path, harness: Typed, more: tuple[str, ...], said: str
) -> None:
    code, _, error = evaluated(harness, small_path, "--condition", "6g:calibration=l1", *more)
    assert code == 2
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("last_seed = 103", "last_seed = 200001", "calibration is fitted on tune seeds"),
        ("prior = [", "prior = [0.5, ", "prior has 4 values"),
        ("prior = [", "prior = [1e-320, ", "0.0001"),
        ('"temperature" = 1', '"temperature" = 99', "temperature"),
        ('level = "L0"', 'level = "L7"', "level"),
        ('level = "L0"', 'level = "L1"', "level L1 goes with a prior if it has L0"),
        ('"temperature" = 1.0', '"temperature" = 2.0', "level L0 has no temperature but 1"),
        ("prior = [0.", "prior = [0.9", "prior sums to 1."),
        ('"answers" = ', '"answers" = -', "allowed: 1 or more"),
        ('"SLOWER", "IDLE"', '"IDLE", "SLOWER"', "was fitted with actions IDLE SLOWER"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_one_line(
    tuned: Path, small_path: Path, harness: Typed, old: str, new: str, said: str
) -> None:
    file = tuned / "calibrations/l0.toml"
    text = file.read_text().replace('"prior"', "prior")
    assert old in text
    file.write_text(text.replace(old, new))
    code, _, error = evaluated(harness, small_path, "--condition", "6g:calibration=l0")
    assert code == 2
    assert said in error
    assert error.count("\n") == 1


def test_nothing_is_fitted_on_an_intent_that_no_text_states(
    two_run: Path, two_path: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(two_run, tmp_path / "run"))
    assert calibrate(run, "L1", two_path, "")[1][0].role == "ego"
    damage(run, answer=lambda row: row.update(intent=(1.0, 0.0, 0.0)))
    with pytest.raises(UserError, match="states another intent than its text says"):
        calibrate(run, "L1", two_path, "")


@pytest.mark.slow
def test_a_calibration_is_of_the_weights_that_it_was_fitted_on(
    proxy_run: Path, small: Dataset, small_path: Path, harness: Typed, tmp_path: Path
) -> None:
    (tmp_path / MARKER).touch()
    tuned = Path(shutil.copytree(proxy_run, tmp_path / "tuned"))
    identity = {**read(tuned).manifest.identity, "file_sha256": "a" * 64, "states": {"size": 9}}
    configure(tuned, identity=identity)
    command = ("--dataset", small_path, "--out", "calibrations/mine.toml")
    code, said, _ = harness("model", "calibrate", tuned, *command)
    assert (code, "runs find it" in said) == (0, False)
    code, said, _ = harness("model", "calibrate", tuned, *command[:3], "mine.toml")
    assert (code, said.endswith("; runs find it in calibrations/ of a project\n")) == (0, True)
    code, _, error = harness("model", "calibrate", tuned, *command[:3], "calibrations/mine.toml")
    assert (code, "give a new name, since runs name calibrations" in error) == (2, True)
    fitted = calibration("mine")
    assert fitted.weights == weights_of(identity)
    assert [*fitted.weights] == ["file_sha256", "states"]
    assert fitted.obstacle_of_models([identity, identity]) is None
    other = {**identity, "file_sha256": "b" * 64}
    spec = spec_of(small, "proxy", points=(named_point("6g:calibration=mine"),))
    for asked in (identity, other):  # as they are, replayed, as `run check` does, and again
        replayed = Replay(read(tuned)).identity()
        replayed["of"]["identity"] = asked
        twice = {**replayed, "of": {**replayed["of"], "model": {"engine": "replay"}}}
        twice["of"]["identity"] = replayed
        for of_models in (asked, replayed, twice):
            if asked is identity:
                spec.check_models(of_models, PAPER)
            else:
                with pytest.raises(UserError, match="mine was fitted on other weights"):
                    spec.check_models(of_models, PAPER)
    said = str(fitted.obstacle_of_models([identity, other]))
    assert said.startswith("was fitted on other weights (file_sha256 aaaaaaaa")
    code, _, error = evaluated(
        harness, small_path, "--condition", "6g:calibration=mine", "--out", "r"
    )
    assert (code, error.count("\n")) == (2, 1)
    assert "calibration mine was fitted on other weights" in error
    assert not Path("r/run.json").exists()
    swept = ("study", "sweep", proxy_run, "--over", "tau", "--grid", "0", "--quiet")
    code, _, error = harness(*swept, "--condition", "6g:calibration=mine")
    assert (code, "calibration mine was fitted on other weights" in error) == (2, True)


def test_of_a_replay_is_fitted_what_is_fitted_of_the_run_that_was_asked(
    two_run: Path, two_path: Path, tmp_path: Path
) -> None:
    """Its helpers and temperature are those of that run; earlier replays do not state them."""
    again = tmp_path / "again"
    run(spec_of(load(two_path), f"replay:{two_run}"), again)
    fitted, replayed = (calibrate(each, "L1", two_path, "") for each in (two_run, again))
    assert fitted[1] == replayed[1]
    assert fitted[0].question == replayed[0].question
    identity = read(again).manifest.identity
    for change, said in (
        ({"temperature": 0.7}, "its answers are sampled"),
        ({"helpers": [{"model": {}}]}, "its helpers have a model of their own"),
        ({"helpers": None}, "does not state how they were asked; give that run"),
    ):
        configure(again, identity={**identity, "of": {**identity["of"], **change}})
        with pytest.raises(UserError, match=said):
            calibrate(again, "L1", two_path, "")


@pytest.mark.slow
def test_report_layouts_and_a_name_that_is_taken_are_refused(
    tuned: Path, tmp_path: Path, small_path: Path, proxy_run: Path, harness: Typed
) -> None:
    build(
        scenarios.get("occluded-intersection"),
        tmp_path / "report",
        1,
        200_000,
        1,
        lambda done: None,
        False,
    )
    code, _, error = evaluated(harness, tmp_path / "report", "--out", "held-out")
    assert code == 0, error
    code, _, error = harness("model", "calibrate", "held-out", "--out", "y.toml")
    assert code == 2
    assert error == (
        "harness: held-out: calibration is fitted on tune seeds, and these are layout seeds 200000 "
        "to 200000 (report)\n"
    )
    assert not Path("y.toml").exists()
    taken = harness(
        "model", "calibrate", proxy_run, "--dataset", small_path, "--out", "calibrations/l1.toml"
    )
    assert "is there already" in taken[2]
    assert (
        "unknown --level"
        in harness("model", "calibrate", proxy_run, "--level", "l9", "--out", "z.toml")[2]
    )


def test_an_answer_in_a_scene_that_the_dataset_has_not_is_one_line(
    proxy_run: Path, small_path: Path, harness: Typed, tmp_path: Path, unrebuilt: None
) -> None:
    run = shutil.copytree(proxy_run, tmp_path / "run")
    line, *_ = (run / "answers.jsonl").read_text().splitlines()
    scene = json.loads(line)["scene"]
    with (run / "answers.jsonl").open("a") as file:
        file.write(line.replace(scene, "00009-0-000000000000") + "\n")
    code, _, error = harness(
        "model", "calibrate", run, "--dataset", small_path, "--out", "mine.toml"
    )
    assert (code, error.count("\n")) == (2, 1)
    assert "has scene '00009-0-000000000000', which decisions.parquet has not" in error


@pytest.mark.slow
def test_helpers_that_answered_nothing_are_not_corrected(
    two_path: Path, small: Any, harness: Typed, tmp_path: Path
) -> None:
    (tmp_path / MARKER).touch()
    run(spec_of(small, points=spec_of(small).points[:1], ask="used"), tmp_path / "alone")
    assert harness("model", "calibrate", "alone", "--out", "calibrations/ego.toml")[0] == 0
    code, _, error = evaluated(harness, two_path, "--condition", "6g:calibration=ego")
    assert code == 2
    assert "was fitted on no helper's answer" in error


def test_a_calibration_of_a_model_without_an_adapter_does_not_fit_one_with() -> None:
    model = {"name": "m", "engine": "e"}
    agent: dict[str, Any] = {"model": model, "prompt": {"version": "v", "sha256": "s"}}
    agent |= dict.fromkeys(OF_QUESTION, "x")
    here = scenarios.get("occluded-intersection")
    found = Calibration(
        command="c", fitted_on="r", first_seed=0, last_seed=3, scenario=here.name, actions=here.actions,
        question=question_of(agent), level="L1", ego=Correction(4),
    )  # fmt: skip
    assert found.obstacle(agent, here) is None
    for key in ("adapter", "sha256"):
        other = {**agent, "model": {**model, key: "new"}}
        assert found.obstacle(other, here) == f"was fitted with model.{key} None, not new"
