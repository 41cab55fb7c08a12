"""The interface of an engine: read tokens, and give the distribution of the next one.

The answer modes are implemented once, on top of it;
an engine knows nothing of JSON, letters or roles.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, Protocol

from harness.backends.chat import Chat
from harness.core.arrays import Floats
from harness.core.image import Image


class Session(Protocol):
    """n sequences that advance together, each with a distribution over its next token."""

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        """Return the most likely next token of each sequence among some (None: all);
        the lowest of equals.
        """
        ...

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        """Return log-probabilities over the vocabulary of some next tokens (None: all), (n,
        tokens).
        """
        ...

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        """Append tokens to each sequence.
        An empty chunk leaves a sequence and its distribution unchanged.
        """
        ...

    def follow(
        self, chunks: Sequence[Sequence[int]], guesses: Sequence[Sequence[int]]
    ) -> list[int]:
        """Append a chunk to each sequence,
        and as much of its guess as is its own likeliest next tokens.

        A chunk is not empty, a guess may be. Returns how many tokens of each guess were appended;
        an engine that checks none appends none.
        """
        self.advance(chunks)
        return [0] * len(guesses)

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        """Return the log-probabilities of some tokens after each of some chunks of each sequence.

        Each sequence has equally many chunks, none empty, and can only be closed then.
        Shape (n, chunks, tokens).
        """
        ...

    def keep(self, places: Sequence[int]) -> None:
        """Keep these sequences only, in this order: n becomes len(places)."""
        ...

    def close(self) -> None: ...


class Engine(Protocol):
    """A loaded model."""

    chat: Chat  # its tokenizer and chat template
    context_tokens: int  # most tokens of one sequence
    stops: Sequence[int]  # token ids that end an answer, sorted

    def look(self, image: Image) -> list[int]:
        """Return the tokens that stand for a picture in a prompt.
        Raises ValueError if the model takes none.

        Tokens that the vision encoder fills are negative, equal for equal pixels and different for
        another picture; markers around them are tokens of the vocabulary.
        """
        ...

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Session:
        """Read some prompts, none of them empty; their common beginning is computed once.

        The logits of the tokens in `exact` are computed in float32,
        whatever the weights' number format.
        """
        ...

    def forget(self) -> None:
        """Drop what is kept of earlier prompts; no session may be open."""
        ...

    def identity(self) -> dict[str, Any]: ...


LEAST_SAVED = 64  # fewer tokens saved are cheaper to read than a group of prompts of its own


def check_logits(largest: Sequence[float]) -> None:
    """Raise ArithmeticError if a sequence's largest logit is not finite:
    its answer would mean nothing.
    """
    if not all(map(math.isfinite, largest)):
        raise ArithmeticError(
            "the logits are no numbers; the weights are damaged, or too large for this dtype"
        )


def common_length(sequences: Sequence[list[int]]) -> int:
    """Return the length of the common beginning of one or more sequences."""
    first, last = min(sequences), max(sequences)  # all that sort between these two begin as both do
    return next(
        (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first)
    )


def common_beginning(sequences: Sequence[list[int]]) -> list[int]:
    """Return the common beginning of one or more sequences."""
    return sequences[0][: common_length(sequences)]


def group_by_beginning(sequences: Sequence[list[int]]) -> Iterator[list[int]]:
    """Yield the places of sequences in groups with longer common beginnings,
    where that saves tokens.
    """
    order = sorted(range(len(sequences)), key=sequences.__getitem__)
    shared = [common_length([sequences[a], sequences[b]]) for a, b in pairwise(order)]
    yield from _split(order, shared)


def _split(order: list[int], shared: list[int]) -> Iterator[list[int]]:
    """Split sorted sequences, of which neighbours share a beginning of some length."""
    least = min(shared, default=0)
    cuts = [-1, *(i for i, length in enumerate(shared) if length == least), len(shared)]
    rest = []
    for start, end in pairwise(cuts):
        part, inside = order[start + 1 : end + 1], shared[start + 1 : end]
        if inside and (len(part) - 1) * (min(inside) - least) >= LEAST_SAVED:
            yield from _split(part, inside)
        else:
            rest += part
    if rest:
        yield rest
