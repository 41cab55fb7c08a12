"""Format estimates and intervals for people (text) and for machines (plain values)."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # commands that print nothing start without NumPy
    from harness.core.statistics import Estimate


def known(value: float) -> float | None:
    """Return the number; None if it is NaN."""
    return None if math.isnan(value) else value


def as_mapping(estimate: "Estimate") -> dict[str, float | int | None]:
    """Return `value`, `low`, `high` and `n` by name; NaN becomes None."""
    ends = {end: known(getattr(estimate, end)) for end in ("value", "low", "high")}
    return {**ends, "n": estimate.n}


def shown(estimate: "Estimate", scale: float = 100.0, decimals: int = 1) -> str:
    """Format an estimate as `89.0 [81.4, 93.7]`, in percent unless `scale` is given; a dash if it is NaN."""
    if math.isnan(estimate.value):
        return "–"
    return interval(estimate.value, estimate.low, estimate.high, scale, decimals)


def interval(
    value: float | None, low: float | None, high: float | None, scale: float = 1.0, decimals: int = 1
) -> str:
    """Format `value [low, high]`; a dash stands for each number that is not known."""
    ends = (math.nan if number is None else number for number in (value, low, high))
    numbers = ("–" if math.isnan(number) else f"{scale * number:z.{decimals}f}" for number in ends)
    return "{} [{}, {}]".format(*numbers)
