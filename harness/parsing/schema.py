"""Judge a JSON value by the schema of an answer, with the library `jsonschema`, whose word is the last."""

import json
import math
from functools import lru_cache
from typing import Any

from harness.parsing.relaxed import Repeated
from harness.prompts.answer_schema import Shape, answer_schema, closed


def fits(value: object, shape: Shape) -> bool:
    """Return whether a value read from JSON fits; a repeated key and NaN, which are no JSON, never do."""
    return _is_json(value) and bool(_validator(shape).is_valid(value))


def further(members: dict[str, Any], shape: Shape) -> dict[str, Any] | None:
    """Return the further members of an answer, without lone surrogates, if they fit; else None."""
    if not _is_json(members) or not _further_validator(shape).is_valid(members):
        return None
    text = json.dumps(members, ensure_ascii=False).encode("utf-8", "replace").decode()
    return dict(json.loads(text))


@lru_cache(maxsize=16)
def _further_validator(shape: Shape) -> Any:
    from jsonschema import Draft202012Validator

    return Draft202012Validator(closed(shape.further))


def _is_json(value: object) -> bool:
    if isinstance(value, dict):
        return not isinstance(value, Repeated) and all(map(_is_json, value.values()))
    if isinstance(value, list):
        return all(map(_is_json, value))
    return not (isinstance(value, float) and math.isnan(value))


@lru_cache(maxsize=16)
def _validator(shape: Shape) -> Any:
    from jsonschema import Draft202012Validator  # plain answers never need it, and it takes time to load

    return Draft202012Validator(answer_schema(**shape._asdict()))
