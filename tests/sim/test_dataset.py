"""Frozen datasets: the same bytes however they are built, and nothing used that is not what it says."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.core.files import canonical_json, sha256_file
from harness.dataset.build import build
from harness.dataset.freeze import Behaviour, freeze
from harness.dataset.load import find, load
from harness.dataset.verify import check
from harness.world.perception.graph import scene_graph
from harness.world.reference import finish
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.world import World

FIRST_SEED = 178


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


# Building.


def test_a_build_killed_half_way_and_continued_by_two_workers_has_the_bytes_of_an_undisturbed_one(
    small_folder, tmp_path
):
    out = tmp_path / small_folder.name
    command = [sys.executable, "-m", "harness", "dataset", "build", "occluded-intersection"]
    command += ["--episodes", "6", "--seed", str(FIRST_SEED), "--workers", "2", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True) as process:
        while process.poll() is None and len(list(out.glob(".building/0*.jsonl"))) < 2:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (out / "manifest.json").exists()
    finished = len(list(out.glob(".building/0*.jsonl")))
    progress = []
    build(SCENARIO, out, 6, FIRST_SEED, 2, progress.append)
    assert (progress[0], sum(progress)) == (finished, 6)
    assert contents(out) == contents(small_folder)


def test_a_build_begun_with_other_settings_is_not_continued(tmp_path):
    (tmp_path / "begun" / ".building").mkdir(parents=True)
    (tmp_path / "begun" / ".building" / "config.json").write_text("{}")
    with pytest.raises(UserError, match="begun with other settings"):
        build(SCENARIO, tmp_path / "begun", 1, 0, 1, lambda done: None)


def test_a_finished_dataset_is_not_built_over(small_folder):
    before = contents(small_folder)
    with pytest.raises(UserError, match="already holds a finished dataset"):
        build(SCENARIO, small_folder, 6, FIRST_SEED, 1, lambda done: None)
    assert contents(small_folder) == before


def test_a_folder_with_other_files_a_file_and_an_odd_name_are_refused_untouched(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name, why in {"notes": "other files", "file": "is a file", "a b": "cannot name a dataset"}.items():
        with pytest.raises(UserError, match=why):
            build(SCENARIO, tmp_path / name, 1, 0, 1, lambda done: None)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "mine.txt", "notes"]


# What is in it.


def test_a_built_dataset_is_sound_and_has_all_its_decision_points(small, small_folder):
    assert check(small_folder) == []
    assert (small.manifest.episodes, small.manifest.decisions, len(small.scenes)) == (6, 36, 36)
    assert [s.id for s in small.scenes[:7]] == [f"00000-{n}" for n in range(6)] + ["00001-0"]
    assert {s.record["episode_seed"] for s in small.scenes} == set(range(FIRST_SEED, FIRST_SEED + 6))


def test_graphs_in_a_record_are_what_the_sensors_say_of_its_state(small):
    for scene in small.scenes[::5]:
        assert scene.viewers == ("v1", "v2", "v3", "v4")
        for viewer in scene.viewers:
            graph = scene_graph(SCENARIO, scene.state, viewer)
            assert canonical_json(graph) == canonical_json(scene.record["graphs"][viewer])


def test_no_graph_says_minus_zero(small):
    for scene in small.scenes:
        assert re.search(r"-0\.0(?!\d)", canonical_json(scene.record["graphs"])) is None


def test_outcomes_in_a_record_are_what_its_thawed_state_comes_to(small):
    for scene in (small.scenes[2], small.scenes[27], small.scenes[34]):
        for action in small.actions:
            world = World.thaw(SCENARIO, scene.state, scene.record["snapshot"])
            world.act(action)
            outcome = finish(world, "full-view")
            row = scene.record["outcomes"][action]
            assert (outcome.result, outcome.time_s, outcome.partner, outcome.fault) == (
                row["result"], row["time_s"], row["partner"], row["fault"],
            )  # fmt: skip


def test_the_outcome_table_of_a_known_episode(small):
    """Seed 181: a danger from the right that a cruising ego would hit 4.8 s after the start."""
    tables = [s.record["outcomes"] for s in small.scenes if s.record["episode_seed"] == 181]
    results = [{a: table[a]["result"] for a in small.actions} for table in tables]
    harmless = dict.fromkeys(small.actions, "cleared")
    assert results == [
        harmless,
        harmless,
        harmless,  # there is still a second to wait and see
        {"SLOWER": "cleared", "IDLE": "collision", "FASTER": "collision"},
        {"SLOWER": "cleared", "IDLE": "cleared", "FASTER": "collision"},  # not yet behind the danger
        {"SLOWER": "time_out", "IDLE": "cleared", "FASTER": "cleared"},  # nobody speeds up after the last one
    ]
    hit = tables[3]["IDLE"]
    assert (hit["time_s"], hit["partner"], hit["fault"]) == (
        5.0,
        small.scenes[18].record["danger"]["vehicle"],
        "ego",
    )


def test_delays_are_against_the_best_safe_action_and_nan_where_unsafe(small):
    safe, delay_s = small.outcome_arrays()
    assert safe.shape == delay_s.shape == (36, 3)
    assert np.array_equal(np.isnan(delay_s), ~safe)
    best = np.nanmin(delay_s[safe.any(axis=1)], axis=1)
    assert (best == 0.0).all()
    harmless = [
        n for n, s in enumerate(small.scenes) if s.record["episode_seed"] == 179 and s.record["step"] == 0
    ]
    slower, idle, _ = delay_s[harmless[0]]
    assert idle == 0.0
    assert 0.3 < slower < 1.0  # one needless SLOWER is within the allowance


def test_the_guard_acts_only_where_the_behaviour_would_have_ended_the_episode(small):
    for scene in small.scenes:
        record = scene.record
        safe = [a for a in small.actions if record["outcomes"][a]["result"] == "cleared"]
        assert record["behaviour"]["action"] in (safe or small.actions)
        if record["behaviour"]["reason"] == "guard":
            quickest = min(safe, key=lambda a: record["outcomes"][a]["time_s"])
            assert record["behaviour"]["action"] == quickest


def test_one_driver_leads_until_the_guard_acts_and_then_full_view_does(small):
    for episode in range(6):
        reasons = [s.record["behaviour"]["reason"] for s in small.scenes if s.record["episode"] == episode]
        guarded = reasons.index("guard") if "guard" in reasons else len(reasons)
        assert {*reasons[:guarded]} - {"random"} in ({"cruise"}, {"local-view"}, set())
        assert {*reasons[guarded:]} <= {"guard", "random", "full-view"}


@pytest.mark.parametrize(
    ("behaviour", "reasons"),
    [
        (Behaviour(cruise_share=1.0, random_share=0.0), {"cruise"}),
        (Behaviour(cruise_share=0.0, random_share=0.0), {"local-view"}),
        (Behaviour(cruise_share=1.0, random_share=1.0), {"random", "guard"}),
    ],
)
def test_a_share_of_one_is_always_and_of_none_is_never(behaviour, reasons):
    records = freeze(SCENARIO, 179, 0, behaviour)  # no danger: there the guard only stops a late SLOWER
    assert {record["behaviour"]["reason"] for record in records} <= reasons
    assert records[0]["behaviour"]["reason"] in reasons - {"guard"}


def test_the_first_episodes_can_be_loaded_alone(small_folder):
    assert [s.id for s in load(small_folder, limit=1).scenes] == [f"00000-{n}" for n in range(6)]


# Damage.


@pytest.fixture
def copy(small_folder, tmp_path):
    return shutil.copytree(small_folder, tmp_path / "copy")


def reseal(folder, **changes):
    """Make the manifest agree with the files again, as someone who means harm would."""
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["scenes.jsonl"] = sha256_file(folder / "scenes.jsonl")
    (folder / "manifest.json").write_text(json.dumps({**manifest, **changes}))


def edit(folder, line, change):
    """Replace a line of scenes.jsonl (from 1) by what `change` makes of its record, and seal it again."""
    lines = (folder / "scenes.jsonl").read_bytes().splitlines(keepends=True)
    record = json.loads(lines[line - 1])
    changed = change(record)
    lines[line - 1] = changed if isinstance(changed, bytes) else (json.dumps(record) + "\n").encode()
    (folder / "scenes.jsonl").write_bytes(b"".join(lines))
    reseal(folder)


def test_a_changed_byte_is_found_and_refused(copy):
    data = bytearray((copy / "scenes.jsonl").read_bytes())
    place = data.index(b'"speed_mps":14.0') + len(b'"speed_mps":1')
    data[place] = ord("5")
    (copy / "scenes.jsonl").write_bytes(bytes(data))
    assert check(copy) == ["scenes.jsonl: changed, its sha256 is not the manifest's"]
    with pytest.raises(UserError, match=r"scenes\.jsonl: changed"):
        load(copy)


@pytest.mark.parametrize("name", ["scenes.jsonl", "README.md", "scene.schema.json", "manifest.schema.json"])
def test_a_missing_file_is_found_and_refused(copy, name):
    (copy / name).unlink()
    assert check(copy) == [f"{name}: missing"]
    with pytest.raises(UserError, match="missing"):
        load(copy)


def test_a_last_line_cut_off_is_found_with_its_number(copy):
    data = (copy / "scenes.jsonl").read_bytes()
    (copy / "scenes.jsonl").write_bytes(data[:-400])
    assert check(copy) == [
        "scenes.jsonl: changed, its sha256 is not the manifest's", "scenes.jsonl line 36: cut off",
    ]  # fmt: skip
    reseal(copy)
    with pytest.raises(UserError, match="line 36: cut off"):
        load(copy)


def test_a_line_taken_out_is_found(copy):
    lines = (copy / "scenes.jsonl").read_bytes().splitlines(keepends=True)
    (copy / "scenes.jsonl").write_bytes(b"".join(lines[:9] + lines[10:]))
    reseal(copy)
    assert check(copy) == [
        "scenes.jsonl line 10: scene 00001-4 does not follow the line before",
        "scenes.jsonl: 35 decision points, the manifest says 36",
    ]
    with pytest.raises(UserError, match="line 10"):
        load(copy)


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
    "infinity": at("outcomes", "IDLE", "time_s", value=float("inf")),
    "a number out of this world": at("state", "vehicles", 0, "x_m", value=1e300),
    "a huge integer": at("episode", value=10**400),
    "a float for an integer": at("snapshot", "sections", 0, value=1.0),
    "a boolean for a number": at("state", "time_s", value=True),
    "a text for a number": at("distance_m", "v1", value="12"),
    "a list for an object": at("graphs", value=[]),
    "no vehicles": at("state", "vehicles", value=[]),
    "a missing field": drop("outcomes", "SLOWER"),
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
    "another step": at("state", "step", value=2),
    "another seed": at("state", "episode_seed", value=180),
    "another scene's id": at("scene", value="00003-3"),
    "a node that is not there": at("graphs", "v1", "nodes", 0, "id", value="v8"),
    "a conflict on a path that merges": at(
        "graphs", "v1", "conflicts", value=[{
            "with": "v2", "sector": "left", "route": "left", "point": {"forward_m": 1.0, "left_m": 1.0},
            "ego": {"arc_m": 1.0, "time_s": 1.0}, "other": {"arc_m": 1.0, "time_s": 1.0, "speed_mps": 1.0},
        }],
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_record_that_is_not_what_it_should_be_is_named_by_line_and_never_used(copy, what):
    edit(copy, 5, HOSTILE[what])
    problems = check(copy)
    assert problems
    assert all(problem.startswith(("scenes.jsonl line 5", "scenes.jsonl line 6")) for problem in problems)
    assert problems[0].startswith("scenes.jsonl line 5")
    assert all(len(problem) < 300 and problem.isprintable() for problem in problems)
    with pytest.raises(UserError, match=r"scenes\.jsonl line 5"):
        load(copy)


HOSTILE_MANIFESTS: dict[str, dict[str, object]] = {
    "a path upwards": {"files": {"../../etc/passwd": "0" * 64, "scenes.jsonl": "0" * 64}},
    "an absolute path": {"files": {"/etc/passwd": "0" * 64, "scenes.jsonl": "0" * 64}},
    "a folder": {"files": {"..": "0" * 64, "scenes.jsonl": "0" * 64}},
    "no digest for the scenes": {"files": {}},
    "a digest that is none": {"files": {"scenes.jsonl": "unknown"}},
    "a name that is a path": {"name": "../elsewhere"},
    "a huge integer": {"episodes": 10**400},
    "no episodes": {"episodes": 0},
    "episodes as text": {"episodes": "6"},
    "another format": {"format": "swarmdrive-dataset/2"},
    "one action": {"actions": ["IDLE"]},
    "actions that are no names": {"actions": [["IDLE"], {}]},
    "an allowance that is a text": {"parameters": {"delay_allowance_s": "1"}},
    "an unknown field": {"extra": 1},
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
    "text", ["", "[", "[" * 100_000, "null", "[]", '{"episodes": NaN}', "9" * 5000, '"\x00"', "\ud800"]
)
def test_a_manifest_that_cannot_be_read_is_refused(copy, text):
    (copy / "manifest.json").write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(UserError, match=r"manifest\.json"):
        load(copy)


def test_more_episodes_stated_than_there_are_is_found(copy):
    reseal(copy, episodes=7)
    assert check(copy) == ["scenes.jsonl: 6 episodes, the manifest says 7"]


def test_a_folder_that_is_no_dataset_and_a_name_that_is_unknown_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"is no dataset \(no manifest\.json\)"):
        load(tmp_path)
    for name in ("nowhere-v9", "x" * 5000, "a\x00b"):
        with pytest.raises(UserError, match="unknown dataset"):
            find(name)


def test_an_unknown_scene_is_refused_with_the_nearest(small):
    with pytest.raises(UserError, match="unknown scene '00005-9'"):
        small.scene("00005-9")
    assert small.scene("00005-5").record["step"] == 5
