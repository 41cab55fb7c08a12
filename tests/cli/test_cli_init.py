"""`harness init`: a project whose own prompts,
cards and datasets are found beside those that ship.
"""

import errno
import json
import os
import re
import shlex
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from harness.backends import cards
from harness.core import resources
from harness.prompts import versions as prompts
from harness.runs import settings

Said = tuple[int, str, str]
Harness = Callable[..., Said]


@pytest.fixture
def project(harness: Harness, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    code, out, err = harness("init", "project")
    assert (code, err) == (0, "")
    # Without the engine of its model, what runs is the settings' rule.
    command = "--model swarm-tiny --prompt mine" if find_spec("llama_cpp") else "settings.toml"
    assert out.startswith(f"made project; next: cd there, `harness eval {command}`; ")
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path / "project"


@pytest.mark.exhaustive
def test_the_commands_of_its_readme_work_as_typed(harness: Harness, project: Path) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    lines = [
        line for line in (project / "README.md").read_text().splitlines() if line.startswith("$ ")
    ]
    assert len(lines) == 4
    for line in lines:
        _, program, *args = shlex.split(line)
        if "--episodes" in args:
            args[args.index("--episodes") + 1] = "1"
        code, _, err = harness(*args, *(["--limit", "1"] if "eval" in args else []))
        assert (program, code) == ("harness", 0)
        assert "harness: " not in err  # a slow machine is told of progress
    report = project / "reports/swarm-tiny-mine-occluded-intersection-v3"
    assert json.loads((report / "run.json").read_text())["prompt"]["version"] == "mine"
    code, out, err = harness(
        "eval", "--prompt", "mine", "--dataset", "mine", "--seeds", "0", "--json"
    )
    assert (code, err) == (0, "")
    assert json.loads(out)["manifest"]["world"]["path"] == str(project / "datasets/mine")


def test_its_own_are_found_beside_those_that_ship_and_only_there(
    harness: Harness, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ship = prompts.names(resources.folder("prompts"))
    assert prompts.names() == sorted(["mine", *ship])
    assert prompts.load("mine").texts == prompts.load("v3").texts
    assert not prompts.load("mine").released
    assert {"my-model", "proxy"} <= set(cards.names())
    monkeypatch.chdir(project.parent)
    assert prompts.names() == ship
    assert "my-model" not in cards.names()


@pytest.mark.slow
def test_weights_lie_beside_its_card(harness: Harness, project: Path) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")

    def missing() -> dict[str, str | None]:
        return {m["name"]: m["missing"] for m in json.loads(harness("model", "list", "--json")[1])}

    assert missing()["my-model"] == "weights"
    assert missing()["swarm-tiny"] is None
    (project / "models/my-model").symlink_to(resources.folder("models") / "swarm-tiny")
    assert missing()["my-model"] is None


@pytest.mark.slow
def test_a_name_that_ships_is_refused(harness: Harness, project: Path) -> None:
    (project / "prompts/mine").rename(project / "prompts/v2")
    assert harness("eval", "--prompt", "v2") == (
        2, "", 
            "harness: prompts/v2 is in this project and ships with the harness; give yours "
            "another name\n",
    )  # fmt: skip
    (project / "models/my-model.toml").rename(project / "models/proxy.toml")
    assert harness("eval", "--prompt", "v1")[2].startswith(
        "harness: models/proxy.toml is in this project and"
    )


@pytest.mark.slow
def test_its_settings_run_as_they_are(harness: Harness, project: Path) -> None:
    typed = ("--limit", "1", "--seeds", "0", "--quiet", "--out", "tried")
    assert harness("eval", "settings.toml", *typed) == (0, "", "")
    manifest = json.loads((project / "tried/run.json").read_text())
    assert (manifest["model"]["name"], manifest["prompt"]["version"]) == ("proxy", "mine")
    assert [condition["name"] for condition in manifest["conditions"]] == ["single-local", "6g"]
    assert harness("eval", "settings.toml", "--limit", "2", "--dry-run", "--quiet") == (0, "", "")


def test_each_line_of_its_settings_can_be_switched_on(project: Path) -> None:
    file = project / "settings.toml"
    usual = settings.read(file, settings.FrozenSettings, {})
    text, switched = re.subn(r"(?m)^# (?=\w+ = )", "", file.read_text())
    assert switched > 6
    file.write_text(text)
    every = settings.read(file, settings.FrozenSettings, {})
    assert (every.answer, every.tag, every.extensions) == (
        "constrained",
        ("first",),
        {"danger": "left", "helper_model": "swarm-tiny", "helper_prompt": "v2"},
    )
    assert (usual.answer, usual.tag, usual.extensions) == ("json", (), {})
    assert usual.condition == every.condition == ("single-local", "6g")


def test_a_prompt_is_released_in_its_project(harness: Harness, project: Path) -> None:
    shipped = (resources.folder("prompts") / "released.toml").read_bytes()
    assert harness("prompt", "release", "mine")[0] == 0
    assert prompts.load("mine").released
    assert (project / "prompts/released.toml").is_file()
    assert (resources.folder("prompts") / "released.toml").read_bytes() == shipped
    ego = project / "prompts/mine/ego.j2"
    ego.write_text(ego.read_text() + "\n")
    assert (
        "prompt mine was released and its text has changed"
        in harness("eval", "--prompt", "mine")[2]
    )


def test_a_card_with_a_mistake_is_what_a_doctor_tells(harness: Harness, project: Path) -> None:
    (project / "models/my-model.toml").write_text("engine = 3")
    code, out, err = harness("model", "doctor", "--json")
    [told] = [m for m in json.loads(out)["models"] if m["name"] == "my-model"]
    assert (code, err, told["missing"]) == (0, "", "a sound card")
    assert "engine = 3; allowed: a text" in told["remedy"]


def test_a_new_repository_becomes_a_project(harness: Harness, tmp_path: Path) -> None:
    (tmp_path / "here/.git").mkdir(parents=True)
    assert harness("init", "here")[0] == 0
    assert {".git", "prompts", "README.md"} <= {path.name for path in (tmp_path / "here").iterdir()}


def test_a_folder_that_is_not_empty_is_refused_and_left(harness: Harness, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/x\x1b").touch()
    (tmp_path / "file").touch()
    for name, state in (("full", "not empty"), ("file", "a file")):
        said = f"harness: {name} is {state}; give a new folder, or an empty one\n"
        assert harness("init", name) == (2, "", said)
    assert os.listdir(tmp_path / "full") == ["x\x1b"]
    code, out, err = harness("init", "file/below")
    assert (code, out) == (2, "")
    assert err.startswith("harness: file/below cannot be made (")


def test_a_full_disk_is_one_line_and_leaves_nothing(
    harness: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copyfile(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    code, _, error = harness("init", "mine")
    assert code == 2
    assert error == "harness: mine cannot be made (No space left on device); give another folder\n"
    assert not [*Path("mine").iterdir()]


def test_an_empty_folder_will_do(harness: Harness, tmp_path: Path) -> None:
    assert harness("init", ".")[0] == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        "README.md", "models", "prompts", "settings.toml", "swarmdrive.toml",
    }  # fmt: skip


def test_what_is_there_already_is_not_written_over(harness: Harness, tmp_path: Path) -> None:
    """By whatever path it is named; nor is a folder made whose name nothing can show."""
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "README.md").write_text("mine")
    for typed in (mine, tmp_path / "absent" / ".." / "mine"):
        code, _, err = harness("init", typed)
        assert (code, "is not empty; give a new folder" in err) == (2, True)
    assert (mine / "README.md").read_text() == "mine"
    code, _, err = harness("init", tmp_path / "x\x1b[31m")
    assert (code, "has characters that nothing can show" in err) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
