"""What the base install can do without the extras, and what it says of the rest."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from harness.core.extras import OPTIONAL

ROOT = Path(__file__).parent.parent
# A process that finds none of these packages.
BARE = """
import sys
from importlib.machinery import PathFinder

hidden, *lines = sys.argv[1:]

class Bare(PathFinder):
    @classmethod
    def find_spec(cls, name, *place):
        return None if name in hidden.split() else super().find_spec(name, *place)

sys.meta_path = [Bare if finder is PathFinder else finder for finder in sys.meta_path]
"""
# Each command line in turn.
TYPED = """
from harness.cli import main
for line in lines:
    sys.argv = ["harness", *line.split()]
    try:
        main()
    except SystemExit as ended:
        print(f"exit {ended.code or 0}", file=sys.stderr)
"""


FROM_PYTHON = """
import harness

run = harness.run(model="proxy", limit=1, seeds="0", out="a", quiet=True)
tables = harness.load("a")
assert len(tables.episodes) == 3 and len(tables.agents) == 0 and len(tables.answers) > 3
assert list(harness.ls(".").name) == ["a"]
for shown in (tables, harness.compare(run, "a"), harness.sweep(run, "loss", "0,0.4", quiet=True)):
    assert shown._repr_html_()
"""


def bare(folder: Path, *lines: str, script: str = TYPED) -> str:
    """What these commands, or a script, say on stderr where no optional package is installed."""
    blocked = " ".join({*OPTIONAL, "gymnasium", "pygame"})
    python = [sys.executable, "-c", BARE + script, blocked, *lines]
    done = subprocess.run(python, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_each_optional_package_is_in_its_extra_and_in_no_base() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = {re.split(r"[<>=\[]", line)[0] for line in project["dependencies"]}
    for package, extra in OPTIONAL.values():
        assert package not in base
        if package != "pillow":  # matplotlib brings it
            assert any(
                re.match(rf"{package}\b", line) for line in project["optional-dependencies"][extra]
            )


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
    "eval --model uniform --dataset suite:v2v-safety-2 --limit 1": ("highway-env", "sim"),
    "eval --model swarm-tiny": ("llama-cpp-python", "llama-cpp"),
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


@pytest.mark.exhaustive
def test_python_needs_no_extra_for_what_the_commands_need_none_for(tmp_path: Path) -> None:
    assert bare(tmp_path, script=FROM_PYTHON) == ""


@pytest.mark.slow
def test_what_teaches_says_in_one_line_which_extra_it_needs(tmp_path: Path) -> None:
    pytest.importorskip("harness.extensions.learn")
    code = """
import harness
try:
    harness.environment()
except harness.UserError as error:
    print(error, file=sys.stderr)
"""
    needs = "needs {}, which is not installed; run `pip install 'swarmdrive-harness[{}]'`\n"
    assert bare(tmp_path, script=code) == "an environment " + needs.format("highway-env", "sim")
    said = bare(tmp_path, "model distill do-not-pass --out student")
    assert said.endswith(f"{needs.format('torch', 'transformers')}exit 2\n")


SWEEP = "study sweep a --over loss --grid 0,0.4 --seeds 0 --pictures"
NO_FIGURES = (
    "harness: drawing figures needs matplotlib, which is not installed; "
    "run `pip install 'swarmdrive-harness[report]'`\n"
)


@pytest.mark.exhaustive
def test_a_study_without_matplotlib_has_its_tables_and_page_and_says_what_figures_need(
    tmp_path: Path,
) -> None:
    ask = "eval --model proxy --limit 1 --seeds 0 --quiet --out a"
    lines = (
        ask,
        f"{SWEEP} --out swept",
        f"{SWEEP} --out silent --quiet",
        f"{SWEEP} --out told --json",
    )
    printed = bare(tmp_path, *lines).splitlines(keepends=True)
    # A sweep also says its points as they are known.
    said = "".join(line for line in printed if line.startswith(("exit", "harness")))
    assert said == f"exit 0\n{NO_FIGURES}exit 0\nexit 0\n{NO_FIGURES}exit 0\n"
    files = {"conditions.csv", "conditions.jsonl", "episodes.csv", "episodes.jsonl"}
    for study in ("swept", "silent", "told"):
        assert {file.name for file in (tmp_path / study).iterdir()} == {
            *files,
            "index.html",
            "sweep.json",
        }
    assert "<img" not in (tmp_path / "swept/index.html").read_text()


STUDIES = {  # what draws besides, and where it writes by itself
    "study contents a --condition 6g --over loss --grid 0,0.4": "a/contents",
    "study schedule compare a --out s --schedule always": "s",
    "study trust a": "a/trust",
    "study twins --model proxy --limit 2 --out t": "t",
    "study grid --model proxy --prompt v2,v3 --limit 2 --out g": "g",
    "study sweep a --over loss --over tau --grid 0,0.4 --grid 0.5,0.7 --out m": "m",
    "study paper --out paper": "paper",
}


@pytest.mark.exhaustive
def test_every_study_ends_well_without_matplotlib(tmp_path: Path) -> None:
    lines = [f"{line} --pictures" for line in STUDIES]
    said = bare(tmp_path, "eval --model proxy --limit 2 --quiet --out a", *lines)
    assert re.findall(r"^exit (\S+)", said, re.MULTILINE) == ["0"] * (1 + len(STUDIES)), said
    assert said.count(NO_FIGURES) == len(STUDIES)
    for folder in STUDIES.values():
        assert (tmp_path / folder / "index.html").is_file()
        assert list((tmp_path / folder).glob("*.json")), "its manifest"
        assert not list((tmp_path / folder).glob("*.svg"))


@pytest.mark.slow
def test_a_frozen_evaluation_needs_no_extra(tmp_path: Path) -> None:
    assert bare(tmp_path, "eval --model proxy --limit 1 --seeds 0 --quiet --out a") == "exit 0\n"
    assert (tmp_path / "a/report.html").is_file()
