"""`--changed`: which extensions' tests `make quick` runs."""

import subprocess
from pathlib import Path

import pytest
from changes import changed, concerns, stayed


@pytest.mark.parametrize(
    ("file", "concerned"),
    [
        ("harness/extensions/learn/pairs/command.py", {"learn"}),
        ("tests/extensions/learn/teaching.py", {"learn"}),
        ("harness/extensions/__init__.py", {"learn", "view"}),
        ("harness/runs/folder.py", {"learn", "view"}),
        ("tests/evaluating.py", {"learn", "view"}),
        ("tests/drive/driving.py", {"learn", "view"}),
        ("pyproject.toml", {"learn", "view"}),
        ("prompts/v2/ego.j2", {"learn", "view"}),
        ("tests/drive/test_agents.py", set()),
        ("tests/extensions/test_extensions.py", set()),
        ("docs/extend.md", set()),
        ("README.md", set()),
    ],
)
def test_a_change_concerns_its_extension_or_all_of_them_or_none(
    file: str, concerned: set[str]
) -> None:
    assert {name for name in ("learn", "view") if concerns([file], name)} == concerned


@pytest.mark.slow
def test_an_extension_that_nobody_changed_since_main_is_stayed(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        own = ("-c", "user.name=me", "-c", "user.email=me@here")
        subprocess.run(("git", *own, *words), cwd=tmp_path, check=True, capture_output=True)

    def write(name: str, text: str) -> None:
        file = tmp_path / "harness/extensions" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    def run() -> list[str]:
        changed.cache_clear()
        folders = (
            tmp_path / "tests/extensions" / name for name in ("committed", "edited", "new", "same")
        )
        return [folder.name for folder in folders if not stayed(folder, tmp_path)]

    assert run() == ["committed", "edited", "new", "same"], "without git all run"
    git("init", "--initial-branch", "main")
    for name in ("committed", "edited", "same"):
        write(f"{name}/it.py", "then")
    git("add", ".")
    git("commit", "--message", "main")
    assert run() == []
    git("checkout", "-b", "mine")
    write("committed/it.py", "now")
    git("commit", "--all", "--message", "mine")
    write("edited/it.py", "now")
    write("new/it.py", "now")
    assert run() == ["committed", "edited", "new"]
    assert not stayed(tmp_path / "tests/sim", tmp_path), "the core's always run"
