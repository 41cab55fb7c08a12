"""The one way in which a number is written for people,
and plain values of estimates for machines.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

DASH = "–"


class Bounded(Protocol):
    """Describe what has a `value` and the ends `low` and `high` of its confidence interval.

    Functions that write numbers take it. All three are in the unit of the value; None or NaN where
    unknown.
    """

    @property
    def value(self) -> float | None: ...
    @property
    def low(self) -> float | None: ...
    @property
    def high(self) -> float | None: ...


class Counted(Bounded, Protocol):
    """Describe what has a value, its interval, and the number `n` behind it.

    n counts the episodes, decisions or seeds that the value is a mean of.
    """

    @property
    def n(self) -> int: ...


@dataclass(frozen=True)
class Unit:
    """Describe how a quantity is written: its unit's name, decimals and factor.

    A stored value is multiplied by `factor` (such as 100 for a share in %), written with `decimals`
    digits behind the point, and followed by `name`. An unknown value is written as a dash, and zero
    never as -0.
    """

    name: str = ""  # stands behind the number
    decimals: int = 1  # digits behind the point
    factor: float = 1.0  # what a stored value is multiplied by

    def number(self, value: float | None, sign: str = "", digits: int | None = None) -> str:
        """Write a value without the unit's name, with at most `digits` significant digits if given.

        `value` is as it is stored, before `factor`; None or NaN is a dash. `sign` is a format
        option such as `+`.
        """
        if value is None or math.isnan(value):
            return DASH
        number, places = value * self.factor, self.decimals
        if digits is not None:
            places = min(places, digits - 1 - math.floor(math.log10(max(abs(number), 1e-9))))
            number = round(number, places)
        return f"{number:{sign}z.{max(places, 0)}f}"

    def text(self, value: float | None) -> str:
        """Write a stored value with the unit's name, such as `89.0 %`."""
        is_known = value is not None and not math.isnan(value)
        return f"{self.number(value)} {self.name}" if is_known and self.name else self.number(value)

    def interval(
        self,
        value: float | None,
        low: float | None,
        high: float | None,
        sign: str = "",
        digits: int | None = None,
    ) -> str:
        """Write a value and its interval as `89.0 [81.4, 93.7]`; a dash if the value is not known.

        Values are as they are stored, before `factor`. `sign` is a format option such as `+`, and
        `digits` the greatest number of significant digits.
        """
        number, *ends = (self.number(each, sign, digits) for each in (value, low, high))
        return number if number == DASH else f"{number} [{', '.join(ends)}]"

    def ends(self, bounded: Bounded) -> str:
        """Write an interval with its unit: `81.4 to 93.7 %`; empty if an end is not known."""
        low, high = self.number(bounded.low), self.number(bounded.high)
        return "" if DASH in (low, high) else f"{low} to {self.text(bounded.high)}"


PERCENT, POINTS, PLAIN = Unit("%", 1, 100.0), Unit("points", 1, 100.0), Unit()


def interval_of(bounded: Bounded, unit: Unit = PERCENT, sign: str = "") -> str:
    """Write a value and its interval as `89.0 [81.4, 93.7]`, without the unit's name.

    `unit` says how its numbers are written; `sign` is a format option such as `+`.
    """
    return unit.interval(bounded.value, bounded.low, bounded.high, sign)


def within(low: float, high: float) -> str:
    """Write how large a difference can be by its interval: `±5.2 points`.

    `low` and `high` are the interval's ends, shares from -1 to 1; the farther from 0 is written.
    """
    return f"±{POINTS.text(max(abs(low), abs(high)))}"


def amount(n: int, noun: str) -> str:
    """Write a count with its noun: `1 layout`, `2 layouts`."""
    return f"{n} {noun}{'s' * (n != 1)}"


def some_of(names: Sequence[str], most: int = 3) -> str:
    """Write up to `most` names and the number of further ones: `a, b, c and 2 more`."""
    parts = [*names[:most], *([f"{len(names) - most} more"] if len(names) > most else [])]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts)


def crossed(episodes: int, seeds: int) -> str:
    """Write the size of a run, such as `6 episodes × 1 channel seed`.

    Each episode is played with each channel seed, a number that fixes which messages get lost.
    """
    return f"{amount(episodes, 'episode')} × {amount(seeds, 'channel seed')}"


def dataset_size(layouts: int, points: int) -> str:
    """Write the size of a dataset: `2 layouts, 40 decision points`.

    A layout is one drawn start situation of a scenario; a decision point is a scene of it in which
    decisions are due.
    """
    return f"{amount(layouts, 'layout')}, {amount(points, 'decision point')}"


def number_or_none(value: float | None) -> float | None:
    """Return a number, or None if it is None or NaN."""
    return None if value is None or math.isnan(value) else value


def as_mapping(estimate: Counted) -> dict[str, float | int | None]:
    """Return a dict of an estimate's `value`, `low`, `high` and `n`; NaN becomes None."""
    ends = {end: number_or_none(getattr(estimate, end)) for end in ("value", "low", "high")}
    return {**ends, "n": estimate.n}
