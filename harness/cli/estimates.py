"""Estimates as people and as machines read them, and numbers held to their range."""

import math
from typing import TYPE_CHECKING

from harness.errors import UserError

if TYPE_CHECKING:
    from harness.metrics import Estimate


def as_mapping(estimate: "Estimate") -> dict[str, float | int | None]:
    """`value`, `low`, `high` and `n`; null where there is no number."""
    ends = {"value": estimate.value, "low": estimate.low, "high": estimate.high}
    return {**{k: None if math.isnan(v) else v for k, v in ends.items()}, "n": estimate.n}


def shown(estimate: "Estimate", scale: float = 100.0) -> str:
    """`89.0 [81.4, 93.7]`: a share in percent, or with another scale."""
    return interval(estimate.value, estimate.low, estimate.high, scale)


def interval(value: float, low: float, high: float, scale: float) -> str:
    """`value [low, high]`, one decimal."""
    return f"{scale * value:.1f} [{scale * low:.1f}, {scale * high:.1f}]"


def in_range(option: str, value: int, least: int, most: int) -> None:
    """Raises UserError unless `least` <= `value` <= `most`."""
    if not least <= value <= most:
        raise UserError(f"{option} {value} is out of range; give {least} to {most}")
