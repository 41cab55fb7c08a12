"""Round trips to a cloud, drawn from what others measured."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from evaluating import run as evaluate
from evaluating import spec_of

from harness.coordination.coordinate import coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import CLOUD, named_point
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.radio.channel import Draws
from harness.radio.fading import Trips
from harness.radio.networks import names, network

pytestmark = pytest.mark.usefixtures("svg_alone")

MINE = """
description = "Mine."
source = "my desk"
status = "measured"
[quantiles_ms]
0 = 10
50 = 20
100 = 60
"""
Said = tuple[int, str, str]


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "networks").mkdir()
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "networks" / "mine.toml"
    path.write_text(MINE)
    return path


@pytest.mark.usefixtures("mine")
def test_a_draw_is_the_quantile_between_those_that_are_given():
    drawn = network("mine").round_trip_s(np.array([0.0, 0.25, 0.5, 0.75, 0.9999999]))
    assert drawn == pytest.approx([0.010, 0.015, 0.020, 0.040, 0.060])


@pytest.mark.parametrize("name", names())
def test_what_ships_is_cited_and_its_draws_have_its_quantiles(name: str):
    its = network(name)
    assert its.status == "cited"
    assert its.source
    drawn = its.round_trip_s((np.arange(100_000) + 0.5) / 100_000)
    for percent, ms in its.quantiles_ms.items():
        assert 1000 * np.quantile(drawn, float(percent) / 100) == pytest.approx(ms, rel=0.02)


def decisions(point, n: int = 400):
    """Lone egos that infer for 145 ms, of as many layouts."""
    helpers = np.zeros((n, 0))
    intents = Intents(
        np.full((n, 2), 0.5), np.zeros((n, 0, 2)), helpers > 0, np.ones((n, 1)), helpers, helpers,
        np.full((n, 1), 0.145),
    )  # fmt: skip
    trips = Trips(np.zeros(n, int), np.arange(n), np.zeros(n, int), 6)
    return coordinate(point, intents, Draws(np.zeros((n, 0, 2)), helpers, trips))


@pytest.mark.usefixtures("mine")
def test_every_decision_waits_for_a_round_trip_of_its_own_on_top_of_the_models_inference():
    far = decisions(named_point("cloud:round_trip=mine"))
    assert far.latency_s.min() >= 0.155
    assert far.latency_s.max() <= 0.205
    assert far.latency_s.mean() == pytest.approx(0.145 + 0.0275, abs=0.002)
    assert np.array_equal(
        far.latency_s, decisions(named_point("single-local:round_trip=mine")).latency_s
    )
    assert np.all(decisions(CLOUD).latency_s == 0.51)
    assert np.array_equal(far.deadline_missed, far.latency_s > 0.2)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("100 = 60", "90 = 60", "mine.toml: quantiles_ms must go from 0 to 100"),
        ("50 = 20", "50 = 5", "mine.toml: quantiles_ms must go from 0 to 100"),
        ("0 = 10", '"all" = 10', "mine.toml: quantiles_ms must go from 0 to 100"),
        ("100 = 60", "100 = 1e10", r"100 = 1.+; allowed: a number from 0 to 3.6e\+06"),
        ("0 = 10", "0 = -10", r"0 = -10; allowed: a number from 0 to 3.6e\+06"),
    ],
)
def test_quantiles_that_are_none_are_refused(mine: Path, old: str, new: str, said: str):
    mine.write_text(MINE.replace(old, new))
    with pytest.raises(UserError, match=said):
        named_point("cloud:round_trip=mine")


def test_the_papers_study_has_no_layouts_to_draw_by():
    point = named_point("single-local:round_trip=us-drive").changed(profile=None)
    one = np.zeros((1, 0))
    intents = Intents(
        np.full((1, 2), 0.5),
        np.zeros((1, 0, 2)),
        one > 0,
        np.ones((1, 1)),
        one,
        one,
        np.ones((1, 1)),
    )
    with pytest.raises(UserError, match="round_trip needs layouts, and the paper's study has none"):
        coordinate(point, intents, Draws(np.zeros((1, 0, 2)), one))


@pytest.mark.slow
def test_a_run_records_its_network_and_a_sweep_refuses_another(
    harness: Callable[..., Said], mine: Path, small: Dataset, tmp_path: Path
) -> None:
    points = tuple(map(named_point, ("cloud:round_trip=mine", "6g:round_trip=mine")))
    run = evaluate(spec_of(small, points=points), tmp_path / "run").out
    decisions = pd.read_parquet(run / "decisions.parquet")
    quiet = decisions[~decisions.triggered].pivot_table(
        index=["scene", "seed"], columns="condition", values="latency_ms", observed=True
    )
    both = quiet.dropna()
    assert len(both)
    assert (both.iloc[:, 0] == both.iloc[:, 1]).all(), "paired"
    sweep = (
        "study",
        "sweep",
        run,
        "--over",
        "window",
        "--grid",
        "200",
        "--condition",
        "6g:round_trip=mine",
    )
    assert harness(*sweep)[0] == 0
    mine.write_text(MINE.replace("60", "70"))
    code, _, err = harness(*sweep)
    assert code == 2
    assert "network mine has changed since; restore it or run again" in err
