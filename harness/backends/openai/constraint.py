"""The constraint that a server is sent for an answer, and whether the answer keeps to it.

Servers differ in how they are asked, and one that does not know the field drops it and answers
freely.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from harness.backends.base import Request
from harness.backends.servers import Kind
from harness.backends.skeleton import UNIT
from harness.core.errors import printable
from harness.core.files import canonical_json
from harness.prompts.answer_schema import Shape, constrained_schema, number_texts

# Kinds that are sent a pattern: compact JSON, members in order, two decimals. With a JSON Schema
# most servers allow numbers of any length.
_BY_PATTERN: Mapping[Kind, str] = {
    "vllm": "regex",
    "llama-server": "grammar",
    "llama-cpp-python": "grammar",
}
_DECIMALS = re.compile(r"0\.[0-9][0-9]|1\.00")
_DECIMALS_BEGUN = re.compile(r"(?:0(?:\.[0-9]?)?|1(?:\.0?)?)?")
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")
_NUMBER_BEGUN = re.compile(r"-?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?(?:[eE][+-]?[0-9]*)?)?")
_BLANK = re.compile(r"[ \t\n\r]*")
_TEXT = r'[^"\\\x00-\x1f]'  # a character of a text, in both kinds of pattern
_CHARACTERS = r'"(?:[^"\\\x00-\x1f]|\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4}))*+'
_STRING = re.compile(_CHARACTERS + '"')
_STRING_BEGUN = re.compile(_CHARACTERS + r"(?:\\(?:u[0-9a-fA-F]{0,3})?)?")
_SHOWN = 40  # characters of an answer that an error shows


@lru_cache
def constraint(kind: Kind, shape: Shape) -> Mapping[str, Any]:
    """Return the request fields by which a kind of server makes the model keep to an answer's form.

    `kind` is the server program, such as `vllm`, and `shape` says what the answer's JSON must look
    like. Depending on the kind the fields hold a regular expression, a grammar or a JSON Schema.
    """
    schema = constrained_schema(shape)
    match _BY_PATTERN.get(kind):
        case "regex":
            return {"structured_outputs": {"regex": _pattern(schema, re.escape)}}
        case "grammar":
            return {"grammar": f"root ::= {_pattern(schema, canonical_json)}"}
    json_schema = {"name": "answer", "strict": True, "schema": schema}
    return {"response_format": {"type": "json_schema", "json_schema": json_schema}}


def broken(kind: Kind, request: Request, text: str, ended: bool) -> str | None:
    """Return where an answer breaks the constraint that was sent, in words; None if nowhere.

    `kind` is the server program, such as `vllm`, `request` the question, and `text` the answer
    without a thought that the server took out. If the model has not `ended` it, it need only be the
    beginning of what fits.
    """
    reader = _Reader(text, compact=kind in _BY_PATTERN)
    try:
        reader.value(constrained_schema(request.shape))
        reader.blank()
        if reader.at == len(text):
            return None
    except EOFError:
        if not ended:
            return None
        return f"it ends after {len(text)} characters"
    except ValueError:
        pass
    return f"{printable(repr(text[reader.at : reader.at + _SHOWN]))} after {reader.at} characters"


def _pattern(schema: Mapping[str, Any], literal: Callable[[str], str]) -> str:
    """Write the compact JSON of a schema as a regular expression,
    or as a rule of llama.cpp's grammar.

    For the parts of an answer the two differ only in how `literal` text is written.
    """
    if "enum" in schema:
        return f"({'|'.join(literal(json.dumps(value)) for value in schema['enum'])})"
    match schema["type"]:
        case "string":
            mark = literal('"')
            return f"{mark}{_TEXT}{{0,{schema['maxLength']}}}{mark}"
        case "boolean":
            return f"({literal('false')}|{literal('true')})"
        case "number" if (schema["minimum"], schema["maximum"]) == UNIT:
            return f"({literal('0.')}[0-9][0-9]|{literal('1.00')})"
        case "number" | "integer":
            return f"({'|'.join(map(literal, number_texts(schema)))})"
        case "array":
            item = _pattern(schema["items"], literal)
            least, most = schema["minItems"], schema["maxItems"]
            items = f"({item}({literal(',')}{item}){{{max(least - 1, 0)},{most - 1}}})"
            return f"{literal('[')}{items}{'' if least else '?'}{literal(']')}"
    members = [
        literal(f"{json.dumps(name)}:") + _pattern(value, literal)
        for name, value in schema["properties"].items()
    ]
    return literal("{") + literal(",").join(members) + literal("}")


class _Reader:
    """Reads a text along a schema: closed objects, lists, bounded texts and numbers, choices.

    Neither `re` nor a validator of JSON can say whether a text that was cut off may still become
    one that fits. Each method raises EOFError if the text ends first, and ValueError if it cannot
    fit after `at` characters.
    """

    def __init__(self, text: str, compact: bool) -> None:
        self._text, self._compact, self.at = text, compact, 0

    def value(self, schema: Mapping[str, Any]) -> None:
        self.blank()
        if "enum" in schema:
            self._one_of([json.dumps(value) for value in schema["enum"]])
        elif schema["type"] == "object":
            self._object(schema["properties"])
        elif schema["type"] == "array":
            self._array(schema["items"], schema["minItems"], schema["maxItems"])
        elif schema["type"] == "string":
            self._string(schema["maxLength"])
        elif schema["type"] == "boolean":
            self._one_of(["false", "true"])
        elif self._compact and (schema["minimum"], schema["maximum"]) != UNIT:
            self._one_of(sorted(number_texts(schema), key=len, reverse=True))
        else:
            self._number(schema["minimum"], schema["maximum"], schema["type"] == "integer")

    def blank(self) -> None:
        if not self._compact and (blank := _BLANK.match(self._text, self.at)):
            self.at = blank.end()

    def _object(self, properties: Mapping[str, Any]) -> None:
        missing = {json.dumps(name): value for name, value in properties.items()}
        self._one_of("{")
        while missing:
            name = self._one_of(list(missing)[:1] if self._compact else list(missing))
            self._one_of(":")
            self.value(missing.pop(name))
            self._one_of("," if missing else "}")

    def _array(self, items: Mapping[str, Any], least: int, most: int) -> None:
        self._one_of("[")
        for count in range(most + 1):
            ends = ("]" if count >= least else "") + ("," if 0 < count < most else "")
            self.blank()
            if count and self._one_of(ends) == "]":
                return
            if not count and not least and self._text.startswith("]", self.at):
                self.at += 1
                return
            self.value(items)

    def _string(self, most: int) -> None:
        match = _STRING.match(self._text, self.at)
        if not match:
            ended = self.at == len(self._text) or _STRING_BEGUN.fullmatch(self._text, self.at)
            raise EOFError if ended else ValueError
        if len(json.loads(match[0])) > most or (self._compact and "\\" in match[0]):
            raise ValueError
        self.at = match.end()

    def _one_of(self, options: Sequence[str]) -> str:
        """Read one of some texts, none of which begins another; a str is one of its characters."""
        self.blank()
        for option in options:
            if self._text.startswith(option, self.at):
                self.at += len(option)
                return option
        rest = self._text[self.at : self.at + max(map(len, options))]
        if any(option.startswith(rest) for option in options):
            raise EOFError
        raise ValueError

    def _number(self, least: float, most: float, whole: bool) -> None:
        number, beginning = (
            (_DECIMALS, _DECIMALS_BEGUN) if self._compact else (_NUMBER, _NUMBER_BEGUN)
        )
        match = number.match(self._text, self.at)
        open_ended = not match or not self._compact  # more digits or an exponent may follow
        if open_ended and beginning.fullmatch(self._text, self.at):
            raise EOFError
        if (
            not match
            or not least <= (value := float(match[0])) <= most
            or (whole and not value.is_integer())
        ):
            raise ValueError
        self.at = match.end()
