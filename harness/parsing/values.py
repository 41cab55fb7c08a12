"""What the members of an answer mean: names, numbers, sums.

The sum is the checksum of a distribution, so it decides: within 0.001 of 1 it is exact, within 0.025 (five
actions rounded by half a hundredth, and back) it is rounding, beyond that nobody knows which number is wrong.
"""

import math
import re
import unicodedata
from collections.abc import Sequence
from typing import Any

from harness.core.errors import printable
from harness.parsing.relaxed import Repeated
from harness.parsing.status import Failure, Repair, Status

EXACT = 0.001 + 1e-9  # the slack lets 0.333 * 3 in, whose binary sum is 0.999 less a hair
ROUNDED = 0.025 + 1e-9

_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?")
_NON_FINITE = re.compile(r"[-+]?(?:nan|inf|infinity)", re.IGNORECASE)
_PLACEHOLDER = re.compile(
    r"p\d*|p_\w+|prob(?:ability)?\w*|number|float|value|x|<.*>|\.{2,}|…|0(?:\.0)?\s*(?:\.\.|-|–|to)\s*1(?:\.0)?",
    re.IGNORECASE,
)

Intent = tuple[float, ...]


def match(name: str, known: Sequence[str]) -> str | None:
    """The known name that is meant: the same, or the only one that differs in case and separators."""
    if name in known:
        return name
    near = [other for other in known if _plain(other) == _plain(name)]
    return near[0] if len(near) == 1 else None


def _plain(name: str) -> str:
    return "".join(c for c in name if c.isalnum()).casefold()


def sort_fields(
    members: dict[str, Any], known: Sequence[str], repairs: set[Repair]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Members under their known names, and the rest. Raises duplicate_key, also for two spellings of one."""
    if isinstance(members, Repeated):
        raise Failure(Status.DUPLICATE_KEY, "an object has the same key twice")
    fields: dict[str, Any] = {}
    rest: dict[str, Any] = {}
    for key, value in members.items():
        name = match(key, known)
        if name is None:
            rest[key] = value
            continue
        if name in fields:
            raise Failure(Status.DUPLICATE_KEY, f"{printable(name, 40)} is given twice")
        if name != key:
            repairs.add(Repair.KEY_CASE)
        fields[name] = value
    return fields, rest


def distribution(value: object, actions: Sequence[str], repairs: set[Repair]) -> tuple[Intent, float]:
    """Intent in the order of `actions`, summing to 1, and the sum that was stated.

    Args:
        value: what stood where the distribution belongs.
        actions: meta-action names.
        repairs: what had to be mended is added here.

    Raises:
        Failure: one of the value statuses.
    """
    if not isinstance(value, dict):
        raise _no_distribution(value, actions)
    fields, rest = sort_fields(value, actions, repairs)
    if any(key.startswith("<") for key in rest) or any(is_placeholder(v) for v in fields.values()):
        raise Failure(Status.SCHEMA_ECHO, "the template's placeholders came back instead of numbers")
    for key, extra in rest.items():
        if isinstance(extra, str) and not _NUMBER.match(extra.strip()):
            repairs.add(Repair.EXTRA_FIELD)
        elif (type(extra) is float and extra == 0.0) or extra in ("0", "0%", "0.0"):
            repairs.add(Repair.EXTRA_ZERO_KEY)
        else:
            raise Failure(Status.UNKNOWN_ACTION, f"{printable(key, 40)!r} is no action of the scenario")
    missing = [action for action in actions if action not in fields]
    if missing:
        raise Failure(Status.MISSING_ACTION, f"no probability for {', '.join(missing)}")
    numbers = _in_unit([number(a, fields[a], repairs) for a in actions], repairs)
    for action, probability in zip(actions, numbers, strict=True):
        check_range(action, probability)
    mass = math.fsum(numbers)
    # What json_repair mended is believed only for its checksum.
    if abs(mass - 1) > (EXACT if Repair.JSON_REPAIR in repairs else ROUNDED):
        raise Failure(Status.BAD_SUM, f"the probabilities sum to {mass:.4g}, not 1", mass)
    if abs(mass - 1) > EXACT:
        repairs.add(Repair.RENORMALISED)
    return tuple(abs(p) / mass for p in numbers), mass


def number(name: str, value: object, repairs: set[Repair]) -> tuple[float, bool]:
    """A finite number, and whether a percent sign stood behind it."""
    percent = False
    if isinstance(value, str):
        text = unicodedata.normalize("NFKC", value).strip()
        if _PLACEHOLDER.fullmatch(text):
            raise Failure(Status.SCHEMA_ECHO, f"{printable(name, 40)} is a placeholder, not a number")
        percent = text.endswith("%")
        text = text.removesuffix("%").strip()
        if _NUMBER.fullmatch(text):
            if not percent:
                repairs.add(Repair.STRING_NUMBER)
            value = float(text)
        elif _NON_FINITE.fullmatch(text):
            value = math.nan
    if type(value) is not float:
        shown = f": {printable(value, 40)!r}" if isinstance(value, str | bool) else ""
        raise Failure(Status.NON_NUMERIC, f"{printable(name, 40)} is no number{shown}")
    if not math.isfinite(value):
        raise Failure(Status.NON_FINITE, f"{printable(name, 40)} is not finite")
    return value, percent


def _in_unit(numbers: list[tuple[float, bool]], repairs: set[Repair]) -> list[float]:
    """Numbers as fractions: percent only if all say so, or if together they make 100."""
    values = [value for value, _ in numbers]
    signed = [percent for value, percent in numbers if value]
    if (any(signed) and all(signed)) or (abs(sum(values) - 100) <= 1 and max(values) > 1):
        repairs.add(Repair.PERCENT)
        return [value / 100 for value in values]
    if any(percent for _, percent in numbers):
        raise Failure(Status.BAD_SUM, "percent and plain numbers are mixed and do not sum to 100")
    return values


def check_range(name: str, value: float) -> None:
    """Raises out_of_range."""
    if not 0 <= value <= 1:
        raise Failure(Status.OUT_OF_RANGE, f"{printable(name, 40)} is {value:.4g}, outside 0..1")


def is_placeholder(value: object) -> bool:
    """Whether a text is what a prompt writes where a number belongs: p1, <number>, 0..1."""
    return isinstance(value, str) and bool(_PLACEHOLDER.fullmatch(value.strip()))


def is_schema(value: object) -> bool:
    """Whether an object is a JSON Schema rather than an answer to it."""
    return isinstance(value, dict) and ("$schema" in value or "properties" in value)


def _no_distribution(value: object, actions: Sequence[str]) -> Failure:
    if isinstance(value, str) and match(value, actions):
        return Failure(Status.LABEL_ONLY, "the distribution is one action's name, without probabilities")
    if is_placeholder(value):
        return Failure(Status.SCHEMA_ECHO, "the template's placeholder stands where the distribution belongs")
    return Failure(Status.MISSING_ACTION, "what stands for the distribution names no actions")
