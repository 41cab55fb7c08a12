"""Build the JSON Schema of an answer: what a prompt asks for, servers are sent, and an answer is judged by.

JSON Schema cannot express that probabilities sum to one; `harness.parsing.parse` checks that.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from harness.core import errors

FORMS = {"ego": ("distribution", "maneuver"), "helper": ("distribution", "recommendation")}
ROLES = tuple(FORMS)
NAMED = {"ego": "maneuver", "helper": "recommended_maneuver"}  # the key of an action that is named alone
RISKS = ("low", "medium", "high")
EVIDENCE_CHARS = 200


class Shape(NamedTuple):
    """What decides the JSON of an answer.

    Attributes:
        role: `ego` or `helper`.
        actions: meta-action names, in the environment's order.
        form: one of the role's `FORMS`; None for any of them.
    """

    role: str
    actions: tuple[str, ...]
    form: str | None = None

    @property
    def forms(self) -> tuple[str, ...]:
        """The forms that the answer may have."""
        return FORMS[self.role] if self.form is None else (self.form,)

    @property
    def named(self) -> str | None:
        """The key of the action that its form names, with a confidence; None for a distribution."""
        return None if self.form == "distribution" else NAMED[self.role]


def answer_schema(
    role: str, actions: Sequence[str], scenario: str | None = None, form: str | None = None
) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one role's answer.

    An answer has one of two forms: a distribution, or one action with a confidence.

    Args:
        role: `ego` or `helper`.
        actions: meta-action names, in the environment's order.
        scenario: named in the title only.
        form: the form that is asked for, one of the role's `FORMS`; None allows any.

    Raises:
        UserError: unknown role.
    """
    if role not in ROLES:
        raise errors.unknown("role", role, ROLES)
    probability = {"type": "number", "minimum": 0, "maximum": 1}
    report: dict[str, Any] = {}
    if role == "helper":
        report = {"evidence": {"type": "string", "maxLength": EVIDENCE_CHARS}, "risk": _choice(RISKS)}
    distribution = {"action_distribution": _closed(dict.fromkeys(actions, probability))}
    one = {NAMED[role]: _choice(actions), "confidence": probability}
    forms = [
        _closed(report | (distribution if each == "distribution" else one))
        for each in Shape(role, tuple(actions), form).forms
    ]
    title = f"{role} answer" + (f", {scenario}" if scenario else "")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title}
    return head | (forms[0] if len(forms) == 1 else {"oneOf": forms})


def _choice(names: Sequence[str]) -> dict[str, Any]:
    # The type follows from the names, but some servers refuse a schema without it.
    return {"type": "string", "enum": list(names)}


def _closed(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }
