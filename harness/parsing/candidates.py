"""Find every object in a text that could be meant as the answer.

Valid JSON is taken as it stands. The relaxed reader tries only braces that open no valid JSON, and
json_repair tries only if neither finds anything.
"""

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from harness.parsing import mend, pieces, relaxed
from harness.parsing.answer import MARKS
from harness.parsing.pieces import FIELDS
from harness.parsing.status import Failure, Repair, Status
from harness.parsing.values import is_schema, match

_MAX_BROKEN = 200  # most braces that open nothing; a text with more is noise, and each costs a try
# most characters that these tries read in total; without it, a megabyte takes minutes
_MAX_TRIED = 4_000_000
_MAX_OBJECTS = 5_000  # no answer has so many
_MISSING = {"evidence": Repair.MISSING_EVIDENCE, "risk": Repair.MISSING_RISK}
_OPENING = re.compile(r"[{｛]")
_FENCE = re.compile(r"```[ \t]*[\w+-]*|~~~[ \t]*\w*")
_STRAY = frozenset("[](){},;:.\"'`*\\")


@dataclass(frozen=True)
class Candidate:
    """Hold an object in a completion (a model's text) that is shaped like an answer.

    `repairs` are the corrections that reading its `members` took. `lost` are repairs that would say
    that a member is missing; they are dropped later, since the text has the member and it merely
    could not be read.
    """

    members: dict[str, Any]  # what it holds
    repairs: frozenset[Repair] = frozenset()  # the repairs that reading it took
    # repairs to drop later: they would report as missing what merely could not be read
    lost: frozenset[Repair] = frozenset()


@dataclass
class _Objects:
    """The top-level objects of a text, by their start, and what could not be read."""

    readings: list[tuple[int, relaxed.Reading]] = field(default_factory=list)
    broken: int | None = None  # the first brace that was meant as JSON and cannot be read
    unfinished: bool = False


def candidates(
    text: str, role: str, actions: tuple[str, ...], cut: bool, reasons_first: bool = False
) -> list[Candidate]:
    """Return all objects in a model's text that could be the answer, in the order of the text.

    Args:
        text: the text without thought and special tokens.
        role: `ego` or `helper`, who was asked.
        actions: names of the meta-actions.
        cut: whether the token limit ended the text; then an open bracket is not closed.
        reasons_first: whether the prompt asked for reasons before the answer; if not, such text is
            counted as a repair.

    Raises:
        Failure: there is no candidate; its status is no_json, label_only, truncated_json, syntax or
            missing_action.
    """
    escapes: frozenset[Repair] = frozenset()
    objects = _objects(text, cut)
    if not objects.readings and ('\\"' in text or "&quot;" in text):
        # The most frequent one first, since unescape calls a function for each.
        text = html.unescape(text.replace("&quot;", '"'))
        text, escapes = text.replace('\\"', '"'), frozenset({Repair.ESCAPES})
        objects = _objects(text, cut)
    if objects.unfinished:
        raise Failure(Status.TRUNCATED_JSON, "the text ends inside a JSON value")

    shaped: list[Candidate] = []
    other_text, at = [], 0
    for start, reading in objects.readings:
        answers = list(_answers(reading.value, role, actions))
        shaped += [
            Candidate(members, extra | reading.repairs | escapes) for members, extra in answers
        ]
        if answers:
            other_text.append(text[at:start])
            at = reading.end
    if shaped and role == "helper" and objects.broken is not None:
        if whole_again := _around(text, objects, role, actions, cut, reasons_first):
            return [replace(whole_again, repairs=whole_again.repairs | escapes)]
        lost = frozenset(repair for name, repair in _MISSING.items() if f'"{name}"' in text)
        shaped = [replace(candidate, lost=lost) for candidate in shaped]
    if shaped:
        before, *after = [*other_text, text[at:]]
        around = _repairs_around(before, "\n".join(after), reasons_first)
        shaped = [replace(candidate, repairs=candidate.repairs | around) for candidate in shaped]
        if pieces.are_one([candidate.members for candidate in shaped], role, actions):
            return [_together(shaped)]
        return shaped
    if objects.broken is not None:
        mended, rest = mend.mended(text[objects.broken :], FIELDS[role] + actions, cut)
        extra = (
            escapes
            | _repairs_around(text[: objects.broken], rest, reasons_first)
            | {Repair.JSON_REPAIR}
        )
        answers = list(_answers(mended, role, actions))
        if not answers:
            raise mend.unreadable()
        return [Candidate(members, nested | extra) for members, nested in answers]
    raise _no_candidate(text, bool(objects.readings), actions)


def spans(text: str, role: str, actions: tuple[str, ...]) -> list[tuple[int, int]]:
    """Return where each object that could be the answer stands in a text, as start and end index.

    `role` is `ego` or `helper`, and `actions` are the names of meta-actions. Empty if `candidates`
    must change the text to find any.
    """
    try:
        objects = _objects(text, cut=False)
    except Failure:
        return []
    return [
        (start, reading.end)
        for start, reading in objects.readings
        if any(_answers(reading.value, role, actions))
    ]


def _around(
    text: str,
    objects: _Objects,
    role: str,
    actions: tuple[str, ...],
    cut: bool,
    reasons_first: bool,
) -> Candidate | None:
    """Return a helper's message whose distribution alone can be read,
    with the fields around it mended.

    A quote in its evidence breaks the object, and nothing else. None if there is no such object.
    """
    start = objects.broken or 0
    inner = [
        (at, each)
        for at, each in objects.readings
        if at > start and _shaped(each.value, role, actions)
    ]
    if len(inner) != 1 or len(objects.readings) != 1:
        return None
    [(at, reading)] = inner
    try:
        members, name, rest = mend.around(
            text[start:], at - start, reading.end - start, FIELDS[role], cut
        )
    except Failure:
        return None
    around = _repairs_around(text[:start], rest, reasons_first)
    repairs = frozenset(reading.repairs) | around | {Repair.JSON_REPAIR}
    return Candidate({**members, name: reading.value}, repairs)


def _together(candidates: list[Candidate]) -> Candidate:
    """Return the answer whose pieces some candidates are."""
    members: dict[str, Any] = {}
    repairs: frozenset[Repair] = frozenset({Repair.IN_PIECES})
    lost: frozenset[Repair] = frozenset()
    for candidate in candidates:
        members |= candidate.members
        repairs |= candidate.repairs
        lost |= candidate.lost
    return Candidate(members, repairs, lost)


def _objects(text: str, cut: bool) -> _Objects:
    """Read objects from left to right, and skip braces that open none."""
    objects = _Objects()
    at = tries = 0
    most_tries = min(_MAX_BROKEN, _MAX_TRIED // (len(text) + 1))
    while opening := _OPENING.search(text, at):
        start = at = opening.start()
        try:
            value, at = relaxed.DECODER.raw_decode(text, start)
            objects.readings.append((start, relaxed.Reading(value, at)))
            if len(objects.readings) > _MAX_OBJECTS:
                raise Failure(Status.SYNTAX, f"more than {_MAX_OBJECTS} JSON objects")
            continue
        except (ValueError, RecursionError):
            pass
        try:
            reading = relaxed.read(text, start)
            if reading.closed_by_end and cut:
                objects.unfinished = True
                return objects
            objects.readings.append((start, reading))
            at = reading.end
        except relaxed.Unfinished:
            if cut or not text.rstrip("` \t\r\n").endswith("}"):
                objects.unfinished = True
                return objects
            at = start + 1  # the text ends in a brace, so it is not cut off; a quote has no partner
            objects.broken = start if objects.broken is None else objects.broken
        except relaxed.Broken as error:
            at = start + 1
            if error.meant and objects.broken is None:
                objects.broken = start
        tries += 1
        if tries > most_tries:
            raise Failure(Status.SYNTAX, f"more than {most_tries} braces that open no JSON object")
    return objects


def _shaped(value: object, role: str, actions: tuple[str, ...]) -> bool:
    return isinstance(value, dict) and any(match(key, MARKS[role] + actions) for key in value)


def _answers(
    value: Any, role: str, actions: tuple[str, ...]
) -> Iterator[tuple[dict[str, Any], frozenset[Repair]]]:
    """Yield answer-shaped objects in a JSON value:
    the value, or what a wrapper such as a tool call holds.
    """
    stack = [(value, frozenset[Repair]())]
    while stack:
        node, repairs = stack.pop()
        node, opened = pieces.decoded(node)
        repairs |= opened
        if is_schema(node) and not isinstance(node, relaxed.Repeated):
            in_schema = pieces.in_schema(node, role, actions)
            yield from [(members, repairs | extra) for members, extra in in_schema] or [
                (node, repairs)
            ]
        elif isinstance(node, relaxed.Repeated) or _shaped(node, role, actions):
            yield node, repairs
        elif isinstance(node, dict | list):
            children = list(node.values()) if isinstance(node, dict) else node
            stack += [(child, repairs | {Repair.NESTED}) for child in reversed(children)]


def _repairs_around(before: str, after: str, reasons_first: bool) -> frozenset[Repair]:
    """Return the repairs for the text before the first answer and for the text behind it."""
    if reasons_first:
        return _repairs_for(after) | _repairs_for(before) - {Repair.PROSE_AROUND}
    return _repairs_for(f"{before}\n{after}")


def _repairs_for(text: str) -> frozenset[Repair]:
    unfenced, fences = _FENCE.subn("", text)
    repairs = {Repair.CODE_FENCE} if fences else set()
    characters = "".join(unfenced.split())
    if characters:
        repairs.add(
            Repair.STRAY_PUNCTUATION if _STRAY.issuperset(characters) else Repair.PROSE_AROUND
        )
    return frozenset(repairs)


def _whole_word(action: str) -> str:
    return rf"(?<![A-Za-z0-9_]){re.escape(action)}(?![A-Za-z0-9_])"


def _no_candidate(text: str, has_object: bool, actions: tuple[str, ...]) -> Failure:
    """Return the failure that explains why a text has no candidate."""
    lone = text.strip("".join(_STRAY) + "!?# \t\r\n").casefold()
    # A name that is not in the text at all needs no look at what surrounds it.
    named = [
        a
        for a in actions
        if (a in text and re.search(_whole_word(a), text))
        or lone == a.casefold()
        or (has_object and f'"{a.casefold()}"' in text.casefold())
    ]
    if len(named) == 1:
        return Failure(Status.LABEL_ONLY, f"only {named[0]} is named, without probabilities")
    if has_object:
        return Failure(Status.MISSING_ACTION, "there is a JSON object, but no distribution in it")
    return Failure(Status.NO_JSON, "there is no JSON object in the text")
