"""A scenario of another package, in one file,
goes through all that the one that ships goes through.
"""

import io
import json
import pickle
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from evaluating import scenes_of
from one_way_crossing import RECORDED, SCENARIO

from harness.core.errors import UserError
from harness.dataset.build import build
from harness.dataset.load import load
from harness.dataset.verify import check
from harness.prompts import versions
from harness.report.drawing.scene import draw
from harness.runs.folder import read
from harness.world import scenarios
from harness.world.drivers import DRIVERS
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.reference import drive_all
from harness.world.world import World

MEETING, FREE = 1, 2  # seeds
NAME = SCENARIO.name


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """A package with an entry point, as pip leaves it."""
    site = tmp_path_factory.mktemp("site")
    info = site / "one_way-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: one-way\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[swarmdrive.scenarios]\n{NAME} = one_way_crossing:SCENARIO\nbroken = "
        f"one_way_crossing:NONE\n{RECORDED.name} = one_way_crossing:RECORDED\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "one-way"
    build(SCENARIO, folder, 2, MEETING, 1, lambda done: None)
    return folder


@pytest.fixture(scope="module")
def frozen(folder):
    return load(folder)


def test_a_package_that_does_not_load_is_one_line():
    assert "broken" in scenarios.names()
    with pytest.raises(
        UserError, match=r"^plug-in 'broken' \(swarmdrive.scenarios\): .* does not load"
    ):
        scenarios.get("broken")


def test_it_is_found_by_its_entry_point_and_travels_as_name_and_parameters():
    assert NAME in scenarios.names()
    assert scenarios.get(NAME) is SCENARIO
    harder = replace(SCENARIO, parameters=replace(SCENARIO.parameters, braking_mps2=5.0))
    assert pickle.loads(pickle.dumps(harder)) == harder
    assert len(pickle.dumps(harder)) < 1000


def test_drivers_meet_its_danger_or_wait_for_it():
    meeting, free = drive_all(SCENARIO, [MEETING, FREE])
    results = {driver: (meeting[driver].result, free[driver].result) for driver in DRIVERS}
    assert results == {
        "cruise": ("collision", "cleared"),
        "brake": ("time_out", "time_out"),
        "local-view": ("cleared", "cleared"),
        "full-view": ("cleared", "cleared"),
    }
    assert (meeting["cruise"].partner, meeting["cruise"].fault) == ("v3", "ego")


def test_both_vehicles_see_its_danger_in_its_sector():
    world = World.start(SCENARIO, MEETING)
    world.act("IDLE")
    state = world.state()
    for viewer in ("v1", "v2"):
        graph = scene_graph(SCENARIO, state, viewer)
        assert [(c.vehicle, c.sector) for c in graph.conflicts] == [("v3", "west")]
        assert [s.sector for s in graph.sectors] == ["west"]
        assert [n.lane for n in graph.nodes if n.id == "v3"] == ["street-west"]
    world.act("IDLE")
    assert plan(SCENARIO, truth_graph(SCENARIO, world.state())) == "SLOWER"


@pytest.mark.exhaustive
def test_its_dataset_is_sound_and_says_whose_it_is(folder, frozen, tmp_path):
    assert check(folder) == []
    assert (frozen.scenario, frozen.actions) == (SCENARIO, SCENARIO.actions)
    assert [len(tree.levels) for tree in frozen.trees] == [4, 4]
    assert {s.record.danger.sector for s in scenes_of(frozen)} == {"west", None}
    build(SCENARIO, tmp_path / "one-way", 2, MEETING, 2, lambda done: None)
    assert (tmp_path / "one-way/manifest.json").read_bytes() == (
        folder / "manifest.json"
    ).read_bytes()


def test_a_dataset_of_a_scenario_that_is_not_here_is_refused_in_a_line(folder, tmp_path):
    manifest = json.loads((folder / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "scenario": "one-way-crosing"}))
    with pytest.raises(
        UserError, match=r"manifest.json: unknown scenario .*did you mean 'one-way-crossing'"
    ):
        load(tmp_path)


def test_prompts_list_its_actions_and_say_its_words(frozen, tmp_path):
    graph = scenes_of(frozen)[1].graphs["v2"]
    [system, user] = versions.load("v2").render(graph, frozen.actions, words=frozen.scenario.words)
    assert '"LANE_RIGHT":p' in system["content"]
    assert "v3 west:" in user["content"]
    draft = replace(
        versions.load("v2"),
        texts=dict.fromkeys(
            ("ego", "helper"),
            "{% block system %}You {{ words.task }}.{% endblock %}{% block user %}{% endblock %}",
        ),
    )
    assert (
        draft.render(graph, frozen.actions, words=SCENARIO.words)[0]["content"]
        == "You cross a one-way street."
    )


@pytest.mark.slow
def test_a_run_states_what_its_layouts_are_cut_from_and_check_holds_it_against_the_scenario(
    harness, tmp_path
):
    """Seeds 1 to 4 are of recordings 1, 1, 2 and 2; intervals count two."""
    build(RECORDED, tmp_path / "data", 4, 1, 1, lambda done: None)
    data = load(tmp_path / "data")
    assert data.clusters.tolist() == [0, 0, 1, 1]
    names = ["recording 1", "recording 1", "recording 2", "recording 2"]
    played = ("--model", "proxy", "--seeds", "0", "--condition", "single-local", "--workers", "1")
    ran = harness("eval", "--dataset", data.path, *played, "--out", "frozen", "--verbose")
    assert (ran[0], "4 layouts of 2 recordings" in ran[1]) == (0, True), ran
    drawn = ("--scenario", RECORDED.name, "--episodes", "4", "--first-seed", "1")
    assert harness("drive", *drawn, *played, "--out", "driven")[0] == 0
    for folder in (Path("frozen"), Path("driven")):
        assert [episode.cluster for episode in read(folder).episodes] == names
        code, out, err = harness("run", "check", folder)
        assert (code, err) == (0, ""), out
        table = folder / "episodes.csv"
        table.write_text(table.read_text().replace("recording 2", "recording 1"))
        code, out, err = harness("run", "check", folder)
        assert (code, "episodes.csv has another cluster in 2 rows" in out) == (1, True), out + err


def test_what_a_layout_is_cut_from_is_a_text():
    for wrong in (7, "", "a\nb", "a" * 1001):
        odd = replace(SCENARIO, cluster=lambda seed, wrong=wrong: wrong)
        with pytest.raises(UserError, match=r"cluster of layout seed 3 is .*, no text of 1 to 1"):
            odd.cluster_of(3)
    calls = count()
    with pytest.raises(UserError, match=r"cluster of layout seed 3 differs from call to call"):
        replace(SCENARIO, cluster=lambda seed: f"r{next(calls)}").cluster_of(3)
    assert SCENARIO.cluster_of(3) is None
    assert (RECORDED.cluster_of(3), RECORDED.at(3).cluster_of(4)) == ("recording 2", "recording 2")


def test_it_is_drawn(frozen):
    picture = io.BytesIO()
    draw(scenes_of(frozen)[1], picture, "svg", "v2")
    assert picture.getvalue().startswith(b"<?xml")


@pytest.mark.exhaustive
def test_the_command_drives_and_evaluates_it_and_reports(harness, folder):
    shown = harness("dataset", "scenario", "show", NAME)
    assert (shown[0], "decisions = 4\n" in shown[1]) == (0, True)
    checked = harness("dataset", "scenario", "drive", NAME, "--episodes", "2", "--workers", "1")
    assert checked[0] == 0
    ran = harness("eval", "--model", "proxy", "--dataset", folder, "--out", "run")
    assert ran[0] == 0, ran
    assert harness("report", "run", "--out", "page.html")[0] == 0
    drove = harness(
        "drive",
        "--scenario",
        NAME,
        "--episodes",
        "2",
        "--seeds",
        "0",
        "--workers",
        "1",
        "--out",
        "driven",
    )
    assert drove[0] == 0, drove
    assert harness("report", "driven", "--out", "driven.html")[0] == 0
