"""A run's stored answers at other operating points."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from evaluating import figure, run, spec_of

from harness.coordination.named_points import POINTS, named_point
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.lifecycle import Evaluated
from harness.runs.folder import read
from harness.studies import replayed_run
from harness.studies.axes import AXES, Setting, axis_of, grid
from harness.studies.replayed_run import ReplayedRun, name_apart
from harness.studies.study import Study, write_study
from harness.studies.sweep import run_sweep, settings


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    return run(spec_of(small), tmp_path_factory.mktemp("sweep") / "run")


@pytest.fixture(scope="module")
def source(done: Evaluated) -> ReplayedRun:
    return ReplayedRun(done.out)


def study_of(source: ReplayedRun, out: Path, name: str, text: str | None = None) -> Study:
    axis = axis_of(name)
    points = settings([source], [axis], [grid(axis, text)], ["6g"])
    return run_sweep([source], {name: points}, source.seeds, out, lambda n: None)


def swept(source: ReplayedRun, out: Path, name: str, text: str | None = None) -> pd.DataFrame:
    return study_of(source, out, name, text).data["conditions"]


def value(summary: pd.DataFrame, at: Any, metric: str) -> float:
    rows = summary[
        (summary.value == at) & (summary.metric == metric) & (summary.interval == "episodes")
    ]
    return float(rows["mean"].item())


@pytest.mark.slow
def test_runs_of_one_name_are_named_by_their_folders_as_well(
    done: Evaluated, tmp_path: Path
) -> None:
    """What is of one name is one source in a study's tables, and a folder is given once."""
    copies = [shutil.copytree(done.out, tmp_path / name / "run") for name in "abc"]
    runs = [ReplayedRun(folder) for folder in copies]
    runs[2].run.manifest.model["name"] = "another"
    runs[2].name = str(runs[2].run.manifest.variant)
    name_apart(runs)
    plain = str(read(done.out).manifest.variant)
    assert [run.name for run in runs] == [
        f"{plain} · run (1)",
        f"{plain} · run (2)",
        plain.replace("proxy", "another"),
    ]
    with pytest.raises(UserError, match=r"c/run is given twice; give each run once"):
        name_apart([*runs, ReplayedRun(tmp_path / "a/../c/run")])


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("more-answers.jsonl", "it is no file, so nothing is appended to it; fix that"),
        (".more-answers.jsonl.lock", "it is no file, but a pipe or a device; fix that"),
        ("sweep-tau/index.html", "it is no file, but a pipe or a device, and is not replaced"),
    ],
)
def test_a_pipe_where_a_study_writes_in_a_run_is_one_line(
    name: str, says: str, done: Evaluated, harness: Callable[..., Any], tmp_path: Path
) -> None:
    pipe = shutil.copytree(done.out, tmp_path / "run") / name
    pipe.parent.mkdir(exist_ok=True)
    os.mkfifo(pipe)
    typed = ("study", "sweep", "run", "--over", "tau", "--grid", "0.1", "--condition", "6g")
    code, _, said = harness(*typed, "--quiet")
    assert (code, said.count("\n")) == (2, 1)
    assert f"run/{name}: {says}" in said
    assert pipe.is_fifo()


@pytest.mark.slow
def test_intents_are_laid_out_again_once_a_helper_was_asked(
    done: Evaluated, tmp_path: Path
) -> None:
    """What is kept of scenes is what is laid out of all answers anew, in any order."""
    shutil.copytree(done.out, tmp_path / "run")
    source = ReplayedRun(tmp_path / "run")
    scenes = source.dataset.scenes(source.dataset.forest.ids[:9])
    before = source.intents(scenes, lambda at: None)
    assert before.unasked is not None
    wanted = before.unasked & (np.arange(len(scenes)) % 2 > 0)[:, None]
    source.helpers(scenes, wanted)
    kept = source.intents(scenes[::-1], lambda at: None)
    anew = source(scenes[::-1])
    assert not np.array_equal(kept.helpers[::-1], before.helpers, equal_nan=True)
    assert kept.arrays().keys() == anew.arrays().keys()
    for name, values in anew.arrays().items():
        np.testing.assert_array_equal(kept.arrays()[name], values, err_msg=name)


@pytest.mark.slow
def test_at_the_runs_own_point_a_sweep_says_what_the_run_said(
    done: Evaluated, source: ReplayedRun, tmp_path: Path
) -> None:
    summary = swept(source, tmp_path, "tau", "0.7")
    for metric in ("success_rate", "trigger_rate", "latency_proxy_ms", "messages_per_episode"):
        assert value(summary, 0.7, metric) == pytest.approx(figure(done, "6g", metric).value)


@pytest.mark.slow
def test_without_others_or_trigger_a_vehicle_is_alone(
    done: Evaluated, source: ReplayedRun, tmp_path: Path
) -> None:
    alone = figure(done, "single-local", "success_rate").value
    assert value(swept(source, tmp_path / "a", "size", "1"), 1, "success_rate") == pytest.approx(
        alone
    )
    assert value(swept(source, tmp_path / "b", "tau", "1.2"), 1.2, "success_rate") == pytest.approx(
        alone
    )
    assert value(swept(source, tmp_path / "c", "loss", "1"), 1, "success_rate") == pytest.approx(
        alone
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "swept_axes", [("consensus",), pytest.param(tuple(AXES), marks=pytest.mark.exhaustive)]
)
def test_every_axis_gives_its_panels(
    source: ReplayedRun, swept_axes: tuple[str, ...], tmp_path: Path
) -> None:
    panels = {name: settings([source], [axis_of(name)], [None], ["6g"]) for name in swept_axes}
    study = run_sweep([source], panels, source.seeds, tmp_path, lambda n: None)
    write_study(study, tmp_path)
    assert set(study.data["conditions"].panel) == set(swept_axes)
    names = {f"{table}.{kind}" for table in ("conditions", "episodes") for kind in ("csv", "jsonl")}
    names |= {"index.html", *(f"sweep.{kind}" for kind in ("json", "svg", "pdf", "png"))}
    assert {p.name for p in tmp_path.iterdir()} == names
    assert (
        json.loads((tmp_path / "sweep.json").read_text())["panels"]["consensus"][0]["value"]
        == "linear"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("svg_alone")
def test_axes_that_are_crossed_give_every_combination_what_it_has_alone(
    source: ReplayedRun, tmp_path: Path
) -> None:
    axes, grids = (
        [axis_of("attack"), AXES["consensus"]],
        [("none", "liar+spoof"), ("linear", "median")],
    )
    points = {"attack × consensus": settings([source], axes, grids, ["6g"])}
    study = run_sweep([source], points, source.seeds, tmp_path, lambda n: None)
    page = write_study(study, tmp_path).read_text()
    assert "% at attack × consensus liar+spoof × linear" in page
    assert (tmp_path / "sweep.svg").is_file()
    rows = study.data["conditions"]
    assert list(rows.value.unique()) == [f"{a} × {rule}" for a in grids[0] for rule in grids[1]]
    attacked = rows[(rows.attack == "liar+spoof") & (rows.consensus == "median")]
    alone = settings([source], axes[1:], grids[1:], ["6g:attack=liar+spoof"])
    apart = run_sweep(
        [source], {"consensus": alone}, source.seeds, tmp_path / "apart", lambda n: None
    )
    expected = apart.data["conditions"]
    expected = expected[expected.value == "median"]
    assert attacked["mean"].tolist() == expected["mean"].tolist()
    assert attacked.metric.tolist() == expected.metric.tolist()


TOGETHER = (
    "6g", "6g:tau_nats=0.3", "6g:loss=0.4", "6g:loss=0.4", "v2x", "6g:on_demand=true,helper_rounds=true",
    "mode2", "its-g5:edge=fusion", "6g:messages=shuffled", "6g:messages=blind", "6g:consensus=trust",
    "6g:attack=liar+spoof:share=1/3", "6g:attack=replay", "mode4:schedule=deadline",
    "6g:schedule=coverage", "single-local",
)  # fmt: skip


OF_EACH_KIND = (
    "6g", "6g:loss=0.4", "6g:loss=0.4", "v2x", "6g:on_demand=true,helper_rounds=true", "6g:messages=blind",
    "6g:consensus=trust", "6g:attack=liar+spoof:share=1/3", "single-local",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "texts",
    [OF_EACH_KIND, pytest.param(TOGETHER, marks=pytest.mark.exhaustive)],
    ids=["some", "all"],
)
@pytest.mark.parametrize("asks", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
def test_points_that_are_walked_together_are_each_as_alone(
    small: Dataset, asks: bool, texts: tuple[str, ...], tmp_path: Path
) -> None:
    """The run came to few decision points: at others its model is asked, or walks are left out."""
    ask = "used" if asks else "all"
    few = run(spec_of(small, points=(POINTS["single-local"],), ask=ask), tmp_path / "few").out
    names = [name for name in texts if asks or "blind" not in name]
    fewer = names if texts is TOGETHER else names[:2]
    points = [
        Setting(name, named_point(name), vehicles)
        for vehicles, of in ((4, names), (2, fewer))
        for name in of
    ]
    source = ReplayedRun(few, asks=asks)
    together = list(source.walked(points, (0, 1, 5)))
    assert bool(source.left_out) != asks
    for setting, [walked] in zip(points, together, strict=True):
        alone = ReplayedRun(
            Path(shutil.copytree(few, tmp_path / "copy", dirs_exist_ok=True)), asks=asks
        )
        [[expected]] = alone.walked([setting], (0, 1, 5))
        assert alone.left_out <= source.left_out
        for name, values in expected.ends.items():
            assert np.array_equal(walked.ends[name], values, equal_nan=True), (setting, name)
        for name, values in expected.columns.items():
            assert np.array_equal(walked.columns[name], values, equal_nan=True), (setting, name)
        assert np.array_equal(walked.places, expected.places)


@pytest.mark.slow
def test_a_helper_beyond_the_size_intends_nothing_whatever_is_stored(
    done: Evaluated, tmp_path: Path
) -> None:
    """Else an attacker that repeats what it intended remembers it from when it was far."""
    source = ReplayedRun(Path(shutil.copytree(done.out, tmp_path / "run")))
    scenes = source.dataset.scenes(source.dataset.forest.ids[:9])
    source.whole(scenes)
    intents = replayed_run._Nearest(source, 1, lambda at: None)(scenes)
    is_near = np.isfinite(intents.range_m)
    assert (is_near.sum(axis=1) == 1).all()
    assert np.isnan(intents.helpers[~is_near]).all()
    assert np.isfinite(intents.helpers[is_near]).all()


def test_a_size_below_the_runs_is_refused_where_all_vehicles_would_still_be_heard(
    source: ReplayedRun,
) -> None:
    said = "with 1 of 4 vehicles, those that are left out would still be heard"
    for condition in ("6g:stream=cpm", "6g:messages=shuffled"):
        with pytest.raises(UserError, match=f"--condition {condition}: {said}"):
            settings([source], [AXES["size"]], [None], [condition])
        assert settings([source], [AXES["tau"]], [(0.5,)], [condition])


def test_a_condition_in_two_spellings_is_swept_once(source: ReplayedRun) -> None:
    names = ["6g:max_helpers=1", "6g", "6g:tau=0.70", "6g:max_helpers=1,tau_nats=0.7"]
    points = settings([source], [AXES["loss"]], [(0.1, 0.2)], names)
    assert [point.condition for point in points] == [name for name in names[:2] for _ in range(2)]


@pytest.mark.exhaustive
def test_many_points_are_walked_in_parts(
    source: ReplayedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = swept(source, tmp_path / "whole", "tau")
    monkeypatch.setattr(replayed_run, "WALKS", 5 * 8)  # of four episodes with two seeds
    assert swept(source, tmp_path / "parts", "tau").equals(whole)


@pytest.mark.slow
def test_a_points_success_is_said_before_later_ones_are_walked(
    source: ReplayedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = list[str]()
    walked = ReplayedRun._walked

    def noted(self: ReplayedRun, points: Any, *rest: Any) -> Any:
        events.append(f"{len(points)} walked")
        yield from walked(self, points, *rest)

    monkeypatch.setattr(ReplayedRun, "_walked", noted)
    monkeypatch.setattr(replayed_run, "WALKS", 5 * 8)  # of four episodes with two seeds
    points = settings([source], [AXES["loss"]], [(0.0, 0.25, 0.5)], ["6g"])
    study = run_sweep(
        [source], {"loss": points}, source.seeds, tmp_path, lambda n: None, events.append
    )
    [table] = study.tables
    rows = [f"  {place}  {success}" for place, success, *_ in table.rows]
    title = f"{table.title}: {table.heads[1]}"
    assert events == ["1 walked", title, rows[0], "2 walked", *rows[1:]]


@pytest.mark.slow
def test_runs_are_paired(source: ReplayedRun, small: Dataset, tmp_path: Path) -> None:
    """The same answers under another prompt's name see the same luck."""
    other = ReplayedRun(run(spec_of(small, prompt="v1"), tmp_path / "v1").out)
    axis = AXES["loss"]
    points = settings([source, other], [axis], [(0.0, 0.5)], ["6g"])
    study = run_sweep([source, other], {"loss": points}, (0, 1), tmp_path / "out", lambda n: None)
    made = study.data["conditions"]
    assert len(set(made.source)) == 2
    assert not made[made.metric == "success_rate"]["mean"].isna().any()


@pytest.mark.parametrize(
    ("axis", "values", "condition", "said"),
    [
        ("tau", (0.7,), "5g", "unknown operating point"),
        ("tau", (0.7,), "single-local", "has no channel"),
        ("size", (9,), "6g", "9 vehicles; the run's scenes have"),
        ("attack", None, "6g:content=oracle", "allows none of its usual values"),
    ],
)
def test_what_cannot_be_is_one_line(
    source: ReplayedRun, axis: str, values: tuple[float, ...] | None, condition: str, said: str
) -> None:
    with pytest.raises(UserError, match=said):
        settings([source], [axis_of(axis)], [values], [condition])


@pytest.mark.parametrize(
    ("condition", "name", "values"),
    [
        ("6g", "edge_delay_s", (0.0, 0.1)),
        ("mode4", "edge_x_m", (0.0, 50.0)),
        ("mode4", "helper_rounds", ("false", "true")),
        ("v2x:schedule=margin", "tau", (0.1, 0.9)),
        ("v2x:schedule=never", "loss", (0.0, 0.9)),
        ("v2x:max_helpers=0", "consensus", ("linear", "median")),
        ("v2x:consensus=bayes", "weight_cap", (0.1, 1.0)),
        ("v2x:consensus=geometric-median", "min_distance_m", (1.0, 1000.0)),
        ("6g:content=objects", "consensus", ("linear", "trust")),
        ("6g:content=objects", "ego_distance_m", (3.5, 300.0)),
        ("v2x:content=objects,latency_s=0.01", "on_demand", ("false", "true")),
        ("v2x:content=objects", "helper_rounds", ("false", "true")),
    ],
)
def test_a_setting_that_is_refused_as_idle_changes_nothing(
    condition: str, name: str, values: tuple[Any, ...], source: ReplayedRun
) -> None:
    axis, point = axis_of(name), named_point(condition)
    assert point.idle(axis.field)
    with pytest.raises(UserError, match=f"--over {name}: it changes nothing in {condition}: "):
        settings([source], [axis], [values], [condition])
    both = [
        Setting(condition, axis.at(point, value), source.vehicles, name, value) for value in values
    ]
    [one], [two] = source.walked(both, source.seeds)
    assert np.isfinite(one.ends["success_rate"]).all()
    for of_one, of_two in ((one.ends, two.ends), (one.columns, two.columns)):
        for metric, values_of_one in of_one.items():
            np.testing.assert_array_equal(values_of_one, of_two[metric])


def test_a_setting_that_one_value_frees_is_drawn(source: ReplayedRun) -> None:
    axis = axis_of("schedule")
    assert len(settings([source], [axis], [("never", "entropy")], ["6g:schedule=never"])) == 2
