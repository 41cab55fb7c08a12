"""What several tests of the parser draw from and judge by."""

import json
import math
from functools import cache
from typing import Any

import jsonschema
from corpus import ACTIONS
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from harness.parsing.parse import Parsed, parse
from harness.prompts.answer_schema import Shape, answer_schema

# Whether a shared machine is slow today is no property of the parser.
unhurried = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

# Texts that prompts write in the place of a helper's evidence.
PLACEHOLDERS = (
    "max 12 words", "Max. 12 words.", 
        "one short sentence", "<evidence>", "...", "string", "low|medium|high",
    "low|medium", "SLOWER or IDLE", "0 to 1",
)  # fmt: skip
ROLES = st.sampled_from(["ego", "helper"])


@cache
def validator(shape: Shape) -> Any:
    return jsonschema.Draft202012Validator(
        answer_schema(shape.role, shape.actions, form=shape.form)
    )


@st.composite
def hundredths(draw: st.DrawFn, actions: tuple[str, ...] = ACTIONS) -> dict[str, float]:
    """A distribution in steps of 0.01 that sums to 1."""
    cuts = sorted(
        draw(st.lists(st.integers(0, 100), min_size=len(actions) - 1, max_size=len(actions) - 1))
    )
    parts = [b - a for a, b in zip([0, *cuts], [*cuts, 100], strict=True)]
    return {action: part / 100 for action, part in zip(actions, parts, strict=True)}


def ego(text: str, **asked: Any) -> Parsed:
    return parse(text, role="ego", actions=ACTIONS, **asked)


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("duplicate key")
    return dict(pairs)


def judged_strict(text: str, shape: Shape) -> bool:
    """A judge that shares no code with the parser:
    JSON, jsonschema, the placeholders, and a sum.
    """
    try:
        value = json.loads(text, object_pairs_hook=_no_key_twice)
    except (ValueError, RecursionError):
        return False
    if not validator(shape).is_valid(value):
        return False
    if value.get("evidence") in (*PLACEHOLDERS, *shape.placeholders):
        return False
    if "action_distribution" not in value:
        return math.isfinite(value["confidence"])
    return abs(math.fsum(value["action_distribution"].values()) - 1) <= 0.001 + 1e-9
