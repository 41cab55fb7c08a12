"""One scene for schedules, and who is asked in it.

The ego is in doubt: .5, .3, .2, which is 1.0297 nats, and its margin is .2. It does not see 80 % of
the left region and 40 % of the right. The helpers at 10, 20 and 30 m see, of what it does not, 0,
50 and 60 % of the left, and 10, 10 and 40 % of the right.
"""

from dataclasses import fields

import numpy as np

from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.scheduling import Outlook
from harness.radio.channel import Draws
from harness.radio.fading import Trips

SIXG = POINTS["6g"]
ALL, NOBODY = [True] * 3, [False] * 3


def scene(
    own=(0.5, 0.3, 0.2), range_m=(10.0, 20.0, 30.0), valid=(True, True, True), unseen=(0.8, 0.4)
):
    added = np.array([(0.0, 0.1), (0.5, 0.1), (0.6, 0.4)])
    return Intents(
        np.array(own), np.full((3, 3), 1 / 3), np.array(valid), np.full(4, 10.0), np.array(range_m),
        np.full(3, 1000.0), np.full(4, 0.145),
        outlook=Outlook(np.array(unseen), added, np.array(3.0), np.array(2)),
    )  # fmt: skip


def draws(seed=0, layout=7, step=0, jitter=0.0) -> Draws:
    trips = Trips(np.array(seed), np.array(layout), np.array(step), 6)
    return Draws(np.full((3, 2), 0.9), np.full(3, jitter), trips)


def asked(point: str, intents: Intents | None = None, at: Draws | None = None) -> list[bool]:
    return exchange(named_point(point), intents or scene(), at or draws()).asked.tolist()


def same(a: Exchange, b: Exchange) -> bool:
    return all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True)
        for f in fields(Exchange)
    )
