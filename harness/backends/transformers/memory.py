"""The keys and values of a transformers model: memory that grows by pages, and beginnings of earlier prompts.

A `DynamicCache` copies everything it holds for each token that is added. Here a step writes its own columns,
and copies only where a page is full.

Importing this imports torch.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from transformers.cache_utils import Cache, DynamicLayer

from harness.backends.engine import common_length

PAGE = 64  # columns by which memory grows
LEAST_TOKENS = 16  # a shorter beginning is cheaper to read again than to keep
MOST_TOKENS = 2048  # most tokens kept in total: 0.3 GB for a 4B model with grouped-query attention


class PagedLayer(DynamicLayer):  # type: ignore[misc]  # transformers is untyped here
    """One layer's keys and values, (n, heads, columns, dim): views of memory with room for more columns."""

    keys: Any
    values: Any

    def __init__(self) -> None:
        super().__init__()
        self._memory: list[Any] = []  # of keys and of values; empty if what is held is not ours

    def update(self, key_states: Any, value_states: Any, *_: Any, **__: Any) -> tuple[Any, Any]:
        """Append columns and return all. What is returned stays as it is when more are appended."""
        if not self.is_initialized:
            self.hold(key_states, value_states)
            return self.keys, self.values
        start, end = self.keys.shape[-2], self.keys.shape[-2] + key_states.shape[-2]
        if not self._memory or end > self._memory[0].shape[-2]:
            self._memory = [_with_room(held, end) for held in (self.keys, self.values)]
        for memory, states in zip(self._memory, (key_states, value_states), strict=True):
            memory[:, :, start:end] = states
        self.keys, self.values = (memory[:, :, :end] for memory in self._memory)
        return self.keys, self.values

    def hold(self, keys: Any, values: Any) -> None:
        """Take columns as they are, without a copy."""
        self.dtype, self.device = keys.dtype, keys.device
        self.keys, self.values, self.is_initialized = keys, values, True

    def place(self, rows: Sequence[int], keys: Any, values: Any, n: int, columns: int) -> None:
        """Copy columns to the beginning of some rows of n."""
        if not self._memory:
            _, heads, _, dim = keys.shape
            # Zeros and not just any memory: a NaN under the mask would reach what is not masked.
            self._memory = [keys.new_zeros(n, heads, _paged(columns), dim) for _ in range(2)]
            self.hold(*(memory[:, :, :columns] for memory in self._memory))
        index = torch.tensor(rows, device=keys.device)
        for memory, states in zip(self._memory, (keys, values), strict=True):
            memory[index, :, : states.shape[-2]] = states

    def reset(self) -> None:
        self._memory = []
        super().reset()

    def batch_select_indices(self, indices: Any) -> None:
        end = self.keys.shape[-2]
        held = [memory[indices] for memory in self._memory or (self.keys, self.values)]
        self._memory = held if self._memory else []
        self.keys, self.values = (memory[:, :, :end] for memory in held)


def _with_room(held: Any, columns: int) -> Any:
    """Copy keys or values to memory with room for `columns`, rounded up to whole pages."""
    n, heads, filled, dim = held.shape
    memory = held.new_empty(n, heads, _paged(columns), dim)
    memory[:, :, :filled] = held
    return memory


def _paged(columns: int) -> int:
    return -(-columns // PAGE) * PAGE


def join_caches(parts: Sequence[tuple[Sequence[int], Cache]]) -> Cache:
    """Return one cache of the rows of several, which are emptied. Rows with fewer columns end in zeros.

    Each cache has paged layers, and comes with the places of its rows among all.
    """
    n = sum(len(places) for places, _ in parts)
    columns = max(cache.get_seq_length() for _, cache in parts)
    layers = [PagedLayer() for _ in parts[0][1].layers]
    for i, layer in enumerate(layers):
        for places, cache in parts:
            part = cache.layers[i]
            layer.place(places, part.keys, part.values, n, columns)
            part.reset()
    whole = parts[0][1]
    whole.layers = layers
    return whole


class Prefix(NamedTuple):
    """A beginning that was read: its tokens, and each layer's keys and values, (1, heads, tokens, dim)."""

    ids: list[int]
    layers: list[tuple[Any, Any]]


NOTHING = Prefix([], [])


class Prefixes:
    """Recently used beginnings; the least recently used are dropped first."""

    def __init__(self) -> None:
        self._kept: list[Prefix] = []

    def longest(self, ids: list[int], but: Sequence[int] = ()) -> Prefix:
        """Return the longest known beginning of a sequence; `NOTHING` if it is below `LEAST_TOKENS`.

        `but` is a whole prompt that is ignored although it was read before.
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
        """Keep a beginning, and drop old ones above the limit."""
        self._kept = [*(kept for kept in self._kept if kept.ids != prefix.ids), prefix]
        while sum(len(kept.ids) for kept in self._kept) > MOST_TOKENS:
            del self._kept[0]

    def clear(self) -> None:
        self._kept.clear()
