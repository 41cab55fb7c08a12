"""Select episodes by number, by where their danger comes from, and at random."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from harness.core.config import convert
from harness.core.errors import UserError, in_range, printable, unknown
from harness.core.seeds import LAST_SEED
from harness.dataset.load import Dataset
from harness.dataset.select import NONE, Choice, Selection, drawn


@dataclass(frozen=True)
class Episodes(Selection):
    """Select the episodes of a run that meet all conditions that are set; None sets none.

    The danger is the vehicle that the ego would meet if it drove on, and a sector, such as `left`,
    the side from which it comes. `chosen_by` names the settings that choose this selection, and
    `by_chance` those of them that draw.
    """

    chosen_by: ClassVar[tuple[str, ...]] = ("only", "danger", "sample", "sample_seed")
    by_chance: ClassVar[tuple[str, ...]] = ("sample", "sample_seed")

    only: str | None = None  # numbers and ranges such as `3,10:20`; a range leaves out its end
    danger: str | None = None  # the sector that the hidden danger comes from, or `none`
    # how many to draw; a larger sample with the same seed contains the smaller one
    sample: int | None = None
    sample_seed: int = 0  # seed of the draw

    def opened(self, settings: Mapping[str, Any]) -> "Episodes | None":
        of_these = {name: settings[name] for name in self.chosen_by if name in settings}
        selection = convert(of_these, Episodes, "selection of episodes")
        in_range("--sample-seed", selection.sample_seed, 0, LAST_SEED)
        return selection if selection._given else None

    @property
    def _given(self) -> dict[str, int | str]:
        """The conditions that are set, by name."""
        conditions = {key: value for key, value in asdict(self).items() if value is not None}
        if self.sample is None:
            del conditions["sample_seed"]
        return conditions

    def choice(self, numbers: Sequence[int], dataset: Dataset | None) -> Choice:
        end, pool = max(numbers) + 1, list(numbers)
        if self.only is not None:
            chosen = _numbers(self.only, end)
            pool = [n for n in pool if n in chosen]
        if self.danger is not None:
            danger_of = self._dangers(dataset)
            pool = [n for n in pool if danger_of[n] == self.danger]
        if not pool:
            options = ", ".join(f"--{key} {printable(value)}" for key, value in self._given.items())
            of_dataset = f" of {printable(dataset.name)}" if dataset else ""
            raise UserError(f"{options}: no episode{of_dataset} matches; give other values")
        sample = pool
        if self.sample is not None:
            sample = drawn(pool, self.sample, self.sample_seed, end)
        return Choice(tuple(sample), tuple(pool), self._given)

    def _dangers(self, dataset: Dataset | None) -> dict[int, str]:
        """Return where the danger of each episode of a dataset comes from, or `none`."""
        if dataset is None:
            raise UserError(
                f"--danger {printable(self.danger)}: where a layout's danger comes from is known "
                "of a dataset's; leave it out"
            )
        dangers = {tree.episode: tree.danger.sector or NONE for tree in dataset.trees}
        whole = dataset.scenario
        sectors = dangers.values() if whole.layouts is not None else whole.road().sectors
        allowed = tuple(dict.fromkeys((*sectors, NONE)))
        if self.danger not in allowed:
            raise unknown("--danger", str(self.danger), allowed)
        return dangers


SELECTION = Episodes()


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
