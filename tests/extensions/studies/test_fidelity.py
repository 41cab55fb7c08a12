"""Frozen against closed, on four layouts that were frozen and driven."""

import json
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from former import DRIVE
from run_on_disk import Row, change, configure
from typer.main import get_command

from harness.cli import app
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.extensions.studies.fidelity.study import disagreements, fidelity

Said = tuple[int, str, str]
MODELS = ("proxy", "cruise", "brake", "local-view")
# those of `small`
LAYOUTS = ("--episodes", "4", "--first-seed", "100", "--seeds", "0", "--workers", "1")


@pytest.fixture(scope="module")
def made(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of four models, each frozen and driven."""
    folder = tmp_path_factory.mktemp("fidelity")
    for model in MODELS:
        evaluate(spec_of(small, model, seeds=(0,)), folder / f"eval-{model}")
        drive = (
            *DRIVE,
            "--model",
            model,
            *LAYOUTS,
            "--quiet",
            "--out",
            str(folder / f"drive-{model}"),
        )
        get_command(app)(drive, standalone_mode=False)
    return folder


@pytest.fixture
def runs(made: Path, harness: Callable[..., Said]) -> list[Path]:
    """Where the test is: each model's frozen and driven run."""
    shutil.copytree(made, Path(), dirs_exist_ok=True)
    return [Path(f"{kind}-{model}") for model in MODELS for kind in ("eval", "drive")]


def success(run: Path, condition: str) -> pd.Series:
    table = pd.read_csv(run / "episodes.csv")
    return table[table.condition == condition].groupby("episode").success.mean()


@pytest.mark.slow
def test_episodes_are_paired_by_layout_condition_and_seed(runs: list[Path]) -> None:
    found = fidelity(runs)
    assert len(found.table) == 4 * 3
    assert len(found.episodes) == 4 * 3 * 4
    row: Any
    for row in found.table.itertuples():
        frozen, closed = (
            success(Path(f"{kind}-{row.model}"), row.condition) for kind in ("eval", "drive")
        )
        assert row.frozen == pytest.approx(frozen.mean())
        assert row.closed == pytest.approx(closed.mean())
        assert row.difference == pytest.approx((frozen - closed).mean())
        assert row.n == 4
    assert found.ranked == 5, (
        "no condition makes a difference to a driver, nor the link here to the proxy"
    )
    assert -1 <= found.rank <= 1
    other = found.episodes.success_frozen != found.episodes.success_closed
    assert disagreements(found.episodes)["count"].sum() == other.sum()


@pytest.mark.slow
def test_a_driver_drives_as_its_frozen_scenes_say(runs: list[Path]) -> None:
    found = fidelity([Path("eval-cruise"), Path("drive-cruise")])
    assert (found.table.difference == 0).all()
    assert (found.table.agreement == 1).all()
    assert disagreements(found.episodes).empty
    for name, turned in (("one-further", 1), ("far-away", 7000)):  # files may state any seeds
        shutil.copytree("eval-cruise", name)
        change(Path(name), episode=partial(turn, by=turned))
        pd.testing.assert_frame_equal(
            fidelity([Path(name), Path("drive-cruise")]).table, found.table
        )


def turn(row: Row, by: int) -> None:
    row["layout_seed"] = 100 + (row["episode"] + by) % 4 if by < 4 else row["layout_seed"] + by


@pytest.mark.exhaustive
def test_the_command_writes_a_page_and_says_the_largest_difference(
    runs: list[Path], harness: Callable[..., Said]
) -> None:
    code, out, err = harness("study", "fidelity", *runs, "--out", "told")
    assert (code, err) == (0, "")
    assert "rank correlation of 5 models and conditions" in out
    assert "Largest difference, frozen minus closed" in out
    assert "json · " not in out + Path("told/index.html").read_text(), (
        "the ego's agent answers for helpers"
    )
    few = harness(
        "study", "fidelity", *(run for run in runs if "proxy" in str(run)), "--out", "few"
    )[1]
    assert "Spearman" not in few
    assert re.search(
        r"No rank correlation: \d different models and conditions are too few; at least 5 are "
        r"needed\.",
        " ".join(few.split()),
    )
    assert "too few" in Path("few/index.html").read_text()


@pytest.mark.slow
def test_what_cannot_be_compared_is_one_line(
    runs: list[Path], harness: Callable[..., Said]
) -> None:
    stated = json.loads((runs[1] / "run.json").read_text())
    for name, changed in (
        ("latency", {"latency": {**stated["latency"], "ego_s": 1.9}}),
        ("weights", {"identity": {**stated["identity"], "file_sha256": "0" * 64}}),
        (
            "radio",
            {"channels": {**stated["channels"], "6g": {**stated["channels"]["6g"], "model": "x"}}},
        ),
    ):
        shutil.copytree(runs[1], name)
        configure(Path(name), **changed)
        with pytest.raises(UserError, match=f"and {name} differ in {name}; give runs that differ"):
            fidelity([runs[0], Path(name)])
    for folders, said in (
        (runs[:1], "no run on live episodes"),
        (runs[1:2], "no run on frozen scenes"),
        ([runs[0], runs[3]], "have no episode in common"),
        ([runs[0], runs[0], runs[1]], "two of the runs have the same episodes"),
        ([runs[0], Path("nowhere")], "nowhere is no finished run"),
    ):
        with pytest.raises(UserError, match=said):
            fidelity(folders)
    shutil.copytree(runs[1], "torn")
    Path("torn/episodes.csv").write_text("model,prompt\n")
    code, out, err = harness("study", "fidelity", runs[0], "torn")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "torn/episodes.csv is broken (" in err
    assert not Path("reports").exists()
