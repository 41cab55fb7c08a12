"""Read an answer-shaped object in each role: an intent, and a helper's message."""

import re
from collections.abc import Sequence
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from harness.core.errors import printable
from harness.parsing import pieces, values
from harness.parsing.pieces import FIELDS
from harness.parsing.relaxed import Repeated
from harness.parsing.schema import further
from harness.parsing.status import Failure, Repair, Status, joined, noted
from harness.prompts.answer_schema import EVIDENCE_CHARS, RISKS, Shape

# Keys that make an object an answer; an ego that states a confidence alone has said nothing yet.
MARKS = {"ego": ("maneuver", "action_distribution"), "helper": FIELDS["helper"]}


class Answer(Struct, frozen=True):
    """Hold an answer that was read from a JSON object: its intent, and the repairs that it took.

    An intent is the probabilities that a vehicle gives to the ego's actions. A repair is one
    correction without which the text could not be read.

    `intent` has the probabilities in the order of the actions, and `mass` their sum as stated; None
    if the answer names one action. `message` is a helper's evidence, risk, maneuver and confidence
    by key, None of the ego; `extension` has the further members that the prompt asked for, None
    without.
    """

    intent: values.Intent  # probabilities in the order of the actions
    mass: float | None  # sum of the probabilities as stated; None without any
    # a helper's evidence, risk, maneuver and confidence; None of the ego
    message: dict[str, Any] | None
    repairs: frozenset[Repair]  # the repairs that reading it took
    extension: dict[str, Any] | None = None  # further members that the prompt asked for

    def mended(self, repair: Repair) -> "Answer":
        return replace(self, repairs=self.repairs | {repair})

    def without(self, repairs: frozenset[Repair]) -> "Answer":
        return replace(self, repairs=self.repairs - repairs)


def read(
    members: dict[str, Any], so_far: frozenset[Repair], shape: Shape, divides: bool = False
) -> Answer:
    """Read an answer from the members of a JSON object that a model wrote.

    Args:
        members: the object's values by key.
        so_far: the repairs (corrections of the text) that finding the object took.
        shape: which members the prompt asked for, and the actions.
        divides: whether probabilities of any sum above 0 are divided by it.

    Raises:
        Failure: the members give no intent (probabilities of the actions); it has all statuses that
            apply.
    """
    if values.is_schema(members):
        raise Failure(Status.SCHEMA_ECHO, "the JSON Schema came back instead of an answer")
    actions, repairs = shape.actions, set(so_far)
    names = tuple(shape.further)
    if not isinstance(members, Repeated):
        members, found_repairs = pieces.gathered(members, shape.role, actions, names)
        repairs |= found_repairs
    fields, rest = values.sort_fields(members, FIELDS[shape.role] + names, repairs)
    extension = None
    if names:
        extension = further({name: fields.pop(name) for name in names if name in fields}, shape)
        if extension is None:
            repairs.add(Repair.UNFIT_EXTENSION)
    has_loose_actions = any(values.match(key, actions) for key in rest)
    if has_loose_actions and fields.keys() & {
        "action_distribution",
        "recommended_maneuver",
        "maneuver",
    }:
        raise Failure(
            Status.CONFLICTING_ANSWERS, "actions stand both inside and outside the answer's fields"
        )
    if has_loose_actions:
        repairs.add(Repair.UNWRAPPED)
        fields["action_distribution"] = rest
    elif rest:
        repairs.add(Repair.EXTRA_FIELD)
    if "confidence" in fields:  # which has no sum to tell percent by
        fields["confidence"] = values.in_percent(fields["confidence"], list(rest.values()))
    if "action_distribution" in fields:
        fields["action_distribution"], found_repairs = pieces.distribution_in(
            fields["action_distribution"], actions
        )
        repairs |= found_repairs

    if _is_other_form(fields, shape):
        repairs.add(Repair.OTHER_FORM)
    if shape.role == "helper":
        return replace(_helper(fields, shape, repairs, divides), extension=extension)
    if "maneuver" in fields:
        intent, mass, maneuver, _ = _judgement(fields, "maneuver", actions, repairs, divides)
        if Repair.OTHER_FORM in repairs and mass is None:
            detail = f"only {maneuver} is named, with a confidence; a distribution was asked for"
            raise Failure(Status.LABEL_ONLY, detail)
    else:
        if "confidence" in fields:
            repairs.add(Repair.EXTRA_FIELD)
        intent, mass = values.distribution(
            fields.get("action_distribution"), actions, repairs, divides
        )
    return Answer(intent, mass, None, frozenset(repairs), extension)


def _is_other_form(fields: dict[str, Any], shape: Shape) -> bool:
    return bool(shape.form) and ("action_distribution" in fields) == (shape.form != "distribution")


def _helper(fields: dict[str, Any], shape: Shape, repairs: set[Repair], divides: bool) -> Answer:
    failures: list[Failure] = []
    with noted(failures):
        intent, mass, maneuver, confidence = _judgement(
            fields, "recommended_maneuver", shape.actions, repairs, divides
        )
    with noted(failures):
        risk = _risk(fields.get("risk"), repairs)
    evidence = _evidence(fields.get("evidence"), shape, repairs)
    if failures and Repair.EVIDENCE_ECHO in repairs:
        failures.append(
            Failure(Status.SCHEMA_ECHO, "the evidence is the prompt's placeholder for it")
        )
    if failures:
        raise joined(failures)
    message = {
        "evidence": evidence,
        "risk": risk,
        "recommended_maneuver": maneuver,
        "confidence": confidence,
    }
    return Answer(intent, mass, message, frozenset(repairs))


def _judgement(
    fields: dict[str, Any], key: str, actions: Sequence[str], repairs: set[Repair], divides: bool
) -> tuple[values.Intent, float | None, str, float]:
    """Return the intent, its sum as stated, the maneuver and its confidence,
    in whichever form they stand.
    """
    if "action_distribution" in fields:
        intent, mass = values.distribution(fields["action_distribution"], actions, repairs, divides)
        confidence = max(intent)
        maneuver = actions[intent.index(confidence)]
        if key in fields or "confidence" in fields:
            repairs.add(Repair.BOTH_FORMS)
            maneuver = _maneuver(fields.get(key, maneuver), actions, repairs)
            if intent[actions.index(maneuver)] < confidence:
                detail = (
                    f"the {key.replace('_', ' ')} is not the distribution's most probable action"
                )
                raise Failure(Status.CONFLICTING_ANSWERS, detail)
        return intent, mass, maneuver, confidence
    failures: list[Failure] = []
    if key in fields:
        with noted(failures):
            maneuver = _maneuver(fields[key], actions, repairs)
    else:
        failures.append(Failure(Status.MISSING_ACTION, f"no {key} and no distribution"))
    if "confidence" in fields:
        with noted(failures):
            confidence = _confidence(fields["confidence"], repairs)
    elif failures:
        failures.append(Failure(Status.MISSING_ACTION, "no confidence and no distribution"))
    else:
        failures.append(
            Failure(Status.LABEL_ONLY, f"only {maneuver} is named, without a confidence")
        )
    if failures:
        raise joined(failures)
    return recommended(maneuver, confidence, actions), None, maneuver, confidence


def recommended(maneuver: str, confidence: float, actions: Sequence[str]) -> values.Intent:
    """Return the intent of an answer that names one action, the rest spread evenly over others.

    An intent is the probabilities of the actions. `maneuver` is that action and `confidence` its
    probability. The result has the probabilities of all `actions`, in their order.
    """
    if len(actions) == 1:
        return (1.0,)
    share = (1 - confidence) / (len(actions) - 1)
    return tuple(confidence if action == maneuver else share for action in actions)


def _maneuver(value: object, actions: Sequence[str], repairs: set[Repair]) -> str:
    if not isinstance(value, str):
        raise Failure(Status.UNKNOWN_ACTION, "the recommended maneuver is no action's name")
    if _lists(value, actions) or values.is_placeholder(value):
        raise Failure(
            Status.SCHEMA_ECHO, "the schema's choice of actions came back instead of one action"
        )
    name = values.match(value, actions)
    if name is None:
        raise Failure(
            Status.UNKNOWN_ACTION, f"{printable(value, 40)!r} is no action of the scenario"
        )
    if name != value:
        repairs.add(Repair.KEY_CASE)
    return name


def _lists(value: str, options: Sequence[str]) -> bool:
    """Return whether a text lists all options and chooses none:
    low|medium|high, low or medium or high.
    """
    listed = all(re.search(rf"\b{re.escape(option)}\b", value) for option in options)
    return "|" in value or (listed and len(options) > 1)


def _confidence(value: object, repairs: set[Repair]) -> float:
    confidence, percent = values.number("confidence", value, repairs)
    if percent:
        repairs.add(Repair.PERCENT)
        confidence /= 100
    values.check_range("confidence", confidence)
    return abs(confidence)


def _evidence(value: object, shape: Shape, repairs: set[Repair]) -> str | None:
    if not isinstance(value, str):
        repairs.add(Repair.MISSING_EVIDENCE)
        return None
    if values.is_placeholder_text(value, shape):
        repairs.add(Repair.EVIDENCE_ECHO)
        return None
    if len(value) > EVIDENCE_CHARS:
        repairs.add(Repair.EVIDENCE_CUT)
    # A lone surrogate is legal JSON ("\ud83d") and cannot be written to any file.
    return value[:EVIDENCE_CHARS].encode("utf-8", "replace").decode()


def _risk(value: object, repairs: set[Repair]) -> str | None:
    if isinstance(value, str) and (_lists(value, RISKS) or values.is_placeholder(value)):
        raise Failure(
            Status.SCHEMA_ECHO, "the schema's choice of risks came back instead of one risk"
        )
    level = values.match(value, RISKS) if isinstance(value, str) else None
    if level is None:
        repairs.add(Repair.MISSING_RISK)
    elif level != value:
        repairs.add(Repair.KEY_CASE)
    return level
