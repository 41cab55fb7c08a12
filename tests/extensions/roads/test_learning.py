"""Who learns from a recording learns from others that react, unless its name says otherwise."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs
from studied import trials

import harness
from harness.core.errors import UserError
from harness.dataset import rebuilt
from harness.dataset.load import load
from harness.extensions.learn.rewards.trips import Trees
from harness.extensions.roads import family, tables
from harness.world import scenarios

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path, once: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWARMDRIVE_RECORDINGS", "")
    trials()["reaction"].lays(tmp_path, once)
    return tmp_path


def test_rewards_are_of_others_that_react_unless_the_scenario_says_so(folder: Path) -> None:
    success = {}
    for name, title in (("with", ""), ("without", ":react=false")):
        dataset = load(folder / name)
        assert scenarios.title(dataset.scenario) == f"{dataset.manifest.scenario}{title}"
        success[name] = Trees(dataset).values.table.mean()
    assert success["with"] > success["without"]  # in which a trainer would learn not to brake


def test_another_import_of_reported_traffic_teaches_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebuilt, "_reported", lambda scenario: [load(folder / "with")])
    rebuilt.refuse_drawn(load(folder / "with").scenario, range(2))
    again = tmp_path / "again"
    again.mkdir()
    source = tables.read(folder / "with")
    scenes = [replace(source.scene("s"), name="t")]
    moments = [structs.replace(moment, scene="t") for moment in source.moments]
    tables.write(again, "again", "", "", 60.0, scenes, moments, {})
    scenario = scenarios.get(family.RECORDINGS.named({"recording": str(again)}))
    with pytest.raises(UserError, match=r"again@.* has layout 0, which is scene 0000.* of with"):
        rebuilt.refuse_drawn(scenario, range(2))


def test_an_episode_of_a_recording_is_text_and_exact(folder: Path) -> None:
    driving = harness.environment(dataset=folder / "with", quiet=True)
    chat, info = driving.reset(options={"layout_seed": 1})
    over, total, start = False, 0.0, info
    while not over:
        assert driving.observation_space.contains(chat)
        assert "EGO speed" in chat[-1]["content"]
        action = int(info["values"].argmin())
        chat, reward, over, _, info = driving.step(action)
        total += reward
    assert total == float(info["success"]) - (not start["lost"])
    assert driving.references(2)["local-view"]["success"] == 1.0
    with pytest.raises(UserError, match='give observation="text"'):
        harness.environment(dataset=folder / "with", observation="arrays", quiet=True)
