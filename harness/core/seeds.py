"""Ranges of layout seeds by purpose, so that no layout is tuned or trained on and then reported.

Constants of scenarios and wordings of prompts are chosen on tune seeds, models learn from train
seeds, and every number that is quoted comes from report seeds. The rule is the same for every
scenario.
"""

from itertools import pairwise
from typing import Literal

from harness.core.errors import UserError

Purpose = Literal["tune", "train", "report"]

# each range ends at the next
FIRST: dict[Purpose, int] = {"tune": 0, "train": 100_000, "report": 200_000}
LAST_EPISODE, LAST_SEED = 99_999, 2**31 - 1


def purpose(first: int, count: int) -> Purpose:
    """Return what a range of `count` layout seeds is for: `tune`, `train` or `report`.

    A layout seed is a number that fixes a drawn start situation of a scenario; each range of them
    has one purpose, so that no situation is tuned or trained on and then reported. `first` is the
    first seed. Raises UserError if the range has several purposes.
    """
    present = purposes(first, count)
    if len(present) > 1:
        ends = [
            f"{start} to {end - 1} ({name})" for (name, start), (_, end) in pairwise(FIRST.items())
        ]
        raise UserError(
            f"layout seeds {first} to {first + count - 1} are for {' and '.join(present)}; keep to "
            f"one of {', '.join(ends)}, {FIRST['report']} and above (report)"
        )
    return present[0]


def seeds_text(first: int, count: int) -> str:
    """Write a range of layout seeds with its purpose: `layout seeds 0 to 239 (tune)`.

    `first` is the first of `count` seeds; each fixes a drawn start situation of a scenario.
    """
    return f"layout seeds {first} to {first + count - 1} ({' and '.join(purposes(first, count))})"


def purposes(first: int, count: int) -> list[Purpose]:
    """Return what a range of layout seeds is for: some of `tune`, `train` and `report`.

    A layout seed fixes a drawn start situation of a scenario, and has one purpose, so that nothing
    is tuned on and then reported. `first` is the first of `count` seeds.
    """
    names = list(FIRST)
    ends = [*list(FIRST.values())[1:], first + count]
    return [
        n for n, end in zip(names, ends, strict=True) if first < end and FIRST[n] < first + count
    ]
