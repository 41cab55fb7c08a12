"""Parse an answer that needs no repair in one typed reading, which costs a third of a search for repairs."""

import math
from functools import lru_cache
from typing import Annotated, Any, Literal

import msgspec

from harness.parsing.answer import Answer, recommended
from harness.parsing.values import EXACT, is_placeholder_text
from harness.prompts.answer_schema import EVIDENCE_CHARS, NAMED, RISKS, Shape

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


def fitting(text: str, shape: Shape) -> Answer | None:
    """Return the answer if the text is nothing else and fits the schema and the sum of 1.

    None is no verdict: a text with an escape, for example, is left to the slower readers.
    """
    for decoder, colons in _forms(shape):
        try:
            answer = decoder.decode(text)
        except (ValueError, RecursionError):
            continue
        evidence = answer.evidence if shape.role == "helper" else ""
        # The decoder silently takes the last of two equal keys, so the colons are counted: one for each key.
        if "\\" in text or text.count(":") != colons + evidence.count(":") or is_placeholder_text(evidence):
            return None
        return _answer(answer, shape)
    return None


def _answer(answer: Any, shape: Shape) -> Answer | None:
    actions = shape.actions
    mass: float | None = None
    if hasattr(answer, "action_distribution"):
        shares = msgspec.structs.astuple(answer.action_distribution)
        mass = math.fsum(shares)
        if abs(mass - 1) > EXACT:
            return None
        intent = tuple([abs(p) / mass for p in shares])
        confidence = max(intent)
        maneuver = actions[intent.index(confidence)]
    else:
        maneuver = getattr(answer, NAMED[shape.role])
        confidence = abs(answer.confidence)
        intent = recommended(maneuver, confidence, actions)
    if shape.role == "ego":
        return Answer(intent, mass, None, frozenset())
    message = {
        "evidence": answer.evidence,
        "risk": answer.risk,
        "recommended_maneuver": maneuver,
        "confidence": confidence,
    }
    return Answer(intent, mass, message, frozenset())


@lru_cache(maxsize=16)
def _forms(shape: Shape) -> tuple[tuple[msgspec.json.Decoder[Any], int], ...]:
    """Return a decoder for each form that an answer may have, and the number of keys of the form."""
    actions = shape.actions
    if shape.extension:
        return ()  # left to the slower readers
    if any(":" in action or "\\" in action for action in actions) or len(set(actions)) < len(actions):
        return ()
    share_fields = [(f"p{n}", Share, msgspec.field(name=action)) for n, action in enumerate(actions)]
    shares = msgspec.defstruct("Shares", share_fields, forbid_unknown_fields=True)
    evidence = Annotated[str, msgspec.Meta(max_length=EVIDENCE_CHARS)]
    report: list[tuple[str, Any]] = [("evidence", evidence), ("risk", Literal[RISKS])]
    decoders = []
    for name in shape.forms:
        form = report if shape.role == "helper" else []
        if name == "distribution":
            form, keys = [*form, ("action_distribution", shares)], len(actions)
        else:
            form, keys = [*form, (NAMED[shape.role], Literal[actions]), ("confidence", Share)], 0
        struct = msgspec.defstruct("Form", form, forbid_unknown_fields=True)
        decoders.append((msgspec.json.Decoder(struct), len(form) + keys))
    return tuple(decoders)
