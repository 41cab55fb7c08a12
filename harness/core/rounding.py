"""Probabilities in whole parts that still sum to 1."""

from collections.abc import Sequence


def rounded(p: Sequence[float], parts: int = 100) -> list[float]:
    """The distribution in so many equal parts; the last go where rounding took most (largest remainder).

    Args:
        p: probabilities that sum to 1.
        parts: hundredths are what a prompt asks for.
    """
    floor = [int(x * parts + 1e-9) for x in p]
    short = parts - sum(floor)
    for i in sorted(range(len(p)), key=lambda i: floor[i] - p[i] * parts)[:short]:
        floor[i] += 1
    return [n / parts for n in floor]
