"""The hooks that run before a commit or a push are there to be run."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parent.parent
[REPO] = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
HOOKS: list[dict[str, Any]] = REPO["hooks"]


def test_no_hook_is_fetched() -> None:
    assert REPO["repo"] == "local"
    assert {hook["language"] for hook in HOOKS} == {"system", "pygrep"}


@pytest.mark.parametrize("hook", HOOKS, ids=[hook["id"] for hook in HOOKS])
def test_a_hook_is_a_program_of_the_dev_extra_or_of_every_machine(hook: dict[str, Any]) -> None:
    if hook["language"] == "pygrep":
        assert re.search(hook["entry"], "-----BEGIN RSA PRIVATE " + "KEY-----")
        return
    program = Path(shlex.split(hook["entry"])[0])
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    packages = {re.split(r"[><=\[]", line)[0] for line in extras["dev"]}
    package = {"lint-imports": "import-linter"}.get(program.name, program.name)
    assert str(program) == "bash" or program.parent == Path(".venv/bin")
    assert package in {*packages, "bash", "python"}


def test_what_is_checked_before_a_push_or_commit_is_what_make_checks() -> None:
    run = {
        Path(shlex.split(hook["entry"])[0]).name for hook in HOOKS if hook["language"] == "system"
    }
    [recipe] = re.findall(
        r"^check:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE
    )
    assert run - {"bash"} == set(re.findall(r"\$\(BIN\)/(\S+)", recipe))
