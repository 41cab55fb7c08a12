"""Probabilities with few decimals that still sum to 1."""

from collections.abc import Sequence


def rounded(p: Sequence[float], decimals: int = 2) -> list[float]:
    """The distribution with so many decimals; the last units go where rounding took most (largest remainder).

    Args:
        p: probabilities that sum to 1.
        decimals: two is what a prompt asks for.
    """
    one = 10**decimals
    floor = [int(x * one + 1e-9) for x in p]
    short = one - sum(floor)
    for i in sorted(range(len(p)), key=lambda i: floor[i] - p[i] * one)[:short]:
        floor[i] += 1
    return [n / one for n in floor]
