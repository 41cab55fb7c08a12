"""Repair broken JSON with json_repair, the last resort;
the result counts only if the text confirms it.
"""

import json
import re
from collections.abc import Sequence
from typing import Any

from harness.parsing.relaxed import DECODER
from harness.parsing.status import Failure, Status

_MAX_CHARS = 4000  # json_repair's time grows faster than its input
# What a repair could mistake for a number or drop unseen: operators, comparisons, denials,
# currencies, literals, half a number.
_AMBIGUOUS = re.compile(
    r"[~≈<>()+*/^=%|$€£]|[!¬]\w"
    r"|(?<![\w.])-?(?:true|false|null|none|nan|inf(?:inity)?)\b|\d\s*-|\d\.(?!\d)",
    re.IGNORECASE,
)
_HOLE = "\ue000"  # stands for a value that has been read; in no language's text
_NUMBER = re.compile(r"(?<![\w.])-?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def unreadable() -> Failure:
    """Build the Failure (of status syntax) of a text in which json_repair finds no reliable answer.

    Json_repair is a package that repairs broken JSON.
    """
    return Failure(Status.SYNTAX, "a JSON object was begun but cannot be read without guessing")


def mended(text: str, names: Sequence[str], cut: bool) -> tuple[Any, str]:
    """Return the broken object at the start of `text`, repaired, and the text after it.

    It counts only if it holds nothing ambiguous, each of `names`, the keys of an answer, is a key
    at most once, and the numbers read are the numbers written, in the same order. A text that the
    token limit ended (`cut`) is not repaired. Raises Failure of status syntax.
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


def around(
    text: str, at: int, end: int, fields: Sequence[str], cut: bool
) -> tuple[dict[str, Any], str, str]:
    """Repair a broken object at the start of `text` around one of its values, which can be read.

    The value stands from index `at` to `end`, with its numbers as they are written, so the text of
    other members may hold anything. The object counts only if it has no other members than
    `fields`, and each text in it stands in `text`. Returned are the other members, the key of the
    value, and the text after the object. A text that the token limit ended (`cut`) is not repaired.
    Raises Failure of status syntax.
    """
    import json_repair

    source = text[: text.rfind("}") + 1]
    if cut or end >= len(source) or len(source) > _MAX_CHARS or _HOLE in text:
        raise unreadable()
    try:
        value = json_repair.loads(f'{source[:at]}"{_HOLE}"{source[end:]}', skip_json_loads=True)
        members = DECODER.decode(json.dumps(value))
        [name] = [key for key, member in members.items() if member == _HOLE]
    except Exception:  # any error of a third-party reader is a syntax error of the text
        raise unreadable() from None
    other_members = {key: member for key, member in members.items() if key != name}
    texts = [member for member in other_members.values() if isinstance(member, str)]
    repeated = any(len(re.findall(rf'"{re.escape(field)}"\s*:', source)) > 1 for field in fields)
    if repeated or not set(members) <= set(fields) or not all(member in source for member in texts):
        raise unreadable()
    if _numbers(list(other_members.values())) != [
        float(number) for number in _NUMBER.findall(source[:at] + source[end:])
    ]:
        raise unreadable()
    return other_members, name, text[len(source) :]


def _numbers(value: object) -> list[float]:
    """Return the numbers in a JSON value in order;
    also those in keys and texts, so that none is lost.
    """
    if isinstance(value, dict):
        parts = [part for pair in value.items() for part in pair]
        return [number for part in parts for number in _numbers(part)]
    if isinstance(value, list):
        return [number for item in value for number in _numbers(item)]
    if isinstance(value, str):
        return [float(number) for number in _NUMBER.findall(value)]
    return [value] if type(value) is float else []
