"""The settings for which a channel's source validated its model."""

import math
from collections.abc import Mapping, Sequence
from typing import Any


def outside(settings: Mapping[str, Any], limits: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a sentence for each setting outside the range for which a channel model was validated.

    `settings` has the channel's settings by name; `limits` has for some of them the least and
    largest value, in the setting's unit. A value that is no number counts as outside.
    """
    return [
        f"{name} = {_number(settings.get(name)):g} is outside what its model was held against, "
        f"{low:g} to {high:g}."
        for name, (low, high) in limits.items()
        if not low <= _number(settings.get(name)) <= high
    ]


def _number(value: object) -> float:
    try:
        return float(value) if isinstance(value, str | int | float) else math.nan
    except ValueError:
        return math.nan
