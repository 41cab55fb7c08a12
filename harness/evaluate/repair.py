"""The repair turn: who gave an answer that cannot be read is asked once more, and told what was wrong."""

import re
from collections.abc import Mapping
from dataclasses import replace

from msgspec import structs

from harness.backends.base import AGAIN, Request
from harness.parsing.status import Status
from harness.prompts.densest import ERROR_CHARS
from harness.prompts.versions import Prompt
from harness.runs.records import Answer, FirstTurn

QUOTED = 400  # characters of an answer that are quoted, at most
# What begins a token of some chat template: <|im_end|>, </s>, <think>, [INST]; full-width forms of it too.
_CONTROL = re.compile(r"[<＜](?=\S)|[\[［](?=/?[A-Za-z])")


def wanted(request: Request, answer: Answer, prompt: Prompt) -> bool:
    """Whether an answer is asked for again: a model wrote it freely, and no intent can be read in it."""
    return (
        request.answer == "json"
        and request.role in prompt.repair_turn
        and answer.verdict == "failed"
        and answer.status != Status.ENGINE_ERROR
    )


def asked(request: Request, answer: Answer, prompt: Prompt, words: Mapping[str, str]) -> Request:
    """The second question: the chat so far, the answer, and what the prompt says of it."""
    said = prompt.repair(request.role, as_text(answer.detail)[:ERROR_CHARS], request.actions, words)
    turns = ({"role": "assistant", "content": quoted(answer.raw)}, {"role": "user", "content": said})
    return replace(request, id=request.id + AGAIN, messages=(*request.messages, *turns))


def quoted(raw: str) -> str:
    """An answer as it stands in a chat: without its thought, as text, cut to `QUOTED` characters."""
    text = as_text(raw.rpartition("</think>")[2].strip())
    return text if len(text) <= QUOTED else text[: QUOTED - 1] + "…"


def as_text(text: str) -> str:
    """The same with a space in all that a chat template may read as a token of its own."""
    return _CONTROL.sub(lambda begins: f"{begins[0]} ", text)


def together(first: Answer, second: Answer) -> Answer:
    """The second turn's answer, with the first's text, and with what both took.

    Times to and between tokens are of one question, and so of neither.
    """
    turn = FirstTurn(**{name: getattr(first, name) for name in FirstTurn.__struct_fields__})
    return structs.replace(
        second, first=turn,
        prompt_tokens=_sum(first.prompt_tokens, second.prompt_tokens),
        completion_tokens=_sum(first.completion_tokens, second.completion_tokens),
        seconds=_sum(first.seconds, second.seconds), slow_s=first.slow_s + second.slow_s,
        retries=first.retries + second.retries, cached=first.cached and second.cached,
        first_token_s=None, token_s=None,
    )  # fmt: skip


def _sum(a: float | None, b: float | None) -> float | None:
    """Both; None where one is not known."""
    return None if a is None or b is None else a + b
