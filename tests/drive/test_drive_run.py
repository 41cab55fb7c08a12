"""A live run's folder: its files, the same for any workers and batch, and after a kill."""

import csv
import json
import os

import pandas as pd
import pytest
from driving import spec
from evaluating import FILES
from killed_run import PLACES, at, killed_at
from tiers import some

from harness.backends.driver import DriverBackend
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.core.work import tidy
from harness.evaluate import live_world
from harness.evaluate.live_world import LiveWorld
from harness.evaluate.run import evaluate
from harness.runs.formats import FORMAT


def folder_of(of, out, workers=1, done=None):
    evaluate(of, out, [].append if done is None else done.append, workers=workers)
    tidy(out)
    return {name: (out / name).read_bytes() for name in FILES}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    done = []
    folder_of(spec(episodes=10), out, done=done)
    assert sum(done) == 10
    return out


def test_a_run_holds_what_was_driven_and_enough_to_drive_it_again(whole):
    assert {p.name for p in whole.iterdir()} == {*FILES, "run.json", "run.toml", "sources"}
    manifest = json.loads((whole / "run.json").read_text())
    assert manifest["format"] == FORMAT
    assert (manifest["latency"]["ego_s"], manifest["latency"]["helper_s"]) == (0.145, 0.145)
    assert "--episodes 10 --first-seed 0 --seeds 0,1" in manifest["command"]
    assert manifest["world"]["scenario"]["parameters"]["simulation_hz"] == 50
    with (whole / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10 * 3 * 2
    places = [(int(r["episode"]), r["condition"], int(r["seed"])) for r in rows]
    assert places == [
        (e, c, s) for c in ("single-local", "v2x", "6g") for s in (0, 1) for e in range(10)
    ]
    assert {r["partner"] != "" for r in rows if r["failure"] == "collision"} == {True}


def test_a_summary_agrees_with_its_episodes(whole):
    episodes, summary = pd.read_csv(whole / "episodes.csv"), pd.read_csv(whole / "summary.csv")
    for condition, mine in episodes.groupby("condition"):
        figures = summary[(summary.condition == condition) & (summary.interval == "episodes")]
        value = figures.set_index("metric").value
        assert value["success_rate"] == pytest.approx(mine.success.mean())
        assert value["collision_rate"] == pytest.approx((mine.failure == "collision").mean())
        ends = ("success_rate", "collision_rate", "late_rate", "time_out_rate", "off_road_rate")
        assert sum(value[end] for end in ends) == pytest.approx(1.0)
        assert value["unsafe_rate"] == pytest.approx(
            1.0 - value["success_rate"] - value["late_rate"]
        )
        assert value["messages_per_episode"] == pytest.approx(mine.messages.mean())
        assert value["hard_brakings_per_episode"] == pytest.approx(mine.hard_brakings.mean())
    assert summary[summary.condition == "all"].metric.tolist()[:2] == [
        "strict_rate_ego",
        "recovered_rate_ego",
    ]


def few(**options):
    """Four episodes under one condition."""
    return spec(points=(POINTS["6g"],), seeds=(0,), episodes=4, **options)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    return folder_of(few(), tmp_path_factory.mktemp("four") / "run")


@pytest.mark.parametrize(
    ("workers", "batch_size"), some([(2, 3)], exhaustive=[(1, 1), (2, 8), (1, 100)])
)
def test_workers_and_batches_change_no_byte(four, tmp_path, monkeypatch, workers, batch_size):
    # so that both workers have some
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 2)
    assert folder_of(few(batch_size=batch_size), tmp_path / "run", workers) == four


@pytest.fixture(scope="module")
def whole_of_killed(tmp_path_factory):
    return folder_of(cruise(), tmp_path_factory.mktemp("whole-of-killed") / "run")


def cruise(seed=0):
    return spec("cruise", seeds=(seed,), episodes=3, batch_size=4)


NOT_BEGUN = ("before anything", "before it keeps its settings", "while the work is cleared away")
# Where a closed loop does something of its own; at the others it is as a frozen run.
ITS_OWN = ("between two parts",)


@pytest.mark.parametrize(
    "place",
    [
        pytest.param(place, marks=pytest.mark.slow if place in ITS_OWN else pytest.mark.exhaustive)
        for place in PLACES
    ],
)
def test_killed_at_one_place_of_each_kind_and_resumed_it_is_the_same_run(
    whole_of_killed, tmp_path, monkeypatch, place
):
    """Of a run in three parts. A frozen run is killed everywhere: tests/test_run_killed.py."""
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)
    change, end = PLACES[place]
    out = tmp_path / "run"
    killed_at(cruise(), out, at(change, end))
    begun = (out / ".work" / "config.json").is_file() and not (out / "run.json").is_file()
    assert begun == (place not in NOT_BEGUN)
    if begun:
        with pytest.raises(UserError, match=r"begun with --seeds .*, and not with --seeds"):
            evaluate(cruise(seed=1), out, lambda done: None)
    assert folder_of(cruise(), out) == whole_of_killed
    assert {p.name for p in out.iterdir()} == {*FILES, "run.json", "run.toml", "sources"}


@pytest.mark.exhaustive
def test_a_chunk_that_kills_its_worker_is_named_and_the_same_command_goes_on(
    harness, tmp_path, monkeypatch
):
    """A worker is forked with the world in which it dies."""

    class Deadly(LiveWorld):
        def __init__(self, scenario, first_seed, numbers, *others):
            if 3 in numbers:
                os._exit(9)
            super().__init__(scenario, first_seed, numbers, *others)

    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 2)
    alone = ("--condition", "single-local")
    line = (
        "drive",
        "--model",
        "cruise",
        "--episodes",
        "5",
        "--seeds",
        "0",
        *alone,
        "--quiet",
        "--out",
        "run",
    )
    with monkeypatch.context() as patched:
        patched.setattr(live_world, "LiveWorld", Deadly)
        code, out, said = harness(*line)
    assert (code, out) == (2, "")
    assert said == (
        "harness: episodes 2 to 3: the worker was killed 3 times, perhaps because memory ran out; "
        "try fewer --workers; the other 2 are done; run keeps what is done; type the same command "
        f"to continue: harness {' '.join(line)}\n"
    )
    kept = {part.name for part in (tmp_path / "run/.work").glob("episodes-*")}
    assert kept == {"episodes-000000-000001", "episodes-000004-000004"}
    assert harness(*line) == (0, "", "")
    assert harness(*line[:-1], "whole", "--workers", "1") == (0, "", "")
    assert all(
        (tmp_path / "run" / n).read_bytes() == (tmp_path / "whole" / n).read_bytes() for n in FILES
    )


def test_a_worker_that_opens_another_model_is_told_so(tmp_path, monkeypatch):
    monkeypatch.setattr(DriverBackend, "identity", lambda self: {"opened": os.urandom(4).hex()})
    with pytest.raises(
        UserError, match=r"a worker opens another model behind cruise .*; give it the same"
    ):
        evaluate(spec("cruise", seeds=(0,), episodes=1), tmp_path / "run", lambda done: None)


def test_a_finished_run_is_not_driven_over(whole):
    with pytest.raises(UserError, match="already holds a finished run"):
        evaluate(spec(episodes=10), whole, lambda done: None)
    (whole / ".work").mkdir()  # killed while it tidied up
    again = evaluate(spec(episodes=10), whole, lambda done: pytest.fail("driven again"))
    assert again.manifest.world.episodes == 10


def test_a_model_that_is_not_there_leaves_nothing_behind(tmp_path):
    with pytest.raises(UserError, match="no such"):
        evaluate(spec("replay:/nowhere"), tmp_path / "run", lambda done: None)
    assert list(tmp_path.iterdir()) == []
