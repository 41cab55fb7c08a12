"""What is kept between runs in the user's cache folder: it saves time, and is made again where it is gone."""

import os
from contextlib import suppress
from functools import cache
from pathlib import Path

from harness import __version__
from harness.core.files import digest, sha256_bytes, write_whole

_PACKAGE = Path(__file__).parent.parent


def folder() -> Path:
    """`$SWARMDRIVE_CACHE`, else the harness's folder in the user's cache folder."""
    if moved := os.environ.get("SWARMDRIVE_CACHE"):
        return Path(moved)
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches) / "swarmdrive-harness"


def recall(name: str) -> bytes | None:
    """What was kept under a name; None where nothing can be read."""
    try:
        return (folder() / name).read_bytes()
    except OSError:
        return None


def keep(name: str, data: bytes) -> None:
    """Keep something under a name, where the folder can be written."""
    with suppress(OSError):
        write_whole(folder() / name, data)


@cache
def code_sha256(*patterns: str) -> str:
    """Digest of the files of the package that match, so that other code finds nothing of what is kept."""
    files = sorted(file for pattern in patterns for file in _PACKAGE.glob(pattern))
    return digest([__version__, *(sha256_bytes(file.read_bytes()) for file in files)])
