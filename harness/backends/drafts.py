"""Guesses of how an answer goes on, from the answers written beside it.

A model checks a guess of several tokens at a time, and drops what it would not have written itself
(speculative decoding, Leviathan et al., 2023), so no answer changes. Guesses are a batch's own.
"""

from collections.abc import Hashable, Sequence

from harness.backends.chat import Chat

BEFORE = 8  # tokens that decide what comes next
MOST = 8  # most tokens of a guess


class Drafts:
    """Guess how answers go on, from which token followed which ones in other answers of the batch.

    The model then checks several guessed tokens in one pass, which is faster than writing them one
    by one. For what came before, tokens with digits count as equal. A token is guessed only where
    all answers went on alike.
    """

    def __init__(self, chat: Chat) -> None:
        self._chat = chat
        self._next: dict[Hashable, int | None] = {}  # None where answers differ
        self._numeric: dict[int, bool] = {}

    def learn(self, kind: Hashable, tokens: Sequence[int]) -> None:
        """Remember that the last token of an answer so far follows those before it.

        `tokens` are the answer's token ids. `kind` tells answers of different forms apart, such as
        that of the ego and of helpers: they are not guessed by each other.
        """
        place = self._place(kind, tokens[:-1])
        if self._next.setdefault(place, tokens[-1]) != tokens[-1]:
            self._next[place] = None

    def after(self, kind: Hashable, tokens: Sequence[int], most: int) -> list[int]:
        """Return up to `most` guessed token ids that may follow an answer so far; none if unknown.

        `tokens` are the answer's token ids. `kind` tells answers of different forms apart, such as
        that of the ego and of helpers.
        """
        guess: list[int] = []
        while len(guess) < min(most, MOST):
            token = self._next.get(self._place(kind, [*tokens, *guess]))
            if token is None:
                break
            guess.append(token)
        return guess

    def _place(self, kind: Hashable, tokens: Sequence[int]) -> Hashable:
        return kind, *(None if self._is_numeric(token) else token for token in tokens[-BEFORE:])

    def _is_numeric(self, token: int) -> bool:
        if token not in self._numeric:
            self._numeric[token] = any(c.isdigit() for c in self._chat.pieces([token])[0])
        return self._numeric[token]
