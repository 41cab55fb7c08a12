"""What chooses the episodes that a run uses, a kind, and draws of numbers.

An extension that ships adds one by `adds={"selections": {NAME: "module:SELECTION"}}`.
"""

import platform
import random
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from harness.core import noise
from harness.core.errors import UserError, printable
from harness.core.extensions import extensions, owner_of_plugin, part_of
from harness.core.plugins import ShippedChoices
from harness.dataset.load import Dataset

T = TypeVar("T")
NONE = "none"  # the `danger` of layouts without one


@dataclass(frozen=True)
class Choice:
    """State which episodes of a dataset a run uses, where something chooses them, as a sample.

    `numbers` are those of the episodes that are used, `pool` of those that they were chosen from,
    both ascending, and `given` has the settings that chose them, by name, as a run states them.
    """

    numbers: tuple[int, ...]  # numbers of the episodes that are used, ascending
    pool: tuple[int, ...]  # numbers of those that they were chosen from, ascending
    given: Mapping[str, Any]  # the settings that chose them, by name, as a run states them


class Selection(ABC):
    """Choose which episodes a run uses, such as a random sample, by an extension's settings.

    `chosen_by` names these settings, and `by_chance` those of them that look at no episode, such as
    a sample's. It is a base class; objects do not change.
    """

    chosen_by: ClassVar[tuple[str, ...]]  # names of the settings of its extension that choose it
    # those of them that draw, and look at no episode
    by_chance: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def opened(self, settings: Mapping[str, Any]) -> "Selection | None":
        """Return the selection that settings of extensions, by name, state; None for none.

        Others than `chosen_by` are ignored. Raises UserError for a value that is not allowed.
        """

    @abstractmethod
    def choice(self, numbers: Sequence[int], dataset: Dataset | None) -> Choice:
        """Return which of the episodes with these numbers are used, ascending as they are.

        They are those of `dataset`, or where that is None layouts (start situations) to drive in
        the simulator. Raises UserError if there are none, or too few.
        """


SELECTIONS = ShippedChoices[Selection]("swarmdrive.selections", Selection, {})


def recorded(record: Mapping[str, Any]) -> Selection | None:
    """Return what chose a run's episodes, by the `selection` that it states; None for all.

    `record` has that, values by name. Raises UserError if nothing chooses by what it states, or the
    extension that does is gone.
    """
    if owner := lacking(record):
        raise UserError(f"what selected the episodes of a run is {part_of(owner)}")
    selection = SELECTIONS.chosen(record)
    if record and selection is None:
        name = printable(next(iter(record)))
        raise UserError(f"a run says that its episodes were selected by {name}, as nothing does")
    return selection


def lacking(record: Mapping[str, Any]) -> str | None:
    """Return the extension that chose a run's episodes, by name, if it is not installed.

    `record` is the `selection` that the run states, values by name; None if there is none, or the
    extension is installed.
    """
    owners = [owner_of_plugin("settings", name) for name in record]
    return next((owner for owner in owners if owner and owner not in extensions()), None)


def pick(record: Mapping[str, Any], with_seeds: bool = False) -> str:
    """Return the options that chose a run's episodes by anything but chance, as one text.

    Whoever chose them may have looked at what happens in them, so that they say nothing of others.
    `record` is the `selection` that the run states, values by name. Empty if nothing chose so.
    `with_seeds` counts draws by another seed than 0, too, which may have been looked for.
    """
    blind = {"of"}
    for selection in SELECTIONS.values():
        seeds = [record.get(name) for name in selection.by_chance if name.endswith("seed")]
        if not (with_seeds and any(seeds)):
            blind |= {*selection.by_chance}
    chosen = {name: value for name, value in record.items() if name not in blind}
    options = {name.replace("_", "-"): value for name, value in chosen.items()}
    return " ".join(f"--{name} {printable(value, 40)}" for name, value in options.items())


def drawn(numbers: Sequence[int], sample: int, seed: int, end: int) -> list[int]:
    """Draw `sample` of the episode numbers, without replacement, and return them sorted.

    `seed` keys the draw, and all numbers are below `end`. A larger sample of the same seed contains
    a smaller one. Raises UserError if there are too few.
    """
    if not 1 <= sample <= len(numbers):
        raise UserError(f"--sample {sample}: give 1 to {len(numbers)} episodes")
    order = noise.generator("sample of episodes", seed).random(end)
    return sorted(sorted(numbers, key=lambda n: order[n])[:sample])


def spot_check(items: Sequence[T], sha256: str, most: int) -> list[T]:
    """Draw up to `most` items of a file, always the same on one machine.

    The draw is keyed by the file's digest `sha256` and the machine's name, so that whoever made the
    file cannot know which items are checked.
    """
    draw = random.Random(f"{sha256} {platform.node()}")
    return draw.sample(items, min(most, len(items)))
