"""Success by the number of witnesses, in rows and summary."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from evaluating import run, spec_of
from former import NAME
from msgspec import structs

from harness.cli.run import BY_WITNESSES, by_witnesses
from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset
from harness.evaluate.live_world import LiveSource
from harness.runs.folder import Run, read
from harness.runs.headline import PAIRED
from harness.runs.metric_names import GAIN
from harness.runs.records import Score

NAMES = [f"success_rate_{k}_witness{'' if k == 1 else 'es'}" for k in range(4)]


def driven(small: Dataset, out: Path, scenario: str, *points: str, episodes: int = 8) -> Run:
    spec = spec_of(small, "proxy", points=tuple(POINTS[name] for name in points), seeds=(0,))
    return read(run(replace(spec, source=LiveSource(0, episodes, scenario)), out).out)


EACH = "occluded-intersection:witnesses=each,radio_share=0.5"


@pytest.fixture(scope="module")
def done(small: Dataset, once: Callable[..., Path]) -> Run:
    """Twenty-four layouts: six with each number of witnesses."""
    return read(
        once("witnesses", lambda out: driven(small, out, EACH, "single-local", episodes=24))
    )


@pytest.mark.exhaustive
def test_rows_have_witnesses_and_the_dangers_radio(done: Run) -> None:
    assert [e.witnesses for e in done.episodes] == [0, 1, 2, 3] * 6
    assert [e.danger_radio is None for e in done.episodes] == [
        e.danger == "none" for e in done.episodes
    ]
    scenario = LiveSource(0, 1, EACH).scenario
    for e in done.episodes:
        made = scenario.layout(e.layout_seed, scenario.parameters)
        assert e.danger_radio == next(
            (s.radio for s in made.spawns if s.id == made.danger_id), None
        )
    for k, metric in enumerate(NAMES):
        own = [e.success for e in done.episodes if e.witnesses == k]
        score = done.score("single-local", metric)
        assert score is not None
        assert (score.value, score.n, score.n_excluded) == (sum(own) / 6, 6, 18)


@pytest.mark.exhaustive
def test_dangers_stand_by_who_can_tell_of_them_beside_the_harmless_layouts(
    done: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    dangers = [e for e in done.episodes if e.danger != "none"]
    groups = {
        f"seen by {k}": [e for e in dangers if e.witnesses == k and not e.danger_radio]
        for k in range(4)
    }
    groups["with a radio"] = [e for e in dangers if e.danger_radio]
    assert sum(map(len, groups.values())) == len(dangers) < 24
    for group, own in groups.items():
        score = done.score("single-local", BY_WITNESSES[group])
        assert score is not None
        assert (score.value, score.n) == (sum(e.success for e in own) / len(own), len(own))
    by_witnesses({(s.condition, s.metric): s for s in done.scores}, ["single-local"])
    lines = capsys.readouterr().out.splitlines()
    assert [line[:12].rstrip() for line in lines[2:-2]] == list(BY_WITNESSES)
    assert max(map(len, lines)) <= 80


def test_the_table_of_three_conditions_fits_into_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = ["single-local", "v2x", "6g:content=objects,encoding=etsi", "6g"]
    figures = {
        (name, metric): Score(name, metric, 1.0, 0.956, 1.0, 100, 0, "episodes")
        for name in names for metric in BY_WITNESSES.values()
    }  # fmt: skip
    by_witnesses(figures, names)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines.count("") == 3, "two tables, and the room below"
    assert sum(line.startswith("no danger") for line in lines) == 2


@pytest.mark.slow
def test_where_none_are_declared_nothing_is_said(
    small: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = driven(small, tmp_path / "run", NAME, "single-local", episodes=2)
    assert {(e.witnesses, e.danger_radio) for e in done.episodes} == {(None, None)}
    assert not {*NAMES, *list(BY_WITNESSES.values())[1:]} & {score.metric for score in done.scores}
    by_witnesses({(s.condition, s.metric): s for s in done.scores}, ["single-local"])
    assert capsys.readouterr().out == ""


@pytest.mark.exhaustive
def test_without_a_witness_messages_make_up_no_gain(small: Dataset, tmp_path: Path) -> None:
    done = driven(
        small,
        tmp_path / "run",
        "occluded-intersection:witnesses=0",
        "single-local",
        "6g",
        episodes=8,
    )
    [gain] = [s for s in done.scores if (s.metric, s.interval) == (GAIN, PAIRED)]
    assert gain.low is not None
    assert gain.high is not None
    assert gain.low <= 0 <= gain.high


def test_frozen_says_what_driven_says(small: Dataset, tmp_path: Path) -> None:
    parameters = {**small.manifest.parameters, "witnesses": "each"}
    dataset = replace(small, manifest=structs.replace(small.manifest, parameters=parameters))
    done = read(
        run(
            spec_of(dataset, "cruise", points=(POINTS["single-local"],), seeds=(0,)), tmp_path / "r"
        ).out
    )
    assert [e.witnesses for e in done.episodes] == [e.layout_seed % 4 for e in done.episodes]
    for k, metric in enumerate(NAMES):
        [own] = [e.success for e in done.episodes if e.witnesses == k]
        score = done.score("single-local", metric)
        assert score is not None
        assert (score.value, score.n, score.n_excluded) == (own, 1, 3)
