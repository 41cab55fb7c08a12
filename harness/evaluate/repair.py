"""Ask once more for an answer that cannot be parsed, and say what was wrong with it:
the repair turn.
"""

import re
from collections.abc import Mapping
from dataclasses import replace

from msgspec import structs

from harness.backends.base import AGAIN, Request
from harness.parsing.status import Status
from harness.prompts.densest import ERROR_CHARS
from harness.prompts.versions import Prompt
from harness.runs.records import Answer, FirstTurn

QUOTED = 400  # most characters of an answer that are quoted
# The beginning of a special token of a chat template, such as <|im_end|>, </s>, <think> or [INST],
# and its full-width forms.
_CONTROL = re.compile(r"[<＜](?=\S)|[\[［](?=/?[A-Za-z])")


def wanted(request: Request, answer: Answer, prompt: Prompt) -> bool:
    """Return whether to ask again: a model answered in free text,
    and no intent can be parsed from it.
    """
    return (
        request.answer == "json"
        and request.role in prompt.repair_turn
        and answer.verdict == "failed"
        and answer.status != Status.ENGINE_ERROR
    )


def asked(request: Request, answer: Answer, prompt: Prompt, words: Mapping[str, str]) -> Request:
    """Return the second request: the chat so far, the answer,
    and the prompt's words about its error.
    """
    correction = prompt.repair(
        request.role, as_text(answer.detail)[:ERROR_CHARS], request.actions, words
    )
    turns = (
        {"role": "assistant", "content": quoted(answer.raw)},
        {"role": "user", "content": correction},
    )
    return replace(request, id=request.id + AGAIN, messages=(*request.messages, *turns))


def quoted(raw: str) -> str:
    """Return an answer as a chat quotes it:
    without its thought, as text, cut to `QUOTED` characters.
    """
    text = as_text(raw.rpartition("</think>")[2].strip())
    return text if len(text) <= QUOTED else text[: QUOTED - 1] + "…"


def as_text(text: str) -> str:
    """Return a text with a space inside whatever a chat template may read as a special token."""
    return _CONTROL.sub(lambda begins: f"{begins[0]} ", text)


def together(first: Answer, second: Answer) -> Answer:
    """Return the second turn's answer with the first turn's text and the tokens,
    time and retries of both.

    The times to the first and between tokens describe one request, so they are left out.
    """
    turn = FirstTurn(**{name: getattr(first, name) for name in FirstTurn.__struct_fields__})
    return structs.replace(
        second,
        first=turn,
        prompt_tokens=_sum(first.prompt_tokens, second.prompt_tokens),
        completion_tokens=_sum(first.completion_tokens, second.completion_tokens),
        seconds=_sum(first.seconds, second.seconds),
        slow_s=first.slow_s + second.slow_s,
        retries=first.retries + second.retries,
        cached=first.cached and second.cached,
        first_token_s=None,
        token_s=None,
    )


def _sum(a: float | None, b: float | None) -> float | None:
    """Return the sum; None if either is unknown."""
    return None if a is None or b is None else a + b
