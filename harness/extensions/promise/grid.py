"""List the settings that a promise may choose, and in which order they are tested."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from harness.coordination.operating_point import OperatingPoint
from harness.extensions.promise.promises import Harm
from harness.extensions.promise.risk import Order

# Entropies from which the ego is careful, as shares of the largest; after them comes never. They
# are dense where sure models are, and where unsure ones.
SHARES = tuple(n / 32 for n in (0, 1, 2, 4, 8, 12, 16, 20, 24, 26, 28, 29, 30, 31))
DIGITS = 4  # of nats


@dataclass(frozen=True)
class Grid:
    """Hold the settings that are tried, fixed before any harm is seen, and the order of tests."""

    points: tuple[OperatingPoint, ...]  # the L settings, as conditions
    order: Order  # in which they are tested, by their indices


def grid_of(conditions: Sequence[OperatingPoint], actions: int, harm: Harm) -> Grid:
    """Return the settings that are tried for a promise on `harm`, for a number of actions.

    Each of the `conditions` always asks, asks as it does, and never asks; each of these is a chain
    from always careful to never careful, since a careful ego does no harm. Where failing is the
    harm an ego that stands fails, and a chain leads the other way. What is tested first is always
    careful, which is the same in all chains; or the first condition as it is.
    """
    most = math.log(actions)
    levels = [round(share * most, DIGITS) for share in SHARES]
    least_first: list[float | None] = [*levels, None]
    if harm == "unsafe":
        first = conditions[0].changed(tau_nats=_asks(conditions[0], most)[-1], careful_nats=0.0)
        rest = least_first[1:]
    else:
        first, rest = conditions[0], least_first[::-1]
    points, chains = [first], []
    for condition in conditions:
        for tau_nats in _asks(condition, most):
            chain = []
            for careful_nats in rest:
                point = condition.changed(tau_nats=tau_nats, careful_nats=careful_nats)
                if point != first:
                    chain.append(len(points))
                    points.append(point)
            chains.append(tuple(chain))
    return Grid(tuple(points), Order(0, tuple(chains)))


def _asks(condition: OperatingPoint, most: float) -> list[float]:
    """Return entropies above which the ego asks: always, as it does, never, as far as they count.

    Another schedule than the paper's does not look at them.
    """
    as_it_is: float = condition.setting("tau_nats")
    if condition.idle("tau_nats"):
        return [as_it_is]
    never = math.ceil(most * 10**DIGITS) / 10**DIGITS  # rounded up, or the most unsure would ask
    return list(dict.fromkeys((0.0, min(as_it_is, never), never)))
