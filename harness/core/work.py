"""A working folder: what a stopped command leaves in the folder it makes, so that the same command goes on.

`.work/config.json` says what the work began with, and the work counts only once that is there. One process
at a time holds the folder.
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from harness.core.errors import Unfinished, UserError, printable
from harness.core.files import alone, forget_halves, write_whole
from harness.core.formats import CONFIG, WORK

LOCK = "lock"
GONE_S = 3.0  # within which the processes of a killed command are gone


class Begun(msgspec.Struct, frozen=True, kw_only=True):
    """What work began with.

    Attributes:
        settings: what has to be the same for it to go on, as plain values.
        shard: which part of the work it is, such as `3/16`; empty for the whole.
    """

    settings: dict[str, Any]
    shard: str = ""

    def facts(self) -> dict[str, Any]:
        """What has to be the same for all shards of a work."""
        return self.settings


Kind = TypeVar("Kind", bound=Begun)


def begun(out: Path, kind: type[Kind]) -> Kind | None:
    """What the work that is left in a folder began with; None where the folder is new, or has none.

    Raises:
        UserError: the work is damaged, or something else is in the folder.
    """
    shown, file = printable(out), out / WORK / CONFIG
    try:
        if file.is_file():
            return msgspec.json.decode(file.read_bytes(), type=kind)
        others = out.is_dir() and any(path.name != WORK for path in out.iterdir())
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(file)} is damaged ({printable(error)}); delete --out {shown} and start again"
        ) from None
    if others or (out.exists() and not out.is_dir()):
        what = "a folder with other files in it" if others else "no folder"
        raise UserError(f"--out {shown} is {what}; choose an empty or a new one")
    return None


def same(out: Path, now: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Raise UserError, naming what differs, unless work began with these settings."""
    now = msgspec.json.decode(msgspec.json.encode(now))  # lists for tuples
    if other := [key for key in {**now, **stored} if now.get(key) != stored.get(key)]:
        raise UserError(
            f"--out {printable(out)} was begun with another {printable(', '.join(other))}; "
            "repeat its settings, delete it, or choose another folder"
        )


def held(out: Path) -> bool:
    """Whether another process is at work in a folder."""
    try:
        with alone(out / WORK / LOCK, GONE_S):
            return False
    except BlockingIOError:
        return True


@contextmanager
def working(out: Path, begin: Begun, last: str | None = None) -> Iterator[Path]:
    """Hold the working folder, the one that was left or a new one that begins with this.

    Another process may have finished, and written the file named `last`, since this one looked: that is
    refused. Where an error of the user's ends it before anything is done, what was made goes again.
    """
    work, made = out / WORK, [path for path in (out, *out.parents) if not path.exists()]
    try:
        work.mkdir(parents=True, exist_ok=True)
        for path in (work, *work.iterdir()):
            if path.is_symlink():
                raise UserError(f"{printable(path)} is a link, which no command makes; delete it")
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be made ({error.strerror}); choose another folder"
        ) from None
    try:
        with alone(work / LOCK, GONE_S), going_on(out):
            left = begun(out, type(begin))  # by another process, since this one looked
            if left is None:
                for path in work.iterdir():
                    if path.name != LOCK:
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
                write_whole(work / CONFIG, msgspec.json.encode(begin))
            elif left != begin or (last and (out / last).exists()):
                raise BlockingIOError
            yield work
    except BlockingIOError:
        raise UserError(f"--out {printable(out)} is being written by another process; wait for it") from None
    except (UserError, OSError):
        with suppress(OSError):  # another process may be at work in any of them by now
            if {path.name for path in work.iterdir()} <= {CONFIG, LOCK}:
                shutil.rmtree(work)
                for path in made:
                    path.rmdir()
        raise


@contextmanager
def going_on(out: Path) -> Iterator[None]:
    """Have whoever interrupts this, or leaves parts of it undone, told that nothing is lost."""
    try:
        yield
    except (KeyboardInterrupt, Unfinished) as stopped:
        stopped.add_note(f"{printable(out)} keeps what is done")
        raise


def tidy(out: Path) -> None:
    """Remove what the work left, and what kills left of files half written."""
    with suppress(OSError):  # first, so that nothing goes on with half of it
        os.unlink(out / WORK / CONFIG)
    shutil.rmtree(out / WORK, ignore_errors=True)
    forget_halves(out)
