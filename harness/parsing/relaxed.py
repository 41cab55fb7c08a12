"""Read almost-JSON; every deviation from JSON is recorded as a repair, and no value is guessed.

It reads what small models often write: Python dicts, typographic quotes, bare keys, comments,
trailing commas, percent signs, missing closing brackets. An expression (`1/3`) is kept as text, so
that no later rule takes it for a number. Numbers and words that touch the end of the text count as
cut off.
"""

import json
import re
import unicodedata
from dataclasses import dataclass, field
from typing import Any, NoReturn

from harness.core.depth import MOST_DEPTH, shallow
from harness.parsing.status import Repair

# Possessive: no digit is given back, which would take a second look at each.
_DIGITS = r"(?:\d++(?:[.．]\d*+)?|[.．]\d++)(?:[eE][-+]?\d*+)?"
_TOKEN = re.compile(
    rf"""
    (?P<comment> (?: (?: //[^\n]*+ | /\*.*?\*/ | \#[^\n]*+ ) \s*+ )++ )
  | (?P<string> "(?:[^"\\]++|\\.)*+" | '(?:[^'\\]++|\\.)*+' | `[^`]+`(?!`)
              | [“”„‟＂][^“”„‟＂"\\]*[“”„‟＂"] | [‘’‚][^‘’‚\\]*[‘’] )
  | (?P<expression> [-+]?{_DIGITS}\s*%?(?:\s*(?:\*\*|[-+*/^])\s*[-+(]*{_DIGITS}\s*%?\)*)+ )
  | (?P<number> [-+]?{_DIGITS}(?:\s*[%％])? )
  | (?P<fence> ``` )
  | (?P<mark> [{{}}\[\]:,｛｝［］：，] )
  | (?P<word> -?[^\W\d]\w* | <[^<>{{}}\n]*> | \.\.\.|… )
    """,
    re.DOTALL | re.VERBOSE,
)
_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?%?")
_JSON_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?")
_WORDS = {
    "true": True,
    "false": False,
    "null": None,
    "none": None,
    "nan": float("nan"),
    "inf": float("inf"),
    "infinity": float("inf"),
    "-inf": float("-inf"),
    "-infinity": float("-inf"),
}
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "b": "\b", "f": "\f", "\n": ""}


class Repeated(dict[str, Any]):
    """Hold a JSON object in which a key was repeated, as a dict with the last value of each key."""


class Broken(Exception):
    """Report that the text at an opening brace cannot be read as an object.

    `meant` is true for broken JSON, and false for a brace in prose, which meant none.
    """

    def __init__(self, meant: bool) -> None:
        super().__init__()
        self.meant = meant


class Unfinished(Exception):
    """Report that the text ends inside the value that is being read."""


@dataclass
class Reading:
    """Hold a value that was read from almost-JSON, with the repairs (corrections) that it took.

    Almost-JSON is JSON with the slips of models, such as comments or bare keys. `end` is the index
    where the value ends in the text; `closed_by_end` is true if brackets were still open there.
    """

    value: Any = None  # the value, as Python has it
    end: int = 0  # index in the text behind it
    repairs: set[Repair] = field(default_factory=set)  # the repairs that reading it took
    closed_by_end: bool = False  # whether brackets were still open at the text's end


def from_pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dict of an object's pairs, or a `Repeated` if a key is repeated.

    It is the `object_pairs_hook` of `DECODER`.
    """
    members = dict(pairs)
    return members if len(members) == len(pairs) else Repeated(members)


class _Decoder(json.JSONDecoder):
    """Refuses what nests deeper than almost-JSON may, with a ValueError."""

    def raw_decode(self, s: str, idx: int = 0) -> tuple[Any, int]:
        value, end = super().raw_decode(s, idx)
        return shallow(value), end


# As a float, an integer may have any number of digits; one too large becomes infinite instead of an
# error.
DECODER = _Decoder(object_pairs_hook=from_pairs, parse_int=float)


@dataclass(frozen=True)
class Token:
    """Describe a token of almost-JSON: JSON with the slips of models, such as comments.

    `kind` is such as `string`, `number`, `word` or `mark`; `other` for a character that begins no
    token, and `end` at the text's end. `text` is as written, with full-width numbers and marks as
    ASCII; `end` is the index where the next token may begin, and `repairs` are the corrections that
    reading it takes.
    """

    # a group of the pattern; `other` for a character that begins no token, `end` at the text's end
    kind: str
    text: str  # the text as written, with full-width numbers and marks as ASCII
    end: int  # where the next token may begin
    repairs: frozenset[Repair] = frozenset()  # repairs for the token and the comments before it


def next_token(text: str, at: int) -> Token:
    """Return the first token of almost-JSON in `text` at or after the index `at`.

    White space and comments are skipped. Almost-JSON is JSON with the slips of models, such as bare
    keys.
    """
    repairs: frozenset[Repair] = frozenset()
    while True:
        while at < len(text) and text[at].isspace():
            at += 1
        if at == len(text):
            return Token("end", "", at)
        match = _TOKEN.match(text, at)
        if match is None:
            return Token("other", text[at], at + 1)
        kind, written, at = match.lastgroup or "other", match.group(), match.end()
        if kind == "comment":
            repairs |= {Repair.COMMENTS}
            continue
        if kind in ("number", "mark") and not written.isascii():
            written = unicodedata.normalize("NFKC", written)
            repairs |= {Repair.FULL_WIDTH}
        return Token(kind, written, at, repairs)


def read(text: str, at: int) -> Reading:
    """Read the object of almost-JSON whose opening brace is at index `at` of a text.

    Raises Broken if what stands there is no object, Unfinished if the text ends inside it.
    """
    return _Reader(text, at).run()


class _Reader:
    def __init__(self, text: str, at: int) -> None:
        self.text = text
        self.out = Reading()
        self.meant = False
        self.last = Token("end", "", at)
        self.token = next_token(self.text, at)

    def run(self) -> Reading:
        self.out.value = self._value(0)
        self.out.end = self.last.end
        return self.out

    def _take(self) -> Token:
        self.out.repairs |= self.token.repairs
        self.last, self.token = self.token, next_token(self.text, self.token.end)
        return self.last

    def _fail(self, token: Token) -> NoReturn:
        is_last = not self.text[token.end :].strip() and token.text not in ("}", "]")
        if is_last or (token.kind == "other" and token.text in "\"'“‘"):
            raise Unfinished
        raise Broken(self.meant)

    def _value(self, depth: int) -> Any:
        if depth > MOST_DEPTH:
            raise Broken(self.meant)
        token = self._take()
        if token.text == "{" and token.kind == "mark":
            return self._object(depth)
        if token.text == "[" and token.kind == "mark":
            return self._array(depth)
        if token.kind == "string":
            return self._string(token.text)
        if token.kind == "number":
            return self._number(token)
        if token.kind == "expression":
            return token.text
        if token.kind == "word":
            if token.text.lower() in _WORDS:
                return _WORDS[token.text.lower()]
            self.out.repairs.add(Repair.QUOTES)
            return token.text
        self._fail(token)

    def _object(self, depth: int) -> dict[str, Any]:
        pairs: list[tuple[str, Any]] = []
        while not self._closed("}", bool(pairs)):
            token = self._take()
            if token.kind == "string":
                self.meant = True
                key = self._string(token.text)
            elif token.kind == "word":
                self.out.repairs.add(Repair.BARE_KEYS)
                key = token.text
            else:
                self._fail(token)
            if self._take().text != ":":
                self._fail(self.last)
            self.meant = True
            pairs.append((key, self._value(depth + 1)))
            if self._ends_after_value("}"):
                break
        return from_pairs(pairs)

    def _array(self, depth: int) -> list[Any]:
        items: list[Any] = []
        while not self._closed("]", bool(items)):
            items.append(self._value(depth + 1))
            if self._ends_after_value("]"):
                break
        return items

    def _closed(self, closer: str, after_comma: bool) -> bool:
        """Return whether the container ends here, where a member or an item may begin."""
        if self.token.kind != "mark" or self.token.text != closer:
            return False
        if after_comma and self.last.text == ",":
            self.out.repairs.add(Repair.TRAILING_COMMA)
        self._take()
        return True

    def _ends_after_value(self, closer: str) -> bool:
        """Read the comma or the closing bracket after a value;
        return whether the container ends there.
        """
        token = self.token
        if token.kind == "mark" and token.text in (",", closer):
            return self._take().text == closer
        if token.kind == "string" and closer == "}":
            self.out.repairs.add(Repair.MISSING_COMMA)
            return False
        last = self.last.kind
        # a closed string or bracket is complete
        if token.kind == "end" and last in ("string", "mark"):
            self.out.closed_by_end = True
        elif token.kind != "fence" and not (last == "mark" and token.kind in ("word", "other")):
            self._fail(token)
        self.out.repairs.add(Repair.MISSING_CLOSERS)
        return True

    def _string(self, quoted: str) -> str:
        if quoted[0] == '"':
            try:
                return str(json.loads(quoted))
            except ValueError:
                self.out.repairs.add(Repair.ESCAPES)
        else:
            self.out.repairs.add(Repair.QUOTES)
        return re.sub(r"\\(u[0-9a-fA-F]{4}|.)", _unescaped, quoted[1:-1], flags=re.DOTALL)

    def _number(self, token: Token) -> float | str:
        """Return a number, or a percentage as text; a number that lacks its last digits fails."""
        text = "".join(token.text.split())
        if not _NUMBER.fullmatch(text):
            self._fail(token)
        if text.endswith("%"):
            return text
        if not _JSON_NUMBER.fullmatch(text):
            self.out.repairs.add(Repair.NUMBER_FORMAT)
        return float(text)


def _unescaped(match: re.Match[str]) -> str:
    escape = match.group(1)
    return chr(int(escape[1:], 16)) if len(escape) == 5 else _ESCAPES.get(escape, escape)
