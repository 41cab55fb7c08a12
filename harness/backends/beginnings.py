"""Which prompts of a batch begin alike, so that an engine reads what they share once."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from harness.backends.engine import common_length

LEAST_SAVED = 64  # fewer tokens saved are cheaper to read than a group of prompts of its own


def alike(sequences: Sequence[list[int]]) -> Iterator[list[int]]:
    """Split sequences into groups with longer common beginnings, where that saves tokens.

    Yields:
        The places of each group's sequences.
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
