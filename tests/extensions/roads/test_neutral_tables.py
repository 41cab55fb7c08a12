"""Recordings: what is written is read, and what cannot be is refused in one line."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.extensions.roads import tables
from harness.extensions.roads.scene import KINDS, House, Lane, Scene, Track, checked
from harness.extensions.roads.tables import Moment

SHA = "0" * 64


def straight(key: str, x_m: float, speed_mps: float, y_m: float = 0.0, **changed: Any) -> Track:
    """Return a car that drives to the east for three seconds, a pose a second."""
    time_s = np.arange(4.0)
    poses = np.stack([x_m + speed_mps * time_s, *np.full((2, 4), 0.0), np.full(4, speed_mps)], 1)
    poses[:, 1] = y_m
    return replace(Track(key, "car", 5.0, 2.0, time_s, poses), **changed)


def road(**changed: Any) -> Scene:
    """Return a road of two lanes of one direction, with two cars, one parked, and a house."""
    west, east = np.array([[0.0, 0.0], [100.0, 0.0]]), np.array([[0.0, 4.0], [100.0, 4.0]])
    lanes = {
        "1": Lane("1", west, 4.0, 13.9, (), "2", None),
        "2": Lane("2", east, 4.0, None, (), None, "1"),
    }
    tracks = {"a": straight("a", 0.0, 10.0), "b": straight("b", 50.0, 0.0, 4.0)}
    house = House("h", np.array([[10.0, 10.0], [20.0, 10.0], [20.0, 20.0]]))
    return replace(Scene("s", "s.xml", SHA, False, tracks, lanes, (house,)), **changed)


def written(folder: Path, *scenes: Scene, moments: Any = ()) -> tables.Recording:
    return tables.write(folder, "mine", "drawn", "mine", 80.0, scenes, moments, {"rule": "none"})


def test_a_track_between_its_poses() -> None:
    turning = np.array([[0.0, 0.0, 3.0, 1.0], [2.0, 4.0, -3.0, 3.0]])
    track = Track("a", "car", 5.0, 2.0, np.array([1.0, 2.0]), turning)
    assert np.allclose(track.at(1.25), [0.5, 1.0, 3.0 + (2 * np.pi - 6) / 4, 1.5])
    assert track.at(0.9) is None
    assert track.at(2.1) is None
    assert np.allclose(track.at(2.0), turning[1])
    assert [straight("a", 0, 10).still, straight("a", 0, 0).still] == [False, True]


def test_a_recording_is_read_as_it_was_written(tmp_path: Path) -> None:
    scene, moment = road(), Moment("s", "a", 1.0, "b", 2.5, "report")
    empty = replace(scene, name="t", houses=())
    recording = written(tmp_path, scene, empty, moments=[moment])
    assert recording.moments == (moment,)
    assert (recording.name, recording.source, recording.licence) == ("mine", "drawn", "mine")
    assert (recording.scene("s").begin_s, recording.scene("s").end_s) == (0, 3)
    for source in (scene, empty):
        same(recording.scene(source.name), source)
    with pytest.raises(UserError, match="no scene nowhere"):
        recording.scene("nowhere")


def same(read: Scene, scene: Scene) -> None:
    assert (read.name, read.file, read.sha256, read.step_s, read.lights) == (
        *(scene.name, scene.file, scene.sha256, scene.step_s, scene.lights),
    )
    for kind in ("tracks", "lanes"):
        things, others = getattr(read, kind), getattr(scene, kind)
        assert list(things) == sorted(others)
        for key, thing in things.items():
            for name, value in vars(others[key]).items():
                assert np.array_equal(vars(thing)[name], value), name
    for house, other in zip(read.houses, scene.houses, strict=True):
        assert house.id == other.id
        assert np.array_equal(house.outline, other.outline)


NAMES = st.text(min_size=1, max_size=5).filter(str.isprintable)
NUMBERS = st.floats(-1e6, 1e6)


@st.composite
def drawn(draw: Callable[..., Any]) -> Scene:
    """Draw a scene: tracks far from each other, any ids, any number of poses."""
    tracks = {}
    for place, key in enumerate(draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))):
        n = draw(st.integers(1, 5))
        poses = np.array(draw(st.lists(NUMBERS, min_size=4 * n, max_size=4 * n))).reshape(n, 4)
        poses[:, :2] = place * 100.0, poses[0, 1]
        poses[:, 2:] *= np.pi / 1e6, 1e-6
        kind = draw(st.sampled_from(KINDS))
        begin_s = draw(st.floats(-1e3, 1e3))
        tracks[key] = Track(key, kind, 4.0, 2.0, begin_s + np.arange(n) / 10, poses)
    lanes = {}
    names = draw(st.lists(NAMES, min_size=2, max_size=4, unique=True))
    for key in names:
        points = np.cumsum(draw(st.lists(st.floats(1, 9), min_size=4, max_size=8)))
        line = points[: len(points) // 2 * 2].reshape(-1, 2)
        others = [other for other in names if other != key]
        beside = draw(st.sampled_from([None, *others]))
        limit = draw(st.none() | st.floats(1, 50))
        lanes[key] = Lane(key, line, 3.5, limit, tuple(others[:2]), beside, None)
    return Scene("s", "f", SHA, draw(st.booleans()), tracks, lanes)


@settings(max_examples=20)
@given(drawn())
def test_any_scene_is_read_as_it_was_written(tmp_path_factory: Any, scene: Scene) -> None:
    same(written(tmp_path_factory.mktemp("r"), scene).scene("s"), scene)


def poses(**changed: float) -> dict[str, Track]:
    track = straight("a", 0.0, 10.0)
    for name, value in changed.items():
        track.poses[1, tables.POSES.index(name)] = value
    return {"a": track}


def moves(at_mps: float = 10.0, **columns: float) -> Track:
    """Return a car that drives to the east, with other values in some columns of all its poses."""
    track = straight("a", 0.0, at_mps)
    for name, value in columns.items():
        track.poses[:, tables.POSES.index(name)] = value
    return track


@pytest.mark.parametrize(
    "columns",
    [
        {"speed_mps": 13.4},
        {"speed_mps": 6.6},
        {"heading_rad": 1.0},
        {"heading_rad": 2 * np.pi - 1},
        {"heading_rad": np.pi, "speed_mps": -10},
    ],
)
def test_what_sensors_err_by_is_taken(columns: dict[str, float]) -> None:
    checked(road(tracks={"a": moves(**columns)}))


LINE = np.array([[0.0, 0.0], [9.0, 0.0]])
WRONG: dict[str, dict[str, Any]] = {
    "a time or pose is no number": {"tracks": poses(x_m=np.nan)},
    "is more than 1e+08 m from": {"tracks": poses(y_m=1e9)},
    "a speed is above 120 m/s": {"tracks": poses(speed_mps=500)},
    "track a: speed_mps 36 where its positions move at 10 m/s; units": {
        "tracks": {"a": moves(speed_mps=36)}
    },
    "speed_mps 0 where its positions move at 10": {"tracks": {"a": moves(speed_mps=0)}},
    "speed_mps 5 where its positions move at 0": {"tracks": {"a": moves(0, speed_mps=5)}},
    "heading_rad 90; allowed: -2 pi to 2 pi; degrees are": {"tracks": {"a": moves(heading_rad=90)}},
    "heading_rad is 2 rad off the course": {"tracks": {"a": moves(heading_rad=-2)}},
    "heading_rad is 3.14 rad off the course": {
        "tracks": {"a": moves(heading_rad=0, speed_mps=-10)}
    },
    "time does not rise after 0 s": {"tracks": {"a": straight("a", 0, 1, time_s=np.zeros(4))}},
    "kind 'tram'; allowed: car, van": {"tracks": {"a": straight("a", 0, 1, kind="tram")}},
    "length_m 0; allowed: 0.1 to 60": {"tracks": {"a": straight("a", 0, 1, length_m=0.0)}},
    "b appears at 0 s where a is already": {
        "tracks": {"a": straight("a", 0, 1), "b": straight("b", 3, 1)}
    },
    "nobody moves or stands there": {"tracks": {}},
    "there; left out: dragon (a kind that none is made of); kinds: car, van": {
        "tracks": {},
        "left_out": {"dragon (a kind that none is made of)": 2},
    },
    "lane 1 names itself": {"lanes": {"1": Lane("1", LINE, 4, None, ("1",), None, None)}},
    "it has no lanes": {"lanes": {}},
    "lane 1 has no length": {"lanes": {"1": Lane("1", 0 * LINE, 4, None, (), None, None)}},
    "lane 1: width_m 0": {"lanes": {"1": Lane("1", LINE, 0, None, (), None, None)}},
    "lane 1 names lane 9": {"lanes": {"1": Lane("1", LINE, 4, None, ("9",), None, None)}},
    "building h has no outline": {"houses": (House("h", LINE),)},
    "its id has 0 characters": {"tracks": {"": straight("", 0, 1)}},
    "track \\x1b: its id has characters that nothing can show": {
        "tracks": {"\x1b": straight("\x1b", 0, 1)}
    },
    "a step of 20 s": {"tracks": {"a": straight("a", 0, 1, time_s=20 * np.arange(4.0))}},
    "its times are from 0 to 1000000000 s; allowed: 1e+06 s": {
        "tracks": {"a": straight("a", 0, 1, time_s=np.array([0.0, 1, 2, 1e9]))}
    },
    "4e+06 s of road users; allowed: 3e+06": {
        "tracks": {
            key: straight(key, 9.0 * n, 1, time_s=np.array([0.0, 1, 2, 1e6]))
            for n, key in enumerate("abcd")
        }
    },
    "1001 lanes begin in a square of 100 m; allowed: 1000": {
        "lanes": {f"{n}": Lane(f"{n}", LINE, 4, None, (), None, None) for n in range(1001)}
    },
}


@pytest.mark.parametrize("words", WRONG)
def test_a_scene_that_cannot_be_is_refused_in_one_line(words: str) -> None:
    with pytest.raises(UserError) as refusal:
        checked(road(**WRONG[words]))
    assert words in str(refusal.value)
    assert "scene s of s.xml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


EDITS = {
    "step_s": ('"step_s":1.0', '"step_s":"x"'),
    "name ../x; allowed": ('"name":"mine"', '"name":"../x"'),
    "is no JSON": ("}", ""),
    "two scenes have one name": (
        '"scenes":[{',
        '"scenes":[{"begin_s":0,"end_s":0,"file":"f","lanes":1,"lights":false,"name":"s","sha256":"'
        + SHA
        + '","step_s":1,"tracks":1},{',
    ),
    "a moment is of scene nowhere": (
        '"moments":[',
        '"moments":[{"scene":"nowhere","vehicle":"a","time_s":0,"hidden":null,"conflict_s":null,"purpose":"report"}',
    ),
    "unknown purpose of a moment": (
        '"moments":[',
        '"moments":[{"scene":"s","vehicle":"a","time_s":0,"hidden":null,"conflict_s":null,"purpose":"mine"}',
    ),
    "speeds_mps do not rise": ('"speeds_mps":[0.0', '"speeds_mps":[9.0'),
    "scene s states tracks 9; its tables give 2": ('"tracks":2', '"tracks":9'),
    "scene s states lanes 9; its tables give 2": ('"lanes":2', '"lanes":9'),
    "scene s states step_s 0.001; its tables give 1": ('"step_s":1.0', '"step_s":0.001'),
    "scene s states begin_s -1; its tables give 0": ('"begin_s":0.0', '"begin_s":-1.0'),
    "scene s states end_s 9; its tables give 3": ('"end_s":3.0', '"end_s":9.0'),
}


@pytest.mark.parametrize("words", EDITS)
def test_a_recording_that_was_edited_is_refused(words: str, tmp_path: Path) -> None:
    written(tmp_path, road())
    facts = tmp_path / "recording.json"
    old, new = EDITS[words]
    assert old in facts.read_text()
    facts.write_text(facts.read_text().replace(old, new))
    with pytest.raises(UserError) as refusal:
        list(tables.read(tmp_path).scenes())
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_folder_with_other_tables_is_refused(tmp_path: Path) -> None:
    written(tmp_path, road())
    (tmp_path / "lanes.parquet").write_bytes((tmp_path / "buildings.parquet").read_bytes())
    with pytest.raises(UserError, match=r"lanes\.parquet: its digest is"):
        tables.read(tmp_path).scene("s")
    with pytest.raises(UserError, match=r"is no recording: it has no recording\.json"):
        tables.read(tmp_path / "nowhere")


def rewritten(folder: Path, file_name: str, table: pa.Table, **how: Any) -> None:
    """Replace a table of a recording, and state its digest."""
    pq.write_table(table, folder / file_name, **how)
    facts = json.loads((folder / "recording.json").read_text())
    facts["files"][file_name] = sha256_file(folder / file_name)
    (folder / "recording.json").write_text(json.dumps(facts))


def lanes_with(**columns: Any) -> pa.Table:
    """Return the table of one lane, with some columns changed."""
    line = {"x_m": [[0.0, 9.0]], "y_m": [[0.0, 0.0]], "width_m": [4.0], "limit_mps": [None]}
    beside = {"successors": [[]], "left": [None], "right": [None]}
    whole = {"scene": ["s"], "id": ["1"], **line, **beside, **columns}
    return pa.table(whole, schema=tables.SCHEMAS["lanes.parquet"])


def many(rows: int) -> pa.Table:
    """Return so many equal rows of tracks."""
    schema = tables.SCHEMAS["tracks.parquet"]
    kinds = [pa.string() if kind == tables.LABEL else kind for kind in schema.types]
    return pa.table(
        [
            pa.repeat(pa.scalar("s" if kind == pa.string() else 0.0), rows).cast(kind)
            for kind in kinds
        ],
        names=schema.names,
    )


HOSTILE: dict[str, Callable[[Path], None]] = {
    "packed so that few bytes may be many values": lambda folder: rewritten(
        folder, "lanes.parquet", lanes_with(), use_dictionary=True
    ),
    "its columns are id, x_m": lambda folder: rewritten(
        folder, "lanes.parquet", lanes_with().drop_columns("scene"), use_dictionary=False
    ),
    "lane 1 names lane None": lambda folder: rewritten(
        folder, "lanes.parquet", lanes_with(successors=[[None]]), use_dictionary=False
    ),
    "lane 1 has no centre line": lambda folder: rewritten(
        folder, "lanes.parquet", lanes_with(x_m=[[None, 1.0]]), use_dictionary=False
    ),
    "line 1 has another number of x_m": lambda folder: rewritten(
        folder, "lanes.parquet", lanes_with(x_m=[[1.0]]), use_dictionary=False
    ),
    "scene s has more than 100 rows": lambda folder: rewritten(folder, "tracks.parquet", many(101)),
    "track s: kind 's'; allowed: car": lambda folder: rewritten(folder, "tracks.parquet", many(9)),
    "x_m is unknown in some rows": lambda folder: rewritten(
        folder, "tracks.parquet", many(2).set_column(4, "x_m", pa.array([None, 1.0]))
    ),
}


@pytest.mark.parametrize("words", HOSTILE)
def test_tables_of_a_stranger_are_refused_in_one_line(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path, road())
    monkeypatch.setattr(tables, "MOST_ROWS", 100)
    HOSTILE[words](tmp_path)
    with pytest.raises(UserError) as refusal:
        tables.read(tmp_path).scene("s")
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
