"""How many requests there may be at a time: the value of `--batch-size`, a number or `auto`."""

from typing import Literal

from harness.core.errors import UserError, printable

AUTO: Literal["auto"] = "auto"  # as many as a server takes well
AtOnce = int | Literal["auto"]
FIRST, MOST = 4, 256  # requests of a server with `auto`: at the beginning, and ever


def at_once_of(text: str) -> AtOnce:
    """Parse the value of `--batch-size`: a whole number, or `auto`.

    Raises UserError if it is neither. Whether the number is allowed is checked where it is used.
    """
    if text == AUTO:
        return AUTO
    try:
        return int(text)
    except ValueError:
        raise UserError(
            f"--batch-size {printable(text)}: give a number, 1 or more, or {AUTO}"
        ) from None


def first_at_once(at_once: AtOnce) -> int:
    """Return with how many requests at a time a server begins; `at_once` may be `auto`."""
    return FIRST if at_once == AUTO else at_once


def most_at_once(at_once: AtOnce) -> int:
    """Return the most requests that one server may have at a time; `at_once` may be `auto`."""
    return MOST if at_once == AUTO else at_once
