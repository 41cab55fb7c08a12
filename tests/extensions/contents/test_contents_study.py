"""Intents, objects, both or nothing, at every point of a study."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from evaluating import run, spec_of

from harness.coordination.named_points import named_point
from harness.core.statistics import mean_of, paired_difference
from harness.dataset.load import Dataset
from harness.extensions.contents.study import NOTHING, Outcome, holding, witnesses
from harness.report.suite import MEAN
from harness.runs.estimates import over_episodes
from harness.runs.folder import read
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.success import Success
from harness.studies.replayed_run import ReplayedRun

pytestmark = pytest.mark.usefixtures("svg_alone")
Said = tuple[int, str, str]
VARIED = ("--condition", "6g", "--over", "loss", "--grid", "0,1")


@pytest.fixture(scope="module")
def done(proxy_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, since the study keeps answers in the run's folder."""
    return shutil.copytree(proxy_run, tmp_path_factory.mktemp("contents") / "run")


@pytest.fixture(scope="module")
def played(done: Path, tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    from harness.core.progress import Progress
    from harness.extensions.contents.page import contents_study
    from harness.extensions.contents.study import models, panels_of, run_contents

    source = ReplayedRun(done)
    panels = panels_of([source], ["6g"], ["loss", "size"], ["0,1", "1,4"])
    out = tmp_path_factory.mktemp("study")
    results = run_contents(models([[source]], panels), panels, source.seeds, out, Progress())
    return contents_study(results, source.seeds).data["points"]


def cell(
    points: pd.DataFrame, content: str, column: str, value: float | None = None, axis: str = "loss"
) -> float:
    at = (
        points.variable == ""
        if value is None
        else (points.variable == axis) & (points.value == value)
    )
    return float(points[(points.content == content) & at][column].item())


@pytest.mark.exhaustive
def test_each_content_is_what_a_run_of_it_comes_to(
    played: pd.DataFrame, small: Dataset, done: Path, tmp_path: Path
) -> None:
    contents = ("objects", "both", "oracle")
    points = tuple(named_point(f"6g:content={content}") for content in contents)
    directly = read(run(spec_of(small, points=points), tmp_path / "run").out)
    for content, point in zip(contents, points, strict=True):
        score = directly.score(point.name, SUCCESS)
        assert score is not None
        assert cell(played, content, "success") == score.value
        assert cell(played, content, "success_low") == score.low
    own = read(done)
    for content, condition in (("intent", "6g"), (NOTHING, "single-local")):
        for column, metric in (("success", SUCCESS), ("latency_proxy_ms", "latency_proxy_ms"),
                               ("bits_per_episode", "bits_per_episode")):  # fmt: skip
            score = own.score(condition, metric)
            assert score is not None
            assert cell(played, content, column) == pytest.approx(score.value)


@pytest.mark.exhaustive
def test_where_nothing_arrives_every_content_is_worth_nothing(played: pd.DataFrame) -> None:
    contents = played.content.unique()
    alone = cell(played, NOTHING, "success")
    assert {cell(played, content, "success", 1) for content in contents} == {alone}
    assert {cell(played, content, "success", 1, "size") for content in contents} == {alone}
    assert {cell(played, content, "bits_per_episode", 1, "size") for content in contents} == {0}
    for content in contents:
        assert cell(played, content, "success", 4, "size") == cell(played, content, "success")
    assert cell(played, NOTHING, "bits_per_episode") == 0
    assert all(
        cell(played, content, "bits_per_episode", 1) > 0
        for content in contents
        if content != NOTHING
    )
    # nobody is heard, so it is not asked again
    assert cell(played, "objects", "off_lag_rate", 1) == 0
    assert (
        cell(played, "objects", "off_lag_rate", 0)
        == cell(played, "objects", "deadline_miss_rate", 0)
        > 0.5
    )
    assert cell(played, "objects", "over_intent", 1) == 0


def test_a_mean_gives_families_the_same_weight_and_differences_are_paired_within_them() -> None:
    draws = np.random.default_rng(0)
    a, b = (
        {
            name: (draws.random((2, n)) < share).astype(float)
            for name, n in (("one", 30), ("two", 90))
        }
        for share in (0.9, 0.4)
    )
    plain = {name: Success(np.zeros(values.shape[1], bool)) for name, values in a.items()}
    better, worse = (
        Outcome({name: {SUCCESS: of} for name, of in each.items()}, plain) for each in (a, b)
    )
    each = [over_episodes(SUCCESS, values) for values in a.values()]
    assert better.estimate(SUCCESS) == mean_of(each)
    assert better.estimate(SUCCESS, "two") == each[1]
    gains = paired_difference([(a[name] - b[name]).mean(axis=0) for name in a])
    assert better.over(worse) == better.over(worse, MEAN) == gains
    p = better.p_over(worse)
    assert p is not None
    assert p < 1e-6
    dangerous = {"one": np.arange(30) < 10, "two": np.arange(90) < 10}
    balanced = Outcome(better.families, {name: Success(of) for name, of in dangerous.items()})
    parts = [
        over_episodes(SUCCESS, v[:, half])
        for n, v in a.items()
        for half in (dangerous[n], ~dangerous[n])
    ]
    assert (balanced.headline_metric, balanced.success) == (
        BALANCED,
        mean_of([mean_of(parts[:2]), mean_of(parts[2:])]),
    )
    of_two = (a["two"] - b["two"]).mean(axis=0)
    gains = paired_difference([of_two[dangerous["two"]], of_two[~dangerous["two"]]])
    assert balanced.over(worse, "two") == gains
    assert balanced.over(worse, metric=SUCCESS) == better.over(worse)
    group = {"one": np.arange(30) < 2, "two": np.arange(90) < 3}
    assert better.pooled(group).shape == (2, 5)
    assert better.pooled_clusters(group) is None
    rules = {
        name: replace(rule, names=[f"street {place % 4}" for place in range(len(rule.dangerous))])
        for name, rule in plain.items()
    }
    clustered = Outcome(better.families, rules)
    assert clustered.pooled_clusters(group).tolist() == [0, 1, 0, 1, 2]
    assert clustered.estimate(SUCCESS) == mean_of(each, together=True)


def test_witnesses_are_the_helpers_that_list_the_danger(done: Path) -> None:
    source = ReplayedRun(done)
    forest = source.dataset.forest
    counts = witnesses(source)
    assert ((counts == -1) == [danger is None for danger in forest.dangers]).all()
    [scene] = source.dataset.scenes([forest.ids[forest.root[int(np.argmax(counts))]]])
    danger = scene.record.danger.vehicle
    lists = [
        danger in [node.id for node in scene.graphs[viewer].nodes] for viewer in scene.viewers[1:]
    ]
    assert counts.max() == sum(lists) > 0


def test_who_holds_nothing_asks_nobody() -> None:
    for text in ("6g", "6g:schedule=margin,threshold=0.2", "mode2:encoding=etsi"):
        assert not holding(named_point(text), NOTHING).asks
    assert holding(named_point("6g"), "both") == named_point("6g").changed(content="both")


@pytest.mark.slow
def test_no_more_is_asked_than_a_dry_run_counts(
    harness: Callable[..., Said], proxy_run: Path
) -> None:
    here = shutil.copytree(proxy_run, Path("run"))
    code, out, err = harness("study", "contents", here, *VARIED, "--dry-run", "--json")
    assert (code, err) == (0, "")
    [by_family] = json.loads(out).values()
    most = by_family["occluded-intersection"]
    _, out, _ = harness("study", "contents", here, *VARIED)
    assert out.startswith(
        "Intent or objects?\nproxy · v2 · json, 6g, points of balanced success over intents: "
    )
    page = (here / "contents" / "index.html").read_text()
    for text in (
        "at the bits of intents",
        "at the age of intents",
        "by who sees the danger",
        "6g over loss",
    ):
        assert text in page
    asked = (here / "more-answers.jsonl").read_text().splitlines()
    assert 0 < len(asked) <= sum(most.values())
