"""Reception against distance: a channel's own curve, the messages it delivers, and what others published."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.statistics import Estimate, rate_interval
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Draws, Links, Physical, Site
from harness.radio.fading import Trips

DISTANCES_M = (10, 20, 50, 100, 150, 200, 300, 400, 500)
SIGHTS = {"clear": CLEAR, "vehicle": VEHICLE, "building": BUILDING}
BLOCKER_M = {"clear": 0.0, "vehicle": 1.5, "building": 0.0}  # a car's height
PAYLOAD_BITS = 800.0


@dataclass(frozen=True)
class Drawn:
    """What a channel did to messages at one distance.

    Attributes:
        distance_m: between ego and helper.
        crossing: share of single crossings that succeed, over shadowing.
        round_trip: share of requests that come back answered.
        delay_s: mean seconds from the request to the end of the reply, for helpers that have their answer.
    """

    distance_m: float
    crossing: Estimate
    round_trip: Estimate
    delay_s: float


def drawn(channel: Physical, distances_m: Sequence[float], sight: str, n: int, seed: int = 0) -> list[Drawn]:
    """`n` trips with one helper at each distance, along one road."""
    result = []
    for distance_m in distances_m:
        trips = Trips(np.arange(n), np.full(n, seed), np.zeros(n, dtype=int), 1)
        draws = Draws(trips.uniforms(1)[:, None, 1:], trips.uniforms(1)[:, :1], trips)
        shape = (n, 1)
        site = Site(
            np.broadcast_to([[0.0, 0.0], [distance_m, 0.0]], (n, 2, 2)), np.full(shape, SIGHTS[sight]),
            np.full(shape, BLOCKER_M[sight]), np.full((n, 1, 2), np.nan),
        )  # fmt: skip
        ones = np.ones(shape, dtype=bool)
        heard_s = np.broadcast_to(np.asarray(channel.request(400.0, draws).heard_s).reshape(-1, 1), shape)
        links = Links(
            ones, heard_s, np.full(shape, distance_m), np.full(shape, PAYLOAD_BITS), ones,
            np.zeros(shape, dtype=bool), 400.0, site,
        )  # fmt: skip
        up, delay_s, loss, _ = channel.deliver(links, draws)
        crossed = draws.packet[..., 1] >= np.broadcast_to(loss, shape)
        crossing, round_trip = (rate_interval(each[:, 0].astype(float)) for each in (crossed, up))
        result.append(Drawn(distance_m, crossing, round_trip, float(delay_s.mean())))
    return result
