"""Errors for users: bad input is reported in one line.

Four kinds of failure are kept apart. A bad completion is data (a parse status). Bad input is a
`UserError`: one line, exit code 2. A question that got no answer is no data either: `Unanswered`,
exit code 3. Anything else is a bug and crashes with a traceback.
"""

import os
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import ClassVar

# What a command ends with; no other code is used.
EXIT_CODES = {
    0: "done",
    1: "a gate or a check failed",
    2: "bad input",
    3: "the model could not be asked",
    130: "interrupted (Ctrl-C)",
    141: "nobody reads the output",
    143: "terminated (SIGTERM)",
}


BETWEEN_NAMES = " · "  # in tables, of a model, a prompt and an answer mode
MOST_LISTED, FEW, NEAR = 60, 24, 6  # names that a message lists, and how many it lists of more
# what prints all of a kind
LISTS = {"model": "harness model list", "prompt": "harness prompt list"}


class UserError(Exception):
    """Report bad input in one line: the thing, the value, what is allowed and what to do.

    `code` is the exit code with which the command ends.
    """

    code: ClassVar[int] = 2  # what the command ends with, one of `EXIT_CODES`


class Unfinished(UserError):
    """Report that some parts of a command's work could not be done, while all others are done.

    The same command does the rest later.
    """


class Unanswered(Unfinished):
    """Report that the model could not be asked, so that the work is to be continued later.

    The message begins with that of its server or engine, which is the program that runs it.
    """

    code = 3


def printable(text: object, limit: int = 120) -> str:
    """Return the text of any object, made safe for one terminal line.

    Control characters are escaped, and a text longer than `limit` characters is cut.
    """
    escaped = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in _text_of(text))
    return escaped if len(escaped) <= limit else escaped[: limit - 1] + "…"


def _text_of(thing: object) -> str:
    """Return the text of a thing, or the name of its type where it has none,
    as a package's error may.
    """
    try:
        return str(thing)
    except Exception:
        return type(thing).__name__


def sayable(what: str, name: str, repair: str = "rename it") -> str:
    """Return `name` unchanged, unless terminals and tables cannot show it as it is.

    Raises UserError if it has control characters, invalid UTF-8 or the separator ` · `. In the
    message `what` says what has this name, such as `file of channels`, and `repair` what to do.
    """
    if not name.isprintable():
        raise UserError(
            f"{what} `{printable(name)}` has characters that nothing can show; {repair}"
        )
    if BETWEEN_NAMES in name:
        raise UserError(
            f"{what} `{name}` has `{BETWEEN_NAMES}`, which stands between names; {repair}"
        )
    return name


def sayable_path(what: str, path: Path, repair: str = "give another name") -> None:
    """Raise UserError as `sayable` does for the name of what is to be made at `path`.

    So for each folder above it that is not there and would be made, too.
    """
    sayable(what, path.name, repair)
    for folder in path.parents:
        if not folder.name.isprintable() and not os.path.lexists(folder):
            sayable(what, str(path), repair)


def one_line(error: Exception) -> str:
    """Return an error's message on one line of at most 200 characters, safe for a terminal."""
    return printable(" ".join(_text_of(error).split()), 200)


def unknown(kind: str, name: str, known_names: Iterable[str], hint: str = "") -> UserError:
    """Build the error for a name that is not among `known_names`; it suggests the nearest of them.

    Args:
        kind: what is named, in words for the message, such as `model`.
        name: the name that is unknown.
        known_names: all names that are allowed.
        hint: more words, appended to the message.

    The message lists the known names; if they are many (`MOST_LISTED`, or `FEW` where a command
    lists them all), only the nearest, and that command.
    """
    names = sorted(known_names)
    nearest = get_close_matches(name, names, n=1)
    suggestion = f"; did you mean {nearest[0]!r}?" if nearest else ";"
    # Of several names that begin so, the nearest is only the shortest.
    if len(begin := [each for each in names if name and each.startswith(name)]) > 1:
        suggestion = f"; did you mean one of {', '.join(map(printable, begin[:MOST_LISTED]))}?"
    candidates = (
        names
        if len(names) <= (FEW if kind in LISTS else MOST_LISTED)
        else get_close_matches(name, names, NEAR, cutoff=0)
    )
    listed = ", ".join(map(printable, candidates)) or "(none)"
    if len(candidates) < len(names):
        all_of = f"; `{LISTS[kind]}` lists all" if kind in LISTS else ""
        listed += f" and {len(names) - len(candidates)} more{all_of}"
    return UserError(f"unknown {kind} {printable(name)!r}{suggestion} known: {listed}{hint}")


def in_range(option: str, value: float, least: float, most: float) -> None:
    """Raise UserError unless a number that a user typed is from `least` to `most`.

    `option` names it in the message, and `value` is the number.
    """
    if not least <= value <= most:
        given = f"{value:g}" if isinstance(value, float) else printable(value, 40)
        raise UserError(f"{option} {given} is out of range; give {least} to {most}")
