"""Define the outcomes of parsing a completion:
its status, its faults, and the repairs that it took.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from typing import Self


class _Documented(StrEnum):
    """An enum whose members have a meaning in words."""

    meaning: str

    def __new__(cls, value: str, meaning: str) -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.meaning = meaning
        return member


class Status(_Documented):
    """State the outcome of parsing a completion, a model's text.

    All but the first two give no intent, the probabilities that a vehicle gives to the ego's
    actions.
    """

    STRICT = (
        "strict",
        "The raw text is JSON that fits the schema and sums to 1 within 0.001; "
        "reasons may stand before it if the prompt asked for them.",
    )
    RECOVERED = (
        "recovered",
        "One unambiguous answer stands in the text, and the repairs name what was wrong.",
    )
    EMPTY = "empty", "There is nothing but white space, special tokens or a closed thought."
    NO_JSON = "no_json", "There is no JSON object, and not exactly one action is named."
    LABEL_ONLY = "label_only", "One action is named and nothing says how probable each action is."
    TRUNCATED_JSON = "truncated_json", "The text ends inside a JSON value."
    TRUNCATED_REASONING = (
        "truncated_reasoning",
        "The thought was never closed, so nothing in it is an answer.",
    )
    SYNTAX = "syntax", "A JSON object was meant, but it cannot be read without guessing."
    SCHEMA_ECHO = (
        "schema_echo",
        "The schema or the prompt's placeholders came back instead of an answer.",
    )
    DUPLICATE_KEY = "duplicate_key", "An object has the same key twice."
    MISSING_ACTION = "missing_action", "An action, the maneuver or its confidence is not given."
    UNKNOWN_ACTION = (
        "unknown_action",
        "Something that is no action of the scenario is chosen or has mass.",
    )
    NON_NUMERIC = (
        "non_numeric",
        "A probability is no number: a word, an expression, true, null, a list.",
    )
    NON_FINITE = "non_finite", "A probability is NaN, infinite, or overflows (1e400)."
    OUT_OF_RANGE = (
        "out_of_range",
        "A probability lies outside 0..1 and the whole does not read as percent.",
    )
    BAD_SUM = (
        "bad_sum",
        "The probabilities differ from a sum of 1 by more than rounding (0.025), or all are zero.",
    )
    CONFLICTING_ANSWERS = (
        "conflicting_answers",
        "Several answers stand in the text and they differ.",
    )
    REFUSED = "refused", "The model refused the question, and the server said so."
    ENGINE_ERROR = "engine_error", "The engine failed; there is no completion to judge."


class Repair(_Documented):
    """Name a correction that was needed to read a model's answer."""

    THINK_BLOCK = (
        "think_block",
        "A thought was cut off where none belongs: thinking was off, or it did not come first.",
    )
    SPECIAL_TOKENS = "special_tokens", "Template tokens such as <|im_end|> were removed."
    INVISIBLE_CHARACTERS = (
        "invisible_characters",
        "BOM, zero-width characters or exotic spaces were removed.",
    )
    CODE_FENCE = "code_fence", "The answer stood in a markdown code fence."
    PROSE_AROUND = "prose_around", "Text that was not asked for stood before or after the answer."
    STRAY_PUNCTUATION = (
        "stray_punctuation",
        "Loose brackets, quotes or commas stood around the answer.",
    )
    NESTED = (
        "nested",
        "The answer, or its distribution, stood inside another object, a schema or a text.",
    )
    IN_PIECES = "in_pieces", "The answer stood in several objects, or in part one level deeper."
    UNWRAPPED = "unwrapped", "The actions stood without the action_distribution around them."
    REPEATED_ANSWER = "repeated_answer", "The same answer was given more than once."
    TRAILING_COMMA = "trailing_comma", "A comma stood before a closing bracket."
    MISSING_COMMA = "missing_comma", "A comma between two members was missing."
    QUOTES = "quotes", "A string had other quotes than JSON's, or none."
    BARE_KEYS = "bare_keys", "A key had no quotes."
    COMMENTS = "comments", "Comments stood inside the JSON."
    MISSING_CLOSERS = "missing_closers", "Closing brackets were missing after a finished value."
    ESCAPES = "escapes", "Escapes that JSON does not know, or raw line breaks, stood in the text."
    NUMBER_FORMAT = "number_format", "A number was not written as in JSON: .5, +0.5, 00.5."
    FULL_WIDTH = "full_width", "Full-width digits or punctuation stood for ASCII ones."
    JSON_REPAIR = (
        "json_repair",
        "json_repair mended the syntax; numbers and sum were checked against the text.",
    )
    KEY_CASE = "key_case", "A name was spelt with other letter case, spaces or underscores."
    STRING_NUMBER = "string_number", "A number stood in quotes."
    PERCENT = "percent", "The probabilities were given in percent."
    EXTRA_ZERO_KEY = (
        "extra_zero_key",
        "A key that is no action of the scenario had probability zero.",
    )
    EXTRA_FIELD = "extra_field", "A field that the schema does not have was dropped."
    RENORMALISED = (
        "renormalised",
        "The sum was off 1 by rounding (0.001 to 0.025) and was divided out.",
    )
    DIVIDED = (
        "divided",
        "The sum was off 1 by more than rounding and was divided out, as was declared.",
    )
    OTHER_FORM = (
        "other_form",
        "One action with a confidence was given where a distribution was asked for, or the "
        "reverse.",
    )
    UNFIT_EXTENSION = (
        "unfit_extension",
        "What the prompt asks for beside the decision was missing or did not fit, and was dropped.",
    )
    BOTH_FORMS = "both_forms", "A helper gave a distribution and a maneuver that agrees with it."
    MISSING_EVIDENCE = "missing_evidence", "A helper gave no evidence text."
    EVIDENCE_ECHO = (
        "evidence_echo",
        "A helper's evidence was the prompt's placeholder, and was dropped.",
    )
    EVIDENCE_CUT = "evidence_cut", "A helper's evidence was cut at 200 characters."
    MISSING_RISK = "missing_risk", "A helper gave no risk of low, medium or high."


class Failure(Exception):
    """Report that a completion gives no intent, the probabilities of the actions.

    `parse` turns it into a `Parsed`: it is data about the model, not a bug.

    Attributes:
        status: the reason.
        detail: one sentence for people, safe to print.
        mass: the sum of the probabilities, if the sum is a reason.
        faults: all reasons, the status first.
    """

    def __init__(
        self,
        status: Status,
        detail: str,
        mass: float | None = None,
        faults: tuple[Status, ...] = (),
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.mass = mass
        self.faults = faults or (status,)


@contextmanager
def noted(failures: list[Failure]) -> Iterator[None]:
    """Enter a context that catches a Failure and appends it to `failures`.

    So the other parts of an answer are read as well, and all its faults are known.
    """
    try:
        yield
    except Failure as failure:
        failures.append(failure)


def joined(failures: Sequence[Failure]) -> Failure:
    """Return one failure with the faults (all statuses that apply) of several `failures`.

    Its status is the first one's; but if one is an echo of the prompt, that goes first, since such
    a text was never meant as an answer.
    """
    first = min(failures, key=lambda failure: failure.status is not Status.SCHEMA_ECHO)
    faults = dict.fromkeys(
        [first.status, *(fault for failure in failures for fault in failure.faults)]
    )
    mass = next((failure.mass for failure in failures if failure.mass is not None), None)
    return Failure(first.status, first.detail, mass, tuple(faults))
