"""What prompts begin with in common, computed once: keys and values of prompts read before."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from harness.backends.engine import common_length

LEAST_TOKENS = 16  # a shorter beginning costs less to read again than to look after
MOST_TOKENS = 2048  # kept together; 0.3 GB of a 4B model with grouped-query attention


class Prefix(NamedTuple):
    """A sequence's beginning, read: its tokens, and each layer's keys and values, (1, heads, tokens, dim)."""

    ids: list[int]
    layers: list[tuple[Any, Any]]


NOTHING = Prefix([], [])


def common(sequences: Sequence[list[int]]) -> list[int]:
    """What some sequences, at least one, begin with in common."""
    return sequences[0][: common_length(sequences)]


class Prefixes:
    """Beginnings that were read lately. The oldest leave first."""

    def __init__(self) -> None:
        self._kept: list[Prefix] = []

    def longest(self, ids: list[int], but: Sequence[int] = ()) -> Prefix:
        """The longest beginning of a sequence that was read before; `NOTHING` if that is not worth while.

        Args:
            ids: the sequence.
            but: a whole prompt that does not count, though it was read before.
        """
        kept = [prefix for prefix in self._kept if prefix.ids != list(but)]
        shared = [len(common([prefix.ids, ids])) for prefix in kept]
        most = max(shared, default=0)
        if most < LEAST_TOKENS:
            return NOTHING
        found = kept[shared.index(most)]
        self.keep(found)  # the last one used is the last to leave
        layers = [(keys[..., :most, :], values[..., :most, :]) for keys, values in found.layers]
        return Prefix(found.ids[:most], layers)

    def holds(self, ids: list[int]) -> bool:
        """Whether a whole prompt was read lately."""
        return any(kept.ids == ids for kept in self._kept)

    def keep(self, prefix: Prefix) -> None:
        """Remember a beginning, and forget old ones that would be too much with it."""
        self._kept = [*(kept for kept in self._kept if kept.ids != prefix.ids), prefix]
        while sum(len(kept.ids) for kept in self._kept) > MOST_TOKENS:
            del self._kept[0]

    def clear(self) -> None:
        """Forget all of them."""
        self._kept.clear()
