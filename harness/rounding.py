"""Probabilities as a prompt asks for them: two decimals that sum to 1."""

from collections.abc import Sequence


def rounded(p: Sequence[float]) -> list[float]:
    """The distribution in hundredths; the last ones go where rounding took most (largest remainder)."""
    floor = [int(x * 100 + 1e-9) for x in p]
    short = 100 - sum(floor)
    for i in sorted(range(len(p)), key=lambda i: floor[i] - p[i] * 100)[:short]:
        floor[i] += 1
    return [n / 100 for n in floor]
