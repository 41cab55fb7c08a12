"""What logs of other programs hold: JSON with more constants than JSON has, and scores."""

import json
import math
from typing import Any, TypeVar

import msgspec

MOST_SCORERS = 100  # of a log
# The number that Inspect takes the text of a score for: of a letter, and of a word in any letters.
LETTERS = {"C": 1.0, "P": 0.5, "I": 0.0, "N": 0.0}
WORDS = {"yes": 1.0, "true": 1.0, "no": 0.0, "false": 0.0}
MOST = 1e12  # of a score: with more, a mean of others is lost in rounding
T = TypeVar("T")


def decoded(data: bytes, kind: type[T]) -> T:
    """Return a JSON text as values of a kind; NaN and Infinity, which are no JSON, are allowed.

    Raises ValueError, msgspec.ValidationError or RecursionError.
    """
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError:  # a score that is not known is written NaN
        loaded = json.loads(data)
        msgspec.json.encode(loaded)  # which fails here for a text that nothing can write again
        return msgspec.convert(loaded, kind)


def number(value: Any) -> float:
    """Return a score as Inspect counts it; NaN for what is no number, or beyond `MOST`."""
    if isinstance(value, str):
        value = LETTERS.get(value, WORDS.get(value.lower(), value))
    if not isinstance(value, str | int | float):
        return math.nan
    try:
        score = float(value)
    except (ValueError, OverflowError):
        return math.nan
    return score if abs(score) <= MOST else math.nan
