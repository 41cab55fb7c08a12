"""Read what a message of a server says:
the answer, a thought that was taken out of it, and a refusal.
"""

from collections.abc import Mapping
from typing import Any

from harness.core.errors import printable

# where servers put a thought; some send both, one of them null
THOUGHTS = ("reasoning_content", "reasoning")
REFUSAL = "refusal"  # where they put the words of a model that refuses
# The field of a message that a part of its content belongs to, by the part's type.
_FIELDS = {
    "text": "content",
    "output_text": "content",
    "thinking": THOUGHTS[0],
    "reasoning": THOUGHTS[0],
    "refusal": REFUSAL,
}


class NoText(TypeError):
    """Report a message whose content has a part that is no text; it says which."""


def in_texts(message: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a server's chat message with its `content` as one text, also if it came in parts.

    Parts with thoughts and refusals go to their own fields. Raises NoText for other parts.
    """
    if not isinstance(message.get("content"), list):
        return message
    texts = {"content": ""}
    for part in message["content"]:
        kind = part.get("type", "text") if isinstance(part, dict) else type(part).__name__
        field = _FIELDS.get(kind) if isinstance(kind, str) and isinstance(part, dict) else None
        if field is None:
            raise NoText(
                f"the answer's content has a part that is no text but {printable(kind, 40)}"
            )
        texts[field] = texts.get(field, "") + _text(part, kind)
    other_fields = {name: value for name, value in message.items() if value and name != "content"}
    return {**message, **texts, **other_fields}


def _text(part: Mapping[str, Any], kind: str) -> str:
    """Return the text of a part, which a thought may have in parts of its own."""
    value = part.get(kind, part.get("text"))
    inner = value if isinstance(value, list) else [value]
    values = [each.get("text") if isinstance(each, dict) else each for each in inner]
    texts = [text for text in values if isinstance(text, str)]
    if len(texts) < len(values):
        raise NoText(f"the answer's content has a part of type {kind} without a text")
    return "".join(texts)


def thought(message: Mapping[str, Any]) -> str | None:
    """Return the thought that a server took out of an answer; None if it has no such field.

    `message` is the chat message of its reply, a dict whose `content` is one text (`in_texts`).
    """
    values = [message.get(name) for name in THOUGHTS]
    texts = [value for value in values if isinstance(value, str)]
    written = [text for text in texts if text]
    return next(iter(written or texts), None)


def refusal(message: Mapping[str, Any]) -> str | None:
    """Return the words in which a model refuses to answer; None if it does not.

    `message` is the chat message of the server's reply, a dict whose `content` is one text
    (`in_texts`).
    """
    words = message.get(REFUSAL)
    return words if isinstance(words, str) and words.strip() else None
