"""The workflow of `examples/ci.yml`: its steps in a repository with a pull request,
GitHub's part played.
"""

import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOW = yaml.safe_load((ROOT / "examples/ci.yml").read_text())
STEPS = {step["name"]: step for step in WORKFLOW["jobs"]["prompt"]["steps"] if "run" in step}
# A pull request's comments, as GitHub's API lists them: of others, and of a stranger who typed the
# mark.
COMMENTS: list[dict[str, Any]] = [
    {"id": 1, "user": {"login": "github-actions[bot]"}, "body": "of another workflow"},
    {"id": 2, "user": {"login": "stranger"}, "body": "<!-- swarmdrive mine -->"},
    {"id": 3, "user": {"login": "github-actions[bot]"}, "body": "<!-- swarmdrive another -->"},
]
GH = """
import json, os, subprocess, sys
from pathlib import Path

file = Path(os.environ["COMMENTS"])
comments = json.loads(file.read_text())
match sys.argv[1:]:
    case ["api", "--paginate", "repos/me/it/issues/7/comments", "--jq", query]:
        subprocess.run(["jq", "--raw-output", query], input=json.dumps(comments), text=True, check=True)
    case ["api", "--method", "PATCH", path, "--field", field, "--silent"]:
        [comment] = [each for each in comments if path == f"repos/me/it/issues/comments/{each['id']}"]
        comment["body"] = Path(field.removeprefix("body=@")).read_text()
    case ["pr", "comment", "7", "--body-file", body]:
        new = {"user": {"login": "github-actions[bot]"}, "body": Path(body).read_text()}
        comments.append({"id": 1 + len(comments), **new})
    case typed:
        sys.exit(f"gh {typed}")
file.write_text(json.dumps(comments))
"""

pytestmark = [
    pytest.mark.skipif(find_spec("llama_cpp") is None, reason="needs the extra llama-cpp"),
    pytest.mark.skipif(which("jq") is None, reason="needs jq, which stands in for the one in gh"),
]


def git(repo: Path, *words: str) -> str:
    who = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    done = subprocess.run(
        ["git", *who, *words], cwd=repo, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.fixture
def repo(tmp_path: Path) -> Path:
    """A project in a repository, and beside it the programs that a runner has."""
    folder, programs = tmp_path / "repo", tmp_path / "programs"
    programs.mkdir()
    (programs / "gh").write_text(f"#!{sys.executable}\n{GH}")
    (tmp_path / "comments.json").write_text(json.dumps(COMMENTS))
    (programs / "harness").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m harness "$@"\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    subprocess.run(
        [sys.executable, "-m", "harness", "init", folder], check=True, env=environment(tmp_path)
    )
    git(folder, "init", "--quiet")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "as it was")
    return folder


def environment(place: Path) -> dict[str, str]:
    return os.environ | {
        "PATH": f"{place / 'programs'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT),
        "COMMENTS": str(place / "comments.json"), "GITHUB_REPOSITORY": "me/it",
        "RUNNER_TEMP": str(place / "temp"), "GITHUB_STEP_SUMMARY": str(place / "summary.md"),
    }  # fmt: skip


def played(step: str, repo: Path, github: dict[str, str]) -> int:
    """The exit code of a step's commands, as GitHub runs them."""

    def filled(value: Any) -> str:
        return re.sub(r"\$\{\{ (\S+) \}\}", lambda found: github[found[1]], str(value))

    more = {
        name: filled(value)
        for name, value in (WORKFLOW["env"] | STEPS[step].get("env", {})).items()
    }
    more |= {"SETTINGS": "--limit 2 --condition 6g --seeds 0:1"}  # of 40 layouts
    command = ["bash", "--noprofile", "--norc", "-e", "-c", STEPS[step]["run"]]
    return subprocess.run(
        command, cwd=repo, env=environment(repo.parent) | more, check=False
    ).returncode


def github_of(base: str) -> dict[str, str]:
    pull = "github.event.pull_request"
    return {f"{pull}.base.sha": base, f"{pull}.number": "7", "github.token": "none"}


DRY = (
    "--dry-run --no-deps --no-index --no-build-isolation --ignore-installed --report installed.json"
)
PIP = f'#!/bin/sh\nexec "{sys.executable}" -m pip "$@" {DRY}\n'


@pytest.mark.exhaustive
def test_it_installs_the_harness_from_where_the_repository_has_it(
    repo: Path, tmp_path: Path
) -> None:
    (tmp_path / "programs/pip").write_text(PIP)
    (tmp_path / "programs/pip").chmod(0o755)
    assert played("Install", repo, {}) > 0, "there is nothing at the place that the example names"
    assert WORKFLOW["env"]["HARNESS"].startswith("./")
    there = repo / WORKFLOW["env"]["HARNESS"]
    there.parent.mkdir()
    there.symlink_to(ROOT)
    assert played("Install", repo, {}) == 0
    [installed] = json.loads((repo / "installed.json").read_text())["install"]
    assert installed["metadata"]["name"] == "swarmdrive-harness"
    assert installed["requested_extras"] == ["llama-cpp"]
    assert installed["download_info"]["url"] == there.as_uri()


@pytest.mark.exhaustive
@pytest.mark.parametrize("breaks", [False, True])
def test_the_workflow_guards_a_prompt(breaks: bool, repo: Path, tmp_path: Path) -> None:
    base = git(repo, "rev-parse", "HEAD")
    prompt = repo / "prompts" / "mine" / "ego.j2"
    asks_nothing = "{% block system %}Say hello.{% endblock %}{% block user %}Hello?{% endblock %}"
    prompt.write_text(asks_nothing if breaks else prompt.read_text() + "\n")
    git(repo, "commit", "--quiet", "--all", "--message", "as a pull request has it")
    github = github_of(base)
    install, evaluate, compare, *says = STEPS
    assert install == "Install"
    assert played(evaluate, repo, github) == 0
    assert played(compare, repo, github) == int(breaks), "the gates decide"
    assert [played(step, repo, github) for step in says] == [0, 0]
    assert all("!cancelled()" in STEPS[step]["if"] for step in says), (
        "a failed gate is said as well"
    )
    comparison = (repo / "comparison.md").read_text()
    assert "fallback" in comparison if breaks else comparison
    assert (tmp_path / "summary.md").read_text() == comparison
    *others, mine = json.loads((tmp_path / "comments.json").read_text())
    assert (others, mine["body"]) == (COMMENTS, f"<!-- swarmdrive mine -->\n{comparison}")
    (repo / "comparison.md").write_text("of a second push")
    assert played(says[-1], repo, github) == 0
    *others, mine = json.loads((tmp_path / "comments.json").read_text())
    assert (others, mine["body"]) == (COMMENTS, "<!-- swarmdrive mine -->\nof a second push")
    failures = ElementTree.parse(repo / "gates.xml").findall(".//failure")
    assert bool(failures) == breaks
    assert (repo / "comparison.html").is_file()


@pytest.mark.slow
def test_a_prompt_that_is_new_is_compared_with_nothing_and_that_is_said(
    repo: Path, tmp_path: Path
) -> None:
    git(repo, "rm", "-r", "--quiet", "prompts/mine")
    git(repo, "commit", "--quiet", "--message", "before it was there")
    base = git(repo, "rev-parse", "HEAD")
    git(repo, "revert", "--no-edit", base)
    _, *steps = STEPS
    assert [played(step, repo, github_of(base)) for step in steps] == [0] * len(steps)
    assert (repo / "reports/guarded/run.json").is_file()
    said = "`mine` is new here: there is nothing to compare it with, and no gate was checked.\n"
    assert (tmp_path / "summary.md").read_text() == said
    assert json.loads((tmp_path / "comments.json").read_text())[-1]["body"].endswith(f"-->\n{said}")
    assert not (repo / "gates.xml").exists()
