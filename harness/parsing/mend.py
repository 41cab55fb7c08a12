"""Repair broken JSON with json_repair, the last resort; the result counts only if the text confirms it."""

import json
import re
from collections.abc import Sequence
from typing import Any

from harness.parsing.relaxed import DECODER
from harness.parsing.status import Failure, Status

_MAX_CHARS = 4000  # json_repair's time grows faster than its input
# What a repair could mistake for a number or drop unseen: operators, comparisons, literals, half a number.
_AMBIGUOUS = re.compile(
    r"[~≈<>()+*/^=%|]|(?<![\w.])-?(?:true|false|null|none|nan|inf(?:inity)?)\b|\d\s*-|\d\.(?!\d)",
    re.IGNORECASE,
)
_NUMBER = re.compile(r"(?<![\w.])-?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def unreadable() -> Failure:
    """Return the failure of a text from which json_repair makes no answer."""
    return Failure(Status.SYNTAX, "a JSON object was begun but cannot be read without guessing")


def mended(text: str, names: Sequence[str], cut: bool) -> tuple[Any, str]:
    """Return the broken object at the start of `text`, repaired, and the text after it.

    The object counts only if it holds nothing ambiguous, each name is a key at most once, and the numbers
    read are the numbers written, in the same order.

    Args:
        text: the text from the opening brace on.
        names: the keys that count: fields and actions.
        cut: whether the engine stopped at its token limit; then nothing is repaired.

    Raises:
        Failure: syntax.
    """
    import json_repair

    source = text[: text.rfind("}") + 1]
    if cut or not source or len(source) > _MAX_CHARS or _AMBIGUOUS.search(source):
        raise unreadable()
    if any(len(re.findall(rf"\b{re.escape(name)}\W?\s*:", source)) > 1 for name in names):
        raise unreadable()
    try:
        value = DECODER.decode(json.dumps(json_repair.loads(source, skip_json_loads=True)))
        if _numbers(value) != [float(number) for number in _NUMBER.findall(source)]:
            raise unreadable()
    except Failure:
        raise
    except Exception:  # any error of a third-party reader is a syntax error of the text
        raise unreadable() from None
    return value, text[len(source) :]


def _numbers(value: object) -> list[float]:
    """Return the numbers in a JSON value in order; also those in keys and texts, so that none is lost."""
    if isinstance(value, dict):
        return [number for pair in value.items() for part in pair for number in _numbers(part)]
    if isinstance(value, list):
        return [number for item in value for number in _numbers(item)]
    if isinstance(value, str):
        return [float(number) for number in _NUMBER.findall(value)]
    return [value] if type(value) is float else []
