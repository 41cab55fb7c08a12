"""The words of almost-JSON: what the relaxed reader reads."""

import re
import unicodedata
from dataclasses import dataclass

from harness.parsing.status import Repair

_DIGITS = r"(?:\d+(?:[.．]\d*)?|[.．]\d+)(?:[eE][-+]?\d*)?"
_TOKEN = re.compile(
    rf"""
    (?P<comment> //[^\n]* | /\*.*?\*/ | \#[^\n]* )
  | (?P<string> "(?:[^"\\]|\\.)*" | '(?:[^'\\]|\\.)*' | `[^`]+`(?!`)
              | [“”„‟＂][^“”„‟＂"\\]*[“”„‟＂"] | [‘’‚][^‘’‚\\]*[‘’] )
  | (?P<expression> [-+]?{_DIGITS}\s*%?(?:\s*(?:\*\*|[-+*/^])\s*[-+(]*{_DIGITS}\s*%?\)*)+ )
  | (?P<number> [-+]?{_DIGITS}(?:\s*[%％])? )
  | (?P<fence> ``` )
  | (?P<mark> [{{}}\[\]:,｛｝［］：，] )
  | (?P<word> -?[^\W\d]\w* | <[^<>{{}}\n]*> | \.\.\.|… )
    """,
    re.DOTALL | re.VERBOSE,
)


@dataclass(frozen=True)
class Token:
    """A piece of text.

    Attributes:
        kind: a group of the pattern; `other` for a character that begins no token, `end` at the text's end.
        text: as written, but full-width numbers and marks as ASCII.
        end: where the next token may begin.
        repairs: liberties taken up to here.
    """

    kind: str
    text: str
    end: int
    repairs: frozenset[Repair] = frozenset()


def next_token(text: str, at: int) -> Token:
    """The first token at or after `at`; white space and comments are passed over."""
    repairs: frozenset[Repair] = frozenset()
    while True:
        while at < len(text) and text[at].isspace():
            at += 1
        if at == len(text):
            return Token("end", "", at)
        match = _TOKEN.match(text, at)
        if match is None:
            return Token("other", text[at], at + 1)
        kind, found, at = match.lastgroup or "other", match.group(), match.end()
        if kind == "comment":
            repairs |= {Repair.COMMENTS}
            continue
        if kind in ("number", "mark") and not found.isascii():
            found = unicodedata.normalize("NFKC", found)
            repairs |= {Repair.FULL_WIDTH}
        return Token(kind, found, at, repairs)
