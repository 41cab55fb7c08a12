"""Cache of common prompt beginnings: the keys and values of prompts that were read before."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from harness.backends.engine import common_length

LEAST_TOKENS = 16  # a shorter beginning is cheaper to read again than to keep
MOST_TOKENS = 2048  # most tokens kept in total: 0.3 GB for a 4B model with grouped-query attention


class Prefix(NamedTuple):
    """A beginning that was read: its tokens, and each layer's keys and values, (1, heads, tokens, dim)."""

    ids: list[int]
    layers: list[tuple[Any, Any]]


NOTHING = Prefix([], [])


def common(sequences: Sequence[list[int]]) -> list[int]:
    """Return the common beginning of one or more sequences."""
    return sequences[0][: common_length(sequences)]


class Prefixes:
    """Recently used beginnings; the least recently used are dropped first."""

    def __init__(self) -> None:
        self._kept: list[Prefix] = []

    def longest(self, ids: list[int], but: Sequence[int] = ()) -> Prefix:
        """Return the longest known beginning of a sequence; `NOTHING` if it is below `LEAST_TOKENS`.

        `but` is a whole prompt that is ignored although it was read before.
        """
        kept = [prefix for prefix in self._kept if prefix.ids != list(but)]
        shared = [len(common([prefix.ids, ids])) for prefix in kept]
        most = max(shared, default=0)
        if most < LEAST_TOKENS:
            return NOTHING
        nearest = kept[shared.index(most)]
        self.keep(nearest)  # mark it as most recently used
        layers = [(keys[..., :most, :], values[..., :most, :]) for keys, values in nearest.layers]
        return Prefix(nearest.ids[:most], layers)

    def holds(self, ids: list[int]) -> bool:
        """Whether a whole prompt is kept."""
        return any(kept.ids == ids for kept in self._kept)

    def keep(self, prefix: Prefix) -> None:
        """Keep a beginning, and drop old ones above the limit."""
        self._kept = [*(kept for kept in self._kept if kept.ids != prefix.ids), prefix]
        while sum(len(kept.ids) for kept in self._kept) > MOST_TOKENS:
            del self._kept[0]

    def clear(self) -> None:
        """Drop all beginnings."""
        self._kept.clear()
