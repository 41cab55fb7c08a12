"""Which episodes of a dataset are evaluated."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from harness.core import noise
from harness.core.errors import UserError, printable, unknown
from harness.dataset.load import Dataset

NONE = "none"  # of `danger`: layouts without one


@dataclass(frozen=True)
class Selection:
    """Episodes that are in all of these; without any, all of them.

    Attributes:
        limit: the first so many of the others.
        only: numbers and ranges, `3,10:20`, each without its end.
        danger: sector that the hidden danger comes from, or `none`.
        sample: how many to draw; a larger sample of the same seed has the smaller one in it.
        sample_seed: of the draw.
    """

    limit: int | None = None
    only: str | None = None
    danger: str | None = None
    sample: int | None = None
    sample_seed: int = 0

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise UserError(f"--limit {self.limit}: give 1 or more episodes")

    @property
    def given(self) -> dict[str, int | str]:
        """What is given besides `limit`, by name."""
        others = {key: value for key, value in asdict(self).items() if key != "limit" and value is not None}
        if self.sample is None:
            del others["sample_seed"]
        return others

    def of(self, dataset: Dataset) -> Dataset:
        """The dataset with these episodes only. Raises UserError if there is none, or no such danger."""
        numbers = list(dataset.episodes)
        if self.only is not None:
            wanted = _numbers(self.only, max(numbers) + 1)
            numbers = [n for n in numbers if n in wanted]
        if self.danger is not None:
            sectors = tuple(dataset.scenario.road().sectors)
            if self.danger not in (*sectors, NONE):
                raise unknown("--danger", self.danger, (*sectors, NONE))
            of = {tree.episode: tree.danger.sector or NONE for tree in dataset.trees}
            numbers = [n for n in numbers if of[n] == self.danger]
        if self.sample is not None:
            numbers = drawn(numbers, self.sample, self.sample_seed, max(dataset.episodes) + 1)
        if not numbers:
            shown = ", ".join(f"--{key} {printable(value)}" for key, value in self.given.items())
            raise UserError(f"{shown}: no episode of {printable(dataset.name)} matches; give other values")
        return dataset.of_episodes(frozenset(numbers[: self.limit]))


ALL = Selection()


def drawn(numbers: Sequence[int], sample: int, seed: int, end: int) -> list[int]:
    """Some of the episodes' numbers, all of which are below `end`. Raises UserError if there are too few."""
    if not 1 <= sample <= len(numbers):
        raise UserError(f"--sample {sample}: give 1 to {len(numbers)} episodes")
    order = noise.generator("sample of episodes", seed).random(end)
    return sorted(sorted(numbers, key=lambda n: order[n])[:sample])


def _numbers(text: str, end: int) -> set[int]:
    """The numbers below `end` that `3,10:20` names. Raises UserError for another text, or one beyond it."""
    found: set[int] = set()
    for part in text.split(","):
        first, colon, last = part.partition(":")
        try:
            at = range(int(first), int(last)) if colon else range(int(first), int(first) + 1)
        except ValueError:
            at = range(0)
        if not at or at.start < 0 or at.stop > end:
            raise UserError(
                f"--only {printable(text)}: give episodes from 0 to {end - 1}, such as 3,10:20, which is "
                "3 and 10 to 19"
            )
        found.update(at)
    return found
