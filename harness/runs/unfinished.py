"""How far an unfinished run is, read from its working folder while another process may be writing
there.
"""

import csv
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from io import TextIOWrapper
from pathlib import Path

from harness.core.files import BROKEN, opened, text_of
from harness.core.formats import CONFIG, WORK
from harness.core.work import LOCK
from harness.runs.formats import LOOKS


@dataclass(frozen=True)
class Extent:
    """Hold how far an unfinished run is, as `extent` reads it from its folder.

    `done` of `due` episodes are at their end, and `answers` is the number of answers kept for the
    others; `due` is None for a part of a run. `going` says whether a process works on it now, and
    `early` whether it may stop once it has seen enough.
    """

    going: bool  # whether a process works on it now
    done: int  # number of episodes that are at their end in all conditions and seeds
    # number of episodes that the run has; None for a shard, one of several parts of a run that are
    # made apart
    due: int | None
    early: bool  # whether the run may stop before, once it has seen enough
    answers: int  # number of answers that are kept for the episodes which are not at their end


def extent(run: Path) -> Extent:
    """Return how far an unfinished run in a folder is; broken files and links count as not done.

    Episodes count once their part of the run, a folder of some episodes, is written; `answers`
    counts those stored for parts that are not.
    """
    work = run / WORK
    names = _names(work)
    parts = [name for name in names if name.startswith("episodes-")]
    done = sum(_episodes(work / name) for name in parts if _is_own_folder(work / name))
    kept = [
        name
        for name in names
        if name.endswith(".jsonl") and name.startswith(("answers", "episodes-"))
    ]
    due, early = _due(work)
    return Extent(_locked(work / LOCK), done, due, early, sum(_lines(work / name) for name in kept))


def _names(folder: Path) -> list[str]:
    with suppress(OSError):  # it may be gone by now
        return sorted(os.listdir(folder)) if _is_own_folder(folder) else []
    return []


def _is_own_folder(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink()


def _due(work: Path) -> tuple[int | None, bool]:
    try:
        config = json.loads(text_of(work / CONFIG, "record"))
        world = config["settings"]["world"]
        return None if config.get("shard") else int(world["episodes"]), bool(world.get(LOOKS))
    except (*BROKEN, AttributeError):
        return None, False


def _episodes(part: Path) -> int:
    """Count the episodes of a part, which is whole and does not change."""
    file = part / "episodes.csv"
    try:
        return 0 if file.is_symlink() else _numbers(file, file.stat().st_mtime_ns)
    except (*BROKEN, csv.Error):
        return 0


@lru_cache(maxsize=1 << 16)
def _numbers(file: Path, written_ns: int) -> int:
    with opened(file, "rows") as data, TextIOWrapper(data, "utf-8-sig", newline="") as text:
        rows = csv.reader(text)
        at = next(rows, []).index("episode")
        return len({row[at] for row in rows})


def _lines(file: Path) -> int:
    if file.is_symlink():
        return 0
    with suppress(OSError), opened(file, "rows") as lines:  # it may be gone by now
        return sum(1 for line in lines if line.endswith(b"\n"))
    return 0


def _locked(lock: Path) -> bool:
    """Return whether a process holds a lock;
    where there are no such locks (Windows), none is known to.
    """
    try:
        import fcntl
    except ImportError:
        return False
    try:
        # Shared, and on a file that is not made here: a run that begins at this moment tries again.
        with opened(lock, "text") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
