"""What was made before scenes changed is read as what it was,
whatever a scenario's bare name means now.
"""

import shutil
from pathlib import Path

import former
import pytest

from harness.dataset import suites
from harness.dataset.load import find, load
from harness.evaluate import replay
from harness.evaluate.live_world import LiveSource
from harness.runs import folder
from harness.runs.settings import DriveSettings, Settings, read, text_of
from harness.world import scenarios
from harness.world.parameters import SUITES

RECORDS = Path(__file__).parent / "records"
LATER = "witnesses=each,radio_share=0.25,limits=2,perception=2"


def test_an_old_dataset_has_the_scenes_that_it_was_built_of() -> None:
    old, new = (
        load(find(name), 1).scenario for name in (former.DATASET, "occluded-intersection-v3")
    )
    assert old.parameters == former.SCENARIO.parameters
    assert new.parameters == scenarios.get(scenarios.DEFAULT).parameters
    assert scenarios.get(scenarios.argument(old)).parameters == old.parameters


@pytest.mark.slow
@pytest.mark.parametrize(
    "commit", [path.name for path in RECORDS.glob("*") if (path / "drive").is_dir()]
)
def test_an_old_driven_run_is_replayed_in_its_own_scenes(commit: str) -> None:
    """Its record lacks the parameters that came later.
    A scene's name is the digest of what is in it.
    """
    run = folder.read(RECORDS / commit / "drive")
    played = replay.played(run, 0, run.conditions[-1], run.manifest.seeds[0])
    assert played.scenario.parameters == former.SCENARIO.parameters
    name = max(run.decisions.scenes)
    assert replay.scenes_of(run, [name])[0].id == name


@pytest.mark.parametrize("suite", SUITES)
def test_a_title_says_whose_scenes_a_scenario_has(suite: str) -> None:
    named = suites.named(f"suite:{suite}")
    assert named is not None
    for dataset in named.datasets:
        scenario = load(find(dataset), 1).scenario
        assert scenarios.title(scenario) == f"{scenario.name}, scenes of {suite}"
        foggy = scenarios.get(f"{scenarios.argument(scenario)},ambient=fog")
        assert scenarios.title(foggy) == f"{scenario.name}:ambient=fog, scenes of {suite}"
    other = scenarios.get(f"{former.NAME},witnesses=0")
    assert scenarios.title(other) == scenarios.argument(other)


def test_an_argument_states_the_scenes_even_where_they_are_the_usual_ones() -> None:
    usual = scenarios.argument(scenarios.get(scenarios.DEFAULT))
    assert usual == f"{scenarios.DEFAULT}:limits=2,perception=2,witnesses=each,radio_share=0.25"
    assert LiveSource(0, 1).settings().scenario == usual
    assert scenarios.argument(scenarios.get("env:merge-v0")) == "env:merge-v0"


@pytest.mark.parametrize(
    ("typed", "scenario"),
    [
        ("occluded-intersection", former.NAME),
        ("occluded-intersection:witnesses=0", f"{former.NAME},witnesses=0"),
        (f"occluded-intersection:{LATER}", f"occluded-intersection:{LATER}"),
        ("blind-merge", "blind-merge"),
    ],
)
def test_an_old_runs_settings_drive_its_own_scenes(
    tmp_path: Path, typed: str, scenario: str
) -> None:
    """The first runs with a run.toml named a scenario as it was typed."""
    shutil.copy(RECORDS / "0103f23/drive/run.json", tmp_path)
    file = tmp_path / "run.toml"
    file.write_text(text_of(Settings(world=DriveSettings(scenario=typed))))
    for path in (file, tmp_path):
        world = read(path, DriveSettings, {}).world
        assert isinstance(world, DriveSettings)
        assert world.scenario is not None
        assert scenarios.get(world.scenario) == scenarios.get(scenario)
    another = DriveSettings(scenario="parking-exit")
    assert read(file, DriveSettings, {"scenario": another.scenario}).world == another
    (tmp_path / "run.json").unlink()
    assert read(file, DriveSettings, {}).world == DriveSettings(scenario=typed)
