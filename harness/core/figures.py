"""Estimates as people and machines read them."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # commands that print nothing start without NumPy
    from harness.core.statistics import Estimate


def known(value: float) -> float | None:
    """The number; None where it is NaN."""
    return None if math.isnan(value) else value


def as_mapping(estimate: "Estimate") -> dict[str, float | int | None]:
    """`value`, `low`, `high` and `n`; null where there is no number."""
    ends = {end: known(getattr(estimate, end)) for end in ("value", "low", "high")}
    return {**ends, "n": estimate.n}


def shown(estimate: "Estimate", scale: float = 100.0, decimals: int = 1) -> str:
    """`89.0 [81.4, 93.7]`: a share in percent, or with another scale; a dash where it is not known."""
    if math.isnan(estimate.value):
        return "–"
    return interval(estimate.value, estimate.low, estimate.high, scale, decimals)


def interval(
    value: float | None, low: float | None, high: float | None, scale: float = 1.0, decimals: int = 1
) -> str:
    """`value [low, high]`; a dash for what is not known."""
    ends = (math.nan if number is None else number for number in (value, low, high))
    numbers = ("–" if math.isnan(number) else f"{scale * number:.{decimals}f}" for number in ends)
    return "{} [{}, {}]".format(*numbers)
