"""The working folder of a command, from which the same command resumes after it was stopped.

It is the folder `.work` inside the output folder. Its `config.json` holds the settings that the
work began with; without that file there is nothing to resume. A lock keeps the folder to one
process at a time.
"""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from harness.core.errors import (
    Unanswered,
    Unfinished,
    UserError,
    one_line,
    printable,
    sayable_path,
)
from harness.core.files import alone, forget_halves, text_of, write_whole
from harness.core.formats import CONFIG, QUESTIONS, WORK

LOCK = "lock"
UNANSWERED = "unanswered.txt"  # why the work stopped, if the model could not be asked
MOST_WORDS = 10_000  # characters of it that are read
GONE_S = 3.0  # seconds until the processes of a killed command are gone
LEVELS = 3  # of tables of settings that a message goes down, as to `kept/calibrations/mine`
SHORT = 30  # most characters of a setting's value that a message has


class WorkStart(msgspec.Struct, frozen=True, kw_only=True):
    """Hold the settings that a command's work began with, as its working folder stores them.

    A working folder is `.work` in the output folder; from it the same command resumes after it was
    stopped. `settings` has plain values by name, which must be the same for that; `shard` says
    which part of the work is done here, such as `3/16`, empty for the whole.
    """

    settings: dict[str, Any]  # plain values that must be the same for the work to be resumed
    shard: str = ""  # which part of the work this is, such as `3/16`; empty for the whole

    def facts(self) -> dict[str, Any]:
        """Return the values, by name, that must be equal in all shards of one work.

        A shard is a part of the work that is done apart.
        """
        return self.settings


Kind = TypeVar("Kind", bound=WorkStart)


def start_of(out: Path, kind: type[Kind]) -> Kind | None:
    """Read what the unfinished work in an output folder began with; None if there is none.

    None means that the folder is new or empty, or that its work stopped before anything was done.
    `kind` is the type of the record to read, a `WorkStart`. Raises UserError if the file is
    damaged, or the folder holds something else.
    """
    sayable_path("--out", out)
    folder, file = printable(out), out / WORK / CONFIG
    try:
        if file.is_file() and not idle(out):
            return msgspec.json.decode(text_of(file, "record"), type=kind)
        occupied = out.is_dir() and any(
            path.name not in (WORK, QUESTIONS) for path in out.iterdir()
        )
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(file)} is damaged ({printable(error)}); delete --out {folder} and start "
            "again"
        ) from None
    if occupied or (out.exists() and not out.is_dir()):
        what = "a folder with other files in it" if occupied else "no folder"
        raise UserError(f"--out {folder} is {what}; choose an empty or a new one")
    return None


def unanswered(out: Path) -> str | None:
    """Return why a stopped command could not ask its model; None if it stopped otherwise.

    `out` is its output folder. It may also be a study's folder, whose runs are subfolders: the
    first such reason is returned.
    """
    for place in (out, *([] if (out / "run.json").is_file() else sorted(out.glob("*/")))):
        with suppress(OSError, ValueError, UserError):
            return printable(text_of(place / WORK / UNANSWERED), MOST_WORDS)
    return None


def idle(out: Path) -> bool:
    """Return whether the work in a folder stopped before its model answered anything.

    Then nothing is lost if the work begins anew, with other settings. `out` is a command's output
    folder.
    """
    work = out / WORK
    with suppress(OSError):
        return (work / UNANSWERED).is_file() and _nothing_done(work)
    return False


def _nothing_done(work: Path) -> bool:
    return {path.name for path in work.iterdir()} <= {CONFIG, f"seal-{CONFIG}", LOCK, UNANSWERED}


def waits(out: Path) -> bool:
    """Return whether a folder holds nothing but questions for another program to answer."""
    with suppress(OSError):
        return [path.name for path in out.iterdir()] == [QUESTIONS]
    return False


def same(
    out: Path,
    now: Mapping[str, Any],
    stored: Mapping[str, Any],
    typed: Callable[[], str] = lambda: "",
) -> None:
    """Raise UserError, naming the differences, unless a stopped command is typed again as before.

    Work goes on only with the settings that it began with.

    Args:
        out: the output folder, named in the message.
        now: the settings of the command as typed now, values by name.
        stored: those that its unfinished work began with.
        typed: returns words for the message on what was typed then and now; if it returns none, the
            message names the settings that differ.
    """
    # turns tuples into lists, as they are stored
    now = msgspec.json.decode(msgspec.json.encode(now))
    if differing := [key for key in {**now, **stored} if now.get(key) != stored.get(key)]:
        before = {key: stored.get(key) for key in differing}
        words = {
            key: str(value) for key, value in before.items() if isinstance(value, str | int | float)
        }
        short = ", ".join(f"{key} {value}" for key, value in words.items() if len(value) <= SHORT)
        what = typed() or f"another {', '.join(_changes(now, stored))}"
        repeated = f" ({short})" if short and what.startswith("another ") else ""
        raise UserError(
            f"--out {printable(out)} was begun with {printable(what)}; repeat its "
            f"settings{printable(repeated)}, delete it, or choose another folder"
        )


def _changes(now: Any, stored: Any, depth: int = LEVELS, within: str = "") -> list[str]:
    """Return the names of settings that differ; of tables in them, such as of channels, by path."""
    if not depth or not (isinstance(now, Mapping) and isinstance(stored, Mapping)):
        return [within]
    names = list[str]()
    for key in {**now, **stored}:
        if now.get(key) != stored.get(key):
            path = f"{within}/{key}" if within else str(key)
            names += _changes(now.get(key), stored.get(key), depth - 1, path)
    return names


def held(out: Path) -> bool:
    """Return whether another process is working in an output folder, since it holds its lock."""
    try:
        with alone(out / WORK / LOCK, GONE_S):
            return False
    except BlockingIOError:
        return True


@contextmanager
def working(out: Path, begin: WorkStart, last: str | None = None) -> Iterator[Path]:
    """Enter a context that works in `.work` of the folder `out`, locked; yield the path of it.

    Args:
        out: the output folder, made if it is missing.
        begin: the settings of the work; a new working folder stores them.
        last: the name of the file in `out` that is written when the work is finished.

    On a UserError or OSError before anything is done, the folders created here are deleted; but if
    the model could not be asked, the folder keeps the reason (`unanswered`). Raises UserError if
    another process works there, or has finished since.
    """
    work, created = out / WORK, [path for path in (out, *out.parents) if not path.exists()]
    try:
        work.mkdir(parents=True, exist_ok=True)
        for path in (work, *work.iterdir()):
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                what = "a link" if path.is_symlink() else "a pipe or device"
                raise UserError(f"{printable(path)} is {what}, which no command makes; delete it")
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be made ({error.strerror}); choose another folder"
        ) from None
    try:
        with alone(work / LOCK, GONE_S), going_on(out):
            # another process may have begun since this one looked
            earlier = start_of(out, type(begin))
            if earlier is None:
                for path in work.iterdir():
                    if path.name != LOCK:
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
                write_whole(work / CONFIG, msgspec.json.encode(begin))
            elif earlier != begin or (last and (out / last).exists()):
                raise BlockingIOError
            (work / UNANSWERED).unlink(missing_ok=True)
            try:
                yield work
            except Unanswered as error:
                write_whole(work / UNANSWERED, str(error))
                raise
    except BlockingIOError:
        raise UserError(
            f"--out {printable(out)} is being written by another process; wait for it"
        ) from None
    except (UserError, OSError) as error:
        if isinstance(error, FileNotFoundError) and not work.exists():
            raise UserError(
                f"--out {printable(out)} was deleted while it was written to, by a tracker or "
                "another program; type the same command again, which begins anew"
            ) from error
        with suppress(OSError):  # another process may be working in one of them by now
            if _nothing_done(work) and not (work / UNANSWERED).exists():
                shutil.rmtree(work)
                for path in created:
                    path.rmdir()
        raise


@contextmanager
def going_on(out: Path) -> Iterator[None]:
    """Enter a context that tells the user, where work is interrupted, that it can be continued.

    It adds a note to an interrupt or `Unfinished` error: the output folder `out` keeps what is
    done.
    """
    try:
        yield
    except (KeyboardInterrupt, Unfinished) as error:
        error.add_note(f"{printable(out)} keeps what is done")
        raise


@contextmanager
def kept_file(file: Path) -> Iterator[None]:
    """Enter a context for reading a file of unfinished work; any error becomes one UserError line.

    It names the file and says that it is damaged.
    """
    try:
        yield
    except Exception as error:  # whatever its format's reader raises
        raise UserError(
            f"{printable(file)} is damaged ({one_line(error)}); delete its folder and start again"
        ) from error


def tidy(out: Path) -> None:
    """Delete the working folder `.work` of an output folder, once its work is finished.

    Temporary files of killed processes in `out` are deleted as well.
    """
    with suppress(OSError):  # first, so that nothing resumes from a half-deleted folder
        os.unlink(out / WORK / CONFIG)
    shutil.rmtree(out / WORK, ignore_errors=True)
    forget_halves(out)
