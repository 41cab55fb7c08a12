"""The keys and values of a transformers model:
those of several batches as one, and of earlier prompts.

Importing this imports torch.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch.nn.functional import pad
from transformers.cache_utils import Cache

from harness.backends.engine import common_length

LEAST_TOKENS = 16  # a shorter beginning is cheaper to read again than to keep
MOST_TOKENS = 2048  # most tokens kept in total: 0.3 GB for a 4B model with grouped-query attention


def join_caches(caches: Sequence[Cache], order: Any) -> Cache:
    """Return one key-value cache with the rows (sequences) of several, which are emptied.

    `order` has indices into the rows of all caches, counted one cache after the other: row n of the
    result is row `order[n]`. Short rows are padded by zeros at their end.
    """
    columns = max(cache.get_seq_length() for cache in caches)
    for layers in zip(*(cache.layers for cache in caches), strict=True):
        for name in ("keys", "values"):
            held = [getattr(layer, name) for layer in layers]
            wide = torch.cat([pad(each, (0, 0, 0, columns - each.shape[-2])) for each in held])
            for layer in layers:
                setattr(layer, name, None)  # so that no more than one layer is in memory twice
            setattr(layers[0], name, wide[order.to(wide.device)])
    return caches[0]


class Prefix(NamedTuple):
    """Hold the beginning of a prompt that was read: its token ids, and their keys and values.

    `layers` has each layer's pair of keys and values, each `(1, heads, tokens, dim)`.
    """

    ids: list[int]  # token ids
    layers: list[tuple[Any, Any]]  # keys and values of each layer, (1, heads, tokens, dim) each


NOTHING = Prefix([], [])


class Prefixes:
    """Keep the keys and values of a few recently read beginnings of prompts, to read them once.

    At most `MOST_TOKENS` tokens in total; the least recently used is dropped first.
    """

    def __init__(self) -> None:
        self._kept: list[Prefix] = []

    def longest(self, ids: list[int], but: Sequence[int] = ()) -> Prefix:
        """Return the longest kept beginning of the token ids `ids`, a prompt.

        It is empty if that is shorter than `LEAST_TOKENS`. `but` is a whole prompt that does not
        count, although it was read before.
        """
        kept = [prefix for prefix in self._kept if prefix.ids != list(but)]
        shared = [common_length([prefix.ids, ids]) for prefix in kept]
        most = max(shared, default=0)
        if most < LEAST_TOKENS:
            return NOTHING
        nearest = kept[shared.index(most)]
        self.keep(nearest)  # mark it as most recently used
        layers = [(keys[..., :most, :], values[..., :most, :]) for keys, values in nearest.layers]
        return Prefix(nearest.ids[:most], layers)

    def holds(self, ids: list[int]) -> bool:
        return any(kept.ids == ids for kept in self._kept)

    def keep(self, prefix: Prefix) -> None:
        """Keep the beginning of a prompt that was read, `prefix`: token ids, keys and values.

        The least recently used ones are dropped until at most `MOST_TOKENS` tokens are kept.
        """
        self._kept = [*(kept for kept in self._kept if kept.ids != prefix.ids), prefix]
        while sum(len(kept.ids) for kept in self._kept) > MOST_TOKENS:
            del self._kept[0]

    def clear(self) -> None:
        self._kept.clear()
