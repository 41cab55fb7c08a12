"""Parse a completion into an intent:
any text gets exactly one status, and every repair is recorded.

The order of the steps is the rule: the thought is cut off before the search for an answer, valid
JSON goes before repaired JSON, and two answers that differ are no answer.
"""

import re
from collections.abc import Sequence
from typing import Any, Literal

from msgspec import Struct

from harness.core import errors
from harness.parsing import candidates, pieces, reasoning
from harness.parsing.answer import Answer, read
from harness.parsing.candidates import Candidate
from harness.parsing.mend import unreadable
from harness.parsing.status import Failure, Repair, Status
from harness.parsing.strict import fitting
from harness.prompts.answer_schema import ROLES, Shape

__all__ = ["Parsed", "Repair", "Status", "parse", "spans"]

_SAME = 1e-9  # two spellings of one distribution (0.5, 50%) differ by less
# The class of first characters comes first, so that the search skips everything else at once.
_SPECIAL = re.compile(
    r"[<\[](?=[|｜sebpuI]|/[sI])(?:(?<=<)(?:\|im_start\|>assistant|start_of_turn>model"
    r"|\|start_header_id\|>assistant<\|end_header_id\|>|[|｜][^<>{}\n]{1,40}[|｜]>"
    r"|/?s>|eos>|bos>|pad>|unk>|end_of_turn>)|(?<=\[)/?INST\])"
)
# Listed, not worked out from \s, so that a search passes over all else at once.
_NO_WIDTH = r"\u200b-\u200f\u2060-\u2064\u202a-\u202e\ufeff\u00ad"
# not JSON's
_SPACES = r"\x0b\x0c\x1c-\x1f\x85\xa0\u1680\u2000-\u200a\u2028\u2029\u202f\u205f\u3000"
_INVISIBLE = re.compile(rf"[{_NO_WIDTH}{_SPACES}]")
_NO_WIDTHS, _SPACE = re.compile(rf"[{_NO_WIDTH}]+"), re.compile(rf"[{_SPACES}]")

# Where no value could be read, the words still show what was copied.
_UNREAD = (Status.NO_JSON, Status.SYNTAX, Status.TRUNCATED_JSON)
_ECHO = re.compile(
    r"\blow ?\| ?medium\b|[\"']\s*:\s*[\"']?p\d?[\"']?\s*[,}]|[\"']max 12 words[\"']"
)


class Parsed(Struct, frozen=True):
    """Hold the result of parsing one completion: a status, and an intent unless it failed.

    A completion is a model's text, an intent the probabilities that a vehicle gives to the ego's
    actions, and a repair one correction without which the text could not be read.

    `repairs` is empty unless the status is recovered. If it failed, `intent` (probabilities in the
    order of the actions) and `message` (a helper's evidence, risk, recommended maneuver and
    confidence) are None, `faults` has all that is wrong, and `detail` says it in a sentence. `mass`
    is the probabilities' sum as written, None without; `reasoning` is the model's thought, None
    without. `extension` has what the prompt asked for beside the decision, None without.
    """

    status: Status  # the outcome
    # the repairs, in the order of `Repair`; empty unless recovered
    repairs: tuple[Repair, ...] = ()
    # probabilities in the order of the actions, summing to 1; None if failed
    intent: tuple[float, ...] | None = None
    # the sum as the model wrote it; None if it wrote none (a recommendation, most failures)
    mass: float | None = None
    # a helper's evidence, risk, recommended_maneuver and confidence. For a distribution, the
    # maneuver is the most probable action (the first of equals) and the confidence its probability
    message: dict[str, Any] | None = None
    # the thought, or None; the whole text if the thought was never closed
    reasoning: str | None = None
    detail: str = ""  # one sentence for people, safe to print
    faults: tuple[Status, ...] = ()  # if failed, all that is wrong with it, the status first
    # the further members that were asked for; None without any, or if they do not fit
    extension: dict[str, Any] | None = None

    @property
    def verdict(self) -> Literal["strict", "recovered", "failed"]:
        if self.status is Status.STRICT:
            return "strict"
        return "recovered" if self.status is Status.RECOVERED else "failed"


def parse(
    text: str,
    *,
    role: str,
    actions: Sequence[str],
    form: str | None = None,
    extension: str = "",
    placeholders: Sequence[str] = (),
    thinking: bool = False,
    reasons_first: bool = False,
    divides: bool = False,
    finish_reason: str = "stop",
    error: str | None = None,
) -> Parsed:
    """Parse one completion (a model's text) into a status and an intent. Never raises for any text.

    An intent is the probabilities of the actions. A closed thought is what a thinking model should
    write, and an empty one is what a template adds, so neither is a repair (a correction). A closed
    thought with content is one if the model was not asked to think.

    Args:
        text: the completion as it came; of a refusal, the words of the model or none.
        role: `ego` or `helper`; with the next four, the `Shape` of the answer that was asked for.
        actions: meta-action names, in the environment's order.
        form: `distribution` over the actions, or one action with a confidence: `maneuver` of the
            ego, `recommendation` of a helper; None if either will do.
        extension: JSON Schemas of further members by name, as JSON text; empty for none.
        placeholders: what the prompt shows in place of values, which is no evidence.
        thinking: whether the text must hold a closed thought: the model was asked to think, and the
            engine did not take the thought out of the text.
        reasons_first: whether the prompt asked for reasons before the answer;
            then prose there is no repair.
        divides: whether a sum that is off 1 by more than rounding is divided out, unless it is 0.
        finish_reason: the engine's finish reason; `length` means that the token limit cut the text
            off, `refusal` that the model refused the question.
        error: the engine's message if it failed.

    Raises UserError for an unknown role.
    """
    if role not in ROLES:
        raise errors.unknown("role", role, ROLES)
    if error is not None or finish_reason == "error":
        message = errors.printable(error or "no message", 80)
        return _failed(Failure(Status.ENGINE_ERROR, f"the engine failed: {message}"), None)
    if finish_reason == "refusal":
        words = f": {errors.printable(text.strip(), 80)}" if text.strip() else ""
        return _failed(Failure(Status.REFUSED, f"the model refused the question{words}"), None)
    shape = Shape(role, tuple(actions), form, extension, tuple(placeholders))
    thought: str | None = None
    try:
        answer = None if thinking else fitting(text, shape)
        if answer is None:
            thought, rest = reasoning.split(text, thinking) if text.strip() else (None, "")
            thought_leads = text.rstrip().endswith(rest.strip())
            answer = fitting(rest, shape) if thought_leads else None
            if answer is None:
                answer = _recovered(rest, shape, finish_reason == "length", reasons_first, divides)
            if (thought and not thinking) or not thought_leads:
                answer = answer.mended(Repair.THINK_BLOCK)
    except Failure as failure:
        if failure.status in _UNREAD and _ECHO.search(text):
            failure.faults += (Status.SCHEMA_ECHO,)
        if failure.status is Status.TRUNCATED_REASONING:
            thought = text.strip()
        return _failed(failure, thought or None)
    repairs = (
        tuple(repair for repair in Repair if repair in answer.repairs) if answer.repairs else ()
    )
    return Parsed(
        Status.RECOVERED if repairs else Status.STRICT,
        repairs,
        answer.intent,
        answer.mass,
        answer.message,
        thought or None,
        extension=answer.extension,
        detail=f"read after {len(repairs)} repair(s): {', '.join(repairs)}"
        if repairs
        else "fits the schema",
    )


def _failed(failure: Failure, thought: str | None) -> Parsed:
    return Parsed(
        failure.status,
        mass=failure.mass,
        reasoning=thought,
        detail=failure.detail,
        faults=failure.faults,
    )


def spans(
    text: str, role: str, actions: Sequence[str], thinking: bool = False
) -> list[tuple[int, int]]:
    """Return the start and end index of each answer that `parse` finds in a completion.

    They are for display. `role` is `ego` or `helper`, `actions` are the names of meta-actions, and
    `thinking` says whether the model was asked to think first. Empty if there is no answer, or if
    the text had to be rewritten before one was found.
    """
    try:
        rest = reasoning.split(text, thinking)[1] if text.strip() else ""
    except Failure:
        return []
    start = text.rfind(rest)
    if start < 0:
        return []
    return [(start + a, start + b) for a, b in candidates.spans(rest, role, tuple(actions))]


def _recovered(text: str, shape: Shape, cut: bool, reasons_first: bool, divides: bool) -> Answer:
    text, special = _SPECIAL.subn(" ", text)
    # A narrow space between a number and its unit is good typography in prose, so reasons may have
    # one.
    zero_width = _INVISIBLE.search(text, text.find("{") if reasons_first else 0)
    if zero_width or (reasons_first and _INVISIBLE.search(text)):
        text = _SPACE.sub(" ", _NO_WIDTHS.sub("", text))
    if not text.strip():
        raise Failure(Status.EMPTY, "there is no answer in the text")
    objects = candidates.candidates(text, shape.role, shape.actions, cut, reasons_first)
    answer = _choose(objects, shape, divides)
    if special:
        answer = answer.mended(Repair.SPECIAL_TOKENS)
    return answer.mended(Repair.INVISIBLE_CHARACTERS) if zero_width else answer


def _choose(objects: list[Candidate], shape: Shape, divides: bool) -> Answer:
    """Return the one answer among the candidates;
    an echo of the template is not a second answer.
    """
    answers: list[Answer] = []
    failures: list[Failure] = []
    partial = True  # whether no candidate that failed names an action
    for candidate in objects:
        try:
            answer = read(candidate.members, candidate.repairs, shape, divides)
            answers.append(answer.without(candidate.lost) if candidate.lost else answer)
        except Failure as failure:
            failures.append(failure)
            fields = pieces.fields_of(candidate.members, shape.role, shape.actions)
            partial = partial and not pieces.decides(fields, shape.role)
    serious = [failure for failure in failures if failure.status is not Status.SCHEMA_ECHO]
    if not answers:
        raise _none_read(objects, failures, serious)
    last = answers[-1]
    agree = all(
        abs(p - q) <= _SAME for a in answers for p, q in zip(a.intent, last.intent, strict=True)
    )
    if serious or not agree:
        count = len(answers) + len(serious)
        faults = _distinct(
            [Status.CONFLICTING_ANSWERS, *(f for each in serious for f in each.faults)]
        )
        detail = f"{count} answers stand in the text and they differ"
        if agree and partial:
            detail = "beside the answer stands a part of another one, which names no action"
        raise Failure(Status.CONFLICTING_ANSWERS, detail, faults=faults)
    return last.mended(Repair.REPEATED_ANSWER) if len(answers) > 1 else last


def _none_read(
    objects: Sequence[Candidate], failures: Sequence[Failure], serious: Sequence[Failure]
) -> Failure:
    """Return the failure of candidates of which none is an answer."""
    last, faults = (serious or failures)[-1], [fault for each in failures for fault in each.faults]
    if any(Repair.JSON_REPAIR in candidate.repairs for candidate in objects):
        # An error in a guessed object need not be one of the text; that it was copied shows in its
        # words.
        last, faults = unreadable(), [fault for fault in faults if fault is Status.SCHEMA_ECHO]
    return Failure(last.status, last.detail, last.mass, _distinct([last.status, *faults]))


def _distinct(faults: Sequence[Status]) -> tuple[Status, ...]:
    return tuple(dict.fromkeys(faults))
