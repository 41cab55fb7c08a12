"""Success by the number of witnesses, in rows and summary."""

from dataclasses import replace
from pathlib import Path

from evaluating import run, spec_of
from msgspec import structs

from harness.coordination.operating_point import POINTS
from harness.dataset.load import Dataset
from harness.evaluate.live_world import LiveSource
from harness.runs.folder import Run, read
from harness.runs.metrics import GAIN

NAMES = [f"success_rate_{k}_witness{'' if k == 1 else 'es'}" for k in range(4)]


def driven(small: Dataset, out: Path, scenario: str, *points: str, episodes: int = 8) -> Run:
    spec = spec_of(small, "proxy", points=tuple(POINTS[name] for name in points), seeds=(0,))
    return read(run(replace(spec, source=LiveSource(0, episodes, scenario)), out).out)


def test_rows_have_witnesses_and_the_dangers_radio(small: Dataset, tmp_path: Path) -> None:
    name = "occluded-intersection:witnesses=each,radio_share=0.5"
    done = driven(small, tmp_path / "run", name, "single-local")
    assert [e.witnesses for e in done.episodes] == [0, 1, 2, 3] * 2
    assert [e.danger_radio is None for e in done.episodes] == [e.danger == "none" for e in done.episodes]
    scenario = LiveSource(0, 1, name).scenario
    for e in done.episodes:
        made = scenario.layout(e.layout_seed, scenario.parameters)
        assert e.danger_radio == next((s.radio for s in made.spawns if s.id == made.danger_id), None)
    for k, metric in enumerate(NAMES):
        own = [e.success for e in done.episodes if e.witnesses == k]
        score = done.score("single-local", metric)
        assert score is not None
        assert (score.value, score.n, score.n_excluded) == (sum(own) / 2, 2, 6)


def test_where_none_are_declared_nothing_is_said(small: Dataset, tmp_path: Path) -> None:
    done = driven(small, tmp_path / "run", "occluded-intersection", "single-local", episodes=2)
    assert {(e.witnesses, e.danger_radio) for e in done.episodes} == {(None, None)}
    assert not {*NAMES} & {score.metric for score in done.scores}


def test_without_a_witness_messages_make_up_no_gain(small: Dataset, tmp_path: Path) -> None:
    done = driven(
        small, tmp_path / "run", "occluded-intersection:witnesses=0", "single-local", "6g", episodes=12
    )
    [gain] = [s for s in done.scores if (s.metric, s.interval) == (GAIN, "episodes")]
    assert gain.low is not None
    assert gain.high is not None
    assert gain.low <= 0 <= gain.high


def test_frozen_says_what_driven_says(small: Dataset, tmp_path: Path) -> None:
    parameters = {**small.manifest.parameters, "witnesses": "each"}
    dataset = replace(small, manifest=structs.replace(small.manifest, parameters=parameters))
    done = read(
        run(spec_of(dataset, "cruise", points=(POINTS["single-local"],), seeds=(0,)), tmp_path / "r").out
    )
    assert [e.witnesses for e in done.episodes] == [e.layout_seed % 4 for e in done.episodes]
