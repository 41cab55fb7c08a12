"""Put an answer together that stands in pieces, in a text,
or where the types of its schema would.
"""

from collections.abc import Sequence
from typing import Any

from harness.core.errors import printable
from harness.parsing import relaxed
from harness.parsing.status import Failure, Repair, Status
from harness.parsing.values import match
from harness.prompts.answer_schema import NAMED

FIELDS = {
    "ego": ("maneuver", "confidence", "action_distribution"),
    "helper": ("evidence", "risk", "recommended_maneuver", "confidence", "action_distribution"),
}
_DISTRIBUTION = "action_distribution"
_OF_A_SCHEMA = ("$schema", "properties")

Found = tuple[dict[str, Any], frozenset[Repair]]  # members, and the repairs that finding them took


def decoded(value: object) -> tuple[Any, frozenset[Repair]]:
    """Return the JSON object that a text value holds, with the repairs that this took.

    A repair is one correction of the text. A model may have written an object in quotes. Nearly
    valid JSON counts, too. Any other value is returned as it is, without repairs.
    """
    if not isinstance(value, str) or "{" not in value:
        return value, frozenset()
    text = value.strip()
    try:
        return relaxed.DECODER.decode(text), frozenset({Repair.NESTED})
    except (ValueError, RecursionError):
        pass
    if not text.startswith("{"):
        return value, frozenset()
    try:
        reading = relaxed.read(text, 0)
    except (relaxed.Broken, relaxed.Unfinished):
        return value, frozenset()
    if reading.end < len(text) or reading.closed_by_end:
        return value, frozenset()
    return reading.value, frozenset({Repair.NESTED, *reading.repairs})


def fields_of(members: dict[str, Any], role: str, actions: Sequence[str]) -> set[str]:
    """Return the names of the answer's fields that an object has, whatever their spelling.

    `members` are the object's values by key, and `actions` the names of meta-actions. `role` is
    `ego` or `helper`. Keys that are actions count as `action_distribution`.
    """
    names = {match(key, FIELDS[role]) for key in members}
    if any(match(key, actions) for key in members):
        names.add(_DISTRIBUTION)
    return {name for name in names if name}


def decides(fields: set[str], role: str) -> bool:
    """Return whether an answer has what decides: an action or a distribution over actions.

    `fields` are the names of its members, as `fields_of` returns them, and `role` is `ego` or
    `helper`.
    """
    return not fields.isdisjoint((_DISTRIBUTION, NAMED[role]))


def in_schema(schema: dict[str, Any], role: str, actions: Sequence[str]) -> list[Found]:
    """Return the answers that a model wrote into a JSON Schema, in place of an answer to it.

    `schema` is the object that it wrote. Each answer is a pair: its members by key, and the repairs
    (corrections) that finding it took. Answers stand beside the schema's keywords, or under
    `properties` in place of types. `role` is `ego` or `helper`, and `actions` are the names of
    meta-actions.
    """
    answers: list[Found] = []
    outer = {key: value for key, value in schema.items() if key not in _OF_A_SCHEMA}
    if _states(outer, role, actions):
        answers.append((outer, frozenset({Repair.EXTRA_FIELD})))
    members = _properties(schema)
    inner = type(members)({key: _properties(value) for key, value in members.items()})
    if members is not schema and _states(inner, role, actions):
        answers.append((inner, frozenset({Repair.NESTED})))
    return answers


def distribution_in(value: object, actions: Sequence[str]) -> tuple[Any, frozenset[Repair]]:
    """Return the distribution over actions that a value holds, and the repairs that this took.

    A repair is one correction of the text. The distribution may stand in a text, or under a
    schema's `properties`. Any other value is returned as it is.
    """
    value, repairs = decoded(value)
    inner = _properties(value)
    if inner is value or not _states({_DISTRIBUTION: inner}, "ego", actions):
        return value, repairs
    return inner, repairs | {Repair.NESTED}


def _properties(value: Any) -> Any:
    inner = value.get("properties") if isinstance(value, dict) else None
    return inner if isinstance(inner, dict) else value


def _states(members: dict[str, Any], role: str, actions: Sequence[str]) -> bool:
    """Return whether members name an action, or give a number or a text for one,
    and not its type.
    """
    shares = [value for key, value in members.items() if match(key, (_DISTRIBUTION,))]
    for each in (members, *(share for share in shares if isinstance(share, dict))):
        answer_values = [
            value for key, value in each.items() if match(key, (NAMED[role], *actions))
        ]
        if answer_values and all(isinstance(value, str | float) for value in answer_values):
            return True
    return False


def gathered(
    members: dict[str, Any], role: str, actions: Sequence[str], apart: Sequence[str]
) -> Found:
    """Return an answer's members with its fields moved up from one level deeper, and the repairs.

    A repair is one correction of the text. `members` are the answer's values by key, and so are
    those returned. `role` is `ego` or `helper`, and `actions` are the names of meta-actions.
    Members whose keys are in `apart` are left alone. Raises Failure (of status conflicting_answers)
    if two members have the same field.
    """
    given = fields_of(members, role, actions)
    repairs: frozenset[Repair] = frozenset()
    whole, taken = dict(members), set(given)
    for key, value in members.items():
        if match(key, (*FIELDS[role], *actions, *apart)):
            continue
        piece, opened = decoded(value)
        if not isinstance(piece, dict) or isinstance(piece, relaxed.Repeated):
            continue
        fields = fields_of(piece, role, actions)
        if not fields or fields & given or _two_forms(fields | given, role):
            continue
        if fields & taken or _two_forms(fields | taken, role):
            detail = f"{printable(key, 40)} repeats what stands beside it in another object"
            raise Failure(Status.CONFLICTING_ANSWERS, detail)
        del whole[key]
        whole |= piece
        taken |= fields
        repairs |= opened - {Repair.NESTED} | {Repair.IN_PIECES}
    return (whole, repairs) if repairs else (members, repairs)


def _two_forms(fields: set[str], role: str) -> bool:
    return _DISTRIBUTION in fields and not fields.isdisjoint((NAMED[role], "confidence"))


def are_one(pieces: Sequence[dict[str, Any]], role: str, actions: Sequence[str]) -> bool:
    """Return whether several objects are pieces of one answer of a role, `ego` or `helper`.

    `pieces` are the objects' values by key, and `actions` the names of meta-actions. That is so if
    exactly one of them names an action or a distribution, and no field is in two.
    """
    if len(pieces) < 2 or any(isinstance(piece, relaxed.Repeated) for piece in pieces):
        return False
    fields = [fields_of(piece, role, actions) for piece in pieces]
    together = set().union(*fields)
    alone = sum(map(len, fields)) == len(together) and all(fields)
    return (
        alone
        and sum(decides(each, role) for each in fields) == 1
        and not _two_forms(together, role)
    )
