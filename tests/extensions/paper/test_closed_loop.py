"""The paper's panels driven in closed loop."""

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from typer.main import get_command

from harness.cli import app
from harness.extensions.paper.closed_loop import panels

Said = tuple[int, str, str]
OPTIONS = (
    "study",
    "closed-loop",
    "--model",
    "proxy",
    "--episodes",
    "2",
    "--seeds",
    "0",
    "--workers",
    "1",
    "--out",
    "study",
)


def test_every_grid_point_is_a_condition_that_its_name_tells() -> None:
    found = panels()
    assert [s.point.name for s in found["core"]] == ["single-local", "v2x", "6g"]
    sizes = [(s.point.ask.max_helpers, s.point.radio.loss) for s in found["size"]]
    assert sizes == [(0, 0.0), (1, 0.006), (2, 0.036), (3, 0.066)]
    assert [s.point.radio.loss for s in found["loss"]][:3] == [0.0, 0.05, 0.1]
    assert found["tau"][0].point.name == "6g:tau_nats=0.3"


@pytest.fixture(scope="module")
def made(once: Callable[..., Path]) -> Path:
    """A folder in which the study was made."""

    def study(folder: Path) -> None:
        folder.mkdir()
        with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as said:
            get_command(app)(OPTIONS, standalone_mode=False)
        (folder / "said").write_text(said.getvalue())

    return once("closed-loop", study)


@pytest.mark.slow
def test_the_study_is_a_live_run_and_figures_of_it(made: Path, harness: Callable[..., Said]) -> None:
    shutil.copytree(made / "study", "study")
    out = (made / "said").read_text()
    assert max(map(len, out.splitlines())) <= 80
    folder = Path("study")
    figures = {f"figure-{f}.{kind}" for f in "ab" for kind in ("svg", "pdf", "png")}
    tables = {"conditions.csv", "conditions.jsonl", "closed-loop.json", "index.html", "run"}
    assert {p.name for p in folder.iterdir()} == figures | tables
    table = pd.read_csv(folder / "conditions.csv")
    driven = pd.read_csv(folder / "run" / "episodes.csv")
    mine = table[(table.metric == "success_rate") & (table.interval == "episodes")]
    at_70 = mine[(mine.panel == "tau") & (mine.value == 0.7)]["mean"].item()
    six = mine[(mine.panel == "core") & (mine.condition == "6g")]["mean"].item()
    assert at_70 == six == pytest.approx(driven[driven.condition == "6g"].success.mean())
    alone = mine[(mine.panel == "core") & (mine.condition == "single-local")]["mean"].item()
    assert mine[(mine.panel == "size") & (mine.value == 1)]["mean"].item() == alone
    written = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    assert harness(*OPTIONS) == (0, out, ""), "again, it is gone on with, and has nothing left to do"
    assert {p: p.read_bytes() for p in written} == written


@pytest.mark.slow
def test_a_folder_of_another_study_is_refused(made: Path, harness: Callable[..., Said]) -> None:
    shutil.copytree(made / "study", "study")
    assert harness(*OPTIONS, "--json")[0] == 0
    told = json.loads(Path("study/closed-loop.json").read_text())
    assert len(told["panels"]["tau"]) == 16
    code, out, err = harness(*OPTIONS, "--prompt", "v1")
    assert (code, out) == (2, "")
    assert "was begun with --prompt v2, and not with --prompt v1" in err
