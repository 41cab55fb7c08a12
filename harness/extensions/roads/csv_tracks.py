"""Scenes of any table of tracks, CSV or TSV, whose columns are declared; and lanes as a table.

A declaration names, for each column of the neutral table, a column of the file, times or divided by
a number where the unit is another: `time_s=frame/25`, `x_m=Local_X*0.3048`. A number, or for `kind`
one of the kinds, is the same for all rows. `front_x_m` and `front_y_m` stand in for `x_m` and `y_m`
where positions are those of front bumpers.
"""

import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Event, Lock
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv

from harness.core.arrays import Floats, Ints
from harness.core.config import toml
from harness.core.errors import UserError, printable, unknown
from harness.extensions.roads.scene import (
    KINDS,
    MOST_HOUSES,
    MOST_LANES,
    MOST_ROWS,
    MOST_TRACKS,
    House,
    Lane,
    Scene,
    Track,
    step_of,
)
from harness.extensions.roads.sources import (
    distinct,
    few_enough,
    name_of,
    no_use,
    once,
    sha256_of,
    stem_of,
    sum_up,
    tracks_of,
    unpacked,
)
from harness.extensions.roads.tables import runs_of

NEEDED = ("time_s", "id", "x_m", "y_m")
FURTHER = ("kind", "heading_rad", "speed_mps", "length_m", "width_m", "scene")
FRONT = {"front_x_m": "x_m", "front_y_m": "y_m"}
NAMES = (*NEEDED, *FURTHER, *FRONT)
LABEL = pa.dictionary(pa.int32(), pa.string())
OF_TEXT = ("id", "kind", "scene")
POINTS = ("x_m", "y_m")
LANE_COLUMNS = ("id", *POINTS, "width_m", "limit_mps", "successors", "left", "right")
HOUSE_COLUMNS = ("building", *POINTS)
LANE_WIDTH_M = 3.5  # where a table of lanes has none
SEPARATOR = ";"  # between the successors of a lane
# What files call the kinds, in small letters.
SYNONYMS = {
    **{kind: kind for kind in KINDS},
    **dict.fromkeys(("auto", "automobile", "passenger", "vehicle", "taxi", "suv"), "car"),
    **dict.fromkeys(("bus", "lorry", "trailer", "truck_bus", "heavy vehicle"), "truck"),
    **dict.fromkeys(("cyclist", "bike", "pedestrian/bicycle"), "bicycle"),
    **dict.fromkeys(("motorbike", "motorcyclist", "moped", "scooter"), "motorcycle"),
    **dict.fromkeys(("person", "ped", "walker"), "pedestrian"),
}
# Length and width where a file has none, m: a car's, and of others what is usual.
SIZES_M = {
    "car": (4.6, 1.8),
    "van": (5.5, 2.0),
    "truck": (9.0, 2.5),
    "bicycle": (1.8, 0.6),
    "motorcycle": (2.2, 0.8),
    "pedestrian": (0.4, 0.5),
}
SCALED = re.compile(r"(.+?)\s*([*/])\s*(-?[0-9.]+(?:[eE][+-]?[0-9]+)?)")
LAST_READ_S = 0.3  # in which a thread that reads ahead asks for more, or does not any more
EXAMPLE = "--columns time_s=frame/25,id=track,x_m=x,y_m=y"


class Column(NamedTuple):
    """Say where a column of the neutral table is from: a column of the file, or one value."""

    source: str | None  # the file's column; None for one value
    factor: float = 1.0  # by which its numbers are multiplied
    value: float | str = ""  # the one value


class Columns(NamedTuple):
    """Hold a declaration: where each column is from, and kinds by the words of the file."""

    texts: Mapping[str, str]  # as they were typed, by the name of the neutral table's column
    kinds: Mapping[str, str]


def columns_of(text: str | None) -> Columns:
    """Return a declaration: names and columns with commas between, or the path of a TOML file.

    The file has the same names as keys, and may have a table `kinds`, of kinds by the file's words.
    Without a declaration the file's own names are those of the neutral table. Raises UserError.
    """
    if text is None:
        return Columns({name: name for name in NAMES}, {})
    if text.endswith(".toml"):
        return _of_file(Path(text))
    declared: dict[str, str] = {}
    for part in text.split(","):
        name, equals, column = part.partition("=")
        if not equals or not column.strip():
            raise UserError(f"--columns: {printable(part)!r} is no NAME=COLUMN; type {EXAMPLE}")
        declared[name.strip()] = column.strip()
    return _checked(declared, {}, "--columns")


def _of_file(path: Path) -> Columns:
    where = f"file of columns {printable(path)}"
    table: dict[str, Any] = toml(path, where)
    kinds = table.pop("kinds", {})
    if not isinstance(kinds, dict):
        raise UserError(f'{where}: kinds is no table; write [kinds], and below it 2 = "car"')
    for word, kind in kinds.items():
        if kind not in KINDS:
            raise unknown(f"kind in {where}, of {printable(word)}", str(kind), KINDS)
    return _checked({name: str(column) for name, column in table.items()}, kinds, where)


def _checked(declared: Mapping[str, str], kinds: Mapping[str, str], where: str) -> Columns:
    for name in declared:
        if name not in NAMES:
            raise unknown(f"column in {where}", name, NAMES)
    for front, name in FRONT.items():
        if (front in declared) == (name in declared):
            raise UserError(f"{where}: give one of {name} and {front}; such as {EXAMPLE}")
    for name in ("time_s", "id"):
        if name not in declared:
            raise UserError(f"{where}: {name} is missing; such as {EXAMPLE}")
    return Columns(declared, dict(kinds))


def header_of(path: Path) -> list[str]:
    """Return the names of a table's columns, of its first line."""
    with unpacked(path) as file:
        line = file.read(1 << 16).decode("utf-8-sig", "replace").split("\n")[0].rstrip("\r")
    return [cell.strip().strip('"') for cell in line.split(_delimiter(line))]


def _delimiter(line: str) -> str:
    return max(",\t;", key=line.count)


def is_lanes(header: list[str]) -> bool:
    """Return whether a table with this header is one of lanes, and not of tracks."""
    return set(LANE_COLUMNS[:3]) <= set(header) <= set(LANE_COLUMNS)


def is_buildings(header: list[str]) -> bool:
    """Return whether a table with this header is one of buildings."""
    return set(HOUSE_COLUMNS) == set(header)


def has_places(header: list[str], columns: Columns) -> bool:
    """Return whether a table with this header has any of the columns of time and place."""
    names = ("time_s", *POINTS, *FRONT)
    for text in [columns.texts[name] for name in names if name in columns.texts]:
        scaled = SCALED.fullmatch(text)
        if text in header or (scaled and scaled[1] in header):
            return True
    return False


def scenes(
    *paths: Path,
    columns: Columns,
    lanes: Mapping[str, Lane],
    houses: tuple[House, ...] = (),
    lights: bool = False,
) -> Iterator[Scene]:
    """Yield the scenes of tables of tracks: one each, or one for each value of `scene`.

    `lanes`, `houses` and whether there are `lights` are of all of them. Raises UserError for a
    table that lacks a column, or whose values are none.
    """
    for path in paths:
        rows = _rows(path, columns)
        sha256 = sha256_of(path)
        for name, begin, end in rows.scenes:
            part = rows.part(begin, end)
            tracks, left_out = _tracks(path, part)
            yield Scene(
                name_of(f"{stem_of(path)}-{name}" if name else stem_of(path)),
                path.name,
                sha256,
                lights,
                tracks,
                lanes,
                houses,
                left_out,
            )


class _Rows(NamedTuple):
    """Hold n rows in the order of scene, id and time; texts are codes of names."""

    numbers: dict[str, Floats]  # (n,) by name: times, poses and sizes; NaN where unknown
    codes: dict[str, Ints]  # (n,) by name: id, kind and scene
    names: dict[str, list[str]]  # by name, what codes stand for
    kinds: Mapping[str, str]
    is_front: bool  # whether positions are those of front bumpers

    @property
    def scenes(self) -> list[tuple[str, int, int]]:
        """Return the name, first row and end of each scene; one without a name is the only one."""
        if "scene" not in self.codes:
            return [("", 0, len(self.numbers["time_s"]))]
        codes, names = self.codes["scene"], self.names["scene"]
        return [(names[codes[start]], start, stop) for start, stop in runs_of(codes)]

    def part(self, begin: int, end: int) -> "_Rows":
        """Return some of the rows."""
        numbers = {name: values[begin:end] for name, values in self.numbers.items()}
        codes = {name: values[begin:end] for name, values in self.codes.items()}
        return self._replace(numbers=numbers, codes=codes)


def _rows(path: Path, columns: Columns) -> _Rows:
    header = header_of(path)
    places = {
        name: _column(name, text, header, path)
        for name, text in columns.texts.items()
        if columns.texts[name] in header or text != name or name in NEEDED
    }
    if "front_x_m" in places:
        places.pop("x_m", None)
    kinds: dict[str, pa.DataType] = {}
    for name, place in places.items():
        if place.source:
            is_text = name in OF_TEXT or kinds.get(place.source) == LABEL
            kinds[place.source] = LABEL if is_text else pa.float64()
    table = _table(path, header, kinds)
    if not len(table):
        raise no_use(path, "it has no rows")
    numbers: dict[str, Floats] = {}
    codes: dict[str, Ints] = {}
    names: dict[str, list[str]] = {}
    for name, place in places.items():
        if name in OF_TEXT:
            codes[name], names[name] = _labels(table, place)
        else:
            numbers[FRONT.get(name, name)] = _numbers(path, table, place)
    del table
    order = np.lexsort((numbers["time_s"], codes["id"], codes.get("scene", codes["id"])))
    if not (np.diff(order) == 1).all():
        numbers = {name: values[order] for name, values in numbers.items()}
        codes = {name: values[order] for name, values in codes.items()}
    return _Rows(numbers, codes, names, columns.kinds, "front_x_m" in places)


def with_limit(path: Path, amount: int, most: int, what: str) -> None:
    """Raise UserError for a file with more of something than a scene can have."""
    try:
        few_enough(amount, most, what)
    except ValueError as error:
        raise no_use(path, error) from None


def _column(name: str, text: str, header: list[str], path: Path) -> Column:
    """Return where a column is from, given its declaration and the file's columns."""
    if text in header:
        return Column(text)
    scaled = SCALED.fullmatch(text)
    if scaled and scaled[1] in header and name not in OF_TEXT:
        by = float(scaled[3])
        if by:
            return Column(scaled[1], by if scaled[2] == "*" else 1 / by)
    if name == "kind" and text in KINDS:
        return Column(None, 1.0, text)
    if name not in NEEDED and name not in FRONT and name not in OF_TEXT:
        try:
            return Column(None, 1.0, float(text))
        except ValueError:
            pass
    hint = f"; declare it: {EXAMPLE}" if text == name else ""
    raise unknown(f"column of {printable(path.name)}, for {name},", text, header, hint)


def _table(path: Path, header: list[str], kinds: Mapping[str, pa.DataType]) -> pa.Table:
    """Return the columns of a file that `kinds` has, as these types."""
    if len(set(header)) < len(header):
        raise no_use(path, "two of its columns have one name")
    with unpacked(path) as file:
        first = file.read(1 << 16)
        delimiter = _delimiter(first.decode("utf-8-sig", "replace").split("\n")[0])
    with unpacked(path) as file, _Raw(file) as raw:
        try:
            reader = pyarrow.csv.open_csv(
                io.BufferedReader(raw, 1 << 20),
                read_options=pyarrow.csv.ReadOptions(
                    use_threads=False, column_names=header, skip_rows=1
                ),
                parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
                convert_options=pyarrow.csv.ConvertOptions(
                    column_types=kinds, include_columns=list(kinds), strings_can_be_null=False
                ),
            )
            batches, n = [], 0
            for batch in reader:
                batches.append(batch)
                n += len(batch)
                few_enough(n, MOST_ROWS, "rows")
            return pa.Table.from_batches(batches, reader.schema).unify_dictionaries()
        except pa.ArrowException as error:
            reason = str(error).split("\n")[0]
            is_empty = reason.startswith("Could not skip")  # the header, as there is no more
            raise ValueError("it has no rows" if is_empty else reason) from None


class _Raw(io.RawIOBase):
    """Give pyarrow a file that it can read from, in a thread of its own.

    That thread reads ahead, and may do so when the rows are refused; it must have come to an end
    of the file before the program has.
    """

    def __init__(self, file: Any) -> None:
        self.file, self._stopped, self._over, self._lock = file, False, Event(), Lock()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        with self._lock:
            data = b"" if self._stopped else self.file.read(len(buffer))
        buffer[: len(data)] = data
        if not data:
            self._over.set()
        return len(data)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._stopped = True
        self._over.wait(LAST_READ_S)


def _numbers(path: Path, table: pa.Table, place: Column) -> Floats:
    if place.source is None:
        return np.full(len(table), float(place.value))
    column = table[place.source]
    if column.type == LABEL:  # which is text as well, such as ids that are sizes
        try:
            column = column.cast(pa.string()).cast(pa.float64())
        except pa.ArrowException as error:
            raise no_use(path, f"column {printable(place.source, 40)}: {error}") from None
    values = column.to_numpy()
    return np.asarray(values * place.factor if place.factor != 1.0 else values)


def _labels(table: pa.Table, place: Column) -> tuple[Ints, list[str]]:
    if place.source is None:
        return np.zeros(len(table), dtype=np.int64), [str(place.value)]
    column = pa.chunked_array(table[place.source]).combine_chunks()
    return column.indices.to_numpy().astype(np.int64), column.dictionary.to_pylist()


def _tracks(path: Path, rows: _Rows) -> tuple[dict[str, Track], dict[str, int]]:
    """Return the tracks of one scene's rows, and what was left out."""
    numbers, n = rows.numbers, len(rows.numbers["time_s"])
    runs = runs_of(rows.codes["id"])
    with_limit(path, len(runs), MOST_TRACKS, "road users")
    steps = np.diff(numbers["time_s"])
    inside = np.ones(n - 1, dtype=bool)
    inside[[stop - 1 for _, stop in runs[:-1]]] = False
    inside &= np.isfinite(steps)
    step_s = step_of(steps[inside]) if inside.any() else 1.0
    unknown_m = np.full(n, np.nan)
    columns = [numbers.get(name, unknown_m) for name in ("heading_rad", "speed_mps")]
    poses = np.column_stack([numbers["x_m"], numbers["y_m"], *columns])
    tracks: dict[str, Track] = {}
    left_out: dict[str, int] = {}
    for start, stop in runs:
        key = rows.names["id"][rows.codes["id"][start]]
        kind = _kind(rows, start)
        if kind not in KINDS:
            sum_up(left_out, f"{printable(kind, 30)} (a kind that none is made of)")
            continue
        size_m = _size(path, key, numbers, start, kind)
        times = numbers["time_s"][start:stop]
        if (np.diff(times) == 0).any():
            again_s = times[:-1][np.diff(times) == 0][0]
            raise no_use(path, f"{printable(key, 60)} has two rows at {again_s:g} s")
        for track in tracks_of(key, kind, size_m, times, poses[start:stop], step_s):
            if rows.is_front:
                track = _from_front(track)
            once(tracks, track.id, "tracks", path)
            tracks[track.id] = track
    return tracks, left_out


def _kind(rows: _Rows, row: int) -> str:
    """Return the kind of a row's road user: the file's word where it is none."""
    if "kind" not in rows.codes:
        return "car"
    word = rows.names["kind"][rows.codes["kind"][row]].strip()
    return rows.kinds.get(word, SYNONYMS.get(word.lower(), word))


def _size(
    path: Path, key: str, numbers: Mapping[str, Floats], row: int, kind: str
) -> tuple[float, float]:
    """Return length and width, m, of a row's road user; what is usual where they are unknown.

    Raises UserError for one that is not above 0; some recordings have 0 for people and bicycles.
    """
    sizes_m = []
    for name, usual_m in zip(("length_m", "width_m"), SIZES_M[kind], strict=True):
        value = float(numbers[name][row]) if name in numbers else np.nan
        if value == 0 and kind in ("bicycle", "pedestrian"):
            value = np.nan
        if value <= 0:
            raise no_use(
                path,
                f"{printable(key, 60)} has {name} {value:g}; allowed: above 0, or none for "
                f"{usual_m:g}",
            )
        sizes_m.append(usual_m if np.isnan(value) else value)
    return sizes_m[0], sizes_m[1]


def _from_front(track: Track) -> Track:
    """Return a track of the centre, given that of the middle of the front."""
    poses = track.poses.copy()
    ahead = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    poses[:, :2] -= track.length_m / 2 * ahead
    return Track(track.id, track.kind, track.length_m, track.width_m, track.time_s, poses)


def lanes_of(path: Path) -> dict[str, Lane]:
    """Return the lanes of a table with a row a point: `id,x_m,y_m` and what else is known.

    The others are `width_m`, `limit_mps`, `successors` (with `;` between), `left` and `right`, and
    are read where a lane's first point has them.
    """
    lanes: dict[str, Lane] = {}
    for key, points, first in _lines(path, "id", LANE_COLUMNS, MOST_LANES):
        once(lanes, key, "lanes", path)
        width_m = _number_of(path, first, "width_m")
        lanes[key] = Lane(
            key,
            distinct(points),
            LANE_WIDTH_M if width_m is None else width_m,
            _number_of(path, first, "limit_mps"),
            tuple(each for each in first.get("successors", "").split(SEPARATOR) if each),
            first.get("left") or None,
            first.get("right") or None,
        )
    return lanes


def buildings_of(path: Path) -> tuple[House, ...]:
    """Return the buildings of a table with a row a corner: `building,x_m,y_m`."""
    houses: dict[str, House] = {}
    for key, points, _ in _lines(path, "building", HOUSE_COLUMNS, MOST_HOUSES):
        once(houses, key, "buildings", path)
        houses[key] = House(key, points)
    return tuple(houses.values())


def _lines(
    path: Path, key_name: str, names: tuple[str, ...], most: int
) -> Iterator[tuple[str, Floats, dict[str, str]]]:
    """Yield each line of a table: its id, its points (n, 2) m, and the texts of its first row."""
    header = header_of(path)
    there = [name for name in names if name in header]
    table = _table(path, header, dict.fromkeys(there, pa.string()))
    with_limit(path, len(table), 50 * most, "points")
    if not len(table):
        return
    codes = pa.chunked_array(table[key_name].dictionary_encode()).combine_chunks()
    runs = runs_of(codes.indices.to_numpy())
    with_limit(path, len(runs), most, f"lines of {key_name}")
    columns = {name: table[name].to_pylist() for name in there}
    try:
        points = np.array([columns[name] for name in POINTS], dtype=float).T
    except ValueError as error:
        raise no_use(path, error) from None
    for start, stop in runs:
        first = {name: column[start].strip() for name, column in columns.items()}
        yield first[key_name], points[start:stop], first


def _number_of(path: Path, row: Mapping[str, str], name: str) -> float | None:
    text = row.get(name, "")
    try:
        return float(text) if text else None
    except ValueError:
        raise no_use(path, f"{name} {printable(text, 40)!r} is no number") from None
