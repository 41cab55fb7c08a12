"""Recorded or simulated traffic as one neutral table: what a recording's folder holds."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
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
from harness.extensions.roads.scene import (
    FASTEST_MPS,
    KINDS,
    LONGEST_ID,
    MOST_LANES,
    MOST_ROWS,
    MOST_TRACKS,
    House,
    Lane,
    Scene,
    Track,
    checked,
)

FORMAT: Literal["swarmdrive-recording/2"] = "swarmdrive-recording/2"
FORMER: Literal["swarmdrive-recording/1"] = "swarmdrive-recording/1"  # drew by digests of files
FACTS = "recording.json"
MOST_SCENES, MOST_MOMENTS = 10_000, 1_000_000
LONGEST_TEXT = 1000  # characters of a licence and a source
WORDS = re.compile(r"[a-z0-9][a-z0-9._-]{0,79}")  # of a recording's name, which scenarios have
Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_ID)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


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

    format: Literal["swarmdrive-recording/1", "swarmdrive-recording/2"]
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
    def is_former(self) -> bool:
        """Return whether its moments were drawn by what it states of its files."""
        return self.facts.format == FORMER

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
    try:
        tracks_by_id = _tracks_of(tracks)
    except ValueError as error:
        raise _broken(recording.folder / TRACKS, str(error)) from None
    scene = Scene(
        name,
        facts.file,
        facts.sha256,
        facts.lights,
        tracks_by_id,
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
    """Return the tracks of a scene's rows, which stand together, each in the order of time.

    Raises ValueError where those of one do not.
    """
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
            raise ValueError(f"the rows of track {printable(key)} do not stand together")
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
        lacks = isinstance(error, FileNotFoundError)
        reason = f"it has no {FACTS}" if lacks else one_line(error)
        raise UserError(
            f"{printable(folder)} is no recording: {reason}; make one: "
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
