"""What was made before scenes changed is read as what it was, whatever a scenario's bare name means now."""

from pathlib import Path

import former
import pytest

from harness.dataset.load import find, load
from harness.evaluate import replay
from harness.runs import folder
from harness.world import scenarios
from harness.world.scenarios import occluded_intersection

RECORDS = Path(__file__).parent / "records"
LATER = "witnesses=each,radio_share=0.25,limits=2,perception=2"


@pytest.fixture(autouse=True)
def _another_default(monkeypatch: pytest.MonkeyPatch) -> None:
    changed = scenarios.get(f"{scenarios.DEFAULT}:{LATER}")
    monkeypatch.setattr(occluded_intersection, "SCENARIO", changed)
    assert scenarios.get(scenarios.DEFAULT).parameters.witnesses == "each"


def test_an_old_dataset_has_the_scenes_that_it_was_built_of() -> None:
    old, new = (load(find(name), 1).scenario for name in (former.DATASET, "occluded-intersection-v3"))
    assert old.parameters == former.SCENARIO.parameters
    assert new.parameters == scenarios.get(scenarios.DEFAULT).parameters
    assert scenarios.get(scenarios.argument(old)).parameters == old.parameters


@pytest.mark.parametrize("commit", [path.name for path in RECORDS.glob("*") if (path / "drive").is_dir()])
def test_an_old_driven_run_is_replayed_in_its_own_scenes(commit: str) -> None:
    """Its record lacks the parameters that came later. A scene's name is the digest of what is in it."""
    run = folder.read(RECORDS / commit / "drive")
    played = replay.find(run.path, 0, None, None)
    assert played.scenario.parameters == former.SCENARIO.parameters
    name = max(run.decisions.scenes)
    assert replay.scene_of(run, name).id == name
    *_, last = replay.stills(replay.find(run.path, 0, "single-local", 0))
    [row] = [e for e in run.episodes if (e.episode, e.condition, e.seed) == (0, "single-local", 0)]
    assert last.outcome.startswith(f"{row.failure or 'cleared'} at {row.time_s:.1f} s")
