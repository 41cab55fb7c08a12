"""What the base install can do without the extras, and what it says of the rest."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from harness.core.extras import OPTIONAL

ROOT = Path(__file__).parent.parent
# Each command line in turn, in one process that finds none of these packages.
BARE = """
import sys
from importlib.machinery import PathFinder

hidden, *lines = sys.argv[1:]

class Bare(PathFinder):
    @classmethod
    def find_spec(cls, name, *place):
        return None if name in hidden.split() else super().find_spec(name, *place)

sys.meta_path = [Bare if finder is PathFinder else finder for finder in sys.meta_path]
from harness.cli import main
for line in lines:
    sys.argv = ["harness", *line.split()]
    try:
        main()
    except SystemExit as ended:
        print(f"exit {ended.code or 0}", file=sys.stderr)
"""


def bare(folder: Path, *lines: str) -> str:
    """What these commands say on stderr where no optional package is installed."""
    blocked = " ".join({*OPTIONAL, "gymnasium", "pygame"})
    done = subprocess.run(
        [sys.executable, "-c", BARE, blocked, *lines], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stderr


def test_each_optional_package_is_in_its_extra_and_in_no_base() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = {re.split(r"[<>=\[]", line)[0] for line in project["dependencies"]}
    for package, extra in OPTIONAL.values():
        assert package not in base
        if package != "pillow":  # matplotlib brings it
            assert any(re.match(rf"{package}\b", line) for line in project["optional-dependencies"][extra])


@pytest.mark.exhaustive
def test_a_frozen_evaluation_and_what_is_done_with_it_need_no_extra(tmp_path: Path) -> None:
    lines = (
        "eval --model proxy --limit 2 --quiet --out a",
        "eval --model full-view --limit 2 --quiet --out b",
        "eval --model replay:a --limit 2 --quiet --out c",
        "report a b --out both.html",
        "compare a b",
        "run export a --csv",
        "run ls .",
        "prompt show v2 --scene 00000-0",
        "dataset check occluded-intersection-v2",
        "dataset scenario show occluded-intersection",
        "model list",
        "model doctor",
    )
    said = bare(tmp_path, *lines)
    assert re.findall(r"^exit (\S+)", said, re.MULTILINE) == ["0"] * len(lines), said
    assert (tmp_path / "a/report.html").is_file()


NEEDS = {
    "drive --model proxy --episodes 1": ("highway-env", "sim"),
    "dataset scenario drive occluded-intersection": ("highway-env", "sim"),
    "dataset build occluded-intersection --episodes 1 --out built": ("highway-env", "sim"),
    "dataset show occluded-intersection-v2 00000-0 --out scene.svg": ("matplotlib", "report"),
    "study paper --out paper": ("matplotlib", "report"),
    "eval --model swarm-tiny": ("llama-cpp-python", "llama-cpp"),
    "model distill do-not-pass --out student": ("torch", "transformers"),
}


@pytest.mark.slow
def test_what_needs_an_extra_says_in_one_line_which(tmp_path: Path) -> None:
    said = bare(tmp_path, *NEEDS).splitlines()
    for line, needs, ended in zip(NEEDS, said[::2], said[1::2], strict=True):
        package, extra = NEEDS[line]
        install = f"pip install 'swarmdrive-harness[{extra}]'"
        assert needs.endswith(f" needs {package}, which is not installed; run `{install}`"), line
        assert ended == "exit 2", line
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_frozen_evaluation_needs_no_extra(tmp_path: Path) -> None:
    assert bare(tmp_path, "eval --model proxy --limit 1 --seeds 0 --quiet --out a") == "exit 0\n"
    assert (tmp_path / "a/report.html").is_file()
