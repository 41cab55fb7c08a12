"""Build the JSON Schema of an answer: what a prompt asks for, servers are sent,
and an answer is judged by.

JSON Schema cannot express that probabilities sum to one; `harness.parsing.parse` checks that.
"""

import json
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from harness.core import errors

FORMS = {"ego": ("distribution", "maneuver"), "helper": ("distribution", "recommendation")}
ROLES = tuple(FORMS)
# the key of an action that is named alone
NAMED = {"ego": "maneuver", "helper": "recommended_maneuver"}
# of any role's answer
FIELDS = ("evidence", "risk", "action_distribution", "confidence", *NAMED.values())
RISKS = ("low", "medium", "high")
EVIDENCE_CHARS = 200


class Shape(NamedTuple):
    """Describe what an answer's JSON must look like; it decides the schema and the parser.

    `role` is who answers: `ego`, the vehicle that decides, or `helper`, one that sees what the ego
    cannot. `actions` are the names of meta-actions in order: what the ego can do in one decision,
    such as to go slower. `form` is `distribution` over the actions, or one action with a
    confidence: `maneuver` of the ego and `recommendation` of a helper; None for either. `extension`
    has the JSON Schemas of further members, by name, as JSON text, empty for none; `placeholders`
    are texts that the prompt shows in place of values, such as `max 12 words`.
    """

    role: str  # `ego` or `helper`
    actions: tuple[str, ...]  # meta-action names, in the environment's order
    form: str | None = None  # one of the role's `FORMS`; None for any of them
    # JSON text of the schemas of further members by name (`harness.prompts.extension`), which come
    # first; empty for none
    extension: str = ""
    # what the prompt shows in place of values, which is no evidence
    placeholders: tuple[str, ...] = ()

    @property
    def forms(self) -> tuple[str, ...]:
        return FORMS[self.role] if self.form is None else (self.form,)

    @property
    def named(self) -> str | None:
        """Return the key under which an answer names an action; None if a distribution is asked."""
        return None if self.form == "distribution" else NAMED[self.role]

    @property
    def further(self) -> dict[str, Any]:
        return dict(json.loads(self.extension)) if self.extension else {}


def answer_schema(
    role: str,
    actions: Sequence[str],
    scenario: str | None = None,
    form: str | None = None,
    extension: str = "",
    placeholders: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one role's answer.

    Args:
        role: `ego` or `helper`, who answers.
        actions: names of the meta-actions, in order.
        scenario: a name for the schema's title.
        form: `distribution` over the actions, or one action with a confidence: `maneuver` of the
            ego, `recommendation` of a helper; None for either.
        extension: JSON Schemas of further members by name, as JSON text; empty for none.
        placeholders: not used; it stands here so that all fields of a `Shape` can be passed.

    Raises:
        UserError: the role is unknown.
    """
    if role not in ROLES:
        raise errors.unknown("role", role, ROLES)
    probability = {"type": "number", "minimum": 0, "maximum": 1}
    shape = Shape(role, tuple(actions), form, extension)
    report = shape.further
    if role == "helper":
        report |= {
            "evidence": {"type": "string", "maxLength": EVIDENCE_CHARS},
            "risk": _choice(RISKS),
        }
    distribution = {"action_distribution": closed(dict.fromkeys(actions, probability))}
    single = {NAMED[role]: _choice(actions), "confidence": probability}
    forms = [
        closed(report | (distribution if each == "distribution" else single))
        for each in shape.forms
    ]
    title = f"{role} answer" + (f", {scenario}" if scenario else "")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title}
    return head | (forms[0] if len(forms) == 1 else {"oneOf": forms})


def _choice(names: Sequence[str]) -> dict[str, Any]:
    # The type follows from the names, but some servers refuse a schema without it.
    return {"type": "string", "enum": list(names)}


def closed(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of an object that has exactly these properties, all required."""
    return {
        "type": "object",
        "properties": dict(properties),
        "required": list(properties),
        "additionalProperties": False,
    }


@lru_cache
def constrained_schema(shape: Shape) -> Mapping[str, Any]:
    """Return the JSON Schema by which decoding is constrained: a model can write nothing else.

    `shape` says what the answer must look like; its `form` must be set. A helper's evidence is an
    empty text in it.
    """
    schema = answer_schema(shape.role, shape.actions, form=shape.form, extension=shape.extension)
    schema = {key: value for key, value in schema.items() if key not in ("$schema", "title")}
    if shape.role == "helper":
        schema["properties"] = {
            **schema["properties"],
            "evidence": {"type": "string", "enum": [""]},
        }
    return schema


def number_texts(schema: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the texts of numbers among which a model may choose in a constrained answer.

    `schema` is the number's JSON Schema. The numbers are steps of a power of ten from `minimum` to
    `maximum`: 100 to 1000 of them for type `number`, such as hundredths between 0 and 1; all whole
    numbers for `integer`.
    """
    least, most = schema["minimum"], schema["maximum"]
    decimals = 0 if schema["type"] == "integer" else 2 - math.floor(math.log10(most - least))
    steps = range(math.ceil(least * 10.0**decimals), math.floor(most * 10.0**decimals) + 1)
    texts = [f"{step / 10.0**decimals:.{max(decimals, 0)}f}" for step in steps]
    return tuple(text for text in texts if least <= float(text) <= most)


def longest(schema: Mapping[str, Any]) -> int:
    """Return the most characters that a value's compact JSON can have, escapes not counted.

    `schema` is the value's JSON Schema, one that a prompt version may ask for.
    """
    if "enum" in schema:
        return max(len(json.dumps(choice, ensure_ascii=False)) for choice in schema["enum"])
    match schema["type"]:
        case "string":
            return 2 + int(schema["maxLength"])
        case "boolean":
            return len("false")
        case "array":
            return 1 + int(schema["maxItems"]) * (1 + longest(schema["items"]))
        case "object":
            return 1 + sum(
                len(name) + 4 + longest(each) for name, each in schema["properties"].items()
            )
    return max(map(len, number_texts(schema)))


def plainest(schema: Mapping[str, Any]) -> Any:
    """Return a minimal value that fits a JSON Schema: an empty text, the first choice, 0.

    `schema` is that of a further member of an answer, which a prompt may ask for beside the
    decision; a rule that answers has nothing to say there.
    """
    if "enum" in schema:
        return schema["enum"][0]
    match schema["type"]:
        case "string":
            return ""
        case "boolean":
            return False
        case "array":
            return [plainest(schema["items"])] * schema["minItems"]
        case "object":
            return {name: plainest(each) for name, each in schema["properties"].items()}
    return min(max(0, schema["minimum"]), schema["maximum"])
