"""Recorded or simulated traffic as one neutral table: what a recording's folder holds.

x is to the east, y to the north and headings run counter-clockwise from +x, as sources have it;
positions are vehicles' centres. Worlds mirror them, and nothing else does.
"""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Meta

from harness.core.arrays import Floats, Ints
from harness.core.config import between, convert, json_loads
from harness.core.errors import UserError, one_line, printable, unknown
from harness.core.files import (
    BROKEN,
    bytes_of,
    canonical_json,
    naming,
    opened,
    sha256_bytes,
    sha256_file,
    write_whole,
)
from harness.core.seeds import FIRST
from harness.world.state import separation_m

FORMAT: Literal["swarmdrive-recording/1"] = "swarmdrive-recording/1"
FACTS = "recording.json"
KINDS = ("car", "van", "truck", "bicycle", "motorcycle", "pedestrian")
STILL_M = 0.5  # what moves less than this in all its time stands
# Of one scene; what is beyond these is no traffic of one place.
MOST_ROWS, MOST_TRACKS, MOST_LANES, MOST_HOUSES = 10_000_000, 50_000, 100_000, 100_000
MOST_POINTS = 5_000_000  # of all its lanes
CELL_M, MOST_OF_CELL = 100.0, 1000  # lanes that begin in one square: what roads are made of
LONGEST_S, LONGEST_ALL_S = 1e6, 3e6  # from its begin to its end, and of all its road users together
MOST_SCENES, MOST_MOMENTS = 10_000, 1_000_000
FARTHEST_M = 1e8  # of a coordinate: maps have them in metres from an equator and a meridian
LENGTHS_M, WIDTHS_M = (0.1, 60.0), (0.1, 10.0)  # of road users
FASTEST_MPS = 120.0
LANE_WIDTHS_M = (0.5, 50.0)
LONGEST_ID = 200  # characters
LONGEST_TEXT = 1000  # characters of a licence and a source
# By how much the median of a track's speeds, m/s and of what it moves at, and of its headings, rad,
# may differ from its movement: far more than sensors err, and less than other units do.
SPEED_SLACK_MPS, SPEED_SLACK, HEADING_SLACK = 1.0, 0.25, np.pi / 3
BASE_S, BASE_M = 1.0, 2.0  # time between positions that are compared, and least way for a course
SLACK_M = 0.3  # by which road users may overlap: sensors err by so much
EARLY_S = 1e-6  # sums of steps miss a time by rounding
WORDS = re.compile(r"[a-z0-9][a-z0-9._-]{0,79}")  # of a recording's name, which scenarios have
Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_ID)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


def _spread(poses: Floats) -> Floats:
    """Return how far x and y reach over n poses (n, >=2), m, (2,)."""
    return np.asarray(np.ptp(poses[:, :2], axis=0))


@dataclass(frozen=True, eq=False)
class Track:
    """Hold one road user over time: n poses of its centre, at rising times.

    Nothing is known outside its time, and in between poses are linear.
    """

    id: str
    kind: str  # one of `KINDS`
    length_m: float
    width_m: float
    time_s: Floats  # (n,), rising
    poses: Floats  # (n, 4): x_m, y_m, heading_rad, speed_mps

    @property
    def begin_s(self) -> float:
        return float(self.time_s[0])

    @property
    def end_s(self) -> float:
        return float(self.time_s[-1])

    @cached_property
    def still(self) -> bool:
        """Return whether it moves less than half a metre in all, as a parked car does."""
        return bool(np.hypot(*_spread(self.poses)) < STILL_M)

    def at(self, time_s: float) -> Floats | None:
        """Return x_m, y_m, heading_rad and speed_mps at a time, (4,); None outside its time.

        Between two poses the heading turns the short way.
        """
        times = self.time_s
        if not times[0] - EARLY_S <= time_s <= times[-1] + EARLY_S:
            return None
        after = int(np.searchsorted(times, time_s, side="right"))
        if after == 0 or after == len(times):
            return np.array(self.poses[min(after, len(times) - 1)])
        before = after - 1
        share = (time_s - times[before]) / (times[after] - times[before])
        step = self.poses[after] - self.poses[before]
        step[2] = (step[2] + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(self.poses[before] + share * step)


@dataclass(frozen=True, eq=False)
class Lane:
    """Hold one lane: its centre line from begin to end, and what lies beside and after it."""

    id: str
    points: Floats  # (n, 2) m
    width_m: float
    limit_mps: float | None  # speed limit; None where none is stated
    successors: tuple[str, ...]  # ids of the lanes that it leads on to
    left: str | None  # id of the next lane of equal direction, to the left
    right: str | None


@dataclass(frozen=True, eq=False)
class House:
    """Hold what blocks sight and does not move."""

    id: str
    outline: Floats  # (n, 2) m, without the first point again


def step_of(steps_s: Floats) -> float:
    """Return the usual time from one pose to the next, s, without what differences round off."""
    return round(float(np.median(steps_s)), 6)


@dataclass(frozen=True, eq=False)
class Scene:
    """Hold what one source file has: one map, one clock, and who moved there."""

    name: str
    file: str  # name of the source file
    sha256: str  # its hex digest
    lights: bool  # whether traffic lights stand there
    tracks: Mapping[str, Track]
    lanes: Mapping[str, Lane]
    houses: tuple[House, ...] = ()
    # how many things a reader left out, by the reason; no table keeps it
    left_out: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def step_s(self) -> float:
        """Return the usual time from one pose of a mover to the next, s; 1 if none has two."""
        times = [track.time_s for track in self.tracks.values() if not track.still]
        steps = [np.diff(each) for each in times]
        steps_s = np.concatenate([*steps, np.empty(0)])
        return step_of(steps_s) if len(steps_s) else 1.0

    @property
    def begin_s(self) -> float:
        return min(track.begin_s for track in self.tracks.values())

    @property
    def end_s(self) -> float:
        return max(track.end_s for track in self.tracks.values())


class Moment(msgspec.Struct, frozen=True):
    """Say where an episode begins: a scene, the vehicle that becomes the ego, and the time."""

    scene: Name
    vehicle: Name
    time_s: float
    hidden: Name | None  # id of the road user in conflict whom the ego cannot see; None for none
    conflict_s: float | None  # time from here until the two would be at one place
    purpose: Annotated[str, Meta(max_length=40)]  # of its layout's seed, one of `FIRST`


class SceneFacts(msgspec.Struct, frozen=True):
    """State of a scene what is known without reading its tables."""

    name: Name
    file: Annotated[str, Meta(min_length=1, max_length=1000)]
    sha256: Sha256
    step_s: Annotated[float, between(0.001, 10)]
    begin_s: float
    end_s: float
    lights: bool
    tracks: Annotated[int, Meta(ge=1, le=MOST_TRACKS)]
    lanes: Annotated[int, Meta(ge=1, le=MOST_LANES)]


class Facts(msgspec.Struct, frozen=True):
    """Hold what `recording.json` has."""

    format: Literal["swarmdrive-recording/1"]
    name: str
    source: str  # where the traffic is from, in words
    licence: str  # under which it may be used, in words
    window_m: Annotated[float, between(10, 2000)]  # of an episode, around the ego
    speeds_mps: Annotated[tuple[float, ...], Meta(min_length=2, max_length=10)]
    period_s: Annotated[float, between(0.1, 10)]
    decisions: Annotated[int, Meta(ge=1, le=9)]
    files: dict[str, Sha256]
    scenes: Annotated[tuple[SceneFacts, ...], Meta(min_length=1, max_length=MOST_SCENES)]
    moments: Annotated[tuple[Moment, ...], Meta(max_length=MOST_MOMENTS)]
    choice: dict[str, Any]


TEXT, LABEL, NUMBER = pa.string(), pa.dictionary(pa.int32(), pa.string()), pa.float64()
TEXTS, NUMBERS = pa.list_(TEXT), pa.list_(NUMBER)
LINE = {"scene": TEXT, "id": TEXT, "x_m": NUMBERS, "y_m": NUMBERS}
POSES = ("x_m", "y_m", "heading_rad", "speed_mps")
SCHEMAS = {
    "tracks.parquet": pa.schema(
        {
            "scene": LABEL,
            "time_s": NUMBER,
            "id": LABEL,
            "kind": LABEL,
            **dict.fromkeys(POSES, NUMBER),
            "length_m": NUMBER,
            "width_m": NUMBER,
        }
    ),
    "lanes.parquet": pa.schema(
        {
            **LINE,
            "width_m": NUMBER,
            "limit_mps": NUMBER,
            "successors": TEXTS,
            "left": TEXT,
            "right": TEXT,
        }
    ),
    "buildings.parquet": pa.schema(LINE),
}
TRACKS, LANES, BUILDINGS = SCHEMAS
NULLABLE = {"limit_mps", "left", "right"}
PLAIN = {"PLAIN", "RLE", "BIT_PACKED"}  # of values, and the latter two of levels of lists
# Bytes that a file's rows may unpack to: a few bytes can state thousands of millions of them.
MOST_BYTES = {TRACKS: 4 << 30, LANES: 1 << 30, BUILDINGS: 1 << 30}


@dataclass(frozen=True, eq=False)
class Recording:
    """Hold a recording: what its folder states, and its scenes, read where they are asked for."""

    folder: Path
    digest: str  # hex SHA-256 of recording.json
    facts: Facts
    _files: dict[str, bool] = field(default_factory=dict, repr=False)  # whose digest was checked

    @property
    def name(self) -> str:
        return self.facts.name

    @property
    def source(self) -> str:
        return self.facts.source

    @property
    def licence(self) -> str:
        return self.facts.licence

    @property
    def window_m(self) -> float:
        return self.facts.window_m

    @property
    def speeds_mps(self) -> tuple[float, ...]:
        return self.facts.speeds_mps

    @property
    def scenes_stated(self) -> tuple[SceneFacts, ...]:
        return self.facts.scenes

    @property
    def moments(self) -> tuple[Moment, ...]:
        return self.facts.moments

    @property
    def choice(self) -> Mapping[str, Any]:
        return self.facts.choice

    def scene(self, name: str) -> Scene:
        """Return a scene by its name, read from the folder and checked; a few are kept.

        Raises UserError for a name that it has not, and for files that are not what the recording
        states.
        """
        return _scene(self, name)

    def scenes(self) -> Iterator[Scene]:
        """Yield all scenes, in order."""
        for facts in self.scenes_stated:
            yield self.scene(facts.name)

    def rows(self, file_name: str, scene: str) -> pa.Table:
        """Return a scene's rows of one of the recording's tables, such as `lanes.parquet`."""
        path = self.folder / file_name
        try:
            pa.default_memory_pool().release_unused()  # what was read before may be as large
            with opened(path, "rows") as file:
                if file_name not in self._files:
                    self._check_digest(file_name, file)
                    self._files[file_name] = True
                return _rows(file, file_name, scene)
        except (*BROKEN, pa.ArrowException) as error:
            raise _broken(path, one_line(error)) from None

    def _check_digest(self, file_name: str, file: BinaryIO) -> None:
        digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
        if digest != self.facts.files.get(file_name):
            raise ValueError(f"its digest is {digest[:12]}…, and {FACTS} states another")
        file.seek(0)


def _broken(path: Path, reason: str) -> UserError:
    return UserError(
        f"recording file {printable(path)}: {reason}; make the recording again: "
        "`harness dataset import`"
    )


def _rows(file: BinaryIO, file_name: str, scene: str) -> pa.Table:
    """Return the rows of a scene: those groups are read that may have it.

    Raises ValueError if the columns are others, or there is more than a scene can have.
    """
    expected = SCHEMAS[file_name]
    labels = [column.name for column in expected if column.type == LABEL]
    source = pq.ParquetFile(file, read_dictionary=labels)
    names = source.schema_arrow.names
    if names != expected.names:
        raise ValueError(f"its columns are {', '.join(names)[:100]}")
    groups = [n for n in range(source.num_row_groups) if _may_have(source.metadata, n, scene)]
    sizes = [source.metadata.row_group(n) for n in groups]
    if sum(size.num_rows for size in sizes) > MOST_ROWS:
        raise ValueError(f"scene {printable(scene)} has more than {MOST_ROWS} rows")
    if sum(size.total_byte_size for size in sizes) > MOST_BYTES[file_name]:
        raise ValueError(f"scene {printable(scene)} takes more bytes than a scene needs")
    if file_name != TRACKS and any(map(_may_grow, sizes)):
        raise ValueError("it is packed so that few bytes may be many values")
    table = source.read_row_groups(groups, use_threads=False).cast(expected)
    for name in expected.names:
        if name not in NULLABLE and table[name].null_count:
            raise ValueError(f"{name} is unknown in some rows")
    return table.filter(pa.compute.equal(table["scene"].cast(TEXT), scene))


def _may_grow(group: pq.RowGroupMetaData) -> bool:
    """Return whether a group's values may take more than the bytes that it states."""
    columns = [group.column(n) for n in range(group.num_columns)]
    return any(not PLAIN.issuperset(column.encodings) for column in columns)


def _may_have(metadata: pq.FileMetaData, group: int, scene: str) -> bool:
    statistics = metadata.row_group(group).column(0).statistics
    if statistics is None or not statistics.has_min_max:
        return True
    return bool(statistics.min <= scene <= statistics.max)


@lru_cache(maxsize=4)
def _scene(recording: Recording, name: str) -> Scene:
    facts = {facts.name: facts for facts in recording.scenes_stated}.get(name)
    if facts is None:
        raise UserError(f"recording {printable(recording.name)} has no scene {printable(name)}")
    tracks = recording.rows(TRACKS, name)
    lanes = recording.rows(LANES, name)
    houses = recording.rows(BUILDINGS, name)
    scene = Scene(
        name,
        facts.file,
        facts.sha256,
        facts.lights,
        _tracks_of(tracks),
        {lane.id: lane for lane in _lanes_of(lanes)},
        tuple(House(str(row["id"]), _line(row)) for row in houses.to_pylist()),
    )
    checked(scene)
    for key, given in _computed_facts(scene).items():
        claim = getattr(facts, key)
        if claim != given:
            reason = f"scene {printable(name)} states {key} {claim:g}; its tables give {given:g}"
            raise _broken(recording.folder / FACTS, reason)
    return scene


def _computed_facts(scene: Scene) -> dict[str, float]:
    """Return what is stated of a scene that its tables give, by the names of `SceneFacts`."""
    return {
        "step_s": scene.step_s,
        "begin_s": scene.begin_s,
        "end_s": scene.end_s,
        "tracks": len(scene.tracks),
        "lanes": len(scene.lanes),
    }


def _tracks_of(table: pa.Table) -> dict[str, Track]:
    """Return the tracks of a scene's rows, which stand together, each in the order of time."""
    if not len(table):
        return {}
    ids, kinds = _labels(table["id"]), _labels(table["kind"])
    codes = ids.indices.to_numpy()
    kind_codes = kinds.indices.to_numpy()
    times = table["time_s"].to_numpy()
    poses = np.stack([table[name].to_numpy() for name in POSES], axis=-1)
    lengths, widths = table["length_m"].to_numpy(), table["width_m"].to_numpy()
    tracks: dict[str, Track] = {}
    for start, stop in runs_of(codes):
        key = ids.dictionary[int(codes[start])].as_py()
        if key in tracks:
            raise UserError(f"track {printable(key)}: its rows do not stand together")
        kind = kinds.dictionary[int(kind_codes[start])].as_py()
        size = float(lengths[start]), float(widths[start])
        tracks[key] = Track(key, kind, *size, times[start:stop], poses[start:stop])
    return tracks


def _labels(column: pa.ChunkedArray) -> pa.DictionaryArray:
    return pa.chunked_array(column.unify_dictionaries()).combine_chunks()


def runs_of(codes: Ints) -> list[tuple[int, int]]:
    """Return where equal values stand together: start and stop of each run, of (n,) values."""
    if not len(codes):
        return []
    starts = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()]
    return list(zip(starts, [*starts[1:], len(codes)], strict=True))


def _line(row: Mapping[str, Any]) -> Floats:
    if len(row["x_m"]) != len(row["y_m"]):
        raise UserError(f"line {printable(row['id'])} has another number of x_m than of y_m")
    return np.array([row["x_m"], row["y_m"]], dtype=float).T


def _lanes_of(table: pa.Table) -> Iterator[Lane]:
    for row in table.to_pylist():
        successors = tuple(row["successors"])
        yield Lane(
            row["id"],
            _line(row),
            row["width_m"],
            row["limit_mps"],
            successors,
            row["left"],
            row["right"],
        )


def read(folder: Path) -> Recording:
    """Read what a recording's folder states; its tables are read scene by scene, later.

    Raises UserError for a folder that is none, or states what cannot be.
    """
    path = folder / FACTS
    try:
        data = bytes_of(path, "record")
        text = data.decode()
    except (OSError, ValueError) as error:
        raise UserError(
            f"{printable(folder)} is no recording: {one_line(error)}; make one: "
            "`harness dataset import FILE --out FOLDER`"
        ) from None
    where = f"recording {printable(path)}"
    value = json_loads(text, where)
    if not isinstance(value, dict):
        raise UserError(f"{where} is no table; make the recording again")
    facts = convert(value, Facts, where)
    _check_facts(facts, where)
    return Recording(folder, sha256_bytes(data), facts)


def _check_facts(facts: Facts, where: str) -> None:
    """Raise UserError where a recording's file contradicts itself."""
    if not WORDS.fullmatch(facts.name):
        raise UserError(f"{where}: name {printable(facts.name)}; allowed: a-z, 0-9, . _ and -")
    if set(facts.files) != set(SCHEMAS):
        raise UserError(f"{where}: files are not {', '.join(SCHEMAS)}; make the recording again")
    if any(
        slow >= fast for slow, fast in zip(facts.speeds_mps, facts.speeds_mps[1:], strict=False)
    ):
        raise UserError(f"{where}: speeds_mps do not rise; give the slowest first")
    if not 0 <= facts.speeds_mps[0] <= facts.speeds_mps[-1] <= FASTEST_MPS:
        raise UserError(f"{where}: speeds_mps; allowed: 0 to {FASTEST_MPS:g}")
    for name, text in (("source", facts.source), ("licence", facts.licence)):
        if len(text) > LONGEST_TEXT or not text.isprintable():
            raise UserError(
                f"{where}: {name} has {len(text)} characters; allowed: {LONGEST_TEXT} at most, all "
                "of which can be shown"
            )
    scenes = {scene.name: scene for scene in facts.scenes}
    if len(scenes) < len(facts.scenes):
        raise UserError(f"{where}: two scenes have one name; make the recording again")
    seen: set[tuple[str, str, float]] = set()
    for moment in facts.moments:
        key = moment.scene, moment.vehicle, moment.time_s
        if key in seen or moment.time_s % 1:
            why = "is there twice" if key in seen else "begins at no whole second"
            raise UserError(
                f"{where}: moment {printable(moment.scene, 60)} {printable(moment.vehicle, 60)} "
                f"{moment.time_s:g} s {why}; make the recording again"
            )
        seen.add(key)
        if (moment.hidden is None) != (moment.conflict_s is None):
            raise UserError(
                f"{where}: a moment has one of hidden and conflict_s; allowed: both or none"
            )
        if moment.purpose not in FIRST:
            raise unknown(f"purpose of a moment in {where}", moment.purpose, FIRST)
        scene = scenes.get(moment.scene)
        if scene is None or not scene.begin_s <= moment.time_s <= scene.end_s:
            raise UserError(
                f"{where}: a moment is of scene {printable(moment.scene)} at {moment.time_s:g} s, "
                "which it has not; make the recording again"
            )


def write(
    folder: Path,
    name: str,
    source: str,
    licence: str,
    window_m: float,
    scenes: Iterable[Scene],
    moments: Iterable[Moment],
    choice: Mapping[str, Any],
    speeds_mps: Sequence[float] = (0.0, 5.0, 10.0),
    decisions: int = 3,
    period_s: float = 1.0,
) -> Recording:
    """Write a recording into a folder that is there, and return it, read again.

    Scenes are written as they come, each checked; moments are asked for after the last scene.
    Equal scenes give equal bytes. Raises UserError for a scene that cannot be.
    """
    with _writers(folder) as writers:
        facts = tuple(_write_scene(writers, scene) for scene in scenes)
    files = {file: sha256_file(folder / file) for file in SCHEMAS}
    whole = Facts(
        FORMAT,
        name,
        source,
        licence,
        window_m,
        tuple(speeds_mps),
        period_s,
        decisions,
        files,
        facts,
        tuple(moments),
        dict(choice),
    )
    write_whole(folder / FACTS, canonical_json(msgspec.to_builtins(whole)) + "\n")
    return read(folder)


def chosen(
    recording: Recording,
    speeds_mps: Sequence[float],
    moments: Iterable[Moment],
    choice: Mapping[str, Any],
) -> Recording:
    """Write the moments of a recording and the ego's target speeds, and return it, read again."""
    facts = msgspec.structs.replace(
        recording.facts,
        speeds_mps=tuple(speeds_mps),
        moments=tuple(moments),
        choice=dict(choice),
    )
    write_whole(recording.folder / FACTS, canonical_json(msgspec.to_builtins(facts)) + "\n")
    return read(recording.folder)


@contextmanager
def _writers(folder: Path) -> Iterator[dict[str, pq.ParquetWriter]]:
    """Enter a context that yields a writer of each table, all closed in the end."""
    with ExitStack() as stack:
        writers = {}
        for file_name, schema in SCHEMAS.items():
            path = folder / file_name
            stack.enter_context(naming(path))
            writer = pq.ParquetWriter(
                path.absolute(), schema, compression="zstd", use_dictionary=file_name == TRACKS
            )
            writers[file_name] = stack.enter_context(writer)
        yield writers


def _write_scene(writers: Mapping[str, pq.ParquetWriter], scene: Scene) -> SceneFacts:
    """Append a scene to the tables, in row groups of its own, and return what is stated of it."""
    checked(scene)
    tracks = [scene.tracks[key] for key in sorted(scene.tracks)]
    lanes = [scene.lanes[key] for key in sorted(scene.lanes)]
    writers[TRACKS].write_table(_track_rows(scene.name, tracks), row_group_size=MOST_ROWS)
    lines = [(lane.id, lane.points) for lane in lanes]
    columns = [
        *_line_columns(scene.name, lines),
        [lane.width_m for lane in lanes],
        [lane.limit_mps for lane in lanes],
        [list(lane.successors) for lane in lanes],
        [lane.left for lane in lanes],
        [lane.right for lane in lanes],
    ]
    writers[LANES].write_table(_table(columns, LANES))
    if scene.houses:
        outlines = [(house.id, house.outline) for house in scene.houses]
        writers[BUILDINGS].write_table(_table(_line_columns(scene.name, outlines), BUILDINGS))
    facts: dict[str, Any] = _computed_facts(scene)
    return SceneFacts(scene.name, scene.file, scene.sha256, lights=scene.lights, **facts)


def _table(columns: Sequence[Any], file_name: str) -> pa.Table:
    schema = SCHEMAS[file_name]
    arrays = []
    for values, kind in zip(columns, schema.types, strict=True):
        arrays.append(values if isinstance(values, pa.Array) else pa.array(values, kind))
    return pa.Table.from_arrays(arrays, schema=schema)


def _line_columns(scene: str, lines: Sequence[tuple[str, Floats]]) -> list[Any]:
    """Return the columns scene, id, x_m and y_m of n lines, by id and points (m, 2)."""
    names, points = [name for name, _ in lines], [line for _, line in lines]
    x_m, y_m = [line[:, 0] for line in points], [line[:, 1] for line in points]
    return [[scene] * len(lines), names, x_m, y_m]


def _track_rows(scene: str, tracks: Sequence[Track]) -> pa.Table:
    lengths = [len(track.time_s) for track in tracks]
    poses = np.concatenate([track.poses for track in tracks])
    kinds = np.array([KINDS.index(track.kind) for track in tracks], dtype=np.int64)

    def labels(codes: Ints, names: Sequence[str]) -> pa.DictionaryArray:
        return pa.DictionaryArray.from_arrays(np.repeat(codes, lengths).astype(np.int32), names)

    columns = [
        labels(np.zeros(len(tracks), dtype=np.int64), [scene]),
        np.concatenate([track.time_s for track in tracks]),
        labels(np.arange(len(tracks)), [track.id for track in tracks]),
        labels(kinds, KINDS),
        *poses.T,
        np.repeat([track.length_m for track in tracks], lengths),
        np.repeat([track.width_m for track in tracks], lengths),
    ]
    return _table(columns, TRACKS)


def checked(scene: Scene) -> None:
    """Raise UserError, which names the scene and the first thing in it that cannot be.

    Such are positions that are no numbers, times that run back, road users of an unknown kind or
    of no size, two in one place as one of them appears, lanes without length, or too much.
    """
    where = f"scene {printable(scene.name, 60)} of {printable(scene.file, 60)}"
    problem = next(_problems(scene), None)
    if problem:
        raise UserError(f"{where}: {problem}; correct the file, or leave it out")


def _problems(scene: Scene) -> Iterator[str]:
    yield from _problems_of_numbers(scene)
    for track in scene.tracks.values():
        yield from _problems_of_track(track)
    if not 0.001 <= scene.step_s <= 10:
        yield f"a step of {scene.step_s:g} s; allowed: 0.001 to 10"
    for lane in scene.lanes.values():
        yield from _problems_of_lane(lane, scene.lanes)
    for house in scene.houses:
        yield from _problems_of_id(f"building {printable(house.id)}", house.id)
        if len(house.outline) < 3 or not _is_place(house.outline):
            yield f"building {printable(house.id)} has no outline of three points or more"
    for late, early in overlaps(list(scene.tracks.values())):
        yield (
            f"{printable(late.id)} appears at {late.begin_s:g} s "
            f"where {printable(early.id)} is already"
        )


def _problems_of_numbers(scene: Scene) -> Iterator[str]:
    if not scene.tracks:
        left_out = ", ".join(printable(reason, 80) for reason in list(scene.left_out)[:3])
        others = f"; left out: {left_out}; kinds: {', '.join(KINDS)}" if left_out else ""
        yield f"nobody moves or stands there{others or '; it needs a track'}"
    if not scene.lanes:
        yield "it has no lanes; give a map"
    rows = sum(len(track.time_s) for track in scene.tracks.values())
    points = sum(len(lane.points) for lane in scene.lanes.values())
    for amount, most, what in (
        (len(scene.tracks), MOST_TRACKS, "tracks"),
        (rows, MOST_ROWS, "poses"),
        (len(scene.lanes), MOST_LANES, "lanes"),
        (points, MOST_POINTS, "points of lanes"),
        (len(scene.houses), MOST_HOUSES, "buildings"),
    ):
        if amount > most:
            yield f"{amount} {what}; allowed: at most {most}: cut it"
    yield from _problems_of_density(scene)


def _problems_of_density(scene: Scene) -> Iterator[str]:
    """Yield what makes a scene that no machine simulates: times far apart, or a heap of lanes."""
    spans = [track.time_s[[0, -1]] for track in scene.tracks.values() if len(track.time_s)]
    ends = np.array(spans).reshape(-1, 2)
    if np.isfinite(ends).all() and len(ends):
        begin_s, end_s = float(ends.min()), float(ends.max())
        all_s = float(np.ptp(ends, axis=1).sum())
        if end_s - begin_s > LONGEST_S:
            yield (
                f"its times are from {begin_s:.10g} to {end_s:.10g} s; allowed: {LONGEST_S:g} s "
                "in all: mend a time that is unknown, or cut it into scenes"
            )
        elif all_s > LONGEST_ALL_S:
            yield f"{all_s:g} s of road users; allowed: {LONGEST_ALL_S:g}: cut it"
    begins = np.array([lane.points[0] for lane in scene.lanes.values() if len(lane.points)])
    if len(begins) > MOST_OF_CELL and _is_place(begins):
        _, counts = np.unique(np.floor(begins / CELL_M), axis=0, return_counts=True)
        if counts.max() > MOST_OF_CELL:
            yield (
                f"{counts.max()} lanes begin in a square of {CELL_M:g} m; allowed: "
                f"{MOST_OF_CELL}: leave out what are no lanes"
            )


def _is_place(points: Floats) -> bool:
    """Return whether points (n, 2) are finite, and no farther than maps have them."""
    return bool((np.abs(points) <= FARTHEST_M).all())


def _problems_of_id(which: str, text: str) -> Iterator[str]:
    if not 0 < len(text) <= LONGEST_ID:
        yield f"{which}: its id has {len(text)} characters; allowed: 1 to {LONGEST_ID}"
    if not text.isprintable():
        yield f"{which}: its id has characters that nothing can show"


def _problems_of_track(track: Track) -> Iterator[str]:
    who, times, poses = f"track {printable(track.id)}", track.time_s, track.poses
    yield from _problems_of_id(who, track.id)
    if track.kind not in KINDS:
        yield f"{who}: kind {printable(track.kind)!r}; allowed: {', '.join(KINDS)}"
    sizes = (("length_m", track.length_m, LENGTHS_M), ("width_m", track.width_m, WIDTHS_M))
    for name, value, (least, most) in sizes:
        if not least <= value <= most:
            yield f"{who}: {name} {value:g}; allowed: {least:g} to {most:g}"
    if not len(times) or poses.shape != (len(times), 4):
        yield f"{who} has no poses, or not one for each time"
        return
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        yield f"{who}: a time or pose is no number"
    elif not _is_place(poses[:, :2]):
        yield f"{who} is more than {FARTHEST_M:g} m from the origin"
    if (np.diff(times) <= 0).any():
        back = int(np.flatnonzero(np.diff(times) <= 0)[0])
        yield f"{who}: time does not rise after {times[back]:g} s"
    elif (np.abs(poses[:, 3]) > FASTEST_MPS).any():
        yield f"{who}: a speed is above {FASTEST_MPS:g} m/s"
    else:
        yield from other_movement(track)


def other_movement(track: Track) -> Iterator[str]:
    """Yield which speeds and headings of a track are not those of its movement.

    Each position is compared with that a second later. Poses are finite, and times rise.
    """
    if len(track.time_s) < 2:
        return
    who, times, poses = f"track {printable(track.id)}", track.time_s, track.poses
    beyond = np.abs(poses[:, 2]) > 2 * np.pi + EARLY_S
    if beyond.any():
        yield (
            f"{who}: heading_rad {poses[beyond, 2][0]:g}; allowed: -2 pi to 2 pi; degrees are "
            "COLUMN*0.0174533"
        )
    rows = round(BASE_S * (len(times) - 1) / (times[-1] - times[0]))
    rows = min(max(rows, 1), len(times) - 1)
    length_s = times[rows:] - times[:-rows]
    way = poses[rows:, :2] - poses[:-rows, :2]
    way_m = np.hypot(way[:, 0], way[:, 1])
    speeds = np.abs(poses[:, 3])
    driven_m = np.zeros(len(times))
    np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2, out=driven_m[1:])
    stated_mps = (driven_m[rows:] - driven_m[:-rows]) / length_s
    moved_mps = way_m / length_s
    moved = _middle(moved_mps)
    off_mps = _middle(np.abs(stated_mps - moved_mps))
    if off_mps > SPEED_SLACK_MPS + SPEED_SLACK * moved:
        yield (
            f"{who}: speed_mps {_middle(stated_mps):.3g} where its positions move at "
            f"{moved:.3g} m/s; units are likely others: km/h are COLUMN/3.6"
        )
    middle, is_course = poses[rows // 2 :][: len(way)], way_m > BASE_M
    if is_course.any():
        along = np.arctan2(way[:, 1], way[:, 0]) + np.pi * (middle[:, 3] < 0)
        turn = (along - middle[:, 2] + np.pi) % (2 * np.pi) - np.pi
        off_rad = _middle(np.abs(turn[is_course]))
        if off_rad > HEADING_SLACK:
            yield (
                f"{who}: heading_rad is {off_rad:.3g} rad off the course of its positions; units "
                "are likely others: degrees are COLUMN*0.0174533, counter-clockwise from +x"
            )


def _middle(values: Floats) -> float:
    """Return the median of values, of two middle ones the greater; NumPy's is far slower."""
    return float(np.sort(values)[len(values) // 2])


def _problems_of_lane(lane: Lane, lanes: Mapping[str, Lane]) -> Iterator[str]:
    which = f"lane {printable(lane.id)}"
    yield from _problems_of_id(which, lane.id)
    if len(lane.points) < 2 or not _is_place(lane.points):
        yield f"{which} has no centre line of two points or more"
    elif not (np.diff(lane.points, axis=0) ** 2).sum() > 1e-6:
        yield f"{which} has no length"
    if not LANE_WIDTHS_M[0] <= lane.width_m <= LANE_WIDTHS_M[1]:
        least, most = LANE_WIDTHS_M
        yield f"{which}: width_m {lane.width_m:g}; allowed: {least:g} to {most:g}"
    if lane.limit_mps is not None and not 0 < lane.limit_mps <= FASTEST_MPS:
        yield f"{which}: limit_mps {lane.limit_mps:g}; allowed: above 0 to {FASTEST_MPS:g}"
    beside = [other for other in (lane.left, lane.right) if other is not None]
    for other in (*lane.successors, *beside):
        if other == lane.id:
            yield f"{which} names itself as what is after or beside it"
        elif other not in lanes:
            yield f"{which} names lane {printable(other)}, which is not there"


def overlaps(tracks: Sequence[Track]) -> Iterator[tuple[Track, Track]]:
    """Yield each track that appears where another is at that time, by more than sensors err.

    Only its first moment is looked at. The track that began later comes first.
    """
    if not tracks:
        return
    by_begin = sorted(tracks, key=lambda track: track.begin_s)
    there = _Positions(by_begin)
    sizes = np.array([(track.length_m, track.width_m) for track in by_begin])
    for place, track in enumerate(by_begin):
        others = np.flatnonzero(there.ends_s[:place] >= track.begin_s)
        poses = there.at(others, track.begin_s)
        mine = np.repeat(track.poses[:1, :3], len(others), axis=0)
        my_sizes = np.repeat(sizes[place : place + 1], len(others), axis=0)
        apart_m = separation_m(mine, my_sizes, poses, sizes[others])
        for other in others[apart_m < -SLACK_M]:
            yield track, by_begin[other]


class _Positions:
    """Look many tracks up at one time, which `Track.at` does for one."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.begins_s = np.array([track.begin_s for track in tracks])
        self.ends_s = np.array([track.end_s for track in tracks])
        stops = np.cumsum([len(track.time_s) for track in tracks], dtype=np.int64)
        self.stops, self.starts = stops, np.append(0, stops[:-1])
        self.poses = np.concatenate([track.poses[:, :3] for track in tracks])
        # Times of one track after those of another, so that one search has its rows.
        span_s = self.ends_s.max(initial=0) - self.begins_s.min(initial=0) + 1
        self.shifts_s = np.arange(len(tracks)) * span_s
        times = [track.time_s for track in tracks]
        self.times_s = np.concatenate(times) + np.repeat(self.shifts_s, stops - self.starts)

    def at(self, which: Ints, time_s: float) -> Floats:
        """Return x_m, y_m and heading_rad at a time, (n, 3), of n tracks that are there then."""
        times_s = self.shifts_s[which] + time_s
        after = np.searchsorted(self.times_s, times_s, side="right")
        after = after.clip(self.starts[which], self.stops[which] - 1)
        before = (after - 1).clip(self.starts[which])
        length_s = self.times_s[after] - self.times_s[before]
        share = (times_s - self.times_s[before]) / np.where(length_s > 0, length_s, 1)
        step = self.poses[after] - self.poses[before]
        step[:, 2] = (step[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(self.poses[before] + share.clip(0, 1)[:, None] * step)
