"""Assemble a streamed chat completion, and record when its first token came.

Pieces are server-sent events (WHATWG HTML, 9.2), each a `data:` line of JSON, up to `[DONE]`.
Nothing in a stream raises an exception: an error becomes a fault, in one sentence.
"""

import json
from codecs import BOM_UTF8
from contextlib import suppress
from typing import Any

from harness.backends.openai.faults import Fault, fault_in, may_pass
from harness.backends.openai.said import REFUSAL, THOUGHTS, NoText, in_texts
from harness.core.depth import shallow

# the last piece has the token counts
ASKED = {"stream": True, "stream_options": {"include_usage": True}}
BROKE_OFF = "the stream broke off"
_TEXTS = ("content", *THOUGHTS, REFUSAL)  # of a message, which come in pieces
_CUT_OFF = "the stream ends before the answer does"


class Stream:
    """Assemble a model's streamed answer, a chat completion, from the bytes of a server's reply.

    The bytes are server-sent events.
    """

    def __init__(self) -> None:
        # Why it is no completion, with text of the server of any length; None once it is one.
        self.fault: str | None = _CUT_OFF
        self.again = True  # whether another attempt may succeed
        # the HTTP status that an error in it would have had, if it states one
        self.code: int | None = None
        self._rest = b""
        self._begun = False  # whether its first line was read, before which a BOM may stand
        self._kind = b""  # of the event
        self._model: str | None = None
        self._texts: dict[str, str] = {}
        self._finish: str | None = None
        self._usage: dict[str, int] = {}
        self._first_at_s: float | None = None
        self._last_at_s: float | None = None

    def take(self, data: bytes, at_s: float) -> None:
        """Add bytes of a server's streamed reply as they come, cut anywhere.

        `at_s` is when they came, in seconds of `time.perf_counter`.
        """
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            if not self._begun:
                line, self._begun = line.removeprefix(BOM_UTF8), True
            field, _, value = line.strip().partition(b":")
            if field in (b"event", b""):  # an empty line ends an event
                self._kind = value.strip() if field else b""
            # a comment keeps the connection alive
            if field == b"data" and self.fault in (None, _CUT_OFF):
                self._event(value.strip().decode("utf-8", "replace"), at_s)

    def _event(self, text: str, at_s: float) -> None:
        if text == "[DONE]":
            return  # whoever cut an answer off on its way may end the stream so, too
        if self._kind == b"error":
            error: Any = text
            with suppress(ValueError, RecursionError):
                error = shallow(json.loads(text))
            self._break_off(fault_in(error) or fault_in({"error": error}) or Fault(text))
            return
        try:
            self._piece(shallow(json.loads(text)), at_s)
        except (ValueError, RecursionError):
            self.fault, self.again = f"a piece of the stream is no JSON: {text}", False
        except NoText as error:
            self.fault, self.again = str(error), False
        except (LookupError, TypeError, AttributeError):
            self.fault, self.again = "a piece of the stream is no part of a chat completion", False

    def _piece(self, piece: Any, at_s: float) -> None:
        if fault := fault_in(piece):
            self._break_off(fault)
            return
        self._model = piece.get("model") or self._model
        self._usage |= {k: v for k, v in (piece.get("usage") or {}).items() if type(v) is int}
        # the last piece may have token counts and no choice
        for choice in (piece.get("choices") or [])[:1]:
            whole = choice.get("message")
            if whole is not None:  # in place of its parts
                self._texts = {}
            part = choice.get("delta") if whole is None else whole
            if part is None and "text" in choice:
                raise LookupError("a piece of a completion of another kind")
            message = in_texts(part or {})
            texts = {name: message[name] for name in _TEXTS if message.get(name) is not None}
            for name, text in texts.items():
                self._texts[name] = self._texts.get(name, "") + text
            if any(texts.values()):
                self._first_at_s, self._last_at_s = self._first_at_s or at_s, at_s
            if choice.get("finish_reason"):
                self._finish, self.fault = str(choice["finish_reason"]), None

    def _break_off(self, fault: Fault) -> None:
        self.fault, self.code = f"{BROKE_OFF}: {fault.words}", fault.code
        self.again = fault.code is None or may_pass(fault.code)

    @property
    def first_at_s(self) -> float | None:
        """Return when the first text came, by `time.perf_counter`; None if it all came at once.

        A buffer on the way then hid the time.
        """
        return None if self._first_at_s == self._last_at_s else self._first_at_s

    def payload(self) -> dict[str, Any]:
        """Return the streamed answer as the JSON value that a server sends without streaming.

        It is complete once `fault` is None.
        """
        choice = {"message": {"content": "", **self._texts}, "finish_reason": self._finish}
        return {"choices": [choice], "usage": self._usage, "model": self._model}
