"""Read a version's `answer.json`: what its answers hold beside the decision,
such as a reason or some gaps.

The file has, for each role that is asked for more, JSON Schemas of further members by name. They
come before the members that decide, and all are required. Only what constrained decoding can fill
in is allowed: bounded texts, choices, numbers, lists and objects.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from harness.core.config import json_loads
from harness.core.errors import UserError, printable, unknown
from harness.prompts.answer_schema import FIELDS, ROLES, closed, longest

ANSWER = "answer.json"
KEYWORDS = {
    "string": ("maxLength", "enum"),
    "number": ("minimum", "maximum"),
    "integer": ("minimum", "maximum"),
    "boolean": (),
    "array": ("items", "minItems", "maxItems"),
    "object": ("properties",),
}
MOST_CHARACTERS = 2000  # of the longest text of all members
MOST_TEXT, MOST_ITEMS, MOST_MEMBERS, MOST_CHOICES, MOST_DEPTH = 400, 20, 16, 100, 4
LARGEST, LEAST_RANGE = 1e6, 1e-3  # of a number
MOST_WHOLE = 1000  # whole numbers between two bounds
_NAME = re.compile(r"[A-Za-z]\w{0,39}", re.ASCII)
_CHOICE = re.compile(r'[^"\\]{1,80}')


def read(text: str, where: str) -> dict[str, str]:
    """Return what a prompt version asks for beside the decision, such as a reason, by role.

    A prompt version is a folder of templates; roles are `ego` and `helper`. `text` is that of its
    `answer.json`, which has JSON Schemas of such further members; those returned are JSON texts as
    `Shape.extension` takes them. `where` names the file in messages. Raises UserError if the text
    is no JSON, or has something that cannot be constrained.
    """
    table = json_loads(text, where)
    if not isinstance(table, dict) or not table:
        raise UserError(f"{where} is no object with members; give ego, helper or both")
    extension = {}
    for role, members in table.items():
        if role not in ROLES:
            raise UserError(f"{where}: {unknown('role', role, ROLES)}")
        checked = _members(members, f"{where}: {role}", 1)
        for name in checked:
            if name.casefold() in FIELDS:
                raise UserError(
                    f"{where}: {role}.{name} is a field of every answer; give another name"
                )
        if (characters := longest(closed(checked))) > MOST_CHARACTERS:
            raise UserError(
                f"{where}: {role} may take {characters} characters; give bounds that leave at most "
                f"{MOST_CHARACTERS}"
            )
        extension[role] = json.dumps(checked, separators=(",", ":"))
    return extension


def _members(members: object, what: str, depth: int) -> dict[str, Any]:
    if not isinstance(members, dict) or not 0 < len(members) <= MOST_MEMBERS:
        raise UserError(
            f"{what} has no members or too many; give an object with 1 to {MOST_MEMBERS} schemas "
            "by name"
        )
    for name in members:
        if not _NAME.fullmatch(name):
            raise UserError(
                f"{what}: {printable(name, 40)!r} is no name; give up to 40 of A-Z a-z 0-9 _"
            )
    return {name: _schema(schema, f"{what}.{name}", depth) for name, schema in members.items()}


def _schema(schema: object, what: str, depth: int) -> dict[str, Any]:
    """Return a schema as servers and the library take it."""
    if not isinstance(schema, dict):
        raise UserError(
            f'{what} is no schema; give one such as {{"type": "string", "maxLength": 120}}'
        )
    if depth > MOST_DEPTH:
        raise UserError(f"{what} is nested {depth} deep; give at most {MOST_DEPTH}")
    kind = schema.get("type")
    keywords = KEYWORDS.get(kind) if isinstance(kind, str) else None
    every = {word for words in KEYWORDS.values() for word in words}
    for word in schema:
        if word != "type" and word not in (every if keywords is None else keywords):
            of = "a schema" if keywords is None else f"type {kind}"
            allowed = ", ".join(("type", *(sorted(every) if keywords is None else keywords)))
            raise UserError(
                f"{what}: {of} may not have {printable(word, 40)!r}; allowed: {allowed}"
            )
    if keywords is None:
        raise UserError(f"{what}: type {printable(kind, 40)!r}; give one of {', '.join(KEYWORDS)}")
    if kind == "string":
        return {"type": kind, **_text(schema, what)}
    if kind in ("number", "integer"):
        return {"type": kind, **_bounds(schema, what)}
    if kind == "array":
        most = _count(schema, "maxItems", 1, MOST_ITEMS, what)
        least = _count(schema, "minItems", 0, most, what) if "minItems" in schema else 0
        items = _schema(schema.get("items"), f"{what}.items", depth + 1)
        return {"type": kind, "items": items, "minItems": least, "maxItems": most}
    if kind == "object":
        return closed(_members(schema.get("properties"), what, depth + 1))
    return {"type": kind}


def _text(schema: Mapping[str, Any], what: str) -> dict[str, Any]:
    if "enum" not in schema:
        return {"maxLength": _count(schema, "maxLength", 1, MOST_TEXT, what)}
    choices = schema["enum"]
    good = (
        isinstance(choices, list) and 0 < len(choices) <= MOST_CHOICES and "maxLength" not in schema
    )
    good = good and all(
        isinstance(c, str) and c.isprintable() and _CHOICE.fullmatch(c) for c in choices
    )
    if not good or len(set(choices)) < len(choices):
        raise UserError(
            f"{what}.enum: give 1 to {MOST_CHOICES} different texts of up to 80 printable "
            "characters without quotes and backslashes, and no maxLength"
        )
    return {"enum": choices}


def _bounds(schema: Mapping[str, Any], what: str) -> dict[str, Any]:
    kinds = (int,) if schema["type"] == "integer" else (int, float)
    least, most = schema.get("minimum", math.nan), schema.get("maximum", math.nan)
    for bound in (least, most):
        if type(bound) not in kinds or not abs(bound) <= LARGEST:
            raise UserError(
                f"{what}: {printable(bound, 40)} is no bound; give minimum and maximum, "
                f"{schema['type']}s from {-LARGEST:.0f} to {LARGEST:.0f}"
            )
    if not most - least >= LEAST_RANGE or (
        schema["type"] == "integer" and most - least > MOST_WHOLE
    ):
        raise UserError(
            f"{what}: from {least} to {most}; give a minimum below the maximum, of an integer by "
            f"at most {MOST_WHOLE}"
        )
    return {"minimum": least, "maximum": most}


def _count(schema: Mapping[str, Any], word: str, least: int, most: int, what: str) -> int:
    count = schema.get(word)
    if type(count) is not int or not least <= count <= most:
        raise UserError(f"{what}.{word} is {printable(count, 40)}; give {least} to {most}")
    return count
