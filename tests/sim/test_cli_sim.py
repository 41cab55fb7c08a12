"""`harness dataset scenario` and `harness dataset` as they are typed."""

import json
import shutil
from zipfile import ZipFile

import jsonschema
import pytest

from harness.core.errors import printable

NAME = "occluded-intersection"


def test_scenarios_are_listed_and_shown_for_people_and_machines(harness):
    code, out, _ = harness("dataset", "scenario", "list")
    assert code == 0
    listed = [line.partition(": ")[0] for line in out.splitlines()]
    assert NAME in listed
    assert [
        s["name"] for s in json.loads(harness("dataset", "scenario", "list", "--json")[1])
    ] == listed
    _, out, _ = harness("dataset", "scenario", "show", NAME)
    assert "actions: SLOWER, IDLE, FASTER" in out
    meaning = "distance of the ego's start to the centroid of the conflict zone, m."
    assert f"ego_start_m = 61, 69\n    {meaning}" in out
    assert max(map(len, out.splitlines())) <= 110


def test_every_parameter_is_shown_with_value_and_meaning(harness):
    shown = json.loads(harness("dataset", "scenario", "show", NAME, "--json")[1])
    assert shown["actions"] == ["SLOWER", "IDLE", "FASTER"]
    assert shown["parameters"]["time_limit_s"]["value"] == 10.0
    assert shown["parameters"]["corner_m"]["value"] == [8.0, 15.0]
    assert all(
        p["meaning"].endswith(".") and len(p["meaning"]) > 5 for p in shown["parameters"].values()
    )


def test_the_answer_schemas_of_a_scenario_are_shown_and_hold(harness):
    schemas = json.loads(harness("dataset", "scenario", "show", NAME, "--json")[1])["answer_schema"]
    one = {"action_distribution": {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}}
    jsonschema.validate(one, schemas["ego"])
    jsonschema.validate({"evidence": "v6 from left", "risk": "high", **one}, schemas["helper"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(one, schemas["helper"])


@pytest.mark.slow
def test_a_scenario_check_states_rates_intervals_and_n(harness):
    code, out, err = harness(
        "dataset",
        "scenario",
        "drive",
        NAME,
        "--episodes",
        3,
        "--seed",
        178,
        "--workers",
        1,
        "--json",
    )
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert found["drivers"].keys() == {"cruise", "brake", "local-view", "full-view"}
    success = found["drivers"]["full-view"]["success"]
    assert success.keys() == {"value", "low", "high", "n"}
    assert (success["value"], success["high"], success["n"]) == (1.0, 1.0, 3)
    assert found["drivers"]["brake"]["time_out"]["value"] == 1.0
    code, out, _ = harness(
        "dataset", "scenario", "drive", NAME, "--episodes", 3, "--seed", 178, "--workers", 1
    )
    assert code == 0
    assert out.startswith(f"{NAME}, scenes of v2v-safety-2")
    assert "n = 3 episodes, layout seeds 178 to 180 (tune)" in out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.slow
@pytest.mark.usefixtures("unrebuilt")
def test_a_dataset_is_built_checked_and_ranked(harness, tmp_path):
    out_folder = tmp_path / "two-v1"
    code, out, _ = harness(
        "dataset",
        "build",
        NAME,
        "--episodes",
        2,
        "--seed",
        179,
        "--workers",
        1,
        "--out",
        out_folder,
    )
    nodes = json.loads((out_folder / "manifest.json").read_text())["nodes"]
    assert (code, f": 2 layouts, {nodes} decision points, in " in out) == (0, True)
    assert out.startswith(f"wrote {printable(out_folder)} of {NAME}, scenes of v2v-safety-2")
    code, out, _ = harness("dataset", "check", out_folder)
    assert (code, out.splitlines()[0]) == (
        0,
        f"{printable(out_folder)} is sound: 2 layouts, {nodes} decision points",
    )
    code, out, _ = harness("dataset", "rank", out_folder, "--workers", 1, "--json")
    ranked = json.loads(out)
    assert (code, ranked["episodes"]) == (0, 2)
    success = {driver: of["frozen"]["value"] for driver, of in ranked["drivers"].items()}
    assert (success["brake"], success["full-view"]) == (0.0, 1.0)
    for of in ranked["drivers"].values():
        assert of["frozen"]["value"] == of["live"]["value"]
        assert (of["difference_points"]["value"], of["agreement"]["value"]) == (0.0, 1.0)
    code, out, _ = harness("dataset", "rank", out_folder, "--workers", 1)
    assert "n = 2 episodes; same: share of them that end alike" in out
    assert "these few drivers give no rank correlation" in out
    assert max(map(len, out.splitlines())) <= 80


def test_a_damaged_dataset_is_told_line_by_line_with_exit_code_1(harness, small_folder, tmp_path):
    damaged = shutil.copytree(small_folder, tmp_path / "damaged")
    with ZipFile(damaged / "layouts.zip") as file:
        entries = {name: file.read(name) for name in file.namelist()}
    entries["00001/2.jsonl"] += b'{"sce'
    entries["00004/tree.json"] = entries["00004/tree.json"].replace(b"IDLE", b"IDEL", 1)
    del entries["00005/0.jsonl"]
    with ZipFile(damaged / "layouts.zip", "w") as file:
        for name, data in entries.items():
            file.writestr(name, data)
    (damaged / "README.md").unlink()
    code, out, err = harness("dataset", "check", damaged)
    lines = out.splitlines()
    assert (code, err) == (1, "")
    assert lines[:3] == [
        "README.md: missing",
        "layouts.zip 00001/2.jsonl: changed, its sha256 is not the one that was pinned",
        "layouts.zip 00004/tree.json: changed, its sha256 is not the one that was pinned",
    ]
    assert lines[3].startswith("layouts.zip 00005/0.jsonl: cannot be read (")
    assert len(lines) == 4
    code, out, _ = harness("dataset", "check", damaged, "--json")
    assert (code, json.loads(out)["problems"]) == (1, lines)


def test_a_dataset_of_other_actions_is_refused(harness, small_folder, tmp_path):
    other = shutil.copytree(small_folder, tmp_path / "other")
    manifest = json.loads((other / "manifest.json").read_text())
    manifest["actions"] = ["STOP", "IDLE", "FASTER"]
    (other / "manifest.json").write_text(json.dumps(manifest))
    code, out, err = harness("dataset", "rank", other)
    assert (code, out) == (2, "")
    assert "[actions] is STOP, IDLE, FASTER; those of its scenario are SLOWER, IDLE, FASTER" in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("dataset scenario show occluded-crossing", "unknown scenario 'occluded-crossing'"),
        ("dataset scenario drive nowhere --episodes 1", "unknown scenario 'nowhere'"),
        (
            f"dataset scenario drive {NAME} --episodes 0",
            "--episodes 0 is out of range; give 1 to 100000",
        ),
        (
            f"dataset scenario drive {NAME} --episodes 1 --workers 0",
            "--workers 0: give 1 to 256 processes, or ray",
        ),
        (f"dataset scenario drive {NAME} --episodes 1 --seed -1", "--seed -1 is out of range"),
        ("dataset build nowhere --out OUT", "unknown scenario 'nowhere'"),
        (f"dataset build {NAME} --episodes 0 --out OUT", "--episodes 0 is out of range"),
        (
            f"dataset build {NAME} --episodes 1 --workers 0 --out OUT",
            "--workers 0: give 1 to 256 processes, or ray",
        ),
        (f"dataset build {NAME} --episodes 1 --out OUT/.hidden", "cannot name a dataset"),
        ("dataset check OUT", "unknown dataset"),
        ("dataset check EMPTY", "is no dataset (no manifest.json)"),
        ("dataset rank EMPTY", "is no dataset (no manifest.json)"),
        ("dataset rank SMALL --workers 0", "--workers 0: give 1 to 256 processes, or ray"),
        ("dataset show SMALL 00099-0 --out OUT.svg", "unknown scene '00099-0'"),
        ("dataset show SMALL 00000-0 --out OUT.gif", "end it in .svg or .png"),
        (
            "dataset show SMALL 00000-0 --viewer v9 --out OUT.svg",
            "unknown viewer of scene 00000-0-",
        ),
        ("dataset show SMALL 00000-0 --camera --out OUT.svg", "end it in .png"),
        (
            "dataset show SMALL 00000-0 --camera --viewer v9 --out OUT.png",
            "unknown viewer of scene 00000-0-",
        ),
        ("dataset show EMPTY 00000-0 --out OUT.svg", "is no dataset"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2_and_nothing_is_written(
    harness, small_folder, tmp_path, words, says
):
    (tmp_path / "empty").mkdir()
    places = {"OUT": tmp_path / "out", "EMPTY": tmp_path / "empty", "SMALL": small_folder}
    for name, place in places.items():
        words = words.replace(name, str(place))
    before = sorted(small_folder.rglob("*"))
    code, out, err = harness(*words.split())
    assert (code, out) == (2, "")
    assert err.startswith("harness: ")
    assert err.count("\n") == 1
    assert says in err
    assert [p.name for p in tmp_path.rglob("*")] == ["empty"]
    assert sorted(small_folder.rglob("*")) == before


@pytest.mark.slow
def test_a_scene_is_drawn_whole(harness, small_folder, tmp_path):
    pytest.importorskip("harness.report.drawing")
    for suffix, start in {"svg": b"<?xml", "png": b"\x89PNG"}.items():
        picture = tmp_path / f"scene.{suffix}"
        code, out, _ = harness(
            "dataset", "show", small_folder, "00000-0", "--viewer", "v2", "--out", picture
        )
        assert (code, out) == (0, f"wrote {picture}\n")
        assert picture.read_bytes().startswith(start)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.png", "scene.svg"]
