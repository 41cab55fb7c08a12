"""Which extensions a change concerns, as git knows it."""

import re
import subprocess
from collections.abc import Iterable
from functools import cache
from pathlib import Path

OF_AN_EXTENSION = re.compile(r"(?:harness|tests)/extensions/(\w+)/")
# What no extension's tests are about: tests of others, and pages. All else is the core's.
OF_NONE = re.compile(r"(?:benchmarks|docs|reports)/|tests/(?:\w+/)*test_\w+\.py$|[^/]+\.md$")


def stayed(folder: Path, root: Path) -> bool:
    """Whether a folder has tests of an extension that no change concerns."""
    own = OF_AN_EXTENSION.match(f"{folder.relative_to(root).as_posix()}/")
    files = changed(root)
    return own is not None and files is not None and not concerns(files, own[1])


def concerns(files: Iterable[str], extension: str) -> bool:
    """Whether one of these files is this extension's or the core's."""
    for file in files:
        own = OF_AN_EXTENSION.match(file)
        if own[1] == extension if own else not OF_NONE.match(file):
            return True
    return False


@cache
def changed(root: Path) -> tuple[str, ...] | None:
    """Name files that differ from where main was left, committed or not;
    None where git cannot say.
    """
    try:
        [left] = _git(root, "merge-base", "HEAD", "main")
        differing = _git(root, "diff", "--name-only", "--no-renames", left)
        return (*differing, *_git(root, "ls-files", "--others", "--exclude-standard"))
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(root: Path, *words: str) -> list[str]:
    typed = ("git", "-C", str(root), *words)
    return subprocess.run(typed, capture_output=True, text=True, check=True).stdout.splitlines()
