"""Split a completion into thought and answer.

A draft inside a thought is never an answer, so an unclosed thought leaves no answer (the rule of
vLLM's Qwen3 reasoning parser). The names and spellings are those of the Qwen, DeepSeek, Phi,
Magistral, EXAONE and harmony templates.
"""

import re

from harness.parsing.relaxed import DECODER
from harness.parsing.status import Failure, Status

_MAX_BROKEN = 200  # most braces that open no valid JSON, and
_MAX_TRIED = 4_000_000  # most characters that these tries read in total; behind them any tag counts
_NAMES = r"(?=[tras])(?:think(?:ing)?|thoughts?|reason(?:ing)?|reflection|analysis|scratchpad)"
# `<think` may lack its bracket: it is safer to read too much as a thought than too little. The
# characters that any tag begins with come first, so that the search skips everything else at once.
_LEFT = r"(?:(?<=[<＜])|(?<=&)lt;)"
_TAG = re.compile(
    rf"""
    [<&＜\[] (?=[\s|\\lctras]|/[\stras]) (?:
    (?P<close> {_LEFT}\|?\s*\\?/\s*{_NAMES}\s*\|?(?:>|&gt;|＞) | (?<=\[)\s*/\s*think\s*\]
             | (?<=<)\|channel\|>\s*final | (?<=<)channel\|> )
  | (?P<open>  {_LEFT}\|?\s*(?:{_NAMES}\b[^<>&＞{{}}\n]*(?:>|&gt;|＞) | think(?:ing)?\b)
             | (?<=\[)\s*think\s*\]
             | (?<=<)\|channel\|?>\s*(?:analysis|thought|commentary) )
    )
    """,
    re.IGNORECASE | re.VERBOSE,
)


def split(text: str, thinking: bool) -> tuple[str | None, str]:
    """Split a completion into the model's thought and the text of its answer.

    The thought is None if there is none, and empty for an empty block. A closing tag without an
    opening one means that the prompt's template opened the thought: all text before it is thought.
    Text before, between and after closed thoughts belongs to the answer. If the model was asked to
    think (`thinking`), a text without a closed thought is all thought. A tag in a string of valid
    JSON is text. Raises Failure (truncated_reasoning) for a thought that is not closed.
    """
    depth = at = 0
    thoughts: list[str] = []
    answers: list[str] = []
    closed = False
    for tag in _tags(text):
        piece, at = text[at : tag.start()], tag.end()
        if tag.lastgroup == "open":
            (thoughts if depth else answers).append(piece)
            depth += 1
            continue
        closed = True
        if depth:
            depth -= 1
        else:
            thoughts += answers
            answers.clear()
        thoughts.append(piece)
    if depth and any(piece.strip() for piece in answers):
        detail = (
            "a thought was begun after other text and not closed; it may overturn what stands "
            "before it"
        )
        raise Failure(Status.TRUNCATED_REASONING, detail)
    if depth or (thinking and not closed):
        raise Failure(
            Status.TRUNCATED_REASONING, "the thought was not closed, so no answer was begun"
        )
    thought = "\n".join(piece.strip() for piece in thoughts if piece.strip())
    return (thought if closed else None), "\n".join([*answers, text[at:]])


def _tags(text: str) -> list[re.Match[str]]:
    """Return the tags of a text but those inside an object of valid JSON,
    which stand in its strings.
    """
    outside: list[re.Match[str]] = []
    most_broken = min(_MAX_BROKEN, _MAX_TRIED // (len(text) + 1))
    opening, end, broken = text.find("{"), 0, 0
    for tag in _TAG.finditer(text):
        while 0 <= opening < tag.start() and broken < most_broken:
            try:
                _, end = DECODER.raw_decode(text, opening)
            except (ValueError, RecursionError):
                broken += 1
            opening = text.find("{", max(end, opening + 1))
        if end <= tag.start():
            outside.append(tag)
    return outside
