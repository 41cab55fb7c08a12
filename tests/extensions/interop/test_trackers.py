"""Trackers, each with its own package offline."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from harness.runs.folder import read

pytestmark = pytest.mark.slow

Typed = Callable[..., tuple[int, str, str]]


def typed_eval(data: Path, *more: str) -> tuple[str | Path, ...]:
    fixed = ("--condition", "6g", "--seeds", "0:2", "--limit", "1", "--out", "run")
    return "eval", "--dataset", data, *fixed, *more


def test_an_unknown_tracker_and_a_shard_are_refused_before_anything(
    two_path: Path, harness: Typed
) -> None:
    code, _, said = harness(*typed_eval(two_path, "--tracker", "mlfow"))
    assert (
        code,
        "unknown tracker 'mlfow'; did you mean 'mlflow'? known: mlflow, trackio, wandb" in said,
    ) == (2, True)
    shard = ("--shard", "1/2", "--out", "run")
    code, _, said = harness("drive", "--episodes", "2", *shard, "--tracker", "mlflow")
    assert (code, "--tracker mlflow: shards are no run of one; leave it out" in said) == (2, True)
    assert not Path("run").exists()


def test_an_unknown_tracker_of_the_environment_is_said_to_stand_there(
    two_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_TRACKERS", "mlfow")
    code, _, said = harness(*typed_eval(two_path))
    assert (code, said.count("\n")) == (2, 1)
    assert said.endswith("known: mlflow, trackio, wandb; it stands in SWARMDRIVE_TRACKERS\n")
    assert "--tracker" not in said


@pytest.mark.skipif(find_spec("mlflow") is not None, reason="needs an environment without MLflow")
def test_a_tracker_without_its_package_says_what_to_install(
    two_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, said = harness(*typed_eval(two_path, "--tracker", "mlflow"))
    assert code == 2
    assert (
        "--tracker mlflow needs mlflow-skinny, which is not installed; run `pip install 'swarmdrive"
        in said
    )
    monkeypatch.setenv("SWARMDRIVE_TRACKERS", "mlflow")
    code, _, said = harness(*typed_eval(two_path))
    assert (code, "harness: SWARMDRIVE_TRACKERS=mlflow needs mlflow-skinny" in said) == (2, True)


def success(run: str) -> float:
    [score] = [
        s for s in read(Path(run)).scores if (s.metric, s.interval) == ("success_rate", "episodes")
    ]
    return score.value


@pytest.mark.skipif(find_spec("mlflow") is None, reason="needs the extra mlflow")
def test_mlflow_has_settings_figures_and_the_page(
    two_path: Path, harness: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlflow

    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "kept").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    code, _, said = harness(*typed_eval(two_path, "--tracker", "mlflow", "--quiet"))
    assert (code, said.count("harness: tracker")) == (0, 0), said
    [run] = mlflow.MlflowClient().search_runs(["0"])
    assert (run.info.status, run.info.run_name) == ("FINISHED", "run")
    assert run.data.params["model.name"] == "proxy"
    assert run.data.params["conditions"] == '["6g"]'
    assert run.data.metrics["6g/success_rate"] == success("run")
    assert {f.path for f in mlflow.MlflowClient().list_artifacts(run.info.run_id)} >= {
        "report.html",
        "run.json",
    }


@pytest.mark.skipif(find_spec("wandb") is None, reason="needs the extra wandb")
def test_wandb_has_settings_and_figures_offline(
    two_path: Path, harness: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    code, _, said = harness(*typed_eval(two_path, "--tracker", "wandb", "--quiet"))
    assert (code, said.count("harness: tracker")) == (0, 0), said
    [kept] = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    written = kept.read_bytes()
    assert b"6g/success_rate" in written
    assert b"model.name" in written


@pytest.mark.skipif(find_spec("trackio") is None, reason="needs the extra trackio")
def test_trackio_has_figures_on_this_machine(
    two_path: Path, harness: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sqlite3

    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    code, _, said = harness(*typed_eval(two_path, "--tracker", "trackio", "--quiet"))
    assert (code, said.count("harness: tracker")) == (0, 0), said
    kept = [*(tmp_path / "trackio").rglob("*.db")]
    assert kept
    with sqlite3.connect(kept[0]) as file:
        rows = file.execute("SELECT metrics FROM metrics").fetchall()
    assert any("6g/success_rate" in str(row) for row in rows)
