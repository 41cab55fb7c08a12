"""The paper's panels driven in closed loop."""

from collections.abc import Callable
from typing import Any

import pandas as pd
import pytest

from harness.extensions.paper.closed_loop import panels


def test_every_grid_point_is_a_condition_that_its_name_tells() -> None:
    found = panels()
    assert [s.point.name for s in found["core"]] == ["single-local", "v2x", "6g"]
    sizes = [(s.point.ask.max_helpers, s.point.radio.loss) for s in found["size"]]
    assert sizes == [(0, 0.0), (1, 0.006), (2, 0.036), (3, 0.066)]
    assert [s.point.radio.loss for s in found["loss"]][:3] == [0.0, 0.05, 0.1]
    assert found["tau"][0].point.name == "6g:tau_nats=0.3"


@pytest.mark.slow
def test_the_study_is_a_live_run_and_figures_of_it(tries: Callable[[str], Any]) -> None:
    folder = tries("closed-loop").folder
    assert {path.name for path in folder.glob("*.svg")} == {"figure-a.svg", "figure-b.svg"}
    table = pd.read_csv(folder / "conditions.csv")
    driven = pd.read_csv(folder / "run" / "episodes.csv")
    mine = table[(table.metric == "success_rate") & (table.interval == "episodes")]
    at_70 = mine[(mine.panel == "tau") & (mine.value == 0.7)]["mean"].item()
    six = mine[(mine.panel == "core") & (mine.condition == "6g")]["mean"].item()
    assert at_70 == six == pytest.approx(driven[driven.condition == "6g"].success.mean())
    alone = mine[(mine.panel == "core") & (mine.condition == "single-local")]["mean"].item()
    assert mine[(mine.panel == "size") & (mine.value == 1)]["mean"].item() == alone
