"""Round probabilities so that they still sum to 1."""

from collections.abc import Sequence


def rounded(p: Sequence[float], parts: int = 100) -> list[float]:
    """Round a distribution to multiples of 1/`parts` that still sum to 1, by largest remainders.

    `p` are its probabilities, and the result has them in the same order.
    """
    floor = [int(x * parts + 1e-9) for x in p]
    short = parts - sum(floor)
    for i in sorted(range(len(p)), key=lambda i: floor[i] - p[i] * parts)[:short]:
        floor[i] += 1
    return [n / parts for n in floor]
