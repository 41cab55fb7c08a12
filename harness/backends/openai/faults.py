"""Find the error in what a server says:
its words, and its code as if that had been the HTTP status.

Some servers and most routers answer HTTP 200 before they know that they cannot answer.
"""

import json
from contextlib import suppress
from typing import Any, NamedTuple

from harness.backends.openai.endings import ending
from harness.core.errors import printable

_WORDS = ("error", "message", "detail")  # where an error or its words stand
_CODES = ("code", "status", "status_code")
_REASON = ("metadata", "raw")  # where a router puts the words of the server behind it


class Fault(NamedTuple):
    """Hold an error that a server states, and the HTTP status it would have had, if known.

    `words` are the server's, `code` is that status, and `again` says that another attempt may
    succeed though no code says so.
    """

    words: str  # the server's own words
    code: int | None = None  # HTTP status that fits the error; None if not known
    again: bool = False  # whether another attempt may succeed, though no code says so


def may_pass(status: int) -> bool:
    """Return whether another attempt may succeed after an HTTP status: 429, or 5xx but 501."""
    return status == 429 or (status >= 500 and status != 501)


def error_words(payload: Any) -> str:
    """Return the words in an error's decoded JSON, where servers put them.

    That is at `error`, `error.message`, `message` or `detail`.
    """
    reason = None
    while isinstance(payload, dict):
        metadata = payload.get(_REASON[0])
        reason = reason or (metadata.get(_REASON[1]) if isinstance(metadata, dict) else None)
        texts = [payload[name] for name in _WORDS if payload.get(name)]
        payload = texts[0] if texts else json.dumps(payload)
    return f"{payload}: {reason}" if isinstance(reason, str) else str(payload)


def fault_in(payload: Any, of_chat: bool = True) -> Fault | None:
    """Return the error in JSON that came with HTTP 200, or in a stream's event; None if none.

    `payload` is the decoded JSON. With `of_chat`, where a chat completion is expected, a bare text,
    or words without any choice, are an error as well.
    """
    if of_chat and isinstance(payload, str) and payload.strip():
        return Fault(payload)
    if not isinstance(payload, dict):
        return None
    choices = payload.get("choices")
    first = choices[0] if isinstance(choices, list) and choices else None
    for part in (payload, first):
        if isinstance(part, dict) and (error := part.get("error")):
            return Fault(error_words({"error": error}), _code(error) or _code(payload))
    finish = first.get("finish_reason") if isinstance(first, dict) else None
    if of_chat and ending(finish) == "broken":
        return Fault(
            f"the answer was broken off (finish_reason {printable(finish, 40)})", again=True
        )
    if (
        of_chat
        and not choices
        and any(isinstance(payload.get(name), str | list) for name in _WORDS[1:])
    ):
        return Fault(error_words(payload), _code(payload))
    return None


def plain_text(data: bytes | bytearray) -> str | None:
    """Return a reply's bytes as one line of text, if they are words and not data.

    None if they are empty, markup, broken JSON or no UTF-8.
    """
    with suppress(UnicodeDecodeError):
        text = " ".join(data.decode().split())
        return text if text and text.isprintable() and text[0] not in "<{[" else None
    return None


def _code(error: Any) -> int | None:
    """Return the HTTP status of an error that an error object names, as a number or in digits."""
    for value in (error.get(name) for name in _CODES) if isinstance(error, dict) else ():
        if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) == 3:
            value = int(value)
        if type(value) is int and 400 <= value <= 599:
            return value
    return None
