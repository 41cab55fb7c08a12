"""Fresh traffic of SUMO as a scenario: its files travel, and its branches are exact."""

from pathlib import Path

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.extensions.roads.sumo import FOLDERS, FRESH, inputs_named

TRAFFIC = Path(__file__).parents[3] / "benchmarks/traffic"
TYPED = {"sumo": TRAFFIC / "crossing.net.xml", "routes": TRAFFIC / "crossing.rou.xml"}
WITH_HOUSES = {**TYPED, "buildings": TRAFFIC / "crossing.poly.xml"}


@pytest.fixture
def crossing(monkeypatch: pytest.MonkeyPatch) -> str:
    pytest.importorskip("libsumo")
    monkeypatch.setenv(FOLDERS, "")
    return FRESH.named({name: str(path) for name, path in WITH_HOUSES.items()})


def test_the_name_has_the_digest_of_the_files_as_sumo_is_given_them(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDERS, "")
    typed = {name: str(path) for name, path in TYPED.items()}
    name = FRESH.named(typed)
    (tmp_path / "mine.net.xml").write_bytes(TYPED["sumo"].read_bytes().replace(b"\n\n", b"\n"))
    assert FRESH.named({**typed, "sumo": str(tmp_path / "mine.net.xml")}).startswith("sumo:mine@")
    assert FRESH.named({**typed, "buildings": str(WITH_HOUSES["buildings"])}) != name
    assert FRESH.split(f"{name}:decisions=2") == (name, "decisions=2")
    assert FRESH.joined(name, ["decisions=2"]) == f"{name}:decisions=2"
    with pytest.raises(UserError, match="give --sumo NET --routes ROUTES"):
        FRESH.named({"sumo": typed["sumo"]})
    with pytest.raises(UserError, match=r"are in no folder that is known; .*: SWARMDRIVE_SUMO=F"):
        inputs_named("sumo:crossing@000000000000")


@pytest.mark.exhaustive
def test_a_dataset_of_fresh_traffic_holds_its_files_and_is_sound(harness, crossing, monkeypatch):
    from harness.extensions.roads import simulation

    files = {**WITH_HOUSES, "sumo": f"{WITH_HOUSES['sumo']}:decisions=2"}
    words = [word for name, path in files.items() for word in (f"--{name}", path)]
    build = ("dataset", "build", *words, "--episodes", "2", "--workers", "1")
    code, _, error = harness(*build, "--out", "a")
    assert code == 0, error
    names = {path.name for path in Path("a").iterdir()}
    assert {"net.xml", "routes.xml", "buildings.xml"} <= names
    monkeypatch.setenv(FOLDERS, "")  # as on another machine
    assert harness("dataset", "check", "a")[0] == 0
    assert harness("eval", "--model", "proxy", "--dataset", "a", "--quiet", "--out", "run")[0] == 0
    monkeypatch.setattr(simulation, "version", lambda: "1.99.0")
    code, said, error = harness("dataset", "check", "a")
    assert code == 2
    assert "here its configuration has another sumo" in said + error


@pytest.mark.exhaustive
def test_a_branch_is_the_drive_with_the_same_actions_and_nobody_else_is_moved_at_once(crossing):
    from harness.world import scenarios
    from harness.world.world import World

    scenario = scenarios.get(f"{crossing}:decisions=2")
    layout = scenario.at(2)
    world = World.start(layout, 2)
    begun = world.state()
    ego_id = world.env.setting.moment.vehicle  # type: ignore[attr-defined]
    assert layout.names.by_id["v1"] == f"seed-2/{ego_id}"
    other = world.branch()
    hz = layout.parameters.simulation_hz
    for branch, action in ((world, "SLOWER"), (other, "FASTER")):
        branch.take(action)
        branch.advance(hz)
        branch.take("SLOWER")
        branch.advance(3 * hz)
    again = World.start(layout, 2)
    again.take("SLOWER")
    again.advance(hz)
    again.take("SLOWER")
    again.advance(3 * hz)
    assert again.state() == world.state() != other.state()
    assert World.start(layout, 2).state() == begun
    ego = world.state().ego
    assert ego.speed_mps < begun.ego.speed_mps
    assert np.hypot(ego.x_m - begun.ego.x_m, ego.y_m - begun.ego.y_m) > 1
