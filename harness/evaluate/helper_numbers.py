"""Number the helpers of an episode, so that each keeps its luck when another one leaves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Ints
from harness.dataset.load import Scene
from harness.evaluate.draws import channel_draws
from harness.radio.channel import Draws


@dataclass(frozen=True)
class HelperNumbers:
    """Say which helpers of their episodes the H helpers of n scenes are.

    A helper's number is its place, from 0, at the first decision of its episode, which it keeps
    when others leave. One that comes later has a number after all of these.
    """

    at_first: Ints  # how many helpers the first decision of each scene's episode has, `(n,)`
    # each helper's number, `(n, H)`; no two of a row are the same. None if all have those of their
    # places
    numbers: Ints | None
    most: int  # how many numbers there are

    def by_number(self, at: Ints, seed: Ints, layout_seed: Ints, step: Ints, steps: int) -> Draws:
        """Return the channel's draws for all numbers, of decisions in the scenes of indices `at`.

        The other arguments are those of `channel_draws`, for the same decisions.
        """
        return channel_draws(seed, layout_seed, step, steps, self.most, self.at_first[at])

    def draws(self, at: Ints, seed: Ints, layout_seed: Ints, step: Ints, steps: int) -> Draws:
        """Return the channel's draws for the helpers, of decisions in the scenes of indices `at`.

        The other arguments are those of `channel_draws`, for the same decisions.
        """
        return self.of(self.by_number(at, seed, layout_seed, step, steps), at)

    def of(self, draws: Draws, at: Ints) -> Draws:
        """Return the draws of the helpers in scenes, given those of all numbers.

        `draws` are of decisions in the scenes of indices `at`.
        """
        return draws if self.numbers is None else draws.numbered(self.numbers[at])


class Helpers:
    """Remember whom the first decision of each episode has as helpers."""

    def __init__(self) -> None:
        # ids of the helpers in their order, by layout seed and the agent that decides
        self._first: dict[tuple[int, int], tuple[str, ...]] = {}

    def numbers(self, scenes: Sequence[Scene]) -> HelperNumbers:
        """Return the numbers of the helpers in n scenes.

        The first scene of an episode that is given here is that of its first decision.
        """
        present = [scene.viewers[1:] for scene in scenes]
        keys = [(scene.record.episode_seed, scene.agent) for scene in scenes]
        first = [self._first.setdefault(*each) for each in zip(keys, present, strict=True)]
        width = max(map(len, present), default=0)
        at_first = np.array([len(ids) for ids in first], dtype=int)
        if present == first and (at_first == width).all():
            return HelperNumbers(at_first, None, width)
        each = zip(present, first, strict=True)
        numbers = np.array([_numbers(*ids, width) for ids in each], dtype=int)
        return HelperNumbers(at_first, numbers, int(numbers.max(initial=-1)) + 1)


def _numbers(present: Sequence[str], first: Sequence[str], width: int) -> list[int]:
    """Return a number for each of `width` places; empty ones have those of nobody, in order."""
    later = [name for name in present if name not in first]
    order = [*first, *later]
    numbers = [order.index(name) for name in present]
    others = [number for number in range(len(order) + width) if number not in numbers]
    return numbers + others[: width - len(present)]
