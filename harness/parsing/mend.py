"""The last resort for broken JSON: json_repair, believed only where the text vouches for it."""

import json
import re
from collections.abc import Sequence
from typing import Any

from harness.parsing.relaxed import DECODER
from harness.parsing.status import Failure, Status

_MAX_CHARS = 4000  # json_repair's time grows faster than its input
# What a repair could take for a number, or drop unseen: operators, comparisons, literals, half a number.
_AMBIGUOUS = re.compile(
    r"[~≈<>()+*/^=%|]|(?<![\w.])-?(?:true|false|null|none|nan|inf(?:inity)?)\b|\d\s*-|\d\.(?!\d)",
    re.IGNORECASE,
)
_NUMBER = re.compile(r"(?<![\w.])-?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def unreadable() -> Failure:
    """The failure of a text that json_repair cannot mend, or mends into something that is no answer."""
    return Failure(Status.SYNTAX, "a JSON object was begun but cannot be read without guessing")


def mended(text: str, names: Sequence[str], cut: bool) -> tuple[Any, str]:
    """The broken object that `text` begins with, and the text after it.

    Believed only if nothing ambiguous stands in it, each name is a key at most once, and the numbers read are
    the numbers written, in the same order.

    Args:
        text: from the opening brace on.
        names: keys that count: fields and actions.
        cut: the engine stopped at its token limit, so nothing is mended.

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
    except Exception:  # whatever a third-party reader does with hostile text is a syntax error of the text
        raise unreadable() from None
    return value, text[len(source) :]


def _numbers(value: object) -> list[float]:
    """Numbers in a JSON value in order, those in keys and texts too, so that none is dropped unseen."""
    if isinstance(value, dict):
        return [number for pair in value.items() for part in pair for number in _numbers(part)]
    if isinstance(value, list):
        return [number for item in value for number in _numbers(item)]
    if isinstance(value, str):
        return [float(number) for number in _NUMBER.findall(value)]
    return [value] if type(value) is float else []
