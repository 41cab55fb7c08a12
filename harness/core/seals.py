"""Tell what this user wrote on this machine from what anybody may have written.

A seal is a digest of the content that only a holder of the user's key can make (HMAC-SHA256,
RFC 2104). The key lies in the cache folder and never leaves it.
"""

import hmac
import os
import secrets
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from harness.core import kept
from harness.core.errors import printable
from harness.core.figures import amount
from harness.core.files import (
    bytes_of,
    canonical_bytes,
    sha256_bytes,
    sha256_file,
    text_of,
    write_whole,
)
from harness.core.formats import CONFIG

KEY, KEY_BYTES = "seal.key", 32


def seal(content: Mapping[str, bytes], place: str) -> str | None:
    """Return a digest of files that only this user's key on this machine makes, their seal.

    A seal shows later that files in a folder, which anybody may have written, are as this user's
    program wrote them. `content` has the files' bytes by name; `place` is a text that names what
    they belong to, and is sealed with them. None if there is no key, which is where the cache
    folder cannot be written.
    """
    key = _key()
    if key is None:
        return None
    digests = {name: sha256_bytes(data) for name, data in content.items()}
    return hmac.new(key, canonical_bytes([place, digests]), "sha256").hexdigest()


def write_seal(part: Path, content: Mapping[str, bytes]) -> None:
    """Write a seal file for a part of unfinished work, before the part itself is written.

    A part is the path of a file or of a folder of files in a working folder, and `content` has its
    files' bytes by name. A seal (see `seal`) shows, when the work goes on, that the part is as this
    user's program wrote it. Nothing is written where there is no key.
    """
    if sealed := seal(content, _place(part)):
        write_whole(_seal_file(part), sealed)


def is_sealed(part: Path) -> bool:
    """Return whether a part of unfinished work is as this user's program wrote it on this machine.

    `part` is the path of a file or folder in a working folder. Its seal must have been made by
    `write_seal`, of the same content, for the work whose `config.json` lies beside it.
    """
    try:
        file_seal = text_of(_seal_file(part), "record")
        files = part.iterdir() if part.is_dir() else [part]
        content = {file.name: bytes_of(file, "rows") for file in files}
        return file_seal == seal(content, _place(part))
    except (OSError, ValueError):
        return False


def say_unsealed(out: Path, count: int, what: str, therefore: str) -> None:
    """Say on stderr that `count` parts of an output folder bear no seal, and what comes of it.

    They were not written by this user's program on this machine. `what` names one of them, such as
    `finished part`; `therefore` says what the command does with them.
    """
    where = f"{printable(out)} has {amount(count, what)} that nobody finished here with your key"
    lacks = "" if _key() else f" ({printable(kept.folder() / KEY)} cannot be written)"
    print(f"harness: {where}{lacks}; {therefore}", file=sys.stderr)


def _seal_file(part: Path) -> Path:
    return part.with_name(f"seal-{part.name}")


def _place(part: Path) -> str:
    """Return what no other part of any work has: its name, and what its work began with."""
    return f"{part.name} {sha256_file(part.with_name(CONFIG), 'record')}"


def _key() -> bytes | None:
    """Return the user's key, which is made where there is none or a broken one; else None."""
    if key := _stored_key():
        return key
    file = kept.folder() / KEY
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        descriptor = os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with open(descriptor, "wb") as opened:
            opened.write(secrets.token_bytes(KEY_BYTES))
    return _stored_key()


def _stored_key() -> bytes | None:
    key = kept.recall(KEY)
    return key if key and len(key) == KEY_BYTES else None
