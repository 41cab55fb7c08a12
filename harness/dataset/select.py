"""Select the episodes of a dataset that are evaluated."""

import platform
import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TypeVar

from harness.core import noise
from harness.core.errors import UserError, in_range, printable, unknown
from harness.core.seeds import LAST_SEED
from harness.dataset.load import Dataset

T = TypeVar("T")
NONE = "none"  # the `danger` of layouts without one


@dataclass(frozen=True)
class Selection:
    """State which episodes of a dataset to evaluate; one must meet all conditions that are set.

    `limit` keeps the first so many of those left; `only` has numbers and ranges such as `3,10:20`,
    without their ends; `danger` is a sector or `none`; `sample` draws so many by `sample_seed`.
    None sets no condition.
    """

    limit: int | None = None  # keeps the first so many of those that the other conditions leave
    only: str | None = None  # numbers and ranges such as `3,10:20`; a range leaves out its end
    danger: str | None = None  # the sector that the hidden danger comes from, or `none`
    # how many to draw; a larger sample with the same seed contains the smaller one
    sample: int | None = None
    sample_seed: int = 0  # seed of the draw

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise UserError(f"--limit {self.limit}: give 1 or more episodes")
        in_range("--sample-seed", self.sample_seed, 0, LAST_SEED)

    @property
    def given(self) -> dict[str, int | str]:
        """The conditions that are set, except `limit`, by name."""
        conditions = {key: value for key, value in asdict(self).items() if value is not None}
        conditions.pop("limit", None)
        if self.sample is None:
            del conditions["sample_seed"]
        return conditions

    def of(self, dataset: Dataset) -> Dataset:
        """Return the dataset restricted to the selected episodes.

        Raises UserError if there are none, or the danger is unknown.
        """
        numbers = list(dataset.episodes)
        if self.only is not None:
            chosen = _numbers(self.only, max(numbers) + 1)
            numbers = [n for n in numbers if n in chosen]
        if self.danger is not None:
            sectors = tuple(dataset.scenario.road().sectors)
            if self.danger not in (*sectors, NONE):
                raise unknown("--danger", self.danger, (*sectors, NONE))
            danger_of = {tree.episode: tree.danger.sector or NONE for tree in dataset.trees}
            numbers = [n for n in numbers if danger_of[n] == self.danger]
        if self.sample is not None:
            numbers = drawn(numbers, self.sample, self.sample_seed, max(dataset.episodes) + 1)
        if not numbers:
            options = ", ".join(f"--{key} {printable(value)}" for key, value in self.given.items())
            raise UserError(
                f"{options}: no episode of {printable(dataset.name)} matches; give other values"
            )
        return dataset.of_episodes(frozenset(numbers[: self.limit]))


ALL = Selection()


def drawn(numbers: Sequence[int], sample: int, seed: int, end: int) -> list[int]:
    """Draw `sample` of the episode numbers, without replacement, and return them sorted.

    All are below `end`. A larger sample of the same seed contains a smaller one. Raises UserError
    if there are too few.
    """
    if not 1 <= sample <= len(numbers):
        raise UserError(f"--sample {sample}: give 1 to {len(numbers)} episodes")
    order = noise.generator("sample of episodes", seed).random(end)
    return sorted(sorted(numbers, key=lambda n: order[n])[:sample])


def _numbers(text: str, end: int) -> set[int]:
    """Parse a text such as `3,10:20`. Raises UserError for any other text,
    or for numbers from `end` on.
    """
    numbers: set[int] = set()
    for part in text.split(","):
        first, colon, last = part.partition(":")
        try:
            span = range(int(first), int(last)) if colon else range(int(first), int(first) + 1)
        except ValueError:
            span = range(0)
        if not span or span.start < 0 or span.stop > end:
            raise UserError(
                f"--only {printable(text)}: give episodes from 0 to {end - 1}, such as 3,10:20, "
                "which is 3 and 10 to 19"
            )
        numbers.update(span)
    return numbers


def spot_check(items: Sequence[T], sha256: str, most: int) -> list[T]:
    """Draw up to `most` items of a file, always the same on one machine.

    The draw is keyed by the file's digest `sha256` and the machine's name, so that whoever made the
    file cannot know which items are checked.
    """
    draw = random.Random(f"{sha256} {platform.node()}")
    return draw.sample(items, min(most, len(items)))
