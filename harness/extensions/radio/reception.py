"""Reception against distance: a channel's own curve, the messages it delivers,
and others' curves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats, Ints
from harness.core.config import changed
from harness.core.errors import UserError, printable
from harness.core.figures import number_or_none
from harness.core.pairs import pairs
from harness.core.statistics import Estimate, episode_interval, rate_interval, resampled
from harness.extensions.radio.tables import DISTANCE_M, RECEPTION, number_of, refuse_ragged, rows_of
from harness.extensions.radio.trace import SIGHTS, Trace
from harness.extensions.radio.transceiver import Transceiver
from harness.radio.channel import CLEAR, Channel, Draws, Links, Physical, Site
from harness.radio.constant import density_coupled_loss
from harness.radio.fading import Trips
from harness.radio.wrapped import busy_ratio, heard_s, link_loss

DISTANCES_M = (10, 20, 50, 100, 150, 200, 300, 400, 500)
VEHICLES = (2, 4, 8, 16, 32, 64, 128)
PAYLOAD_BITS = 800.0
PACKETS, MPS = 200, 14.0  # of a trip, and its speed
RESAMPLES = 200
COLUMNS = ("distance_m", "reception", "configuration", "source")  # of somebody else's curves


@dataclass(frozen=True)
class Drawn:
    """Hold how messages of a channel, simulated at one distance, were received.

    The ego sends a request, and a helper replies; each is one transmission. `model` is the share of
    transmissions that succeed by the channel's own curve and `crossing` the simulated one;
    `round_trip` is the share of requests that come back answered, after `delay_s` seconds in the
    mean for helpers that have their answer ready.
    """

    distance_m: float  # between ego and helper
    model: float  # share of single transmissions that succeed, by the channel's own curve
    crossing: Estimate  # share of single transmissions that succeed, over shadowing
    round_trip: Estimate  # share of requests that come back answered
    # mean seconds from the request to the end of the reply, for helpers that have their answer
    delay_s: float


def by_sight(channel: Physical, distances_m: Sequence[float] | Floats) -> dict[str, Floats]:
    """Return the share of packets received at n distances in m, (n,), for each kind of obstacle.

    The keys are those of `SIGHTS`, what stands between: `clear` (nothing), `vehicle` and
    `building`.
    """
    metres = np.asarray(distances_m, dtype=float)
    return {name: channel.reception(metres, sight) for name, sight in SIGHTS.items()}


def latencies_ms(
    channel: Channel, distances_m: Sequence[float]
) -> dict[str, dict[str, list[float]]]:
    """Return a message's median and 95th percentile latency, ms, by obstacle and distance.

    The keys are those of `SIGHTS` (what stands between), then `p50` and `p95`, with one value for
    each distance. It is empty unless the channel is a user's table that has both.
    """
    if not (isinstance(channel, Trace) and channel.spread):
        return {}
    metres = np.asarray(distances_m, dtype=float)
    both = {name: channel.percentiles_s(metres, sight) for name, sight in SIGHTS.items()}
    return {
        name: {"p50": (1000 * p50_s).tolist(), "p95": (1000 * p95_s).tolist()}
        for name, (p50_s, p95_s) in both.items()
    }


def drawn(channel: Physical, distances_m: Sequence[float], n: int, seed: int = 0) -> list[Drawn]:
    """Simulate `n` requests and replies to one helper at each distance; return their reception.

    The vehicles are on one road in line of sight, and `channel` is their radio; each message has
    its own shadowing (change of power by what stands around), drawn by `seed`. `distances_m` are in
    metres.
    """
    result = []
    curve = by_sight(channel, distances_m)["clear"].tolist()
    for distance_m, model in zip(distances_m, curve, strict=True):
        trips = Trips(np.arange(n), np.full(n, seed), np.zeros(n, dtype=int), 1)
        draws = Draws(trips.uniforms(1)[:, None, 1:], trips.uniforms(1)[:, :1], trips)
        shape = (n, 1)
        site = Site(
            np.broadcast_to([[0.0, 0.0], [distance_m, 0.0]], (n, 2, 2)),
            np.full(shape, CLEAR),
            np.zeros(shape),
            np.full((n, 1, 2), np.nan),
        )
        ones = np.ones(shape, dtype=bool)
        links = Links(
            ones,
            np.zeros(shape),
            np.full(shape, distance_m),
            np.full(shape, PAYLOAD_BITS),
            ones,
            np.zeros(shape, dtype=bool),
            400.0,
            site,
        )
        ready_s = np.broadcast_to(
            heard_s(channel, channel.request(400.0, draws), links, draws), shape
        )
        up, delay_s, loss, _ = channel.deliver(replace(links, ready_s=ready_s), draws)
        crossed = draws.packet[..., 1] >= np.broadcast_to(loss, shape)
        crossing, round_trip = (rate_interval(each[:, 0].astype(float)) for each in (crossed, up))
        result.append(Drawn(distance_m, model, crossing, round_trip, float(delay_s.mean())))
    return result


@dataclass(frozen=True)
class Gap:
    """Hold the inter-packet gap at one distance: the time between two received packets.

    They are packets of one vehicle, received by another on the same trip. `mean_s` and `p95_s`, the
    mean and the 95th percentile, have intervals over trips; `independent_s` would be the mean if
    each packet were lost by itself.
    """

    distance_m: float  # between the two vehicles
    mean_s: Estimate  # the mean gap, with an interval over trips
    p95_s: Estimate  # 95th percentile, with an interval over trips
    independent_s: float  # the mean if each packet were lost by itself: 1 / (rate x reception)


def gaps(channel: Transceiver, distances_m: Sequence[float], n: int, seed: int = 0) -> list[Gap]:
    """Simulate the time between received packets on `n` trips of two vehicles at each distance.

    `channel` is their radio, and `distances_m` are the metres between them. They drive in line of
    sight at 14 m/s on one road, for `PACKETS` packets. Their shadowing (change of power by what
    stands around) changes as they go; a packet is drawn by its own loss, as in runs, and draws are
    made from `seed`. Gaps that a trip's end cuts off are left out, so ones that would be longer
    than a tenth of a trip are unknown.
    """
    moved_m = MPS / channel.rate_hz * np.arange(PACKETS)
    numbers = np.broadcast_to(np.arange(n)[:, None], (n, PACKETS))
    trips = Trips(numbers, np.full((n, PACKETS), seed), np.zeros((n, PACKETS), dtype=int), 1)
    uniforms = noise.uniforms((n, PACKETS), "packets of a trip", seed)
    reception = by_sight(channel, distances_m)["clear"]
    result = []
    for distance_m, share in zip(distances_m, reception.tolist(), strict=True):
        ends_m = moved_m[:, None] + [0.0, distance_m]
        xy_m = np.broadcast_to(
            np.stack([ends_m, np.zeros_like(ends_m)], axis=-1), (n, PACKETS, 2, 2)
        )
        none = np.zeros((n, PACKETS, 1))
        site = Site(xy_m, np.full(none.shape, CLEAR), none, np.full((*none.shape, 2), np.nan))
        loss = link_loss(channel, site, partial(trips.shadow, xy_m), channel.packet_bits)[..., 0]
        trip, packet = np.nonzero((uniforms >= loss) & (PACKETS * share > 10))
        same = np.diff(trip) == 0
        waits_s, trip = np.diff(packet)[same] / channel.rate_hz, trip[1:][same]
        independent_s = 1 / (channel.rate_hz * share) if share else math.inf
        result.append(
            Gap(distance_m, episode_interval(waits_s, trip), _p95(waits_s, trip), independent_s)
        )
    return result


def _p95(values: Floats, trips: Ints) -> Estimate:
    """Return the 95th percentile, with the bootstrap's interval over trips; NaN of none."""
    present, place = np.unique(trips, return_inverse=True)
    if not len(present):
        return Estimate(math.nan, math.nan, math.nan, 0, 0)
    times = resampled(noise.generator("waits"), len(present), RESAMPLES)
    value, *bootstrap = (np.quantile(np.repeat(values, row[place]), 0.95) for row in times)
    low, high = np.quantile(bootstrap, [0.025, 0.975]).tolist()
    return Estimate(float(value), low, high, len(present), 0)


@dataclass(frozen=True)
class Curve:
    """Hold a published or simulated curve of reception over distance, as n points.

    `reception` (n,) is the share of packets received at `distance_m` (n,). `configuration` has the
    channel's settings with which it was made, such as `rate_hz=10`; empty for those of the channel
    that it is compared with. `source` is who published it.
    """

    # the channel settings that it was made with, as a condition states them: `rate_hz=10`; empty
    # for those of the channel that it is compared with
    configuration: str
    source: str  # who published it; else the file's name
    distance_m: Floats  # between sender and receiver, `(n,)`
    reception: Floats  # share of packets received there, `(n,)`


def curves_of(path: Path) -> list[Curve]:
    """Return the published curves of reception in a CSV file, to compare a radio with.

    It has the columns `distance_m` and `reception` (share of packets received), and may have
    `configuration` (the radio's settings, such as `rate_hz=10`) and `source` (who published it);
    rows with the same pair of these are one curve. Raises UserError, with file, line and value, if
    it is no such table or a value is not allowed.
    """
    file = printable(path)
    _, rows = rows_of(path, ("distance_m", "reception"), COLUMNS)
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line, row in rows:
        where = f"{file}, line {line}"
        refuse_ragged(where, row)
        point = (
            number_of(where, row, "distance_m", *DISTANCE_M),
            number_of(where, row, "reception", *RECEPTION),
        )
        key = row.get("configuration", ""), row.get("source") or path.name
        curves.setdefault(key, []).append(point)
    if not curves:
        raise UserError(
            f"{file} has no rows; give distance_m and reception at one distance at least"
        )
    return [Curve(*key, *np.array(points).T) for key, points in curves.items()]


@dataclass(frozen=True)
class Compared:
    """Hold a published curve of reception beside the radio model's at the same n distances."""

    curve: Curve  # the curve
    reception: Floats  # share of packets received by the model, `(n,)`

    @property
    def mean_difference(self) -> float:
        """Return the mean absolute difference of the model's reception from the curve's, 0 to 1."""
        return float(np.abs(self.reception - self.curve.reception).mean())

    @property
    def largest_difference(self) -> float:
        """Return the largest difference, -1 to 1: the model's reception less the curve's."""
        apart = self.reception - self.curve.reception
        return float(apart[np.abs(apart).argmax()])


def compared(channel: Channel, curve: Curve, where: str) -> Compared:
    """Return a published curve of reception beside that of a radio's model, at the same distances.

    The model has the settings that the curve states. `channel` is the radio, and `where` names it
    for errors. Raises UserError for a setting that it does not have.
    """
    adapted = changed(channel, pairs(curve.configuration), where)
    assert isinstance(adapted, Physical)
    return Compared(curve, adapted.reception(curve.distance_m))


@dataclass(frozen=True)
class Check:
    """Hold a channel's comparison with its own simulated messages and with published curves.

    `n` messages were simulated at each distance; `messages` says how they were received, `waits`
    how long it is from one received packet of a vehicle to the next, and `curves` has the published
    curves. `busy_ratio` is the share of time in which the medium is sensed as busy.
    """

    n: int  # messages at each distance
    # share of time in which its channel is sensed as busy, under the background load; None if the
    # model has no load
    busy_ratio: float | None
    # times between received packets of a vehicle, by distance; empty of a radio without packets of
    # background traffic
    waits: list[Gap]
    messages: list[Drawn]  # what was simulated
    curves: list[Compared]  # others' curves

    @property
    def mean_difference(self) -> float:
        """Return the mean absolute difference of model and published curves, 0 to 1.

        It is of reception, the share of packets received; each curve weighs alike.
        """
        return float(np.mean([curve.mean_difference for curve in self.curves]))


def check(channel: Physical, n: int, files: Sequence[Path], where: str) -> Check:
    """Check a radio's model: simulate its messages, and compare it with published curves.

    `n` messages are simulated at each of `DISTANCES_M`. `files` are CSV files of distances and
    shares of packets received. `where` names the radio for errors. Raises UserError if a file has
    no curves, or one states a setting that the radio does not have.
    """
    curves = [compared(channel, curve, where) for file in files for curve in curves_of(file)]
    return Check(
        n,
        number_or_none(busy_ratio(channel)),
        gaps(channel, DISTANCES_M, n // 10)
        if isinstance(channel, Transceiver) and channel.rate_hz
        else [],
        drawn(channel, DISTANCES_M, n),
        curves,
    )


def crowds(
    channels: Mapping[str, Channel], radius_m: float, distance_m: float, sight: str
) -> dict[str, Floats]:
    """Return how much of a radio's messages is lost, by the number of vehicles around.

    Values are shares of single transmissions lost, `(n,)`, for each of the n numbers in `VEHICLES`.
    The keys are those of `channels`, the radios, and `paper` for the line that the SwarmDrive paper
    assumes. Vehicles are within `radius_m` metres; sender and receiver, `distance_m` metres apart
    with `sight` between (a key of `SIGHTS`, such as `clear`), are two of them, and the others are
    background load, evenly along one road.
    """
    losses = {"paper": density_coupled_loss(np.array(VEHICLES))}
    for name, channel in channels.items():
        received = []
        for n in VEHICLES:
            per_km = max(n - 2, 0) / (2 * radius_m) * 1000
            crowded = changed(channel, {"density_per_km": str(per_km)}, "channel")
            assert isinstance(crowded, Physical)
            received.append(crowded.reception(np.array([distance_m]), SIGHTS[sight])[0])
        losses[name] = 1 - np.array(received)
    return losses
