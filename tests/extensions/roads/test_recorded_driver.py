"""The recorded driver on a run's page."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evaluating import run as evaluate
from evaluating import spec_of
from studied import trials

from harness.dataset.load import load
from harness.extensions.roads.page import REGRET, section
from harness.runs.folder import read

pytestmark = pytest.mark.slow
MODELS = ("recorded", "brake")


@pytest.fixture
def runs(
    tmp_path: Path, once: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> dict[str, Path]:
    """Folders of runs of rules on a recording, whose others only replay."""
    monkeypatch.setenv("SWARMDRIVE_RECORDINGS", "")
    trials()["reaction"].lays(tmp_path, once)
    dataset = load(tmp_path / "without")
    for model in MODELS:
        evaluate(spec_of(dataset, model, prompt="v4", seeds=(0, 1)), tmp_path / model)
    return {model: tmp_path / model for model in MODELS}


def test_he_stands_beside_every_condition(runs: dict[str, Path]) -> None:
    for model, folder in runs.items():
        run = read(folder)
        shown = section(run)
        assert shown.headline[0].startswith("The recorded driver succeeds in 100.0 [20.7, 100.0] %")
        assert shown.title == f"The recorded driver beside {model} · v4 · json"
        assert "do not react" in shown.caveats[0]
        his, *rows = shown.tables[0].rows
        success = np.array([episode.success for episode in run.episodes]).reshape(run.grid.shape)
        worse = int((success[0].mean(axis=0) < 1).sum())
        assert [row[0] for row in rows] == list(run.conditions)
        if model == "recorded":
            assert rows[0][1:3] == his[1:3]
            assert rows[0][3:] == ("+0.0 [–, –]", "0", "0")
            assert len(shown.tables) == 1
        else:
            regret = run.score(run.conditions[0], REGRET)
            assert rows[0][2].startswith(f"{100 * regret.value:.1f} ")
            assert rows[0][4:] == ("0", str(worse))
            assert worse == len(shown.tables[1].rows) == 2


def test_a_run_of_no_recording_has_no_such_section(proxy_run: Path) -> None:
    assert section(read(proxy_run)) is None
