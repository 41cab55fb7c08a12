"""Keep data between runs in the user's cache folder. It only saves time:
what is missing is made again.
"""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

from harness import __version__
from harness.core.files import alone, bytes_of, digest, sha256_file, write_whole

_PACKAGE = Path(__file__).parent.parent
PATIENCE_S = 3600.0  # for another process that makes the same


def folder() -> Path:
    """Return the cache folder, where things that can be computed again are kept.

    It is `$SWARMDRIVE_CACHE`, or else the harness's own folder in the user's cache folder.
    """
    if moved := os.environ.get("SWARMDRIVE_CACHE"):
        return Path(moved)
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches) / "swarmdrive-harness"


def recall(name: str) -> bytes | None:
    """Read what `keep` stored under a file name in the cache folder; None if it cannot be read."""
    try:
        return bytes_of(folder() / name, "rows")
    except OSError:
        return None


def keep(name: str, data: bytes) -> None:
    """Store data that can be computed again under a file name in the cache folder.

    Nothing is done if it cannot be written; `recall` reads it.
    """
    with suppress(OSError):
        write_whole(folder() / name, data)


def made(to: Path, make: Callable[[Path], None]) -> None:
    """Make a folder in the cache folder, unless it is there: all of it or nothing.

    `make` is called with the path at which to make it; other processes wait meanwhile. Raises
    OSError if it cannot be written.
    """
    to.parent.mkdir(parents=True, exist_ok=True)
    with alone(to.with_name(f".{to.name}.lock"), PATIENCE_S):
        if to.is_dir():
            return
        part = to.with_name(f".{to.name}.part")
        shutil.rmtree(part, ignore_errors=True)  # of a process that was killed
        try:
            make(part)
            os.replace(part, to)
        finally:
            shutil.rmtree(part, ignore_errors=True)


@cache
def code_sha256(*patterns: str) -> str:
    """Return a digest of the source files of `harness` that match glob patterns, and its version.

    It is part of cache keys that must change with the code. Patterns are such as `world/**/*.py`.
    """
    files = sorted(file for pattern in patterns for file in _PACKAGE.glob(pattern))
    return digest([__version__, *(sha256_file(file) for file in files)])
