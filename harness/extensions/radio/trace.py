"""A channel from a user's table of packet reception by distance,
such as a run of ns-3 or Veins gives.

The table is a CSV file with the columns `distance_m` and `reception` (share of packets received),
and optionally `sight` (`clear`, `vehicle` or `building`, with a curve for each) and latencies:
`latency_ms`, or their median `latency_p50_ms` and 95th percentile `latency_p95_ms`. A latency may
be blank or `nan` where nothing is received. Values are interpolated linearly between distances;
below the first distance its values hold, and beyond the last its latencies.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.config import Seconds, convert
from harness.core.errors import UserError, printable
from harness.core.files import sha256_file
from harness.core.quantiles import normal_quantile
from harness.extensions.radio.tables import DISTANCE_M, RECEPTION, number_of, refuse_ragged, rows_of
from harness.radio.channel import (
    BUILDING,
    CLEAR,
    REPLY,
    VEHICLE,
    Broadcast,
    Delivery,
    Draws,
    Links,
    Site,
    Way,
)
from harness.radio.constant import link_up

SIGHTS = {"clear": CLEAR, "vehicle": VEHICLE, "building": BUILDING}
MEAN, SPREAD = "latency_ms", ("latency_p50_ms", "latency_p95_ms")
COLUMNS = {"distance_m", "reception", "sight", MEAN, *SPREAD}
P95 = 0.95


class Spread(NamedTuple):
    """Hold the median and 95th percentile of a latency that is drawn anew for each message.

    A latency is the time from the wish to send until reception.
    """

    p50_s: float  # the median
    p95_s: float  # 95th percentile


What = Literal["reception", "p50_s", "p95_s"]


class Point(NamedTuple):
    """Hold a row of a user's table of reception: distance, reception, obstacle and latency.

    `reception` is the share of packets received over `distance_m` metres, with `sight` between (one
    of `SIGHTS`, None in a table without this column). `latency_s` is the time from the wish to send
    until reception, or its median and 95th percentile; None in a table without.
    """

    distance_m: float  # distance between sender and receiver
    reception: float  # share of packets received
    # what stands between them, one of `SIGHTS`; None in a table without this column
    sight: str | None
    # time from the wish to send until reception; None in a table without latencies
    latency_s: float | Spread | None


@dataclass(frozen=True)
class Table:
    """Hold the rows of a user's table of reception over distance, and which file it is."""

    file: str  # path of the file
    # hex SHA-256 of the file
    sha256: str
    points: tuple[Point, ...]  # its rows


@dataclass(frozen=True)
class Trace:
    """Define a channel by a table of reception over distance, such as another simulator's.

    The table is averaged over shadowing (change of power by what stands around) and for one packet
    size, so a link's own shadowing and a message's bits change nothing, and replies do not wait for
    each other. A request reaches each helper after the latency of its own distance. Between two
    percentiles a message's latency is drawn from the lognormal distribution that has them; that it
    is lognormal, and that messages draw independently, is assumed. `decorrelation_m`, over which
    shadowing stays alike, is infinite, since it plays no part.
    """

    receptions: Table  # the table
    latency_s: Seconds = 0.025  # latency of each message if the table has none
    # reception beyond the last distance: `zero`, since a table usually ends where packets are no
    # longer received, or `held`, that of the last row, for a table that ends early
    beyond: Literal["zero", "held"] = "zero"
    decorrelation_m: ClassVar[float] = math.inf
    # settings that change losses alone, and nothing where an operating point gives the loss
    of_loss: ClassVar[tuple[str, ...]] = ("beyond",)

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return self._at(distance_m, CLEAR if sight is None else sight, "reception")

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        return 1 - self._at(site.distance_m, site.sight, "reception")

    def busy_ratio(self) -> float:
        return math.nan

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Return when helpers have the ego's request: NaN, since each has a latency of its own.

        It is that of its distance in the table. The request's time on air is unknown, NaN as well.
        `bits` and `draws` are not read.
        """
        return Broadcast(math.nan, math.nan)

    def latencies_s(self, site: Site, draws: Draws, way: Way) -> Floats:
        if not self.spread:
            return self._at(site.distance_m, site.sight, "p50_s")
        p50_s, p95_s = self.percentiles_s(site.distance_m, site.sight)
        slower = normal_quantile(draws.latency[..., way]) / normal_quantile(P95)
        return np.asarray(p50_s * (p95_s / p50_s) ** slower)

    @property
    def spread(self) -> bool:
        """Return whether the table has the median and 95th percentile of latency for each distance.

        Then each message's latency is drawn at random; else it is the same for all at a distance.
        """
        return any(isinstance(point.latency_s, Spread) for point in self.receptions.points)

    def percentiles_s(self, distance_m: Floats, sight: Ints | int) -> tuple[Floats, Floats]:
        """Return the median and the 95th percentile of messages' latency, s, `(...)` each.

        Latency is the time from the wish to send until reception. `distance_m` has the distances of
        sender and receiver, m, `(...)`, and `sight` is what stands between, such as `CLEAR`.
        """
        return self._at(distance_m, sight, "p50_s"), self._at(distance_m, sight, "p95_s")

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        loss = self.loss(links.where, np.zeros(()), links.payload_bits)
        latency_s = self.latencies_s(links.where, draws, REPLY)
        delay_s = np.where(links.asked, links.ready_s + latency_s, np.inf)
        return Delivery(link_up(draws.packet, loss), delay_s, loss, np.full_like(loss, np.nan))

    def idle(self, setting: str | None) -> str | None:
        received = [point for point in self.receptions.points if point.reception > 0]
        if setting == "latency_s" and all(point.latency_s is not None for point in received):
            return f"its table {printable(self.receptions.file)} has latencies of its own"
        if setting == "beyond" and not any(point.reception for point in self._last()):
            return f"its table {printable(self.receptions.file)} ends where nothing is received"
        return None

    def _last(self) -> list[Point]:
        return list({point.sight: point for point in self.receptions.points}.values())

    def _value(self, point: Point, what: What) -> float:
        if what == "reception":
            return point.reception
        latency_s = self.latency_s if point.latency_s is None else point.latency_s
        return float(getattr(latency_s, what)) if isinstance(latency_s, Spread) else latency_s

    def _at(self, distance_m: Floats, sight: Ints | int, what: What) -> Floats:
        """Interpolate a quantity of the table at these distances, for what stands between."""
        values = np.full(np.broadcast_shapes(np.shape(distance_m), np.shape(sight)), np.nan)
        for name, number in SIGHTS.items():
            rows = [p for p in self.receptions.points if p.sight in (None, name)]
            column = [self._value(p, what) for p in rows]
            last = 0.0 if (what, self.beyond) == ("reception", "zero") else None
            curve = np.interp(distance_m, [p.distance_m for p in rows], column, right=last)
            values = np.where(np.equal(sight, number), curve, values)
        return values


def from_profile(parameters: Mapping[str, Any], folder: Path, where: str) -> Trace:
    """Return the channel of a profile whose parameter `file` names a table in the same folder.

    A profile is a radio by name, one file of `channels/`. `parameters` has its settings by name,
    `folder` is where its file lies, and `where` names it in messages. Raises UserError if the table
    is missing, elsewhere or wrong.
    """
    if not isinstance(parameters.get("file"), str):
        raise UserError(f"{where} has no file; add it, a CSV with distance_m and reception")
    path = folder / parameters["file"]
    if not path.resolve().is_relative_to(folder.resolve()):  # a profile may come from others
        raise UserError(
            f"{where}: file {printable(parameters['file'])!r} lies elsewhere; put it beside the "
            "profile"
        )
    points = read(path)
    table = Table(parameters["file"], sha256_file(path, "text"), points)
    rest = {key: value for key, value in parameters.items() if key != "file"}
    return convert(rest, Trace, where, receptions=table)


def read(path: Path) -> tuple[Point, ...]:
    """Return the rows of a user's CSV table of reception, sorted by obstacle and distance.

    It has `distance_m` and `reception` (share of packets received), and may have what stands
    between and latencies. Raises UserError if the table is wrong.
    """
    file = printable(path)
    columns, rows = rows_of(path, ("distance_m", "reception"), COLUMNS)
    _refuse_mixed_latencies(file, columns)
    points = [_point(f"{file}, line {line}", row) for line, row in rows]
    if not points:
        raise UserError(f"{file}: has no rows; give reception at one distance at least")
    sights = {p.sight for p in points}
    if sights != {None} and sights != {*SIGHTS}:
        lacks = next(name for name in SIGHTS if name not in sights)
        raise UserError(
            f"{file}: has no row of sight {lacks!r}; with sight it needs {', '.join(SIGHTS)}"
        )
    points = _with_latencies(sorted(points, key=_place))
    for a, b in pairwise(points):
        if (a.sight, a.distance_m) == (b.sight, b.distance_m):
            raise UserError(
                f"{file}: distance_m {a.distance_m:g} stands there twice; give each once"
            )
    return tuple(points)


def _place(point: Point) -> tuple[int, float]:
    return SIGHTS[point.sight] if point.sight else CLEAR, point.distance_m


def _refuse_mixed_latencies(file: str, columns: Sequence[str]) -> None:
    has = [name for name in SPREAD if name in columns]
    if has and MEAN in columns:
        raise UserError(
            f"{file}: has both {MEAN} and {has[0]}; give {MEAN}, or {' and '.join(SPREAD)}"
        )
    if len(has) == 1:
        lacks = next(name for name in SPREAD if name not in has)
        raise UserError(f"{file}: has {has[0]} without {lacks}; add {lacks}, or give {MEAN} alone")


def _with_latencies(points: Sequence[Point]) -> list[Point]:
    """Give points where nothing is received, which have no latency of their own,
    that of a point beside them.

    Reception is interpolated, so that something is received next to them. The point before them
    comes first, so that no row changes what is nearer. Points are sorted by sight and distance.
    """
    known_points = [point for point in points if not _blank(point)]
    return [
        point._replace(latency_s=_beside(point, known_points)) if _blank(point) else point
        for point in points
    ]


def _blank(point: Point) -> bool:
    return isinstance(point.latency_s, float) and math.isnan(point.latency_s)


def _beside(point: Point, known_points: Iterable[Point]) -> float | Spread | None:
    """Return the latency of the point before, else after;
    where this sight has none, of the next sight.
    """

    def how_far(other: Point) -> tuple[bool, int, bool, float]:
        after = other.distance_m > point.distance_m
        return (
            other.sight != point.sight,
            _place(other)[0],
            after,
            abs(other.distance_m - point.distance_m),
        )

    nearest = min(known_points, key=how_far, default=None)
    return nearest and nearest.latency_s


def _point(where: str, row: dict[str, str]) -> Point:
    refuse_ragged(where, row)
    sight = row.get("sight")
    if sight is not None and sight not in SIGHTS:
        raise UserError(f"{where}: sight is {printable(sight)!r}; it must be {', '.join(SIGHTS)}")
    distance_m = number_of(where, row, "distance_m", *DISTANCE_M)
    reception = number_of(where, row, "reception", *RECEPTION)
    latency_s: float | Spread | None = None
    given = [name for name in (MEAN, *SPREAD) if name in row]
    if given and reception == 0 and all(row[name].strip().lower() in ("", "nan") for name in given):
        latency_s = math.nan
    elif given == [MEAN]:
        allowed = "milliseconds, 0 to 1000000; it may be blank where reception is 0"
        latency_s = number_of(where, row, MEAN, 1e6, allowed) / 1000
    elif given:
        allowed = "milliseconds, 0.001 to 1000000; both may be blank where reception is 0"
        p50_ms, p95_ms = (number_of(where, row, name, 1e6, allowed, 1e-3) for name in SPREAD)
        if p95_ms < p50_ms:
            least = f"{SPREAD[0]} of its row, {p50_ms:g}, or more"
            raise UserError(f"{where}: {SPREAD[1]} is {p95_ms:g}; it must be {least}")
        latency_s = Spread(p50_ms / 1000, p95_ms / 1000)
    return Point(distance_m, reception, sight, latency_s)
