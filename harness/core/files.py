"""Read files, write them atomically, lock them, and compute digests of files and JSON values.

Every file that the harness reads passes `opened`. A file may come from a stranger: a pipe in its
place would block, a device would never end, and a large one would fill memory.
"""

import errno
import hashlib
import json
import math
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache, wraps
from glob import escape
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeVar

from harness.core.errors import UserError, printable, sayable_path

if TYPE_CHECKING:
    from zipfile import ZipFile

_EXACT = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False, check_circular=False
)
NO_FILE = "it is no file, but a pipe or a device"
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
# what a formula begins with, and what spreadsheets skip before it
FORMULA = ("=", "+", "-", "@", "\t", "\r")
T = TypeVar("T")


def canonical_json(value: Any) -> str:
    """Return the canonical JSON text of a value: sorted keys and no spaces.

    Raises ValueError on NaN or infinity.
    """
    return _EXACT.encode(value)


def canonical_bytes(value: Any) -> bytes:
    """Return a value's JSON text with sorted keys and no spaces, as UTF-8 bytes.

    Raises UnicodeEncodeError, a ValueError, on a lone surrogate, and ValueError on NaN.
    """
    return canonical_json(value).encode()


# What reading a file and taking its values apart raises where it is not what it should be.
BROKEN = (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError)


class Refused(OSError):
    """Report that a file is not read, since it is no regular file or too large for its kind."""


Kind = Literal["settings", "text", "record", "picture", "rows", "weights"]
_MB = 1 << 20
LARGEST: dict[Kind, int] = {
    # what people write in TOML and JSON: cards, channels, suites, --env-config
    "settings": 1 * _MB,
    "text": 16 * _MB,  # a prompt's files, one completion, a table of measurements
    # JSON by programs: run.json, manifest.json, a checkpoint's config and vocabulary
    "record": 256 * _MB,
    "picture": 64 * _MB,  # figures and pages
    "rows": 32 << 30,  # one line or row for each answer or decision, layouts, logs of work
    "weights": 4 << 40,
}
"""The largest file of each kind, bytes."""

# its size that an archive may unpack to: JSON takes some 30, nothing but zeros 1000
MOST_TIMES = 200


def opened(path: str | Path, kind: Kind) -> BufferedReader:
    """Open a file for reading in binary mode, and refuse one that is too large for its kind.

    `kind` is a key of `LARGEST`, such as `text`, whose value is the most bytes allowed. The file is
    checked after it is opened, so that nothing can replace it in between. Raises OSError, and
    Refused if it is not a regular file or too large.
    """
    file = open(path, "rb", opener=_at_once)  # noqa: SIM115
    try:
        if os.fstat(file.fileno()).st_size > LARGEST[kind]:
            raise Refused(
                errno.EFBIG, f"it is larger than {_size(LARGEST[kind])}, the limit", str(path)
            )
    except OSError:
        file.close()
        raise
    return file


def _at_once(path: str, flags: int) -> int:
    # Without the first flag, opening a pipe waits for somebody at its other end.
    flags |= getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    try:
        file = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno != errno.ENXIO:  # of a pipe that nobody reads, and of a socket
            raise
        raise Refused(errno.EINVAL, NO_FILE, path) from None
    mode = os.fstat(file).st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        os.close(file)
        raise Refused(errno.EINVAL, NO_FILE, path)
    return file


def _size(size: int) -> str:
    return f"{size / (1 << 30):.3g} GB" if size >= 1 << 30 else f"{size / _MB:.3g} MB"


def bytes_of(path: str | Path, kind: Kind) -> bytes:
    """Read a whole file; bytes that are appended after it was opened are not read.

    `kind`, a key of `LARGEST`, says how large it may be. Raises OSError, and Refused if it is not a
    regular file or too large.
    """
    with opened(path, kind) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def text_of(path: str | Path, kind: Kind = "text") -> str:
    """Read a UTF-8 text file, without the byte order mark that some editors put first.

    `kind`, a key of `LARGEST`, says how large it may be. Raises OSError, Refused if it is not a
    regular file or too large, and UnicodeDecodeError.
    """
    return bytes_of(path, kind).decode("utf-8-sig")


def read_once(read: Callable[[Path], T]) -> Callable[[Path], T]:
    """Decorate a function that reads a file: it reads each file once, until the file is modified.

    What `read` returned for a path is returned again; 64 of them are kept.
    """

    @lru_cache(maxsize=64)
    def kept(path: Path, state: tuple[int, ...]) -> T:
        return read(path)

    @wraps(read)
    def of_now(path: Path) -> T:
        return kept(path, state_of(path))

    return of_now


def state_of(path: Path) -> tuple[int, ...]:
    """Return numbers that are others once a file was modified or replaced; none if it is not there.

    They are its inode, its size in bytes, and when its content and its inode changed, in ns.
    """
    try:
        state = path.stat()
    except (OSError, ValueError):  # as for a link to nowhere, and a name that none can have
        return ()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def neutral(cell: T) -> T | str:
    """Return a CSV cell, with an apostrophe before a text that spreadsheets would run as a formula.

    Numbers, also those that are texts, stay as they are.
    """
    if not isinstance(cell, str) or not cell.startswith(FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def refuse_bomb(archive: "ZipFile", packed: int, most: float = math.inf) -> None:
    """Raise BadZipFile if a ZIP archive states that it unpacks to too much; nothing is unpacked.

    It is called before unpacking what somebody else may have made. `packed` is the archive's size,
    and the limit is the lesser of `most` and `MOST_TIMES` its size plus 1 MB, all in bytes.
    """
    from zipfile import BadZipFile  # imported here, since few commands need it

    unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > min(most, MOST_TIMES * packed + _MB):
        raise BadZipFile(f"it has {_size(packed)} and would unpack to {_size(unpacked)}")


def sha256_bytes(data: bytes) -> str:
    """Return the hex SHA-256 digest of bytes."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path, kind: Kind = "weights") -> str:
    """Return the hex SHA-256 digest of a file's content.

    `kind`, a key of `LARGEST`, says how large it may be. Raises OSError, and Refused if it is not a
    regular file or too large.
    """
    return sha256_files([path], kind)


def sha256_files(paths: Iterable[Path], kind: Kind = "weights") -> str:
    """Return the hex SHA-256 digest of the content of several files, one after another.

    `kind`, a key of `LARGEST`, says how large each may be. Raises OSError, and Refused if one is
    not a regular file or too large.
    """
    total = hashlib.sha256()
    for path in paths:
        with opened(path, kind) as file:
            hashlib.file_digest(file, lambda: total)
    return total.hexdigest()


def digest(value: Any) -> str:
    """Return the hex SHA-256 digest of a JSON value, the same for equal values.

    It is that of the JSON text with sorted keys and no spaces.
    """
    return sha256_bytes(canonical_bytes(value))


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Enter a context that adds the file's name to an error of a full or failing disk.

    Python raises an OSError of a write without a name; `path` is the file.
    """
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def appending(path: Path) -> Iterator[BinaryIO]:
    """Enter a context that yields a file open to append bytes, created if it is missing.

    An OSError names the file; it is also raised for a link, a pipe or a device, which somebody
    else's folder may have in its place.
    """
    with naming(path), open(path, "ab", opener=_in_place) as file:
        yield file


def _in_place(path: str, flags: int) -> int:
    if os.path.islink(path):
        raise Refused(errno.ELOOP, "it is a link, and nothing is written through it", path)
    return _at_once(path, flags | getattr(os, "O_NOFOLLOW", 0))


def is_there(path: Path) -> bool:
    """Return whether a file is at `path`, which is read now, and to which is appended later.

    Raises Refused for anything else, to which nothing is appended, before work for it is in vain.
    """
    if not path.is_file() and os.path.lexists(path):
        raise Refused(errno.EINVAL, "it is no file, so nothing is appended to it", str(path))
    return path.is_file()


def folder_in(run: Path, name: str) -> Path:
    """Return the folder of this name in a run's folder, where something is to be written.

    Raises UserError for a link, which may lead anywhere: somebody else may have made the run.
    """
    folder = run / name
    if folder.is_symlink():
        raise UserError(f"{printable(folder)} is a link; delete it, or name another folder: --out")
    return folder


def refuse_links(path: Path) -> None:
    """Raise UserError, which names it, if `path` is a link, or a folder with one in it or below.

    It guards what is read or copied from a folder that somebody else may have made: a link leads
    anywhere, to any file of whoever reads it.
    """
    for place in chain([path], path.rglob("*")):  # the first before any of what it leads to
        if place.is_symlink():
            raise UserError(
                f"{printable(place)} is a link; put the file itself there, or delete it"
            )


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Enter a context that yields a temporary file to write, which then replaces `path`.

    On an error it is deleted, and `path` stays as it was. Temporary files of killed processes are
    deleted as well. Raises OSError if `path` cannot be written, but never FileNotFoundError.
    """
    sayable_path("file", path)
    if path.is_dir():  # fail now, and not only after all is written
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():  # a device or a pipe, whose place the file would take
        raise Refused(errno.EEXIST, f"{NO_FILE}, and is not replaced", str(path))
    # Arrow takes a relative path with a colon, such as `6g:loss=0/x`, for an address.
    part = path.absolute().with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        forget_halves(path.parent, escape(path.name))
        part.unlink(missing_ok=True)  # it may be a link, or left by an earlier process with this id
        part.touch()
    except FileNotFoundError:  # what /proc says to whoever makes a file there
        raise PermissionError(errno.EACCES, "no file can be made there", str(path)) from None
    try:
        with naming(path), alone(part):
            yield part
            with part.open("rb+") as f:
                os.fsync(f.fileno())
            os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def refuse_taken(option: str, path: Path, what: str = "folder") -> None:
    """Raise UserError if anything exists at `path`, where a command is to make a new folder.

    `option` names the option that gave it, such as `--out`, and `what` is what is made.
    """
    if os.path.lexists(path):
        raise UserError(f"{option} {printable(path)} is there already; give a new {what}")


@contextmanager
def making(folder: Path) -> Iterator[Path]:
    """Enter a context that yields a temporary folder to fill, which then becomes `folder`.

    On an error it is deleted. Temporary folders of killed processes are deleted as well. Raises
    OSError if it cannot be made.
    """
    sayable_path("folder", folder)
    whole = folder.absolute()
    forget_halves(whole.parent, escape(whole.name))
    part = whole.with_name(f".{whole.name}.{os.getpid()}.part")
    try:
        part.mkdir(parents=True)
        with naming(folder), alone(part):
            yield part
            part.rename(whole)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def forget_halves(folder: Path, name: str = "*") -> None:
    """Delete the temporary files and folders in a folder that killed processes left.

    Those of running processes are locked and stay. `name` is a glob pattern of the names that the
    files would have had in the end.
    """
    for part in folder.glob(f".{name}.[0-9]*.part"):
        with suppress(OSError), alone(part):
            shutil.rmtree(part) if part.is_dir() else part.unlink()


def write_whole(path: Path, data: str | bytes) -> None:
    """Write `data` to `path` in one step: a kill leaves either the old file or the new one."""
    with replacing(path) as part:
        part.write_bytes(data.encode() if isinstance(data, str) else data)


@contextmanager
def alone(path: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Enter a context in which no other process of this program works on a folder or file.

    It holds an exclusive lock; a missing file is created. The lock of a killed process is released.
    On systems without such locks (Windows) nothing is locked. Raises BlockingIOError if another
    process still holds it after `patience_s` seconds, and OSError if the file is a link, a pipe or
    a device, or cannot be opened.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    how = os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT
    file = _at_once(str(path), how | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        deadline_s = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline_s:
                    raise
                time.sleep(0.05)
        yield
    finally:
        os.close(file)
