"""Where the thought ends and the answer begins.

A draft inside a thought is never an answer, so a thought that is not closed leaves nothing (the rule of
vLLM's Qwen3 reasoning parser). The names and spellings are those of the Qwen, DeepSeek, Phi, Magistral,
EXAONE and harmony templates.
"""

import re

from harness.parsing.status import Failure, Status

_NAMES = r"(?=[tras])(?:think(?:ing)?|thoughts?|reason(?:ing)?|reflection|analysis|scratchpad)"
# `<think` may lack its bracket: rather read too much as a thought than too little. What all tags begin with
# stands first, so that the search passes over all else at once.
_LEFT = r"(?:(?<=[<＜])|(?<=&)lt;)"
_TAG = re.compile(
    rf"""
    [<&＜\[] (?=[\s|\\/lctras]) (?:
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
    """The thought, if any, and what is left as the answer.

    A closing tag without an opening one means that the prompt's template opened the thought: all before
    it is thought. Text before, between and after closed thoughts is answer.

    Args:
        text: the completion.
        thinking: whether the model was asked to think; then a text without a closed thought is all thought.

    Returns:
        Thought (None: there was none; empty: an empty block) and answer.

    Raises:
        Failure: truncated_reasoning.
    """
    depth = at = 0
    thoughts: list[str] = []
    answers: list[str] = []
    closed = False
    for tag in _TAG.finditer(text):
        piece, at = text[at : tag.start()], tag.end()
        if tag["open"]:
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
    if depth or (thinking and not closed):
        raise Failure(Status.TRUNCATED_REASONING, "the thought was not closed, so no answer was begun")
    thought = "\n".join(piece.strip() for piece in thoughts if piece.strip())
    return (thought if closed else None), "\n".join([*answers, text[at:]])
