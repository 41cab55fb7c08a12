"""What a language model's engine can do: go forward over tokens, and say which comes next.

The answer modes are written once, on top of this; an engine knows nothing of JSON, letters or roles.
"""

import math
from collections.abc import Sequence
from typing import Any, Protocol

from harness.backends.chat import Chat
from harness.core.arrays import Floats
from harness.core.image import Image


class Session(Protocol):
    """n sequences that go forward together, each with a distribution over its next token."""

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        """Most likely next token of each sequence: of the tokens listed for it, or of all where None.

        The lowest id wins a tie.
        """
        ...

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        """Natural log-probabilities of some tokens, or of all, as the next one, of the whole vocabulary.

        Shape (n, len(tokens)), or (n, vocabulary).
        """
        ...

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        """Append tokens to each sequence. An empty chunk leaves a sequence and its distribution alone."""
        ...

    def keep(self, places: Sequence[int]) -> None:
        """Go on with these sequences only, in this order: n becomes len(places)."""
        ...

    def close(self) -> None:
        """Give the memory back."""
        ...


class Engine(Protocol):
    """A loaded model.

    Attributes:
        chat: its tokenizer and chat template.
        context_tokens: most tokens of one sequence.
        stops: token ids that end an answer, sorted.
    """

    chat: Chat
    context_tokens: int
    stops: Sequence[int]

    def look(self, image: Image) -> list[int]:
        """What stands for a picture in a prompt.

        Tokens that its vision encoder fills are negative, the same for the same pixels and others for another
        picture; markers around them are tokens of the vocabulary.

        Raises:
            ValueError: the model takes no pictures.
        """
        ...

    def begin(self, prompts: Sequence[Sequence[int]]) -> Session:
        """Read some prompts, none of them empty; what they begin with in common is computed once."""
        ...

    def identity(self) -> dict[str, Any]:
        """What decides the answers, as JSON: engine, versions, weights, settings."""
        ...


_PLACE_BITS, _DIGITS = 16, 10  # of a picture's token: its place among them, and digits of the digest before


def picture_tokens(image: Image, count: int) -> list[int]:
    """The negative numbers that stand for a picture of so many tokens, in every engine and process."""
    first = int(image.sha256[:_DIGITS], 16) << _PLACE_BITS
    return [-1 - (first | place) for place in range(count)]


def picture_of(token: int) -> tuple[int, int]:
    """A picture's number, by one of its tokens, and the token's place among them."""
    return divmod(-1 - token, 1 << _PLACE_BITS)


def check_logits(largest: Sequence[float]) -> None:
    """Raise ArithmeticError if some sequence's largest logit is no number: its answer would mean nothing."""
    if not all(map(math.isfinite, largest)):
        raise ArithmeticError(
            "the logits are no numbers; the weights are damaged, or too large for this dtype"
        )


def common_length(sequences: Sequence[list[int]]) -> int:
    """How many tokens some sequences, at least one, begin with in common."""
    first, last = min(sequences), max(sequences)  # whatever lies between begins with what these two do
    return next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
