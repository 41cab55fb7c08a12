"""Say what is wrong with an answer that a stopped run kept, and that anybody may have written.

Its text is what a model may have said. All else is what the request and the text make of it.
"""

from typing import Any

from msgspec import UNSET, UnsetType, structs

from harness.backends.base import OF_LETTERS, Completion, Request
from harness.backends.token_counts import too_few
from harness.evaluate import repair
from harness.evaluate.answers import answer_of, digests
from harness.evaluate.spec import Spec
from harness.runs.records import Answer, FirstTurn

SUMMED = ("prompt_tokens", "completion_tokens", "seconds", "slow_s")  # over the turns of an answer


def fault(spec: Spec, request: Request, answer: Answer) -> str | None:
    """Return why a stopped run cannot have got an answer that its folder has, or None.

    Anybody may have written it. The phrase follows "the answer", as in "the answer has ...". `spec`
    is the evaluation and `request` the question.
    """
    if digests(request) != (answer.prompt_sha256, answer.image_sha256):
        return "is to another prompt or picture than is asked"
    if answer.agent != spec.agent_of_answer(request.agent):
        return "states another model than is asked there"
    if not request.bare:
        for name in OF_LETTERS:
            if getattr(answer, name) not in (None, UNSET):
                return f"states a {name}, which only a read-out has"
    first = answer.first
    if isinstance(first, UnsetType):
        if repair.wanted(request, answer, spec.agents[request.agent].prompt):
            return "lacks the repair turn that its text calls for"
        return _of_tokens(spec, request, answer)
    return _of_turns(spec, request, answer, first)


def _of_turns(spec: Spec, request: Request, answer: Answer, first: FirstTurn) -> str | None:
    """Return what is wrong with an answer that states a repair turn, and an answer before it."""
    for name in SUMMED:
        of_both, of_first = getattr(answer, name), getattr(first, name)
        if None not in (of_both, of_first) and of_both < of_first:
            return f"states less {name} than its first turn"
    of_first_turn = {name: getattr(first, name) for name in SUMMED}
    reason: Any = first.finish_reason
    text = Completion(request.id, first.raw, finish_reason=reason, batch_size=1, **of_first_turn)
    before = answer_of(request, text)
    if before.status != first.status:
        return "states another status of its first turn than the text of that says"
    if not repair.wanted(request, before, spec.agents[request.agent].prompt):
        return "states a repair turn, and the text before it calls for none"
    in_second = {}
    for name in ("prompt_tokens", "completion_tokens"):
        of_both, of_first = getattr(answer, name), getattr(first, name)
        in_second[name] = None if None in (of_both, of_first) else of_both - of_first
    second = structs.replace(answer, **in_second)
    return _of_tokens(spec, request, before) or _of_tokens(spec, request, second)


def _of_tokens(spec: Spec, request: Request, answer: Answer) -> str | None:
    can = spec.agents[request.agent].can
    few = too_few(request, can, answer.raw, answer.prompt_tokens, answer.completion_tokens)
    return f"states {few}, too few" if few else None
