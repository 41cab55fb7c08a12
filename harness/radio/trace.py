"""A channel from a user's table of packet reception by distance, such as a run of ns-3 or Veins gives.

The table is a CSV file with the columns `distance_m` and `reception` (share of packets received), and
optionally `sight` (`clear`, `vehicle` or `building`, with a curve for each) and `latency_ms`, which may be
blank or `nan` where nothing is received. Values are interpolated linearly between distances; below the first
distance its values hold.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.config import Seconds, convert
from harness.core.errors import UserError, printable, unknown
from harness.core.files import sha256_file, text_of
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Broadcast, Delivery, Draws, Links, Site
from harness.radio.constant import link_up

SIGHTS = {"clear": CLEAR, "vehicle": VEHICLE, "building": BUILDING}
COLUMNS = {"distance_m", "reception", "sight", "latency_ms"}


class Point(NamedTuple):
    """One row of the table."""

    distance_m: float  # distance between sender and receiver
    reception: float  # share of packets received
    sight: str | None  # one of `SIGHTS`; None in a table without this column
    latency_s: float | None  # time from the wish to send until reception; None in a table without this column


@dataclass(frozen=True)
class Table:
    """A file of receptions."""

    file: str  # path of the file
    sha256: str  # its digest
    points: tuple[Point, ...]  # its rows


@dataclass(frozen=True)
class Trace:
    """A channel with the reception of a table.

    The table is averaged over shadowing and for one packet size, so a link's own shadowing and a message's
    bits change nothing, and replies do not wait for each other. The helpers have a request after the table's
    longest latency.
    """

    receptions: Table  # the table
    latency_s: Seconds = 0.025  # latency of each message if the table has none
    # reception beyond the last distance: `zero`, since a table usually ends where packets are no longer
    # received, or `held`, that of the last row, for a table that ends early
    beyond: Literal["zero", "held"] = "zero"
    decorrelation_m: ClassVar[float] = math.inf

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return self._at(distance_m, CLEAR if sight is None else sight, "reception")

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        return 1 - self._at(site.distance_m, site.sight, "reception")

    def busy_ratio(self) -> float:
        return math.nan

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Helpers have a request after the longest latency; its time on air is not known."""
        return Broadcast(max(self._latency_s(p) for p in self.receptions.points), math.nan)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        loss = self.loss(links.where, np.zeros(()), links.payload_bits)
        latency_s = self._at(links.where.distance_m, links.where.sight, "latency_s")
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

    def _latency_s(self, point: Point) -> float:
        return self.latency_s if point.latency_s is None else point.latency_s

    def _at(self, distance_m: Floats, sight: Ints | int, what: Literal["reception", "latency_s"]) -> Floats:
        """Interpolate a column of the table at these distances, for what stands between."""
        values = np.full(np.broadcast_shapes(np.shape(distance_m), np.shape(sight)), np.nan)
        for name, number in SIGHTS.items():
            rows = [p for p in self.receptions.points if p.sight in (None, name)]
            column = [p.reception if what == "reception" else self._latency_s(p) for p in rows]
            last = 0.0 if (what, self.beyond) == ("reception", "zero") else None
            curve = np.interp(distance_m, [p.distance_m for p in rows], column, right=last)
            values = np.where(np.equal(sight, number), curve, values)
        return values


def from_profile(parameters: Mapping[str, Any], folder: Path, where: str) -> Trace:
    """Build the channel of a profile that names a `file` beside it. Raises UserError if it is wrong."""
    if not isinstance(parameters.get("file"), str):
        raise UserError(f"{where} has no file; add it, a CSV with distance_m and reception")
    path = folder / parameters["file"]
    if not path.resolve().is_relative_to(folder.resolve()):  # a profile may come from others
        raise UserError(
            f"{where}: file {printable(parameters['file'])!r} lies elsewhere; put it beside the profile"
        )
    points = read(path)
    table = Table(parameters["file"], sha256_file(path, "text"), points)
    rest = {key: value for key, value in parameters.items() if key != "file"}
    return convert(rest, Trace, where, receptions=table)


def read(path: Path) -> tuple[Point, ...]:
    """Read the rows of a table, sorted by sight and distance. Raises UserError if the table is wrong."""
    shown = printable(path)
    try:
        rows = csv.DictReader(StringIO(text_of(path), newline=""))
        if missing := {"distance_m", "reception"} - {*(rows.fieldnames or ())}:
            raise UserError(f"{shown}: has no column {' or '.join(sorted(missing))}")
        for name in rows.fieldnames or ():
            if name not in COLUMNS:
                raise unknown(f"column of {shown}", name, COLUMNS)
        points = _with_latencies([_point(f"{shown}, line {rows.line_num}", row) for row in rows])
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise UserError(f"{shown}: cannot be read as a table ({printable(problem)})") from None
    if not points:
        raise UserError(f"{shown}: has no rows; give reception at one distance at least")
    sights = {p.sight for p in points}
    if sights != {None} and sights != {*SIGHTS}:
        lacks = next(name for name in SIGHTS if name not in sights)
        raise UserError(f"{shown}: has no row of sight {lacks!r}; with sight it needs {', '.join(SIGHTS)}")
    points.sort(key=lambda p: (SIGHTS[p.sight] if p.sight else CLEAR, p.distance_m))
    for a, b in pairwise(points):
        if (a.sight, a.distance_m) == (b.sight, b.distance_m):
            raise UserError(f"{shown}: distance_m {a.distance_m:g} stands there twice; give each once")
    return tuple(points)


def _with_latencies(points: Sequence[Point]) -> list[Point]:
    """Give points where nothing is received, which have no latency of their own, that of points beside them.

    Reception is interpolated, so that something is received next to them.
    """
    known = [p for p in points if p.latency_s is not None and not math.isnan(p.latency_s)]
    longest_s = max((p.latency_s for p in known if p.latency_s is not None), default=None)
    full = []
    for point in points:
        if point.latency_s is not None and math.isnan(point.latency_s):
            beside = sorted((p.distance_m, p.latency_s) for p in known if p.sight == point.sight)
            latency_s = longest_s
            if beside:
                latency_s = float(np.interp(point.distance_m, *np.array(beside, dtype=float).T))
            point = point._replace(latency_s=latency_s)
        full.append(point)
    return full


def _point(where: str, row: dict[str, str]) -> Point:
    def number(column: str, most: float, allowed: str) -> float:
        try:
            value = float(row[column])
        except (TypeError, ValueError):
            value = math.nan
        if not 0 <= value <= most:
            raise UserError(f"{where}: {column} is {printable(row[column])!r}; it must be {allowed}")
        return value

    if None in row or None in row.values():
        raise UserError(f"{where}: has other columns than the first line")
    sight = row.get("sight")
    if sight is not None and sight not in SIGHTS:
        raise UserError(f"{where}: sight is {printable(sight)!r}; it must be {', '.join(SIGHTS)}")
    distance_m = number("distance_m", 1e6, "metres, 0 or more")
    reception = number("reception", 1.0, "a share from 0 to 1")
    latency_s = None
    if "latency_ms" in row:
        if reception == 0 and row["latency_ms"].strip().lower() in ("", "nan"):
            latency_s = math.nan
        else:
            allowed = "milliseconds, 0 or more; it may be blank where reception is 0"
            latency_s = number("latency_ms", 1e6, allowed) / 1000
    return Point(distance_m, reception, sight, latency_s)
