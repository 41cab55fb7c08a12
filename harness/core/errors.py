"""What a user can get wrong, said in one line.

Three kinds of failure are kept apart. A bad completion is data (a parse status). Bad input is a
`UserError`: one line, exit code 2. Anything else is a bug and crashes with a traceback.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(Exception):
    """Bad input. The message names the thing, the value, what is allowed and what to do."""


class Unfinished(UserError):
    """Some parts of some work cannot be done; the others are."""


def printable(text: object, limit: int = 120) -> str:
    """Hostile text made safe for one terminal line: control characters escaped, cut at `limit`."""
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


def unknown(kind: str, name: str, known: Iterable[str], hint: str = "") -> UserError:
    """`UserError` for a name that does not exist, with the nearest one and the list."""
    names = sorted(known)
    near = get_close_matches(name, names, n=1)
    meant = f"; did you mean {near[0]!r}?" if near else ";"
    listed = ", ".join(names) or "(none)"
    return UserError(f"unknown {kind} {printable(name)!r}{meant} known: {listed}{hint}")
