"""Frozen datasets: the same bytes however they are built,
and nothing used that is not what it says.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from zipfile import ZipFile

import msgspec
import pytest
from evaluating import scenes_of
from former import SCENARIO
from relabelling import relabel
from together import act_together

from harness.core.errors import UserError
from harness.core.files import canonical_json, sha256_bytes
from harness.core.seeds import FIRST
from harness.dataset import verify
from harness.dataset.build import build
from harness.dataset.load import find, load
from harness.dataset.verify import check
from harness.world.perception.graph import scene_graph
from harness.world.reference import finish
from harness.world.scenarios import argument
from harness.world.world import World

FIRST_SEED = 178
FEW = replace(SCENARIO, parameters=replace(SCENARIO.parameters, decisions=3))


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.fixture(scope="session")
def three_decisions(once):
    """Folder of two layouts with three decisions each, which is fast to build and to check."""
    return once("three-decisions", lambda out: build(FEW, out, 2, 5, 1, lambda done: None))


# Building.


SOME_PARTS = {
    "as it was": lambda layout: None,
    "garbage": lambda layout: layout.write_bytes(b"PK"),
    "no seal": lambda layout: layout.with_name(f"seal-{layout.name}").unlink(),
}


@pytest.mark.slow
@pytest.mark.parametrize("kept", SOME_PARTS)
def test_a_build_that_was_stopped_and_is_continued_has_the_bytes_of_an_undisturbed_one(
    three_decisions, tmp_path, kept, capsys
):
    """Its layouts are frozen again where somebody else may have written them."""
    out, done = tmp_path / three_decisions.name, []

    def stopping(count):
        done.append(count)
        if sum(done) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(FEW, out, 2, 5, 1, stopping)
    assert not (out / "manifest.json").exists()
    [layout] = out.glob(".work/0*.zip")
    SOME_PARTS[kept](layout)
    again = []
    build(FEW, out, 2, 5, 1, again.append)
    if kept == "as it was":
        assert again == [1, 1], "the one that was there, and the other"
    else:
        assert again == [0, 1, 1]
        assert "has 1 frozen layout that nobody finished here with" in capsys.readouterr().err
    assert contents(out) == contents(three_decisions)


@pytest.mark.exhaustive
def test_a_build_killed_half_way_and_continued_by_two_workers_has_the_bytes_of_an_undisturbed_one(
    small_folder, tmp_path
):
    out = tmp_path / small_folder.name
    command = [sys.executable, "-m", "harness", "dataset", "build", argument(SCENARIO)]
    command += ["--episodes", "6", "--seed", str(FIRST_SEED), "--workers", "2", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True) as process:
        while process.poll() is None and len(list(out.glob(".work/0*.zip"))) < 2:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (out / "manifest.json").exists()
    finished = len(list(out.glob(".work/0*.zip")))
    progress = []
    build(SCENARIO, out, 6, FIRST_SEED, 2, progress.append)
    assert (progress[0], sum(progress)) == (finished, 6)
    assert contents(out) == contents(small_folder)


def test_a_build_begun_with_other_settings_is_not_continued(tmp_path):
    (tmp_path / "begun" / ".work").mkdir(parents=True)
    (tmp_path / "begun" / ".work" / "config.json").write_text('{"settings": {"seed": 1}}')
    with pytest.raises(UserError, match=r"begun with another .*seed"):
        build(SCENARIO, tmp_path / "begun", 1, 0, 1, lambda done: None)


def test_a_finished_dataset_is_not_built_over(small_folder):
    before = contents(small_folder)
    with pytest.raises(UserError, match="already holds a finished dataset"):
        build(SCENARIO, small_folder, 6, FIRST_SEED, 1, lambda done: None)
    assert contents(small_folder) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: None, None),
        (
            lambda folder: (folder / "layouts.zip").write_bytes(bytes(1000)),
            r"layouts\.zip: cannot be read",
        ),
        (lambda folder: relabel(folder, {0: 7, 1: 8}), "another seed; repeat its settings"),
    ],
)
def test_a_folder_that_was_stopped_as_it_tidied_is_held_to_what_it_states(
    three_decisions, tmp_path, spoil, said
):
    out = shutil.copytree(three_decisions, tmp_path / three_decisions.name)
    (out / ".work").mkdir()
    spoil(out)
    if said is None:
        assert build(FEW, out, 2, 5, 1, lambda done: None)["seed"] == 5
        assert contents(out) == contents(three_decisions)
        return
    with pytest.raises(UserError, match=said):
        build(FEW, out, 2, 5, 1, lambda done: None)
    if "another seed" in said:
        with pytest.raises(UserError, match="layout 0 is not what layout seed 7 gives"):
            build(FEW, out, 2, 7, 1, lambda done: None)


def test_a_folder_with_other_files_a_file_and_an_odd_name_are_refused_untouched(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name, why in {
        "notes": "other files",
        "file": "no folder",
        "a b": "cannot name a dataset",
    }.items():
        with pytest.raises(UserError, match=why):
            build(SCENARIO, tmp_path / name, 1, 0, 1, lambda done: None)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "mine.txt", "notes"]


# What is in it.


def test_a_built_dataset_is_sound_and_has_every_course(small, small_folder):
    assert check(small_folder) == []
    forest = small.forest
    assert small.manifest.episodes == 6
    assert small.manifest.nodes == len(forest.ids)
    assert [tree.episode_seed for tree in small.trees] == list(range(FIRST_SEED, FIRST_SEED + 6))
    # Three target speeds, so at most three new decision points a decision point; far fewer are new.
    for tree in small.trees:
        sizes = [len(level) for level in tree.levels]
        assert len(sizes) == SCENARIO.parameters.decisions
        assert sizes[0] == 1
        assert sum(sizes) < 130


def test_trees_and_scenes_that_were_forgotten_are_read_again_as_they_were(
    small, small_folder, monkeypatch
):
    monkeypatch.setattr("harness.dataset.load.TREES_KEPT", 2)
    data = replace(load(small_folder), kept=3)
    assert list(data.trees) == list(small.trees)
    ids, records = (
        small.forest.ids[::7],
        [scene.record for scene in small.scenes(small.forest.ids[::7])],
    )
    for _ in range(2):
        assert [scene.record for scene in data.scenes(ids)] == records
        assert len(data._scenes) == 3


def test_a_dataset_knows_which_ids_are_its_own(small_folder):
    small = load(small_folder)
    one = small.of_episodes({2})
    [mine, *_] = one.forest.ids
    assert mine in one
    assert mine in small
    assert small.forest.ids[0] not in one
    for other in (
        "",
        "2",
        "00002-0",
        f"{mine}x",
        mine.replace("-0-", "-9-"),
        "00099-0-000000000000",
        "é" * 99,
    ):
        assert other not in small
    with pytest.raises(KeyError):
        one.scenes([small.forest.ids[0]])


def test_graphs_in_a_record_are_what_the_sensors_say_of_its_state(small):
    for scene in scenes_of(small)[::9]:
        assert scene.viewers == ("v1", "v2", "v3", "v4")
        for viewer in scene.viewers:
            graph = scene_graph(SCENARIO, scene.state, viewer)
            assert graph == scene.graphs[viewer]


def test_no_graph_says_minus_zero(small):
    for scene in scenes_of(small):
        assert (
            re.search(r"-0\.0(?!\d)", canonical_json(msgspec.to_builtins(scene.record.graphs)))
            is None
        )


def test_poses_are_kept_to_the_micrometre_so_that_other_machines_write_the_same(small):
    for scene in scenes_of(small)[::9]:
        for v in scene.record.state.vehicles:
            for number in (v.x_m, v.y_m, v.heading_rad, v.speed_mps):
                assert number == round(number, 6)


@pytest.mark.slow
def test_an_edge_leads_where_the_thawed_world_goes(small):
    """Thawed to the micrometre, so positions agree to a millimetre, and ends to the frame."""
    forest = small.forest
    for n, place, world in acted(small, range(0, len(forest.ids), 37)):
        child = int(forest.child[n, place])
        if child < 0:
            end = forest.end(int(forest.edge[n, place]))
            assert (world.outcome.result, world.outcome.time_s) == (end.result, end.time_s)
            assert (world.outcome.partner, world.outcome.fault) == (end.partner, end.fault)
            continue
        [there] = small.scenes([forest.ids[child]])
        for mine, its in zip(world.state().vehicles, there.state.vehicles, strict=True):
            assert (mine.x_m, mine.y_m) == pytest.approx((its.x_m, its.y_m), abs=1e-3)
            assert mine.speed_mps == pytest.approx(its.speed_mps, abs=1e-3)


def acted(small, nodes):
    """A node, the place of an action, and the world after it, for every action in some nodes."""
    places = [(n, place) for n in nodes for place in range(len(small.actions))]
    scenes = small.scenes([small.forest.ids[n] for n, _ in places])
    worlds = [World.thaw(SCENARIO, scene.state, scene.record.snapshot) for scene in scenes]
    act_together(worlds, [small.actions[place] for _, place in places])
    return [(n, place, world) for (n, place), world in zip(places, worlds, strict=True)]


@pytest.mark.slow
def test_what_becomes_of_an_action_with_the_full_view_driver_is_what_it_drives(small):
    forest = small.forest
    some = acted(small, forest.visited(forest.drivers["cruise"]).tolist()[::5])
    outcomes = finish([world for *_, world in some], ["full-view"] * len(some))
    for (n, place, _), outcome in zip(some, outcomes, strict=True):
        end = forest.end(int(forest.then_full_view[n, place]))
        assert (outcome.result, outcome.time_s) == (end.result, end.time_s)


def test_actions_that_come_to_the_same_are_one_edge(small):
    """At the highest speed level FASTER changes nothing."""
    first = small.trees[0].levels[0][0]
    assert [edge.actions for edge in first.edges] == [["SLOWER"], ["IDLE", "FASTER"]]


def test_the_first_episodes_can_be_loaded_alone(small_folder):
    few = load(small_folder, limit=1)
    assert few.episodes == (0,)
    assert {name[:5] for name in few.forest.ids} == {"00000"}


@pytest.mark.exhaustive
def test_another_lag_is_another_dataset_and_everybody_has_it(small, tmp_path):
    p = replace(SCENARIO.parameters, decision_lag_s=0.0)
    at_once = replace(SCENARIO, parameters=p)
    build(at_once, tmp_path / "at-once", 1, FIRST_SEED, 1, lambda done: None)
    data = load(tmp_path / "at-once")
    assert data.scenario.parameters.lag_frames == 0
    assert data.scenario.parameters == p
    assert small.scenario.parameters.lag_frames == 8  # 145 ms in frames of 20 ms
    assert data.trees[0].levels[0][0].scene == small.trees[0].levels[0][0].scene
    assert {b.scene for b in data.trees[0].levels[1]} != {b.scene for b in small.trees[0].levels[1]}
    layouts = f"--episodes 1 --seed {FIRST_SEED} --lag 0 --out again/at-once"
    command = f"harness dataset build {argument(SCENARIO)} {layouts}"
    assert f"Built by `{command}`." in (tmp_path / "at-once/README.md").read_text()


# Damage.


@pytest.fixture
def copy(two_path, tmp_path):
    return shutil.copytree(two_path, tmp_path / "copy")


@pytest.fixture
def small_copy(three_decisions, tmp_path):
    return shutil.copytree(three_decisions, tmp_path / "copy")


def rewrite(folder, name, change):
    """Replace a file in layouts.zip by what `change` makes of its bytes."""
    with ZipFile(folder / "layouts.zip") as file:
        entries = {each: file.read(each) for each in file.namelist()}
    made = change(entries[name])
    entries[name] = made
    if made is None:
        del entries[name]
    with ZipFile(folder / "layouts.zip", "w") as file:
        for each, data in entries.items():
            file.writestr(each, data)
    return entries


def reseal(folder, entries, **changes):
    """Make manifest and trees agree with the files again, as someone who means harm would."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for episode in range(manifest["episodes"]):
        tree = json.loads(entries[f"{episode:05d}/tree.json"])
        if isinstance(tree, dict) and isinstance(tree.get("levels"), list):
            levels = [f"{episode:05d}/{step}.jsonl" for step in range(len(tree["levels"]))]
            tree["scenes_sha256"] = [
                sha256_bytes(entries[name]) for name in levels if name in entries
            ]
            entries[f"{episode:05d}/tree.json"] = json.dumps(tree).encode()
        manifest["trees_sha256"][episode] = sha256_bytes(entries[f"{episode:05d}/tree.json"])
    with ZipFile(folder / "layouts.zip", "w") as file:
        for each, data in entries.items():
            file.writestr(each, data)
    (folder / "manifest.json").write_text(json.dumps({**manifest, **changes}))


def edit(folder, line, change):
    """Replace a scene of the second layout's level 2 (from 1) by what `change` makes of it, and
    seal it.
    """

    def of_lines(data):
        lines = data.splitlines(keepends=True)
        record = json.loads(lines[line - 1])
        changed = change(record)
        lines[line - 1] = (
            changed if isinstance(changed, bytes) else (json.dumps(record) + "\n").encode()
        )
        return b"".join(lines)

    reseal(folder, rewrite(folder, "00001/2.jsonl", of_lines))


def use(folder):
    """Load, and read every scene."""
    data = load(folder)
    data.scenes(data.forest.ids)


def test_a_changed_byte_is_found_and_refused(copy):
    rewrite(
        copy,
        "00001/2.jsonl",
        lambda data: data.replace(b'"speed_mps":14.0', b'"speed_mps":15.0', 1),
    )
    changed = "layouts.zip 00001/2.jsonl: changed, its sha256 is not the one that was pinned"
    assert check(copy) == [changed]
    with pytest.raises(UserError, match=re.escape(changed)):
        use(copy)


@pytest.mark.parametrize("name", ["README.md", "scene.schema.json", "manifest.schema.json"])
def test_a_missing_file_is_found_and_refused(copy, name):
    (copy / name).unlink()
    assert check(copy) == [f"{name}: missing"]
    with pytest.raises(UserError, match="missing"):
        load(copy)


@pytest.mark.parametrize(
    ("content", "why"),
    [(None, "No such file"), (b"", "not a zip file"), (b"PK\x03\x04" + bytes(99), "zip")],
)
def test_layouts_that_are_missing_or_no_archive_are_refused(copy, content, why):
    if content is None:
        (copy / "layouts.zip").unlink()
    else:
        (copy / "layouts.zip").write_bytes(content)
    [problem] = check(copy)
    assert re.search(f"layouts.zip: cannot be read .*{why}", problem)
    with pytest.raises(UserError, match="cannot be read"):
        load(copy)


def test_an_archive_cut_off_is_refused(copy):
    data = (copy / "layouts.zip").read_bytes()
    (copy / "layouts.zip").write_bytes(data[:-400])
    with pytest.raises(UserError, match="cannot be read"):
        load(copy)


def test_a_member_that_is_missing_is_found_and_refused(copy):
    rewrite(copy, "00001/2.jsonl", lambda data: None)
    [problem] = check(copy)
    assert problem.startswith("layouts.zip 00001/2.jsonl: cannot be read (")
    with pytest.raises(UserError, match="There is no item"):
        use(copy)


def test_a_level_that_claims_gigabytes_is_not_unpacked(copy, monkeypatch):
    monkeypatch.setattr(verify, "LARGEST_ENTRY", 10_000)
    assert any("too large" in problem for problem in check(copy))
    with pytest.raises(UserError, match="too large"):
        use(copy)


def test_a_scene_taken_out_is_found(copy):
    entries = rewrite(
        copy, "00001/2.jsonl", lambda data: b"".join(data.splitlines(keepends=True)[1:])
    )
    reseal(copy, entries)
    assert check(copy) == ["layouts.zip 00001/2.jsonl: 4 scenes, the tree has 5"]
    with pytest.raises(UserError, match="4 scenes, the tree has 5"):
        use(copy)


def at(*keys, value):
    """An edit: the value at a place in the record."""

    def change(record):
        for key in keys[:-1]:
            record = record[key]
        record[keys[-1]] = value

    return change


def drop(*keys):
    def change(record):
        for key in keys[:-1]:
            record = record[key]
        del record[keys[-1]]

    return change


HOSTILE = {
    "not JSON": lambda record: b"{]\n",
    "an empty line": lambda record: b"\n",
    "a list": lambda record: b"[]\n",
    "null": lambda record: b"null\n",
    "bytes that are no text": lambda record: b"\xff\xfe\n",
    "nested too deeply": lambda record: b"[" * 100_000 + b"\n",
    "an integer of five thousand digits": lambda record: b'{"episode":' + b"9" * 5000 + b"}\n",
    "not a number": at("state", "ego_speed", value=1.0),
    "NaN": at("state", "time_s", value=float("nan")),
    "infinity": at("state", "time_s", value=float("inf")),
    "a number out of this world": at("state", "vehicles", 0, "x_m", value=1e300),
    "a huge integer": at("episode", value=10**400),
    "a float for an integer": at("snapshot", "sections", 0, value=1.0),
    "a boolean for a number": at("state", "time_s", value=True),
    "a text for a number": at("distance_m", "v1", value="12"),
    "a list for an object": at("graphs", value=[]),
    "no vehicles": at("state", "vehicles", value=[]),
    "a missing field": drop("snapshot", "frame"),
    "an unknown field": at("state", "hidden", value=1),
    "an unknown kind of vehicle": at("state", "vehicles", 0, "kind", value="tank"),
    "an id with markup": at("state", "vehicles", 0, "id", value="<script>"),
    "two vehicles of one id": at("state", "vehicles", 1, "id", value="v1"),
    "two egos": at("state", "vehicles", 1, "part", value="ego"),
    "a helper that became another": at("state", "vehicles", 1, "part", value="other"),
    "a graph that is missing": drop("graphs", "v2"),
    "a graph of another viewer": at("graphs", "v2", "viewer", value="v3"),
    "a distance that is missing": drop("distance_m", "v4"),
    "a danger that is not there": at("danger", "vehicle", value="v9"),
    "a section too few": at("snapshot", "sections", value=[0]),
    "a section too far": at("snapshot", "sections", 0, value=3),
    "another step": at("state", "step", value=3),
    "another seed": at("state", "episode_seed", value=181),
    "another scene's id": at("scene", value="00003-3-0123456789ab"),
    "a node that is not there": at("graphs", "v1", "nodes", 0, "id", value="v8"),
    "a conflict on a path that merges": at(
        "graphs", "v1", "conflicts", value=[{
            "with": "v2", "sector": "left", "route": "left", "point": {"forward_m": 1.0, "left_m": 1.0},
            "ego": {"arc_m": 1.0, "time_s": 1.0}, "other": {"arc_m": 1.0, "time_s": 1.0, "speed_mps": 1.0},
        }],
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_scene_that_is_not_what_it_should_be_is_named_and_never_used(small_copy, what):
    edit(small_copy, 3, HOSTILE[what])
    problems = check(small_copy)
    assert problems
    name = load(small_copy).trees[1].levels[2][2].scene
    where = f"layouts.zip scene {name}"
    assert all(problem.startswith(where) for problem in problems)
    assert all(len(problem) < 300 and problem.isprintable() for problem in problems)
    with pytest.raises(UserError, match=re.escape(where)):
        use(small_copy)


HOSTILE_TREES = {
    "another episode": at("episode", value=2),
    "another seed": at("episode_seed", value=5),
    "an edge to nowhere": at("levels", 0, 0, "edges", 0, "to", value=99),
    "an edge that neither leads on nor ends": at("levels", 0, 0, "edges", 0, "to", value=None),
    "an edge that leads on after the last level": at("levels", 5, 0, "edges", 0, "to", value=0),
    "a negative place": at("levels", 0, 0, "edges", 0, "to", value=-1),
    "an action that is not one": at("levels", 0, 0, "edges", 0, "actions", value=["JUMP"]),
    "an action twice": at("levels", 0, 0, "edges", 0, "actions", value=["IDLE"]),
    "no edges": at("levels", 0, 0, "edges", value=[]),
    "no levels": at("levels", value=[]),
    "a driver that jumps": at("levels", 0, 0, "drivers", "full-view", value="JUMP"),
    "no drivers": at("levels", 0, 0, "drivers", value={}),
    "an id with a path": at("levels", 0, 0, "scene", value="../../etc"),
    "an id of another step": at("levels", 0, 0, "scene", value="00001-3-0123456789ab"),
    "an unknown end": at("levels", 5, 0, "edges", 0, "end", "result", value="won"),
    "a time out of this world": at("levels", 5, 0, "edges", 0, "end", "time_s", value=1e300),
    "an unknown field": at("more", value=1),
    "a time to collision in the past": at("levels", 0, 0, "edges", 0, "ttc_s", value=-1.0),
    "an edge without the measures of the others": lambda tree: tree["levels"][0][0]["edges"][0].pop(
        "pet_s"
    ),
    "a collision that is no conflict": at(
        "levels", 5, 0, "edges", 0, "end", "result", value="collision"
    ),
}


@pytest.mark.parametrize("what", HOSTILE_TREES)
def test_a_tree_that_is_not_what_it_should_be_is_refused(copy, what):
    def change(data):
        tree = json.loads(data)
        HOSTILE_TREES[what](tree)
        return json.dumps(tree).encode()

    entries = rewrite(copy, "00001/tree.json", change)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["trees_sha256"][1] = sha256_bytes(entries["00001/tree.json"])
    (copy / "manifest.json").write_text(json.dumps(manifest))
    [problem] = check(copy)
    assert problem.startswith("layouts.zip 00001/tree.json: ")
    assert len(problem) < 300
    assert problem.isprintable()
    with pytest.raises(UserError, match=r"00001/tree\.json"):
        load(copy)


def test_an_archive_that_is_packed_otherwise_than_it_says_is_refused(copy):
    file = copy / "layouts.zip"
    data = bytearray(file.read_bytes())
    for mark, at_method in ((b"PK\1\2", 10), (b"PK\3\4", 8)):
        at = -1
        while (at := data.find(mark, at + 1)) >= 0:
            data[at + at_method] = 14  # LZMA
    file.write_bytes(bytes(data))
    with pytest.raises(UserError, match=r"layouts\.zip .*cannot be read"):
        load(copy)


@pytest.mark.parametrize("text", [b"", b"[", b"[" * 100_000, b"null", b"[]", b"9" * 5000, b"\xff"])
def test_a_tree_that_cannot_be_read_is_refused(copy, text):
    rewrite(copy, "00001/tree.json", lambda data: text)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["trees_sha256"][1] = sha256_bytes(text)
    (copy / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=r"00001/tree\.json"):
        load(copy)


USUAL = asdict(SCENARIO.parameters)
HOSTILE_MANIFESTS: dict[str, dict[str, object]] = {
    "a path upwards": {"files": {"../../etc/passwd": "0" * 64}},
    "an absolute path": {"files": {"/etc/passwd": "0" * 64}},
    "a folder": {"files": {"..": "0" * 64}},
    "a digest too few": {"trees_sha256": ["0" * 64]},
    "a digest that is none": {"trees_sha256": ["unknown"] * 6},
    "a name that is a path": {"name": "../elsewhere"},
    "a huge integer": {"episodes": 10**400},
    "no episodes": {"episodes": 0},
    "episodes as text": {"episodes": "6"},
    "another format": {"format": "swarmdrive-dataset/1"},
    "one action": {"actions": ["IDLE"]},
    "actions that are no names": {"actions": [["IDLE"], {}]},
    "actions in another order": {"actions": [*SCENARIO.actions[::-1]]},
    "an action twice": {"actions": [*SCENARIO.actions, "IDLE"]},
    "a purpose that its seeds have not": {"purpose": "report"},
    "seeds of two purposes": {"seed": FIRST["train"] - 1, "purpose": "train"},
    "a licence that its scenario does not state": {"licence": "MIT"},
    "a source that its scenario does not state": {"source": "a road"},
    "an allowance that is a text": {"parameters": {"delay_allowance_s": "1"}},
    "decisions at one time": {"parameters": {**USUAL, "decision_period_s": 0.0}},
    "an unknown field": {"extra": 1},
    "a scenario that is none": {"scenario": "egg"},
}


@pytest.mark.parametrize("what", HOSTILE_MANIFESTS)
def test_a_manifest_that_is_not_what_it_should_be_is_refused(copy, what):
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, **HOSTILE_MANIFESTS[what]}))
    for use in (check, load):
        with pytest.raises(UserError, match=r"manifest\.json") as error:
            use(copy)
        assert str(error.value).isprintable()
        assert len(str(error.value)) < 600


@pytest.mark.parametrize(
    "text",
    ["", "[", "[" * 100_000, "null", "[]", '{"episodes": NaN}', "9" * 5000, '"\x00"', "\ud800"],
)
def test_a_manifest_that_cannot_be_read_is_refused(copy, text):
    (copy / "manifest.json").write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(UserError, match=r"manifest\.json"):
        load(copy)


def test_more_decision_points_stated_than_there_are_is_found(copy):
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "nodes": manifest["nodes"] + 1}))
    n = manifest["nodes"]
    assert check(copy) == [f"layouts.zip: {n} decision points, the manifest says {n + 1}"]


def test_a_folder_that_is_no_dataset_and_a_name_that_is_unknown_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"is no dataset \(no manifest\.json\)"):
        load(tmp_path)
    for name in ("nowhere-v9", "x" * 5000, "a\x00b"):
        with pytest.raises(UserError, match="unknown dataset"):
            find(name)


def test_a_scene_is_found_by_the_beginning_of_its_id_if_that_is_one_scenes_alone(small):
    assert small.scene("00005-0").record.step == 0
    name = small.trees[5].levels[3][1].scene
    assert small.scene(name).id == small.scene(name[:-4]).id == name
    for unclear in ("00005-9", "00005-3", ""):
        with pytest.raises(UserError, match=f"unknown scene '{unclear}'"):
            small.scene(unclear)
