"""A channel from a table of transmissions, one a row, as ns-3, Veins and Artery log them.

The table is a CSV or Parquet file with the columns `time_s`, `delay_ms` and `received` (1 or 0),
and `tx` and `rx`, the names of sender and receiver in the source of the traffic, or `distance_m`,
or all three. A column `scene` says of which scene of a recording the names are, where there are
several; other columns are not read. Where the scene's cars have these names, a message does what
the transmission of that pair did that is nearest in time. Any other message does what one of those
transmissions did whose distance fits best, drawn by the link.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import InitVar, dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, one_line, printable, unknown
from harness.core.files import BROKEN, bytes_of, sha256_bytes
from harness.radio.channel import (
    REPLY,
    REQUEST,
    Broadcast,
    Delivery,
    Draws,
    Links,
    Site,
    Way,
)

NAMES, SCENE, DISTANCE = ("tx", "rx"), "scene", "distance_m"
NUMBERS = ("time_s", "delay_ms", "received")
TYPES = {
    **dict.fromkeys((*NAMES, SCENE), pa.string()),
    **dict.fromkeys((*NUMBERS, DISTANCE), pa.float64()),
}
FAR_S = 1.0  # from here on a pair's transmission says nothing of this time
DRAWN_OF = 50  # transmissions of the best fitting distances
MOST_ROWS, MOST_DELAY_MS, MOST_M = 20_000_000, 1e6, 1e6
# What a link's transmission may be besides the number of a row.
UNHEARD, UNKNOWN = -1, -2


class Columns(NamedTuple):
    """Hold n transmissions, sorted by pair and time."""

    time_s: Floats  # (n,), by the clock of the traffic's source
    delay_s: Floats  # (n,), from the wish to send until reception; the median where it is lost
    received: Bools  # (n,)
    pairs: Mapping[tuple[str, str], slice]  # the rows of each sender and receiver
    has_scenes: bool  # whether their names have the scene in front, as those of a site have
    distance_m: Floats | None  # (n,)
    by_distance: Ints  # (n,) rows in the order of distance; empty without distances


@dataclass(frozen=True)
class Table:
    """Say which file of transmissions a channel has; `transmitted` has its rows."""

    file: str  # path of the file
    sha256: str  # hex SHA-256 of the file
    rows: int
    columns: InitVar[Columns]  # no field: records of a run say which table it was

    def __post_init__(self, columns: Columns) -> None:
        self.__dict__["_columns"] = columns

    @property
    def transmitted(self) -> Columns:
        columns: Columns = self.__dict__["_columns"]
        return columns


@dataclass(frozen=True)
class Transmissions:
    """Define a channel by a table of single transmissions, another simulator's or a measurement's.

    What a message does is in the table, so its bits change nothing, and replies do not wait for
    each other. A link draws once for an episode: with its distance it moves on among transmissions
    that are sorted by pair and time. Beyond the largest distance nothing is received.
    """

    table: Table
    decorrelation_m: ClassVar[float] = math.inf  # shadowing plays no part

    def reception(self, distance_m: Floats, sight: Ints | int | None = None) -> Floats:
        return 1 - self._lost_at(distance_m)

    def loss(self, site: Site, shadow: Floats, bits: Floats | float) -> Floats:
        """Return the share lost of what each link may have, `(..., H)`.

        Of a pair with names that is its own two transmissions, and else those of fitting distance.
        """
        ways = [self._of_pairs(site, way) for way in (REQUEST, REPLY)]
        lost = np.mean([self._is_lost(rows) for rows in ways], axis=0)
        return np.where(np.max(ways, axis=0) >= 0, lost, self._lost_at(site.distance_m))

    def busy_ratio(self) -> float:
        return math.nan

    def request(self, bits: Floats | float, draws: Draws) -> Broadcast:
        """Return when helpers have the ego's request: NaN, since each has a latency of its own."""
        return Broadcast(math.nan, math.nan)

    def latencies_s(self, site: Site, draws: Draws, way: Way) -> Floats:
        rows, columns = self._rows(site, draws, way), self.table.transmitted
        unheard_s = np.where(rows == UNHEARD, _median(columns.delay_s), np.nan)
        return np.where(rows >= 0, columns.delay_s[rows], unheard_s)

    def deliver(self, links: Links, draws: Draws) -> Delivery:
        """Return which replies are received, and when.

        Raises UserError where a helper was asked of whom the table says nothing.
        """
        site = links.where
        requests, replies = (self._rows(site, draws, way) for way in (REQUEST, REPLY))
        if np.any(links.asked & ((requests == UNKNOWN) | (replies == UNKNOWN))):
            raise UserError(
                f"{printable(self.table.file)}: has no transmission of two cars of this scene at "
                f"its time, and no column {DISTANCE} to take another's; add {DISTANCE}"
            )
        up = ~(self._is_lost(requests) | self._is_lost(replies))
        latency_s = self.latencies_s(site, draws, REPLY)
        delay_s = np.where(links.asked, links.ready_s + latency_s, np.inf)
        loss = self.loss(site, np.zeros(()), links.payload_bits)
        return Delivery(up, delay_s, loss, np.full_like(loss, np.nan))

    def _is_lost(self, rows: Ints) -> Bools:
        return (rows < 0) | ~self.table.transmitted.received[rows]

    def _rows(self, site: Site, draws: Draws, way: Way) -> Ints:
        """Return the transmission of each link, `(..., H)`: a row, `UNHEARD` or `UNKNOWN`."""
        rows = self._of_pairs(site, way)
        drawn = self._of_distance(site.distance_m, draws.link[..., way])
        return np.where(rows >= 0, rows, drawn)

    def _of_pairs(self, site: Site, way: Way) -> Ints:
        """Return the transmission nearest in time of each link with names, else `UNKNOWN`."""
        rows, columns = np.full(site.sight.shape, UNKNOWN), self.table.transmitted
        if site.names is None or site.time_s is None or not columns.pairs:
            return rows
        if site.several_scenes and not columns.has_scenes:
            raise UserError(
                f"{printable(self.table.file)}: has no column {SCENE}, and the traffic has several "
                f"scenes, where others may have these names; add {SCENE}"
            )
        for at in np.ndindex(*rows.shape):
            names = str(site.names[(*at[:-1], 0)]), str(site.names[(*at[:-1], at[-1] + 1)])
            ends = names if columns.has_scenes else (_alone(names[0]), _alone(names[1]))
            pair = columns.pairs.get(ends if way == REQUEST else ends[::-1])
            if pair is not None:
                rows[at] = _nearest(columns.time_s, pair, float(site.time_s[at[:-1]]))
        return rows

    def _of_distance(self, distance_m: Floats, share: Floats) -> Ints:
        """Return the transmission that each link draws, by `share`, among those that fit best."""
        candidates = self._fitting(distance_m)
        if candidates is None:
            return np.full(distance_m.shape, UNKNOWN)
        place = (share * candidates.shape[-1]).astype(int)[..., None]
        rows = np.take_along_axis(np.sort(candidates, axis=-1), place, axis=-1)[..., 0]
        return np.where(self._is_beyond(distance_m), UNHEARD, rows)

    def _lost_at(self, distance_m: Floats) -> Floats:
        """Return the share lost of the transmissions that fit distances best, `(...)`."""
        candidates = self._fitting(distance_m)
        if candidates is None:
            return np.full(np.shape(distance_m), np.nan)
        lost = np.mean(~self.table.transmitted.received[candidates], axis=-1)
        lost = np.where(self._is_beyond(distance_m), 1.0, lost)
        return np.where(np.isnan(distance_m), np.nan, lost)

    def _fitting(self, distance_m: Floats) -> Ints | None:
        """Return the rows that fit distances best, `(..., K)`; None in a table without distances.

        They stand together in the order of distance, with the best place in the middle.
        """
        columns = self.table.transmitted
        if columns.distance_m is None:
            return None
        order = columns.by_distance
        most = min(DRAWN_OF, len(order))
        place = np.searchsorted(columns.distance_m[order], distance_m) - most // 2
        first = np.clip(place, 0, len(order) - most)
        fitting: Ints = order[first[..., None] + np.arange(most)]
        return fitting

    def _is_beyond(self, distance_m: Floats) -> Bools:
        distances_m = self.table.transmitted.distance_m
        return np.greater(distance_m, math.inf if distances_m is None else distances_m.max())


def _alone(name: str) -> str:
    """Return the name of a vehicle without the scene in front of it."""
    return name.partition("/")[2]


def _nearest(time_s: Floats, pair: slice, at_s: float) -> int:
    """Return the row of a pair nearest to a time, the earlier of two; `UNKNOWN` if all are far."""
    after = pair.start + int(np.searchsorted(time_s[pair], at_s))
    near = [row for row in (after - 1, after) if pair.start <= row < pair.stop]
    best = min(near, key=lambda row: abs(float(time_s[row]) - at_s))
    return best if abs(float(time_s[best]) - at_s) <= FAR_S else UNKNOWN


def from_profile(parameters: Mapping[str, Any], folder: Path, where: str) -> Transmissions:
    """Return the channel of a profile whose parameter `file` names a table in the same folder.

    A profile is a radio by name, one file of `channels/`. `parameters` has its settings by name,
    `folder` is where its file lies, and `where` names it in messages. Raises UserError if the table
    is missing, elsewhere or wrong.
    """
    name = parameters.get("file")
    if not isinstance(name, str):
        raise UserError(f"{where} has no file; add it, a CSV or Parquet file of transmissions")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):  # a profile may come from others
        raise UserError(
            f"{where}: file {printable(name)!r} lies elsewhere; put it beside the profile"
        )
    for key in parameters:
        if key != "file":
            raise unknown(f"key in {where}", key, ["file"])
    return Transmissions(read(path, name))


def read(path: Path, name: str) -> Table:
    """Read a table of transmissions; `name` is its path in messages and records.

    Raises UserError if it is none, has neither names nor distances, or a value is impossible.
    """
    file = printable(name)
    try:
        data = bytes_of(path, "rows")
        table = _table(data, file)
    except (*BROKEN, pa.ArrowException) as error:
        raise UserError(f"{file}: cannot be read as a table ({one_line(error)})") from None
    return Table(name, sha256_bytes(data), len(table), _columns(table, file))


def _table(data: bytes, file: str) -> pa.Table:
    """Return the columns that are read of a file's bytes."""
    if data[:4] == b"PAR1":
        source = parquet.ParquetFile(BytesIO(data))
        columns, rows = _wanted(source.schema_arrow.names, file), source.metadata.num_rows
        table = source.read(columns) if rows <= MOST_ROWS else None
    else:
        columns = _wanted(_first_line(data), file)
        options = csv.ConvertOptions(
            column_types={column: TYPES[column] for column in columns}, include_columns=columns
        )
        table = csv.read_csv(BytesIO(data), convert_options=options)
        rows = len(table)
    if table is None or not 0 < rows <= MOST_ROWS:
        raise UserError(f"{file}: has {rows} rows; allowed: 1 to {MOST_ROWS}")
    return table.cast(pa.schema({column: TYPES[column] for column in columns}))


def _first_line(data: bytes) -> list[str]:
    line = data.partition(b"\n")[0].decode("utf-8-sig")
    return [name.strip().strip('"') for name in line.split(",")]


def _wanted(names: Sequence[str], file: str) -> list[str]:
    """Return those of a file's columns that are read. Raises UserError if it lacks one."""
    missing = [name for name in NUMBERS if name not in names]
    if missing:
        there = printable(", ".join(names), 60)
        raise UserError(f"{file}: has no column {' or '.join(missing)}; it has {there}")
    named = all(name in names for name in NAMES)
    if not named and DISTANCE not in names:
        raise UserError(
            f"{file}: has neither tx and rx nor {DISTANCE}; add them: nothing else says whose a "
            "transmission is"
        )
    further = [name for name in (SCENE, DISTANCE) if name in names and (named or name != SCENE)]
    return [*NUMBERS, *(NAMES if named else ()), *further]


def _columns(table: pa.Table, file: str) -> Columns:
    """Return a table's columns, checked, sorted by pair and time."""
    time_s, delay_ms, received = (table[name].to_numpy() for name in NUMBERS)
    _refuse(file, "time_s", time_s, ~np.isfinite(time_s), "seconds")
    _refuse(file, "received", received, ~np.isin(received, (0, 1)), "1 or 0")
    is_late = (received == 1) & ~((delay_ms >= 0) & (delay_ms <= MOST_DELAY_MS))
    _refuse(file, "delay_ms", delay_ms, is_late, f"0 to {MOST_DELAY_MS:g}, where it is received")
    senders, receivers = _texts(table, file)
    order = np.lexsort((time_s, receivers, senders))
    is_received = received[order] == 1
    delay_s = delay_ms[order] / 1000
    delay_s = np.where(is_received, delay_s, _median(delay_s[is_received]))
    pairs = _pairs(senders[order], receivers[order]) if NAMES[0] in table.column_names else {}
    has_scenes = SCENE in table.column_names
    if DISTANCE not in table.column_names:
        nothing = np.zeros(0, dtype=int)
        return Columns(time_s[order], delay_s, is_received, pairs, has_scenes, None, nothing)
    distance_m = table[DISTANCE].to_numpy()
    is_no_distance = ~((distance_m >= 0) & (distance_m <= MOST_M))
    _refuse(file, DISTANCE, distance_m, is_no_distance, f"metres, 0 to {MOST_M:g}")
    distance_m = distance_m[order]
    by_distance = np.argsort(distance_m, kind="stable")
    return Columns(time_s[order], delay_s, is_received, pairs, has_scenes, distance_m, by_distance)


def _refuse(file: str, name: str, values: Floats, is_wrong: Bools, allowed: str) -> None:
    """Raise UserError for the first wrong value of a column."""
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise UserError(f"{file}, row {row + 1}: {name} is {values[row]:g}; allowed: {allowed}")


def _texts(table: pa.Table, file: str) -> tuple[Any, Any]:
    """Return the names of senders and receivers, (n,) each; empty ones in a table without."""
    if NAMES[0] not in table.column_names:
        nobody = np.full(len(table), "")
        return nobody, nobody
    has_scenes = SCENE in table.column_names
    for name in (*NAMES, SCENE) if has_scenes else NAMES:
        if table[name].null_count:
            raise UserError(f"{file}: {name} is unknown in some rows; name it in all")
    senders, receivers = (table[name].to_numpy().astype(str) for name in NAMES)
    if has_scenes:
        scenes = np.char.add(table[SCENE].to_numpy().astype(str), "/")
        senders, receivers = np.char.add(scenes, senders), np.char.add(scenes, receivers)
    return senders, receivers


def _pairs(senders: Any, receivers: Any) -> dict[tuple[str, str], slice]:
    """Return the rows of each pair, which stand together."""
    is_other = (senders[1:] != senders[:-1]) | (receivers[1:] != receivers[:-1])
    starts = [0, *(np.flatnonzero(is_other) + 1).tolist(), len(senders)]
    return {
        (str(senders[start]), str(receivers[start])): slice(start, stop)
        for start, stop in pairwise(starts)
    }


def _median(values: Floats) -> float:
    """Return the median; 0 of nothing, since what is never received has no delay."""
    return float(np.median(values)) if len(values) else 0.0
