"""Build the JSON Schema of an answer from the action names.

Prompts, servers that constrain answers and readers of a dataset use it. JSON Schema cannot express that
probabilities sum to one; `harness.parsing.parse` checks that.
"""

from collections.abc import Sequence
from typing import Any

from harness.core import errors

ROLES = ("ego", "helper")
RISKS = ("low", "medium", "high")
EVIDENCE_CHARS = 200


def answer_schema(
    role: str, actions: Sequence[str], scenario: str | None = None, form: str | None = None
) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one role's answer.

    A helper answers in one of two forms: a recommended maneuver with a confidence (prompt v1) or a
    distribution (prompt v2). So does an ego: a distribution, or a maneuver with a confidence (prompt v9).

    Args:
        role: `ego` or `helper`.
        actions: meta-action names, in the environment's order.
        scenario: named in the title only.
        form: the form that is asked for: `recommendation` or `distribution` of a helper, where None allows
            both; `maneuver` of an ego, and a distribution by any other.

    Raises:
        UserError: unknown role.
    """
    probability = {"type": "number", "minimum": 0, "maximum": 1}
    distribution = {"action_distribution": _closed(dict.fromkeys(actions, probability))}
    report = {
        "evidence": {"type": "string", "maxLength": EVIDENCE_CHARS},
        "risk": _choice(RISKS),
    }
    recommendation = {"recommended_maneuver": _choice(actions), "confidence": probability}
    title = f"{role} answer" + (f", {scenario}" if scenario else "")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title}
    if role == "ego":
        maneuver = {"maneuver": _choice(actions), "confidence": probability}
        return head | _closed(maneuver if form == "maneuver" else distribution)
    if role == "helper":
        forms = {
            "recommendation": _closed(report | recommendation),
            "distribution": _closed(report | distribution),
        }
        return head | ({"oneOf": list(forms.values())} if form is None else forms[form])
    raise errors.unknown("role", role, ROLES)


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
