"""The read-out: the model is asked for one letter, and the letters' probabilities are its answer.

Letters, because labels may begin with the same token (`LANE_LEFT` and `LANE_RIGHT` share two in Qwen's
vocabulary), so that the first token of a label says nothing of which one it is.
"""

import math
from collections.abc import Mapping, Sequence

from harness.core.errors import UserError
from harness.core.files import canonical_json
from harness.core.rounding import rounded

LETTERS = "ABCDEFGHIJ"


def letters(actions: Sequence[str]) -> str:
    """One letter an action, in order. Raises UserError for more actions than there are letters."""
    if len(actions) > len(LETTERS):
        raise UserError(f"--answer readout: {len(actions)} actions, and {len(LETTERS)} letters; use json")
    return LETTERS[: len(actions)]


def question(actions: Sequence[str]) -> str:
    """The line that asks for a letter."""
    options = ", ".join(f"{letter} {a}" for letter, a in zip(letters(actions), actions, strict=True))
    return f"Answer with one letter: {options}."


def asked(
    messages: Sequence[Mapping[str, str]], actions: Sequence[str], answered: Sequence[str] = ()
) -> tuple[Mapping[str, str], ...]:
    """The same chat, each of whose questions asks for one letter in the end.

    Args:
        messages: the chat.
        actions: what the letters stand for.
        answered: the action that each earlier answer is likeliest to take, which it then says by its letter.
    """
    letter, earlier = dict(zip(actions, letters(actions), strict=True)), iter(answered)

    def said(message: Mapping[str, str]) -> str:
        if message["role"] == "assistant":
            return letter[next(earlier)]
        return message["content"] + (f"\n{question(actions)}" if message["role"] == "user" else "")

    return tuple({**message, "content": said(message)} for message in messages)


def stated(actions: Sequence[str], shares: Sequence[float]) -> str:
    """A read-out as an answer's text: the actions' shares, divided by their sum, in millionths."""
    whole = math.fsum(shares)
    p = rounded([share / whole for share in shares], parts=10**6)
    return canonical_json({"action_distribution": dict(zip(actions, p, strict=True))})
