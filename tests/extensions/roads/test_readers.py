"""Readers of CommonRoad, SUMO and tables: numbers worked out by hand, and files that are refused."""

import gzip
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import road_files as files

from harness.core.errors import UserError
from harness.extensions.roads import commonroad, csv_tracks, sources, sumo_files
from harness.extensions.roads.scene import Scene, checked


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def close(values: Any, *others: Any) -> bool:
    return np.allclose(values, np.array(others), atol=1e-6)


def lane(scene: Scene, key: str) -> tuple:
    one = scene.lanes[key]
    return (one.width_m, one.limit_mps, one.successors, one.left, one.right)


def test_commonroad_of_2018(tmp_path: Path) -> None:
    [scene] = commonroad.scenes(written(tmp_path, "a.xml", files.COMMONROAD_2018B))
    checked(scene)
    assert (scene.name, scene.file, scene.step_s, scene.lights) == (
        *("XXX_Hand-1_1_T-1", "a.xml", 0.5, False),
    )
    assert lane(scene, "1") == (4, 13.5, ("3",), "2", None)  # and nothing is after it at 99
    assert lane(scene, "2") == (4, None, (), None, "1")  # beside it is one of the other direction
    assert close(scene.lanes["1"].points, [0, 0], [50, 0])
    car, parked = scene.tracks["10"], scene.tracks["11"]
    assert (car.kind, car.length_m, car.width_m, car.still) == ("car", 4.5, 1.8, False)
    assert close(car.time_s, 0, 0.5)
    assert close(car.poses, [5, 0, 0.1, 10], [10, 0, 0.1, 10])  # middles of what is uncertain
    assert (parked.kind, parked.still, parked.end_s) == ("car", True, 0.5)
    missing = {"lanelet that is named and not in the file": 1}
    assert scene.left_out == {"train (a kind that none is made of)": 1, **missing}
    assert len(scene.tracks) == 2  # the ego of a planning problem is no track


def test_commonroad_of_2020(tmp_path: Path) -> None:
    [scene] = commonroad.scenes(written(tmp_path, "a.xml", files.COMMONROAD_2020A))
    checked(scene)
    assert lane(scene, "1") == (4, 8.33, (), None, None)
    assert scene.lights
    bus, walker = scene.tracks["20"], scene.tracks["21"]
    assert (bus.kind, walker.kind) == ("truck", "pedestrian")
    assert close(bus.poses[:, 3], 5, 5, 5)  # two speeds are those of the movement
    assert close(walker.length_m, 0.6)
    assert [house.id for house in scene.houses] == ["30"]
    assert close(scene.houses[0].outline, [20, 5], [25, 5], [25, 9])
    assert scene.left_out == {"car without a trajectory": 1}


def test_sumo_gives_front_bumpers_and_degrees_of_a_compass(tmp_path: Path) -> None:
    paths = [
        written(tmp_path, "j.net.xml", files.NET),
        written(tmp_path, "poly.xml", files.POLYGONS),
        written(tmp_path, "routes.xml", files.ROUTES),
    ]
    packed = tmp_path / "run1.fcd.xml.gz"
    packed.write_bytes(gzip.compress(files.FCD.encode()))
    [scene] = sumo_files.scenes(*paths, packed)
    checked(scene)
    assert (scene.name, scene.file, scene.step_s, scene.lights) == (
        *("run1", "run1.fcd.xml.gz", 0.5, True),
    )
    assert sorted(scene.lanes) == [":J_0_0", "in_1", "in_2", "out_0"]
    assert lane(scene, "in_1") == (3.2, 13.89, (":J_0_0",), "in_2", None)
    assert lane(scene, "in_2") == (3.0, 13.89, (), None, "in_1")
    assert lane(scene, ":J_0_0") == (3.2, 8, ("out_0",), None, None)
    lorry, car, walker = (scene.tracks[key] for key in "vup")
    assert (lorry.kind, lorry.length_m, lorry.width_m) == ("truck", 8, 2.4)
    assert close(lorry.poses, [8.5, 1.6, 0, 10], [13.5, 1.6, 0, 10])
    diagonal = 2.5 / np.sqrt(2)
    assert close(car.poses, [-diagonal, 4.7 - diagonal, np.pi / 4, 0])
    assert (walker.kind, walker.poses[0, 2]) == ("pedestrian", np.pi / 2)
    assert [house.id for house in scene.houses] == ["house"]
    assert scene.houses[0].outline.shape == (3, 2)
    assert scene.left_out == {
        "tram (a class of no road user)": 1,
        "building in degrees of longitude and latitude": 1,
        "lane that is not for cars": 1,
    }


def test_a_lane_without_length_is_passed_by(tmp_path: Path) -> None:
    net = files.NET.replace('shape="50,1.6 60,1.6"', 'shape="50,1.6 50,1.6"')
    road = sumo_files.map_of(written(tmp_path, "j.net.xml", net))
    assert road.lanes["in_1"].successors == ("out_0",)
    assert ":J_0_0" not in road.lanes
    assert road.left_out["lane without length"] == 1


MAPPED = "time_s=frame/25,id=track,x_m=cx*0.3048,y_m=cy*0.3048,kind=class,length_m=len,width_m=wid"


def test_a_table_is_read_by_its_declared_columns(tmp_path: Path) -> None:
    path = written(tmp_path, "t.csv", files.TRACKS)
    lanes = csv_tracks.lanes_of(written(tmp_path, "lanes.csv", files.LANES))
    houses = csv_tracks.buildings_of(written(tmp_path, "houses.csv", files.BUILDINGS))
    columns = csv_tracks.columns_of(MAPPED)
    columns = columns._replace(kinds={"2": "van"})
    [scene] = csv_tracks.scenes(path, columns=columns, lanes=lanes, houses=houses)
    checked(scene)
    assert lane(scene, "1") == (3.5, 13.9, ("3",), "2", None)
    assert close(scene.lanes["2"].points, [0, 4], [50, 4])
    car, van = scene.tracks["a"], scene.tracks["c"]
    assert close(car.poses, [0, 0, 0, 10], [10, 0, 0, 10], [20, 0, 0, 10])
    assert (car.kind, car.length_m, scene.step_s) == ("car", 4.5, 1)
    assert (van.kind, van.still) == ("van", True)
    assert (van.length_m, van.width_m) == csv_tracks.SIZES_M["van"]  # none is stated
    assert scene.left_out == {"Tram (a kind that none is made of)": 1}
    turned = csv_tracks.columns_of("time_s=frame/25,id=track,front_x_m=cy,front_y_m=cx,scene=class")
    scenes = list(csv_tracks.scenes(path, columns=turned, lanes=lanes))
    assert [scene.name for scene in scenes] == ["t-Car", "t-Tram", "t-2"]
    assert close(scenes[0].tracks["a"].poses[0], 0, -2.3, np.pi / 2, 32.8084)


def test_the_columns_can_stand_in_a_file(tmp_path: Path) -> None:
    lines = [part.replace("=", ' = "') + '"' for part in MAPPED.split(",")]
    path = written(tmp_path, "c.toml", "\n".join([*lines, "[kinds]", '2 = "van"']))
    columns = csv_tracks.columns_of(str(path))
    assert columns == csv_tracks.columns_of(MAPPED)._replace(kinds={"2": "van"})


def test_who_is_gone_for_a_while_is_another_one_after_it() -> None:
    times = np.array([0, 1, 2, 9, 10, 11.0])
    poses = np.stack([10 * times, 0 * times, np.full(6, np.nan), np.full(6, np.nan)], axis=1)
    parts = list(sources.tracks_of("a", "car", (5, 2), times, poses, 1.0))
    assert [(part.id, part.begin_s, part.end_s) for part in parts] == [("a", 0, 2), ("a~2", 9, 11)]
    poses[:] = 7
    assert len(list(sources.tracks_of("a", "car", (5, 2), times, poses, 1.0))) == 1  # it stood
    stands = np.array([[0, 0], [1, 1], [1, 1], [1, 1]])
    poses = np.column_stack([stands, np.full((4, 2), np.nan)])
    assert close(sources.moving(np.arange(4.0), poses)[:, 2], *[np.pi / 4] * 4)


ENTITY = '<!DOCTYPE commonRoad [<!ENTITY a "aaaaaaaaaa">]>'
ROOT_2018 = '<commonRoad commonRoadVersion="2018b" timeStepSize="0.1">'
POINT = "<point><x>1</x><y>2</y></point>"
BAD_COMMONROAD = {
    "it is no XML": files.COMMONROAD_2018B[:-30],
    "it has a document type": files.COMMONROAD_2018B.replace("<commonRoad", ENTITY + "<commonRoad"),
    "version '2017a'; allowed: 2018b or 2020a": files.COMMONROAD_2018B.replace("2018b", "2017a"),
    "timeStepSize 0; allowed": files.COMMONROAD_2018B.replace('"0.5"', '"0"'),
    "two lanelets have the id 1": files.COMMONROAD_2018B.replace(
        'lanelet id="2"', 'lanelet id="1"'
    ),
    "two obstacles have the id 10": files.COMMONROAD_2018B.replace(
        'obstacle id="11"', 'obstacle id="10"'
    ),
    "obstacle 10: could not convert": files.COMMONROAD_2018B.replace("<x>5</x>", "<x>five</x>"),
    "obstacle 11: it has no shape": files.COMMONROAD_2018B.replace(
        "<rectangle><length>4</length><width>2</width></rectangle>", ""
    ),
    "lanelet 3: a bound has fewer": files.COMMONROAD_2018B.replace(
        "<point><x>99</x><y>2</y></point>", ""
    ),
    "obstacle 11: its rectangle has a length or width": files.COMMONROAD_2018B.replace(
        "<length>4</length>", "<length>-4</length>"
    ),
    "stand more than 50 in one another": ROOT_2018
    + "<lanelet>" * 60
    + "</lanelet>" * 60
    + "</commonRoad>",
    "it is no XML: no element found": "",
}


@pytest.mark.parametrize("words", BAD_COMMONROAD)
def test_a_wrong_commonroad_file_is_refused_in_one_line(words: str, tmp_path: Path) -> None:
    path = written(tmp_path, "a.xml", BAD_COMMONROAD[words])
    refused(words, lambda: list(commonroad.scenes(path)))


def refused(words: str, read: Callable[[], object]) -> None:
    with pytest.raises(UserError) as refusal:
        read()
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_too_many_lanelets_are_refused_before_they_fill_memory(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(commonroad, "MOST_LANES", 2)
    path = written(tmp_path, "a.xml", files.COMMONROAD_2018B)
    refused("lanelet 3: more than 2 lanelets: cut the map", lambda: list(commonroad.scenes(path)))
    monkeypatch.setattr(sources, "MOST_OF_ELEMENT", 1000)
    monkeypatch.setattr(sources, "CHUNK", 100)
    big = ROOT_2018 + "<lanelet>" + POINT * 99 + "</lanelet></commonRoad>"
    path = written(tmp_path, "a.xml", big)
    refused("one element has more than 0 MB", lambda: list(commonroad.scenes(path)))


def test_a_gzip_bomb_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.xml.gz"
    path.write_bytes(gzip.compress(b"<fcd-export>" + b" " * (20 << 20) + b"</fcd-export>"))
    refused("it unpacks to more than such files do", lambda: list(sources.elements(path)))


BAD_SUMO = {
    "no file is a net of SUMO": {"net": files.ROUTES},
    "no file has the positions": {"fcd": files.NET},
    "two lanes have the id in_1": {"net": files.NET.replace('"in_2"', '"in_1"')},
    "could not convert string to float: 'x'": {"net": files.NET.replace("50,4.7,1", "x,4.7")},
    "time 0.5 does not rise": {"fcd": files.FCD.replace('"0.00"', '"0.50"')},
    "time nan does not rise": {"fcd": files.FCD.replace('"0.00"', '"nan"')},
    "v is twice at 0 s": {"fcd": files.FCD.replace('"tram" x', '"v" x')},
    "a row has no angle": {"fcd": files.FCD.replace("angle", "turn")},
    "a road user stands before": {"fcd": files.FCD.replace("timestep", "step")},
    "nobody is near the net": {
        "net": files.NET.replace('shape="', 'shape="1e6,1e6 ')
        .replace(" 0,", " 1e6,")
        .replace(" 50,", " 1e6,")
        .replace(" 60,", " 1e6,")
        .replace(" 100,", " 1e6,")
    },
    "vType lorry: could not convert": {"further": files.ROUTES.replace('"8"', '"long"')},
    "poly house: ": {"further": files.POLYGONS.replace("20,10 30,10", "a,b")},
}


@pytest.mark.parametrize("words", BAD_SUMO)
def test_wrong_files_of_sumo_are_refused_in_one_line(words: str, tmp_path: Path) -> None:
    texts = {"net": files.NET, "fcd": files.FCD, "further": files.ROUTES} | BAD_SUMO[words]
    paths = [written(tmp_path, f"{name}.xml", text) for name, text in texts.items()]
    refused(words, lambda: [checked(scene) for scene in sumo_files.scenes(*paths)])


BAD_COLUMNS = {
    "'x_m' is no NAME=COLUMN": "time_s=frame,x_m",
    "unknown column in --columns 'tims_s'; did you mean 'time_s'": "tims_s=frame,x_m=cx,y_m=cy,id=track",
    "--columns: id is missing": "time_s=frame,x_m=cx,y_m=cy",
    "give one of x_m and front_x_m": "time_s=frame,id=track,x_m=cx,front_x_m=cx,y_m=cy",
    "unknown column of t.csv, for x_m, 'cz'; known: class, cx": "time_s=frame,id=track,x_m=cz,y_m=cy",
    "a has two rows at 0 s": "time_s=cy,id=track,x_m=cx,y_m=cy",
    "for time_s, 'frame/0'": "time_s=frame/0,id=track,x_m=cx,y_m=cy",
    "column track: Failed to parse": "time_s=track,id=track,x_m=cx,y_m=cy",
}


@pytest.mark.parametrize("words", BAD_COLUMNS)
def test_wrong_columns_are_refused_in_one_line(words: str, tmp_path: Path) -> None:
    path = written(tmp_path, "t.csv", files.TRACKS)

    def read() -> object:
        columns = csv_tracks.columns_of(BAD_COLUMNS[words])
        return list(csv_tracks.scenes(path, columns=columns, lanes={}))

    refused(words, read)


SIZES = {
    "Car,-4.5": "a has length_m -4.5; allowed: above 0, or none for 4.6",
    "Car,0": "a has length_m 0; allowed",
    "bicycle,0": 1.8,  # as some recordings have it
    "pedestrian,": 0.4,
}


@pytest.mark.parametrize("text", SIZES)
def test_a_size_that_is_none_is_refused_and_an_unknown_one_is_usual(
    text: str, tmp_path: Path
) -> None:
    rows = files.TRACKS.replace("a,Car,", "a,KIND,").replace(",4.5,1.8", ",SIZE,1.8")
    kind, size = text.split(",")
    path = written(tmp_path, "t.csv", rows.replace("KIND", kind).replace("SIZE", size))
    columns = csv_tracks.columns_of(MAPPED)._replace(kinds={"2": "van"})
    expected = SIZES[text]
    if isinstance(expected, str):
        refused(expected, lambda: list(csv_tracks.scenes(path, columns=columns, lanes={})))
    else:
        [scene] = csv_tracks.scenes(path, columns=columns, lanes={})
        assert scene.tracks["a"].length_m == expected


HEAD = files.TRACKS.split("\n")[0]
BAD_TABLES = {
    "unknown column of t.csv": "",
    "it has no rows": HEAD,
    "CSV parse error": HEAD + "\n0,a\n",
    "two of its columns have one name": HEAD.replace("wid", "cx"),
}


@pytest.mark.parametrize("words", BAD_TABLES)
def test_a_table_that_is_none_is_refused(words: str, tmp_path: Path) -> None:
    path = written(tmp_path, "t.csv", BAD_TABLES[words])
    columns = csv_tracks.columns_of("time_s=frame,id=track,x_m=cx,y_m=cy")
    refused(words, lambda: list(csv_tracks.scenes(path, columns=columns, lanes={})))


def test_a_wrong_table_of_lanes_is_refused(tmp_path: Path) -> None:
    for new, words in {
        "3,fifty,0,,,,,": "could not convert string to float: 'fifty'",
        "3,50,0,wide,,,,": "width_m 'wide' is no number",
        "3,50,0,,,,,\n1,0,0,,,,,": "two lanes have the id 1",
    }.items():
        path = written(tmp_path, "l.csv", files.LANES.replace("3,50,0,,,,,", new))
        with pytest.raises(UserError, match=words):
            csv_tracks.lanes_of(path)


def test_nobody_reads_on_when_rows_are_refused() -> None:
    """A thread that reads ahead would call Python while it ends, which aborts it."""
    with csv_tracks._Raw(io.BytesIO(b"0123456789")) as raw:
        assert raw.read(4) == b"0123"
    assert raw.read(4) == b""
