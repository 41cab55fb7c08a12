"""The workflow of `examples/ci.yml`: its steps in a repository with a pull request, GitHub's part played."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOW = yaml.safe_load((ROOT / "examples/ci.yml").read_text())
STEPS = {step["name"]: step for step in WORKFLOW["jobs"]["prompt"]["steps"] if "run" in step}
GH = """#!/bin/sh
echo "$@" >> "$TOLD/gh.txt"
cp "$5" "$TOLD/comment.md"
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("llama_cpp") is None, reason="needs the extra llama-cpp"),
]


def git(repo: Path, *words: str) -> str:
    who = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    done = subprocess.run(["git", *who, *words], cwd=repo, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def repo(tmp_path: Path) -> Path:
    """A project in a repository, and beside it the programs that a runner has."""
    folder, programs = tmp_path / "repo", tmp_path / "programs"
    programs.mkdir()
    (programs / "gh").write_text(GH)
    (programs / "harness").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m harness "$@"\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    subprocess.run([sys.executable, "-m", "harness", "init", folder], check=True, env=environment(tmp_path))
    git(folder, "init", "--quiet")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "as it was")
    return folder


def environment(place: Path) -> dict[str, str]:
    return os.environ | {
        "PATH": f"{place / 'programs'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT), "TOLD": str(place),
        "RUNNER_TEMP": str(place / "temp"), "GITHUB_STEP_SUMMARY": str(place / "summary.md"),
    }  # fmt: skip


def played(step: str, repo: Path, github: dict[str, str]) -> int:
    """The exit code of a step's commands, as GitHub runs them."""

    def filled(value: Any) -> str:
        return re.sub(r"\$\{\{ (\S+) \}\}", lambda found: github[found[1]], str(value))

    more = {name: filled(value) for name, value in (WORKFLOW["env"] | STEPS[step].get("env", {})).items()}
    more |= {"SETTINGS": "--limit 2 --condition 6g --seeds 0:1"}  # of 40 layouts
    command = ["bash", "--noprofile", "--norc", "-e", "-c", STEPS[step]["run"]]
    return subprocess.run(command, cwd=repo, env=environment(repo.parent) | more, check=False).returncode


@pytest.mark.parametrize("breaks", [False, True])
def test_the_workflow_guards_a_prompt(breaks: bool, repo: Path, tmp_path: Path) -> None:
    base = git(repo, "rev-parse", "HEAD")
    prompt = repo / "prompts" / "mine" / "ego.j2"
    asks_nothing = "{% block system %}Say hello.{% endblock %}{% block user %}Hello?{% endblock %}"
    prompt.write_text(asks_nothing if breaks else prompt.read_text() + "\n")
    git(repo, "commit", "--quiet", "--all", "--message", "as a pull request has it")
    pull = "github.event.pull_request"
    github = {f"{pull}.base.sha": base, f"{pull}.number": "7", "github.token": "none"}
    install, evaluate, compare, *says = STEPS
    assert STEPS[install]["run"].startswith("pip install 'swarmdrive-harness[")
    assert played(evaluate, repo, github) == 0
    assert played(compare, repo, github) == int(breaks), "the gates decide"
    assert [played(step, repo, github) for step in says] == [0, 0]
    assert all("!cancelled()" in STEPS[step]["if"] for step in says), "a failed gate is said as well"
    comparison = (repo / "comparison.md").read_text()
    assert "fallback" in comparison if breaks else comparison
    assert (tmp_path / "summary.md").read_text() == comparison
    assert (tmp_path / "comment.md").read_text() == comparison
    told = (tmp_path / "gh.txt").read_text()
    assert told == "pr comment 7 --body-file comment.md --edit-last --create-if-none\n"
    failures = ElementTree.parse(repo / "gates.xml").findall(".//failure")
    assert bool(failures) == breaks
    assert (repo / "comparison.html").is_file()
