"""Every object in a text that could be meant as the answer.

Valid JSON is taken as it stands; only where a brace opens none does the relaxed reader try, and only where
that finds nothing either, json_repair.
"""

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from harness.parsing import mend, relaxed
from harness.parsing.answer import FIELDS
from harness.parsing.status import Failure, Repair, Status
from harness.parsing.values import is_schema, match

_MAX_BROKEN = 200  # braces that open nothing; a text with more is noise, and each costs a try
_MAX_TRIED = 4_000_000  # characters that these tries may read in all, or a megabyte would take minutes
_MAX_OBJECTS = 5_000  # no answer has as many
_OPENING = re.compile(r"[{｛]")
_FENCE = re.compile(r"```[ \t]*[\w+-]*|~~~[ \t]*\w*")
_STRAY = frozenset("[](){},;:.\"'`*\\")


@dataclass(frozen=True)
class Candidate:
    """An object shaped like an answer, and what it took to read it."""

    members: dict[str, Any]
    repairs: frozenset[Repair] = frozenset()


@dataclass
class _Objects:
    """Top-level objects of a text with their spans, and what else was met on the way."""

    readings: list[tuple[int, relaxed.Reading]] = field(default_factory=list)
    broken: int | None = None  # first brace that was meant as JSON and cannot be read
    unfinished: bool = False


def whole(text: str, role: str, actions: tuple[str, ...]) -> Candidate | None:
    """The candidate if the text is one JSON object, shaped like an answer, and nothing else."""
    try:
        value = relaxed.DECODER.decode(text)
    except (ValueError, RecursionError):
        return None
    return Candidate(value) if _shaped(value, role, actions) else None


def candidates(
    text: str, role: str, actions: tuple[str, ...], cut: bool, reasons_first: bool = False
) -> list[Candidate]:
    """All candidates, in the text's order.

    Args:
        text: the answer, without thought and special tokens.
        role: whose fields to look for.
        actions: whose names to look for.
        cut: the engine stopped at its token limit, so an open bracket is never closed here.
        reasons_first: the prompt asked for reasons before the answer, so prose there is no repair.

    Raises:
        Failure: no_json, label_only, truncated_json, syntax or, without any candidate, missing_action.
    """
    escapes: frozenset[Repair] = frozenset()
    objects = _objects(text, cut)
    if not objects.readings and ('\\"' in text or "&quot;" in text):
        text, escapes = html.unescape(text).replace('\\"', '"'), frozenset({Repair.ESCAPES})
        objects = _objects(text, cut)
    if objects.unfinished:
        raise Failure(Status.TRUNCATED_JSON, "the text ends inside a JSON value")

    shaped: list[Candidate] = []
    outside, at = [], 0
    for start, reading in objects.readings:
        inside = list(_answers(reading.value, role, actions))
        shaped += [Candidate(members, extra | reading.repairs | escapes) for members, extra in inside]
        if inside:
            outside.append(text[at:start])
            at = reading.end
    if shaped:
        before, *behind = [*outside, text[at:]]
        around = _around(before, "\n".join(behind), reasons_first)
        return [Candidate(one.members, one.repairs | around) for one in shaped]
    if objects.broken is not None:
        mended, rest = mend.mended(text[objects.broken :], FIELDS[role] + actions, cut)
        extra = escapes | _around(text[: objects.broken], rest, reasons_first) | {Repair.JSON_REPAIR}
        inside = list(_answers(mended, role, actions))
        if not inside:
            raise mend.unreadable()
        return [Candidate(members, nested | extra) for members, nested in inside]
    raise _nothing(text, bool(objects.readings), actions)


def spans(text: str, role: str, actions: tuple[str, ...]) -> list[tuple[int, int]]:
    """Where in a text the objects stand that `candidates` finds; empty where it takes more than finding."""
    try:
        objects = _objects(text, cut=False)
    except Failure:
        return []
    return [
        (start, reading.end)
        for start, reading in objects.readings
        if any(_answers(reading.value, role, actions))
    ]


def _objects(text: str, cut: bool) -> _Objects:
    """Objects from left to right; a brace that opens none is passed by."""
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
            at = start + 1  # closed, so not cut off: an opening quote has no partner
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
    return isinstance(value, dict) and any(match(key, FIELDS[role] + actions) for key in value)


def _answers(
    value: Any, role: str, actions: tuple[str, ...]
) -> Iterator[tuple[dict[str, Any], frozenset[Repair]]]:
    """Answer-shaped objects in a JSON value: itself, or what a wrapper such as a tool call holds."""
    stack = [(value, frozenset[Repair]())]
    while stack:
        node, repairs = stack.pop()
        if isinstance(node, str) and "{" in node:
            try:
                node = relaxed.DECODER.decode(node)
            except (ValueError, RecursionError):
                continue
        if isinstance(node, relaxed.Repeated) or _shaped(node, role, actions) or is_schema(node):
            yield node, repairs
        elif isinstance(node, dict | list):
            inner = list(node.values()) if isinstance(node, dict) else node
            stack += [(child, frozenset({Repair.NESTED})) for child in reversed(inner)]


def _around(before: str, behind: str, reasons_first: bool) -> frozenset[Repair]:
    """What the text before the first answer, and all that is behind it and no answer, takes to overlook."""
    if reasons_first:
        return _outside(behind) | _outside(before) - {Repair.PROSE_AROUND}
    return _outside(f"{before}\n{behind}")


def _outside(outside: str) -> frozenset[Repair]:
    bare, fences = _FENCE.subn("", outside)
    repairs = {Repair.CODE_FENCE} if fences else set()
    rest = "".join(bare.split())
    if rest:
        repairs.add(Repair.STRAY_PUNCTUATION if _STRAY.issuperset(rest) else Repair.PROSE_AROUND)
    return frozenset(repairs)


def _name(action: str) -> str:
    return rf"(?<![A-Za-z0-9_]){re.escape(action)}(?![A-Za-z0-9_])"


def _nothing(text: str, objects: bool, actions: tuple[str, ...]) -> Failure:
    """Why a text without a candidate has none."""
    lone = text.strip("".join(_STRAY) + "!?# \t\r\n").casefold()
    # Where a name stands nowhere, no look at what is around it is needed.
    named = [a for a in actions if (a in text and re.search(_name(a), text)) or lone == a.casefold()]
    if len(named) == 1:
        return Failure(Status.LABEL_ONLY, f"only {named[0]} is named, without probabilities")
    if objects:
        return Failure(Status.MISSING_ACTION, "there is a JSON object, but no distribution in it")
    return Failure(Status.NO_JSON, "there is no JSON object in the text")
