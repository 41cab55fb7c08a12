"""Leave out of what others read where things lie on this machine,
and the keys that stand in addresses.
"""

import re
import shlex
from collections.abc import Mapping
from pathlib import PurePath, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import urlsplit

# A scheme has a limit, or a long word would be read from each of its letters to its end.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]{0,30}://[^\s'\"<>]+")
_PATH = re.compile(
    r"(?P<address>" + _ADDRESS.pattern + r")|"
    r"(?<![\w.~\\/-])(?P<path>(?:[A-Za-z]:|~\w*|\.\.)?(?:[\\/]+[^\s\\/'\":,;()<>]+){2,}[\\/]*)"
)
_WHOLE = re.compile(r"(?:[A-Za-z]:)?[\\/].+|~\w*[\\/].+|\.\.[\\/].+", re.DOTALL)
COMMAND = "command"  # key of a value that is a command line


def nameless(value: Any, key: str = "") -> Any:
    """Return a JSON value with file names in place of absolute paths, to give it to others.

    So it does not tell where the user keeps files. URLs lose user, password and query. A path with
    spaces is found only if it is a whole text, or a word of a command line. `key` is the key under
    which a dict has `value`: `command` says that it is a command line; empty for a value outside of
    dicts.
    """
    if isinstance(value, str):
        return _command(value) if key == COMMAND else text(value)
    if isinstance(value, Mapping):
        return {name: nameless(inner, name) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(nameless(inner) for inner in value)
    return value


def text(value: str) -> str:
    """Return a text without what tells where its user keeps files, to give it to others.

    File names stand in place of absolute paths; URLs lose user and password.
    """
    if _WHOLE.fullmatch(value) and not _ADDRESS.match(value):
        return name(value)
    return _PATH.sub(lambda match: address(match[0]) if match["address"] else name(match[0]), value)


def name(path: str) -> str:
    """Return the last part of a POSIX or Windows path; the path itself if it has none."""
    kind: type[PurePath] = (
        PureWindowsPath if "\\" in path or re.match("[A-Za-z]:", path) else PurePosixPath
    )
    return kind(path).name or path


def address(url: str) -> str:
    """Return a URL without user, password, query and fragment, to show it to others.

    Of a `file:` URL it is the file's name.
    """
    try:
        parts = urlsplit(url)
        host = parts.netloc.rpartition("@")[2]
    except ValueError:
        return ""
    return name(parts.path) if parts.scheme == "file" else f"{parts.scheme}://{host}{parts.path}"


def _command(line: str) -> str:
    try:
        words = shlex.split(line)
    except ValueError:
        return text(line)
    return shlex.join(_word(word) for word in words)


def _word(word: str) -> str:
    """Return a word of a command, such as a path, `replay:PATH`, `PATH,NAME` or `--option=PATH`."""
    return "".join(
        f"{part[:7]}{text(part[7:])}" if part.startswith("replay:") else text(part)
        for part in re.split("([,=])", word)
    )
