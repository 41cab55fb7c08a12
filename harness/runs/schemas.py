"""JSON Schemas of what a run holds: `run.json`, a line of `answers.jsonl`, and a message sent.

They are made of the types by which runs are read, for programs that read them, too.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from harness.dataset.schema import published
from harness.prompts.answer_schema import EVIDENCE_CHARS
from harness.runs.records import Answer, Manifest
from harness.world.fields import Closed, Number, VehicleId

Share = Annotated[float, Meta(ge=0, le=1)]


class Says(Closed, frozen=True):
    """Hold what a helper says beside its intent; what it left out is null."""

    evidence: Annotated[str, Meta(max_length=EVIDENCE_CHARS)] | None  # the words of its message
    risk: Literal["low", "medium", "high"] | None
    recommended_maneuver: str | None  # the action that it names, where its answer has that form
    confidence: Share | None  # in this action


class Message(Closed, frozen=True):
    """Hold a helper's message as it is sent where `content` is `intent` and `encoding` is `json`.

    It is sent as compact JSON, whose bytes are the payload; without an intent it is not used.
    """

    sender: VehicleId = field(name="from")  # the helper
    # the probability of each of the ego's actions, two decimals; null if its answer failed
    intent: tuple[Share, ...] | None
    says: Says | None  # the rest of its answer; null if it failed
    xy_m: tuple[Number, Number]  # where it is, m to the east and to the south, one decimal


def schemas(actions: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the JSON Schemas (draft 2020-12) of a run's files and of messages, by file name.

    `actions` are the names of the run's meta-actions, of which an intent has one number each.
    """
    run = published(Manifest, "run.json of a run")
    answer = published(Answer, "a line of answers.jsonl")
    message = published(Message, "a helper's message on the air")
    for schema, kind in ((answer, "Answer"), (message, "Message")):
        members = schema["$defs"][kind]["properties"]
        [numbers, _] = members["intent"]["anyOf"]
        numbers |= {"minItems": len(actions), "maxItems": len(actions)}
    names = message["$defs"]["Says"]["properties"]["recommended_maneuver"]["anyOf"]
    names[0] = {"enum": [*actions]}
    return {
        "run.schema.json": _portable(run),
        "answer.schema.json": _portable(answer),
        "message.schema.json": _portable(message),
    }


def _portable(schema: Any) -> Any:
    """Return a schema whose patterns are those of JSON Schema, which ends a text with `$`."""
    if isinstance(schema, dict):
        return {key: _portable(each) for key, each in schema.items()}
    if isinstance(schema, list):
        return [_portable(each) for each in schema]
    return schema.replace(r"\Z", "$") if isinstance(schema, str) else schema
