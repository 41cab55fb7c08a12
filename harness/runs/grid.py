"""The grid of a run: its conditions, seeds and episodes, the axes of its figures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from harness.core.arrays import Ints
from harness.runs.decisions import Decisions
from harness.runs.records import Episode

T = TypeVar("T")


@dataclass(frozen=True)
class Grid:
    """Hold the conditions, seeds and episodes of a run: the axes (C, S, E) of its figures.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages; seeds are those of the radio channel's random draws. Each combination is a cell: one
    episode under one condition with one seed.
    """

    conditions: tuple[str, ...]  # names of the C conditions, operating points of the run
    seeds: tuple[int, ...]  # the S seeds of the channel's draws
    episodes: tuple[int, ...]  # numbers of the E episodes, one for each layout

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.conditions), len(self.seeds), len(self.episodes)

    def places(self, decisions: Decisions) -> Ints:
        """Return the cell of the run that each of n decisions is in, an index, (n,).

        A cell is one episode under one condition with one seed; the index is that in a flattened
        array (C, S, E) of all. Raises ValueError for a decision outside the grid.
        """
        condition = decisions.codes("condition", self.conditions)
        seed, episode = (
            _position(decisions.whole(name), names)
            for name, names in (("seed", self.seeds), ("episode", self.episodes))
        )
        return np.ravel_multi_index((condition, seed, episode), self.shape)

    def ordered(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the episodes' records by condition, then seed, then number.

        It is the order of arrays (C, S, E). Raises ValueError unless there is exactly one for each.
        """
        condition, seed, episode = map(_places_of, (self.conditions, self.seeds, self.episodes))
        _, seeds, layouts = self.shape
        try:
            cells = [
                (condition[e.condition] * seeds + seed[e.seed]) * layouts + episode[e.episode]
                for e in episodes
            ]
        except KeyError:
            cells = []
        order = np.argsort(cells)
        if not np.array_equal(np.sort(cells), np.arange(math.prod(self.shape))):
            raise ValueError("not every episode is there once in every condition and seed")
        return [episodes[place] for place in order.tolist()]


def _places_of(axis: Sequence[T]) -> dict[T, int]:
    return {each: place for place, each in enumerate(axis)}


def _position(values: Ints, names: Sequence[int]) -> Ints:
    order = np.argsort(names)
    place = order[np.minimum(np.searchsorted(names, values, sorter=order), len(names) - 1)]
    if (np.asarray(names)[place] != values).any():
        raise ValueError("a decision of another seed or episode")
    return np.asarray(place)
