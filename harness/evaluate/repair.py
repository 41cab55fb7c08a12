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
    """Return whether to ask again because no intent could be parsed from a free-text answer.

    The prompt must have a text for such a second question (a repair turn) in the role, and the
    engine must not have failed. A role is what a vehicle is asked as: ego, helper or, after
    messages, merge.
    """
    return (
        request.answer == "json"
        and request.role in prompt.repair_turn
        and answer.verdict == "failed"
        and answer.status != Status.ENGINE_ERROR
    )


def repair_request(
    request: Request, answer: Answer, prompt: Prompt, words: Mapping[str, str]
) -> Request:
    """Return the request of a repair turn: the chat so far, the failed answer and what was wrong.

    A repair turn is a second question after an answer that cannot be parsed. A template of the
    prompt words it; `words` are the scenario's texts, which templates take by name.
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
    """Return an answer as text to quote in a chat: no thought, at most `QUOTED` characters."""
    text = as_text(raw.rpartition("</think>")[2].strip())
    return text if len(text) <= QUOTED else text[: QUOTED - 1] + "…"


def as_text(text: str) -> str:
    """Return a text in which no chat template finds a special token: a space is put into each.

    So a quoted answer cannot end its turn.
    """
    return _CONTROL.sub(lambda begins: f"{begins[0]} ", text)


def together(first: Answer, second: Answer) -> Answer:
    """Return the answer to a second question, with the failed first one's text and cost added.

    The second question, a repair turn, is asked after an answer that cannot be parsed. Costs are
    tokens, time and retries. The times to the first and between tokens describe one request, so
    they are left out.
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
