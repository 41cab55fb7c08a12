"""Read the members of an answer: names, numbers and sums.

The sum is the checksum of a distribution, so it decides. Within 0.001 of 1 it is exact. Within
0.025 (five actions rounded by half a hundredth, and back) it is rounding. Beyond, it is unknown
which number is wrong.
"""

import math
import re
import unicodedata
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from harness.core.errors import printable
from harness.parsing.relaxed import Repeated
from harness.parsing.status import Failure, Repair, Status, joined, noted
from harness.prompts.answer_schema import RISKS, Shape

EXACT = 0.001 + 1e-9  # the slack admits 0.333 * 3, whose binary sum is slightly below 0.999
ROUNDED = 0.025 + 1e-9
_LARGEST = 1e9  # of the numbers whose sum is worth saying; larger ones may overflow

_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?")
_NON_FINITE = re.compile(r"[-+]?(?:nan|inf|infinity)", re.IGNORECASE)
_RANGE = r"(?:(?:a )?number (?:from|between) )?0(?:\.0)?\s*(?:\.\.|-|–|to|and)\s*1(?:\.0)?"
_PLACEHOLDER = re.compile(
    rf"p\d*|p_\w+|prob(?:ability)?\w*|(?:number|float|value|x)(?: from)?|<.*>|\.{{2,}}|…|{_RANGE}",
    re.IGNORECASE,
)
_NOT = ("!", "¬", "~", "-", "−")
_PERCENT_WORDS = ("%", "percent", "per cent")
_BETWEEN_CHOICES = re.compile(r"[|/,]|\bor\b")
# What any prompt may write in the place of words: how many, or what kind of text. What the one that
# asked writes is known from its template.
_WORDS = re.compile(
    r"(?:at most|max(?:imum)?(?: of)?|up to|under|in)\.? \d+ (?:words?|characters?)"
    rf"|(?:one|a) short sentence|text|string|<.*>|\.{{2,}}|…|{_RANGE}",
    re.IGNORECASE,
)

Intent = tuple[float, ...]


def match(name: str, names: Sequence[str]) -> str | None:
    """Return the one of `names` that is meant; None if there is none, or several.

    Letter case and separators may differ. A name behind a sign that denies it, such as !SLOWER, is
    not meant.
    """
    if name in names:
        return name
    if name.lstrip().startswith(_NOT):
        return None
    similar = [candidate for candidate in names if _plain(candidate) == _plain(name)]
    return similar[0] if len(similar) == 1 else None


def _plain(name: str) -> str:
    return "".join(c for c in name if c.isalnum()).casefold()


def sort_fields(
    members: dict[str, Any], names: Sequence[str], repairs: set[Repair]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split an object's members into those with a known key, under that key, and the rest.

    `names` are the known keys. Corrections of spelling are added to `repairs`. Raises Failure (of
    status duplicate_key) if one is given twice, also in two spellings.
    """
    if isinstance(members, Repeated):
        raise Failure(Status.DUPLICATE_KEY, "an object has the same key twice")
    fields: dict[str, Any] = {}
    rest: dict[str, Any] = {}
    for key, value in members.items():
        name = match(key, names)
        if name is None:
            rest[key] = value
            continue
        if name in fields:
            raise Failure(Status.DUPLICATE_KEY, f"{printable(name, 40)} is given twice")
        if name != key:
            repairs.add(Repair.KEY_CASE)
        fields[name] = value
    return fields, rest


def distribution(
    value: object, actions: Sequence[str], repairs: set[Repair], divides: bool
) -> tuple[Intent, float]:
    """Return the probabilities in the order of `actions`, summing to 1, and their sum as stated.

    `value` is what the model's answer gives for the distribution. Repairs (corrections) that it
    took are added to `repairs`; with `divides` any sum above 0 is divided out. Raises Failure, with
    all statuses that apply, if `value` is no such distribution.
    """
    if not isinstance(value, dict):
        raise _no_distribution(value, actions)
    fields, rest = sort_fields(value, actions, repairs)
    failures: list[Failure] = []
    if any(key.startswith("<") for key in rest) or any(is_placeholder(v) for v in fields.values()):
        failures.append(
            Failure(Status.SCHEMA_ECHO, "the template's placeholders came back instead of numbers")
        )
    for key, extra in rest.items():
        if isinstance(extra, str) and not _NUMBER.match(extra.strip()):
            repairs.add(Repair.EXTRA_FIELD)
        elif (type(extra) is float and extra == 0.0) or extra in ("0", "0%", "0.0"):
            repairs.add(Repair.EXTRA_ZERO_KEY)
        elif not key.startswith("<"):
            detail = f"{printable(key, 40)!r} is no action of the scenario"
            failures.append(Failure(Status.UNKNOWN_ACTION, detail))
    if missing := [action for action in actions if action not in fields]:
        failures.append(Failure(Status.MISSING_ACTION, f"no probability for {', '.join(missing)}"))
    stated_numbers = []
    for action in [action for action in actions if action in fields]:
        with noted(failures):
            stated_numbers.append(number(action, fields[action], repairs))
    if failures:
        raise joined(failures)
    numbers = _in_unit(stated_numbers, repairs)
    for action, probability in zip(actions, numbers, strict=True):
        with noted(failures):
            check_range(action, probability)
    mass = math.nan
    if max(map(abs, numbers)) <= _LARGEST:
        mass = math.fsum(numbers)
        with noted(failures):
            _check_sum(mass, repairs, divides)
    if failures:
        raise joined(failures)
    return tuple(abs(p) / mass for p in numbers), mass


def _check_sum(mass: float, repairs: set[Repair], divides: bool) -> None:
    # The sum is the only check on what json_repair read, so it must be exact.
    guessed = Repair.JSON_REPAIR in repairs
    if abs(mass - 1) <= EXACT:
        return
    if abs(mass - 1) <= ROUNDED and not guessed:
        repairs.add(Repair.RENORMALISED)
    elif divides and mass > 0 and not guessed:
        repairs.add(Repair.DIVIDED)
    else:
        raise Failure(Status.BAD_SUM, f"the probabilities sum to {mass:.4g}, not 1", mass)


def number(name: str, value: object, repairs: set[Repair]) -> tuple[float, bool]:
    """Return a finite number that a model wrote, and whether a percent sign followed it.

    `name` names it in messages. Corrections that reading it took are added to `repairs`. Raises
    Failure for any other value.
    """
    percent = False
    if isinstance(value, str):
        text = unicodedata.normalize("NFKC", value).strip()
        if _PLACEHOLDER.fullmatch(text):
            raise Failure(
                Status.SCHEMA_ECHO, f"{printable(name, 40)} is a placeholder, not a number"
            )
        percent = text.endswith("%")
        text = text.removesuffix("%").strip()
        if _NUMBER.fullmatch(text):
            if not percent:
                repairs.add(Repair.STRING_NUMBER)
            value = float(text)
        elif _NON_FINITE.fullmatch(text):
            value = math.nan
    if type(value) is not float:
        value_text = f": {printable(value, 40)!r}" if isinstance(value, str | bool) else ""
        raise Failure(Status.NON_NUMERIC, f"{printable(name, 40)} is no number{value_text}")
    if not math.isfinite(value):
        raise Failure(Status.NON_FINITE, f"{printable(name, 40)} is not finite")
    return value, percent


def _in_unit(numbers: list[tuple[float, bool]], repairs: set[Repair]) -> list[float]:
    """Return numbers as fractions; they are percent only if all say so or if they sum to 100."""
    values = [value for value, _ in numbers]
    nonzero_percents = [percent for value, percent in numbers if value]
    if (any(nonzero_percents) and all(nonzero_percents)) or (
        abs(sum(values) - 100) <= 1 and max(values) > 1
    ):
        repairs.add(Repair.PERCENT)
        return [value / 100 for value in values]
    if any(percent for _, percent in numbers):
        raise Failure(Status.BAD_SUM, "percent and plain numbers are mixed and do not sum to 100")
    return values


def check_range(name: str, value: float) -> None:
    """Raise Failure (out_of_range) unless a probability, `value`, is from 0 to 1.

    `name` is what messages call it.
    """
    if not 0 <= value <= 1:
        raise Failure(Status.OUT_OF_RANGE, f"{printable(name, 40)} is {value:.4g}, outside 0..1")


def in_percent(value: object, rest: Sequence[object]) -> object:
    """Return a number as a text with a percent sign, if another value of its object says percent.

    `rest` are the other values of that object. Any other value is returned as it is.
    """
    has_unit = any(
        isinstance(each, str) and each.strip().casefold() in _PERCENT_WORDS for each in rest
    )
    return f"{value}%" if has_unit and type(value) is float else value


def is_placeholder(value: object) -> bool:
    """Return whether a value that a model wrote is a prompt's placeholder for a number.

    Such are `p1`, `<number>` and `0..1`, which stand in a prompt in place of a number.
    """
    return isinstance(value, str) and bool(_PLACEHOLDER.fullmatch(value.strip()))


def is_placeholder_text(text: str, shape: Shape) -> bool:
    """Return whether a text is a placeholder of a prompt: max 12 words, <text>, low|medium.

    A placeholder is what a prompt shows in place of a value. It is one of the prompt that asked
    (`shape.placeholders`), one that any prompt may use, or several choices in one text.
    """
    if _WORDS.fullmatch(text.strip().strip(".").strip() or text.strip()):
        return True
    written, choices = _written(shape.placeholders, shape.actions)
    chosen = _choices(text)
    return _folded(text) in written or (len(chosen) > 1 and any(chosen <= each for each in choices))


@lru_cache(maxsize=64)
def _written(
    placeholders: tuple[str, ...], actions: tuple[str, ...]
) -> tuple[frozenset[str], tuple[frozenset[str], ...]]:
    """Return the placeholders of a prompt, folded, and the choices that each of them offers."""
    offered = [_choices(text) for text in (*placeholders, "|".join(RISKS), "|".join(actions))]
    return frozenset(map(_folded, placeholders)), tuple(offered)


def _choices(text: str) -> frozenset[str]:
    parts = map(_folded, _BETWEEN_CHOICES.split(text))
    return frozenset(part for part in parts if part)


def _folded(text: str) -> str:
    return " ".join(text.replace('"', " ").casefold().split()).strip(". ")


def is_schema(value: object) -> bool:
    """Return whether a decoded JSON value is a JSON Schema instead of an answer to it."""
    return isinstance(value, dict) and ("$schema" in value or "properties" in value)


def _no_distribution(value: object, actions: Sequence[str]) -> Failure:
    if isinstance(value, str) and match(value, actions):
        return Failure(
            Status.LABEL_ONLY, "the distribution is one action's name, without probabilities"
        )
    if is_placeholder(value):
        return Failure(
            Status.SCHEMA_ECHO, "the template's placeholder stands where the distribution belongs"
        )
    if isinstance(value, str):
        return Failure(
            Status.MISSING_ACTION, "what stands for the distribution is a text, and none of JSON"
        )
    return Failure(Status.MISSING_ACTION, "what stands for the distribution names no actions")
