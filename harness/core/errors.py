"""Errors for users: bad input is reported in one line.

Three kinds of failure are kept apart. A bad completion is data (a parse status). Bad input is a
`UserError`: one line, exit code 2. Anything else is a bug and crashes with a traceback.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(Exception):
    """Bad input. The message names the thing, the value, what is allowed and what to do."""


class Unfinished(UserError):
    """Some parts of the work cannot be done; all others are done."""


def printable(text: object, limit: int = 120) -> str:
    """Make any text safe for one terminal line: escape control characters, and cut at `limit` characters."""
    escaped = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return escaped if len(escaped) <= limit else escaped[: limit - 1] + "…"


def unknown(kind: str, name: str, known: Iterable[str], hint: str = "") -> UserError:
    """Build the `UserError` for a name that does not exist; it suggests the nearest name and lists all."""
    names = sorted(known)
    nearest = get_close_matches(name, names, n=1)
    suggestion = f"; did you mean {nearest[0]!r}?" if nearest else ";"
    # Of several names that begin so, the nearest is only the shortest.
    if len(begin := [known for known in names if name and known.startswith(name)]) > 1:
        suggestion = f"; did you mean one of {', '.join(begin)}?"
    listed = ", ".join(names) or "(none)"
    return UserError(f"unknown {kind} {printable(name)!r}{suggestion} known: {listed}{hint}")
