"""Judge the further members of an answer, which a prompt's `answer.json` asks for,
with `jsonschema`.
"""

import json
import math
from functools import lru_cache
from typing import Any

from harness.parsing.relaxed import Repeated
from harness.prompts.answer_schema import Shape, closed


def further(members: dict[str, Any], shape: Shape) -> dict[str, Any] | None:
    """Return the members that a prompt asks for beside the decision, such as a reason.

    `members` are those of an answer, and `shape` has the JSON Schemas of further ones. None if one
    does not fit its schema. Lone surrogates in them are replaced.
    """
    if not is_json(members) or not _validator(shape).is_valid(members):
        return None
    text = json.dumps(members, ensure_ascii=False).encode("utf-8", "replace").decode()
    return dict(json.loads(text))


def is_json(value: object) -> bool:
    """Return whether a decoded value has no repeated key and no NaN, which JSON does not allow.

    Objects with a repeated key are `relaxed.Repeated`.
    """
    if isinstance(value, dict):
        return not isinstance(value, Repeated) and all(map(is_json, value.values()))
    if isinstance(value, list):
        return all(map(is_json, value))
    return not (isinstance(value, float) and math.isnan(value))


@lru_cache(maxsize=16)
def _validator(shape: Shape) -> Any:
    # plain answers never need it, and it takes time to load
    from jsonschema import Draft202012Validator

    return Draft202012Validator(closed(shape.further))
