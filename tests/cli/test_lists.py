"""A file that is wrong stands in its list as such; only the command that needs it fails."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("svg_alone")

Typed = Callable[..., tuple[int, str, str]]
# What is listed, by which command, what else it must have, and a command that needs the wrong one.
LISTS = {
    "models": (("model", "list"), "proxy", ("eval", "--model", "bad")),
    "devices": (("model", "device", "list"), "agx-orin", ("model", "device", "show", "bad")),
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project in which each file is wrong."""
    (tmp_path / "swarmdrive.toml").touch()
    for kind in (*LISTS, "channels", "networks", "schedules"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "bad.toml").write_text("model = [\n")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("kind", LISTS)
def test_a_wrong_file_stands_in_its_list(kind: str, project: Path, harness: Typed) -> None:
    command, sound, needs = LISTS[kind]
    code, said, _ = harness(*command)
    assert code == 0
    lines = said.splitlines()
    place = lines.index("bad · wrong")
    assert f"{kind}/bad.toml" in lines[place + 1]
    assert any(line.startswith(sound) for line in lines)
    code, said, _ = harness(*command, "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(said)}
    assert f"{kind}/bad.toml" in rows["bad"]["error"]
    assert "error" not in rows[sound]
    code, _, said = harness(*needs)
    assert (code, said.count("\n")) == (2, 1)
    assert f"{kind}/bad.toml" in said


@pytest.mark.exhaustive
def test_what_needs_another_file_does_not_fail(
    project: Path, harness: Typed, small_path: Path
) -> None:
    few = ("--limit", "1", "--seeds", "0", "--condition", "6g", "--quiet")
    assert harness("eval", "--dataset", small_path, *few, "--out", "run")[0] == 0
    for command in (
        ("study", "sweep", "run", "--over", "reliability", "--grid", "1"),
        ("study", "sweep", "run", "--over", "loss", "--grid", "0"),
        ("study", "schedule", "compare", "run", "--schedule", "never"),
    ):
        code, _, said = harness(*command)
        assert "bad.toml" not in said, command
        assert code == 0 or "unknown" in said, said


def test_a_wrong_file_of_suites_takes_no_shipped_suite_with_it(
    project: Path, harness: Typed
) -> None:
    from harness.dataset.suites import named

    (project / "datasets").mkdir()
    (project / "datasets/suites.toml").write_text("[mine\n")
    assert named("suite:v2v-safety").datasets
    code, _, said = harness("eval", "--dataset", "suite:mine")
    assert (code, "datasets/suites.toml" in said) == (2, True)
