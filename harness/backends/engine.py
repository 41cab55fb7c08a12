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
    """Describe n token sequences in a loaded model that advance together, one for each answer.

    The model has read them, and knows its distribution over the next token of each.
    """

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        """Return each sequence's likeliest next token id, n of them; of equals the lowest id.

        `among` has for each sequence the ids to choose from, None for all.
        """
        ...

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        """Return log-probabilities of the next token of each of n sequences, `(n, K)`.

        They are those of the K ids `tokens`; None takes all ids of the vocabulary. Values are
        normalised over the whole vocabulary in either case.
        """
        ...

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        """Append the token ids `chunks[i]` to each sequence i, which the model reads.

        An empty chunk leaves a sequence and its distribution as they are.
        """
        ...

    def follow(
        self, chunks: Sequence[Sequence[int]], guesses: Sequence[Sequence[int]]
    ) -> list[int]:
        """Append a chunk to each sequence, and as much of its guess as the model would write.

        `chunks` and `guesses` have the token ids for each sequence; a chunk is not empty, a guess
        may be. A guess is appended while its tokens are the likeliest next ones. Returns how many
        tokens of each guess were appended; an engine that checks none appends none.
        """
        self.advance(chunks)
        return [0] * len(guesses)

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        """Return log-probabilities of K token ids after each of C continuations, `(n, C, K)`.

        The ids are `tokens`. `chunks` has for each of the n sequences C lists of token ids that
        would follow it; each sequence has equally many, none empty. The session can only be closed
        afterwards.
        """
        ...

    def keep(self, places: Sequence[int]) -> None:
        """Drop all sequences but those at the indices `places`, which are then in this order.

        It is called when some answers are finished.
        """
        ...

    def close(self) -> None: ...


class Engine(Protocol):
    """Describe a loaded model that reads tokens and gives distributions of next ones.

    `chat` is its tokenizer with the chat template, `context_tokens` the most tokens of one
    sequence, and `stops` the ids of tokens that end an answer.
    """

    chat: Chat  # its tokenizer and chat template
    context_tokens: int  # most tokens of one sequence
    stops: Sequence[int]  # token ids that end an answer, sorted

    def look(self, image: Image) -> list[int]:
        """Return the token ids that stand for a picture in a prompt.

        Ids that the vision encoder fills are negative, equal for equal pixels and different for
        another picture; markers around them are tokens of the vocabulary. Raises ValueError if the
        model takes no pictures.
        """
        ...

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Session:
        """Return a session that has read some prompts; each is one of its sequences.

        A prompt is a list of token ids. Their common beginning is computed once. No prompt may be
        empty. The logits of the token ids in `exact` are computed in float32, whatever the weights'
        number format.
        """
        ...

    def forget(self) -> None:
        """Drop what is kept of earlier prompts, such as their keys and values.

        No session may be open.
        """
        ...

    def identity(self) -> dict[str, Any]: ...


LEAST_SAVED = 64  # fewer tokens saved are cheaper to read than a group of prompts of its own


def check_logits(largest: Sequence[float]) -> None:
    """Raise ArithmeticError if a logit is not finite, as damaged weights make them.

    `largest` has the largest logit of each sequence.
    """
    if not all(map(math.isfinite, largest)):
        raise ArithmeticError(
            "the logits are no numbers; the weights are damaged, or too large for this dtype"
        )


def common_length(sequences: Sequence[list[int]]) -> int:
    """Return how many tokens some sequences have in common at their beginning.

    Each is a list of token ids; there must be at least one.
    """
    first, last = min(sequences), max(sequences)  # all that sort between these two begin as both do
    return next(
        (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first)
    )


def common_beginning(sequences: Sequence[list[int]]) -> list[int]:
    """Return the token ids that some sequences have in common at their beginning.

    Each is a list of token ids; there must be at least one.
    """
    return sequences[0][: common_length(sequences)]


def group_by_beginning(sequences: Sequence[list[int]]) -> Iterator[list[int]]:
    """Yield groups of token sequences with long common beginnings, which are then read only once.

    A group is a list of indices into `sequences`, lists of token ids; each index is in one group. A
    group of its own is made only where that saves reading at least `LEAST_SAVED` tokens.
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
