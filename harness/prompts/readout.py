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
    """Return one letter for each action, in order, as one text: `ABC` for three.

    Raises UserError if there are more actions than letters.
    """
    if len(actions) > len(LETTERS):
        raise UserError(
            f"--answer readout: {len(actions)} actions, and {len(LETTERS)} letters; use json"
        )
    return LETTERS[: len(actions)]


def cyclic(actions: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the A cyclic orders of A actions: each begins with another action and goes round.

    In these orders of a list each action has each letter once.
    """
    return [(*actions[start:], *actions[:start]) for start in range(len(actions))]


def spelt(token: str) -> str:
    """Return a token's text without blanks around it, or signs that stand for them.

    So the token ` A` becomes `A`.
    """
    return token.strip(_BLANKS)


def question(actions: Sequence[str]) -> str:
    """Return the line that asks for a letter: `Answer with one letter: A SLOWER, B IDLE`.

    `actions` are the names of the meta-actions; the first has the letter A.
    """
    options = ", ".join(
        f"{letter} {a}" for letter, a in zip(letters(actions), actions, strict=True)
    )
    return f"Answer with one letter: {options}."


def letter_chat(
    messages: Sequence[Mapping[str, str]], actions: Sequence[str], answered: Sequence[str] = ()
) -> tuple[Mapping[str, str], ...]:
    """Return a chat in which every question asks for the letter of an action.

    The answer is then read from the letters' probabilities. `messages` are the prompt's chat, with
    earlier answers if it has examples. Letters are those of `actions`, in order. `answered` has the
    likeliest action of each earlier answer, whose letter replaces the answer.
    """
    letter, earlier = dict(zip(actions, letters(actions), strict=True)), iter(answered)

    def content(message: Mapping[str, str]) -> str:
        if message["role"] == "assistant":
            return letter[next(earlier)]
        return message["content"] + (f"\n{question(actions)}" if message["role"] == "user" else "")

    return tuple({**message, "content": content(message)} for message in messages)


def answer_json(actions: Sequence[str], shares: Sequence[float]) -> str:
    """Return the JSON text of an answer that gives each of the actions its share as probability.

    `shares` has one number for each action, of any sum: they are divided by it and rounded to
    millionths.
    """
    total = math.fsum(shares)
    p = rounded([share / total for share in shares], parts=10**6)
    return canonical_json({"action_distribution": dict(zip(actions, p, strict=True))})
