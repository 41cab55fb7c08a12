"""Read an answer that is exactly what was asked for, in one typed reading;
anything else takes repairs.
"""

import math
from functools import lru_cache
from typing import Annotated, Any, Literal

import msgspec

from harness.parsing.answer import Answer, recommended
from harness.parsing.relaxed import DECODER
from harness.parsing.schema import further, is_json
from harness.parsing.values import EXACT, is_placeholder_text
from harness.prompts.answer_schema import EVIDENCE_CHARS, NAMED, RISKS, Shape

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


def fitting(text: str, shape: Shape) -> Answer | None:
    """Return the answer if a text is exactly the JSON that was asked for, with a sum of 1.

    `shape` says what was asked for. The probabilities must sum to 1 within 0.001. None for any
    other text, which then takes corrections or fails.
    """
    try:
        value = DECODER.decode(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(value, dict) or not is_json(value):
        return None
    names, extension = shape.further, None
    if names:
        extension = further({name: value.pop(name) for name in names if name in value}, shape)
        if extension is None:
            return None
    for form in _forms(shape):
        try:
            return _answer(msgspec.convert(value, form), shape, extension)
        # a form that it is not, or a key with a lone surrogate, which is legal JSON
        except ValueError:
            continue
    return None


def _answer(answer: Any, shape: Shape, extension: dict[str, Any] | None) -> Answer | None:
    actions = shape.actions
    mass: float | None = None
    if hasattr(answer, "action_distribution"):
        share_of = answer.action_distribution
        mass = math.fsum(share_of.values())
        if len(share_of) < len(actions) or abs(mass - 1) > EXACT:
            return None
        shares = [share_of[action] for action in actions]
        intent = tuple([abs(p) / mass for p in shares])
        confidence = max(intent)
        maneuver = actions[intent.index(confidence)]
    else:
        maneuver = getattr(answer, NAMED[shape.role])
        confidence = abs(answer.confidence)
        intent = recommended(maneuver, confidence, actions)
    if shape.role == "ego":
        return Answer(intent, mass, None, frozenset(), extension)
    if is_placeholder_text(answer.evidence, shape):
        return None
    message = {
        # a lone surrogate is legal JSON
        "evidence": answer.evidence.encode("utf-8", "replace").decode(),
        "risk": answer.risk,
        "recommended_maneuver": maneuver,
        "confidence": confidence,
    }
    return Answer(intent, mass, message, frozenset(), extension)


@lru_cache(maxsize=16)
def _forms(shape: Shape) -> tuple[type[msgspec.Struct], ...]:
    """Return the type of each form that an answer may have, without further members."""
    shares = dict[Literal[shape.actions], Share]  # type: ignore[name-defined]
    report: list[tuple[str, Any]] = []
    if shape.role == "helper":
        evidence = Annotated[str, msgspec.Meta(max_length=EVIDENCE_CHARS)]
        report = [("evidence", evidence), ("risk", Literal[RISKS])]
    single = [(NAMED[shape.role], Literal[shape.actions]), ("confidence", Share)]
    return tuple(
        msgspec.defstruct(
            "Form",
            [*report, *([("action_distribution", shares)] if form == "distribution" else single)],
            forbid_unknown_fields=True,
        )
        for form in shape.forms
    )
