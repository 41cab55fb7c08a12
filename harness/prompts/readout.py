"""The read-out answer mode: ask the model for one letter,
and take the letters' probabilities as its answer.

Letters stand for the actions because labels may begin with the same tokens (`LANE_LEFT` and
`LANE_RIGHT` share two in Qwen's vocabulary), so the first token of a label does not tell which one
it is.
"""

import math
from collections.abc import Mapping, Sequence

from harness.core.errors import UserError
from harness.core.files import canonical_json
from harness.core.rounding import rounded

LETTERS = "ABCDEFGHIJ"
MOST_SHARE = 0.5  # letter share from which the letter explains more of a read-out than all else
# What stands for a blank or a line break in a token: itself, or SentencePiece's and byte-level
# BPE's signs.
_BLANKS = " \t\r\n\u2581\u0120\u010a"


def letters(actions: Sequence[str]) -> str:
    """Return one letter for each action, in order.
    Raises UserError if there are too few letters.
    """
    if len(actions) > len(LETTERS):
        raise UserError(
            f"--answer readout: {len(actions)} actions, and {len(LETTERS)} letters; use json"
        )
    return LETTERS[: len(actions)]


def cyclic(actions: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the cyclic orders of the actions: in each, every letter stands for the next action."""
    return [(*actions[start:], *actions[:start]) for start in range(len(actions))]


def spelt(token: str) -> str:
    """Return a token's text without blanks around it:
    ` A` is another token than `A`, and the same letter.
    """
    return token.strip(_BLANKS)


def question(actions: Sequence[str]) -> str:
    """Return the line that asks for a letter."""
    options = ", ".join(
        f"{letter} {a}" for letter, a in zip(letters(actions), actions, strict=True)
    )
    return f"Answer with one letter: {options}."


def asked(
    messages: Sequence[Mapping[str, str]], actions: Sequence[str], answered: Sequence[str] = ()
) -> tuple[Mapping[str, str], ...]:
    """Append to every question of a chat the line that asks for one letter,
    which stand for the actions.

    `answered` has the likeliest action of each earlier answer, whose letter replaces the answer.
    """
    letter, earlier = dict(zip(actions, letters(actions), strict=True)), iter(answered)

    def content(message: Mapping[str, str]) -> str:
        if message["role"] == "assistant":
            return letter[next(earlier)]
        return message["content"] + (f"\n{question(actions)}" if message["role"] == "user" else "")

    return tuple({**message, "content": content(message)} for message in messages)


def stated(actions: Sequence[str], shares: Sequence[float]) -> str:
    """Write a read-out as an answer's text: the actions' shares, normalised, in millionths."""
    total = math.fsum(shares)
    p = rounded([share / total for share in shares], parts=10**6)
    return canonical_json({"action_distribution": dict(zip(actions, p, strict=True))})
