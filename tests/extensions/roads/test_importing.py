"""`harness dataset import` as typed: what is taken, what is left out, and what is refused."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import road_files as files

from harness.cli.progress import Bar, bar
from harness.core.errors import UserError
from harness.core.progress import Progress
from harness.extensions.roads import fitness, importing, moments, tables
from harness.extensions.roads.csv_tracks import columns_of
from harness.extensions.roads.importing import Sources, kind_of
from harness.extensions.roads.scene import Lane, Scene, Track, checked
from harness.extensions.roads.tables import Moment

Said = tuple[int, str, str]
FILES = {
    "hand-1.xml": files.COMMONROAD_2018B,
    "hand-2.cr": files.COMMONROAD_2020A,
    "my.net.xml": files.NET,
    "my.fcd.xml": files.FCD,
    "my.rou.xml": files.ROUTES,
    "my.poly.xml": files.POLYGONS,
    "tracks.csv": files.TRACKS,
    "lanes.csv": files.LANES,
    "houses.csv": files.BUILDINGS,
}
NOBODY = re.sub(r"<obstacle.*</obstacle>", "", files.COMMONROAD_2018B, flags=re.DOTALL)
COLUMNS = "time_s=frame/25,id=track,x_m=cx*0.3048,y_m=cy*0.3048,kind=class"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Return a folder with a file of each kind, and one of none."""
    folder = tmp_path / "files"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    (folder / "README.md").write_text("where this is from\n")
    return folder


def test_what_stands_in_a_file_says_what_it_is(source: Path) -> None:
    kinds = ("commonroad",) * 2 + (
        "sumo",
        "positions",
        "sumo",
        "sumo",
        "tracks",
        "lanes",
        "buildings",
    )
    assert tuple(kind_of(source / name) for name in FILES) == kinds


def test_a_folder_of_files_is_a_recording(harness: Callable[..., Said], source: Path) -> None:
    for name in ("tracks.csv", "lanes.csv", "houses.csv"):
        (source / name).unlink()
    for name in ("empty.xml", "void.xml"):
        (source / name).write_text(NOBODY)
    code, out, err = harness("dataset", "import", source, "--out", "mine", "--licence", "CC0-1.0")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "wrote mine: 3 scenes of 0.0 minutes, 7 road users, 8 lanes",
        "road users: 3 cars, 2 trucks, 2 pedestrians; 4 of them never move",
        "traffic lights: in 2 of 3 scenes, and their signals are not known",
        "left out: 3 lanelet that is named and not in the file; 2 scene without road",
        "  users; 1 file of another kind; 5 for other reasons",
        "files without road users or lanes: empty.xml and void.xml",
        "episodes: 80 m around the ego, 4 decisions, target speeds 0, 5 and 10 m/s",
        *out.splitlines()[7:],
    ]
    assert len(out.splitlines()) <= 15
    recording = tables.read(Path("mine"))
    assert [scene.file for scene in recording.scenes_stated] == [
        *("my.fcd.xml", "hand-1.xml", "hand-2.cr"),
    ]
    reason = "scene without road users"
    assert recording.choice["files_left_out"] == {"empty.xml": reason, "void.xml": reason}
    assert recording.licence == "CC0-1.0"
    assert recording.scene("my").lights
    code, _, err = harness("dataset", "import", source, "--out", "mine", "--licence", "CC0-1.0")
    assert (code, err.count("\n")) == (2, 1)
    assert "--out mine is there already" in err


STREET = Path(__file__).parent / "street"


def test_a_street_whose_moments_are_known(
    harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every 10 s a car from the south is 1.6 s, then 5 s before one from the west, behind a house.

    Where it is 1.6 s each of the two is hidden from the other, and in conflict with it.
    """
    read_so_far: list[str] = []

    @contextmanager
    def watched(label: str, *given: Any, **named: Any) -> Iterator[Bar]:
        with bar(label, *given, **named) as progress:
            yield progress
        read_so_far.append(progress.spent())

    monkeypatch.setattr(importing, "bar", watched)
    code, out, err = harness("dataset", "import", STREET, "--out", "my", "--licence", "CC0-1.0")
    assert (code, err) == (0, "")
    assert list(filter(None, read_so_far)) == ["0.1 MB"]  # the header, the form and all rows
    assert "wrote my: 1 scene of 3.0 minutes, 38 road users, 4 lanes" in out
    assert "32 cars, 4 vans, 1 truck, 1 pedestrian; 1 of them never move" in out
    assert len(out.splitlines()) <= 15
    assert out.splitlines()[-2].startswith("next: harness dataset build --recording my --episodes")
    recording = tables.read(Path("my"))
    conflicts = [{moment.vehicle, moment.hidden} for moment in recording.moments if moment.hidden]
    assert all(pair in [{f"east{k}", f"north{k}"} for k in range(0, 16, 2)] for pair in conflicts)
    assert len(conflicts) == len(recording.moments) / 2 > 0
    assert recording.choice["horizon_s"] == 6


@pytest.mark.slow
def test_who_reaches_the_goal_is_judged_with_the_speeds_that_the_ego_will_have(
    harness: Callable[..., Said], source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("tracks.csv", "lanes.csv", "houses.csv"):
        (source / name).unlink()
    choose_fit, judged = fitness.choose_fit, []

    def watched(recording: tables.Recording, *given: Any) -> moments.Choice:
        judged.append(recording.speeds_mps)
        return choose_fit(recording, *given)

    monkeypatch.setattr(fitness, "choose_fit", watched)
    monkeypatch.setattr(importing._Taken, "targets_mps", lambda taken: (0.0, 7.0, 14.0))
    command = ("dataset", "import", source, "--out", "mine", "--licence", "CC0-1.0")
    assert harness(*command)[0] == 0
    assert judged == [tables.read(Path("mine")).speeds_mps] == [(0.0, 7.0, 14.0)]


@pytest.mark.slow
def test_a_table_with_its_map_and_a_picture(harness: Callable[..., Said], source: Path) -> None:
    given = [source / name for name in ("tracks.csv", "lanes.csv", "houses.csv")]
    more = ("--columns", COLUMNS, "--show", "mine.svg", "--json", "--licence", "unknown")
    code, out, err = harness("dataset", "import", *given, "--out", "mine", *more)
    assert (code, err) == (0, "")
    said = json.loads(out)
    assert said["road_users"] == {"car": 1}
    assert said["left_out"] == {
        "Tram (a kind that none is made of)": 1,
        "2 (a kind that none is made of)": 1,
    }
    assert said["licence"] == "unknown"
    picture = Path("mine.svg").read_text()
    for words in ("mine: 1 scene", "tracks: 1 road user, 0 to 2 s", "m to the east", ">car<"):
        assert words in picture


def scene_of(tracks: int, places_m: float) -> Scene:
    """Return cars that stand side by side, so many metres from each other."""
    points = np.array([[0.0, 0.0], [9.0, 0.0]])
    cars = {}
    for n in range(tracks):
        poses = np.array([[0.0, n * places_m, 0.0, 0.0]])
        cars[f"{n:02}"] = Track(f"{n:02}", "car", 4, 2, np.array([0.0]), poses)
    lanes = {"1": Lane("1", points, 4, None, (), None, None)}
    return Scene("s", "s.xml", "0" * 64, False, cars, lanes)


def test_a_few_that_appear_where_others_are_are_left_out() -> None:
    scene = scene_of(10, 3)
    first = replace(scene.tracks["00"], id="again")
    doubled = replace(scene, tracks={**scene.tracks, "again": first})
    whole = importing.without_few(doubled)
    assert len(whole.tracks) == 10
    assert whole.left_out == {"appears where another is": 1}
    checked(whole)
    fast = replace(first, id="again", time_s=np.arange(2.0), poses=np.array([[9, 99, 0, 36.0]] * 2))
    whole = importing.without_few(replace(scene, tracks={**scene.tracks, "again": fast}))
    assert whole.left_out == {"states another speed or heading than it moves with": 1}
    crowd = importing.without_few(scene_of(10, 1))
    with pytest.raises(UserError, match="01 appears at 0 s where 00 is already"):
        checked(crowd)


WRONG: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "--licence is missing": (("hand-1.xml",), ()),
    "unknown --show, a file that ends in '.gif'": (
        ("hand-1.xml",),
        ("--licence", "x", "--show", "a.gif"),
    ),
    "--show /proc/a.svg cannot be written": (
        ("hand-1.xml",),
        ("--licence", "x", "--show", "/proc/a.svg"),
    ),
    "--show mine/a.svg is in --out mine": (
        ("hand-1.xml",),
        ("--licence", "x", "--show", "mine/a.svg"),
    ),
    "--show files/tracks.svg is there already; give a new path": (
        ("hand-1.xml",),
        ("--licence", "x", "--show", "files/tracks.svg"),
    ),
    "--window 5 is out of range": (("hand-1.xml",), ("--licence", "x", "--window", "5")),
    "--name '../x'; allowed: small letters": (
        ("hand-1.xml",),
        ("--licence", "x", "--name", "../x"),
    ),
    "--licence `a\\n": (("hand-1.xml",), ("--licence", "a\nb")),
    "README.md: its first line names no columns": (("README.md",), ("--licence", "x")),
    "no file has the positions of SUMO's vehicles": (("my.net.xml",), ("--licence", "x")),
    "no file is a net of SUMO": (("my.fcd.xml",), ("--licence", "x")),
    "tables of tracks need one map": (("tracks.csv", "--columns", COLUMNS), ("--licence", "x")),
    "no file has road users": (("lanes.csv",), ("--licence", "x")),
    "nobody moves or stands there; left out: lanelet that is named": (
        ("nobody.xml",),
        ("--licence", "x"),
    ),
    "torn.xml: it is no XML": (("hand-1.xml", "nobody.xml", "torn.xml"), ("--licence", "x")),
    "10: a time or pose is no number": (("hand-1.xml", "nan.xml"), ("--licence", "x")),
    "nowhere.xml: No such file": (("nowhere.xml",), ("--licence", "x")),
    "unknown column of tracks.csv, for time_s": (("tracks.csv", "lanes.csv"), ("--licence", "x")),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_command_writes_nothing(
    words: str, harness: Callable[..., Said], source: Path
) -> None:
    given, more = WRONG[words]
    typed = [source / each if "." in each and "=" not in each else each for each in given]
    broken = files.COMMONROAD_2018B.replace("<x>5</x>", "<x>nan</x>")
    more_files = {"nobody.xml": NOBODY, "nan.xml": broken, "torn.xml": broken[:-20]}
    for name, text in {**more_files, "tracks.svg": "of another day"}.items():
        (source / name).write_text(text)
    code, _, err = harness("dataset", "import", *typed, "--out", "mine", *more)
    assert (code, err.count("\n")) == (2, 1), err
    assert (source / "tracks.svg").read_text() == "of another day"
    assert words in err
    assert sorted(path.name for path in source.parent.iterdir()) == ["files"]


@pytest.mark.parametrize(
    ("names", "others"),
    [
        (("tracks.csv", "tracksMeta.csv", "recordingMeta.csv", "lanes.csv"), 2),
        (("tracksMeta.csv", "lanes.csv"), "no file has road users (left out: file"),
    ],
)
def test_a_folder_may_have_tables_of_other_things(
    names: tuple[str, ...], others: int | str, tmp_path: Path
) -> None:
    metas = {
        "tracksMeta.csv": "recordingId,track,initialFrame,width,length,class\n0,0,0,2,4,car\n",
        "recordingMeta.csv": "recordingId,locationId,frameRate,weekday\n0,4,25,monday\n",
    }
    for name in names:
        (tmp_path / name).write_text({**FILES, **metas}[name])
    if isinstance(others, str):
        with pytest.raises(UserError) as refusal:
            Sources.of([tmp_path], Progress(), columns_of(COLUMNS))
        assert others in str(refusal.value)
        assert "none of the columns of time and place" in str(refusal.value)
        return
    sources = Sources.of([tmp_path], Progress(), columns_of(COLUMNS))
    assert [path.name for path in sources.tracks] == ["tracks.csv"]
    assert len(sources.others) == others


def test_scenes_of_one_name_get_a_number(source: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    (again / "hand-3.xml").write_text(files.COMMONROAD_2018B)
    sources = Sources.of([source / "hand-1.xml", again], Progress(), columns_of(None))
    names = [
        scene.name for scene in importing._unique(importing.scenes_of(sources, columns_of(None)))
    ]
    assert names == ["XXX_Hand-1_1_T-1", "XXX_Hand-1_1_T-1-2"]


def test_moments_are_drawn_where_they_are(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from harness.extensions.roads.picture import draw

    recording = tables.write(tmp_path, "mine", "", "", 80, [scene_of(3, 3)], (), {})
    moment = Moment("s", "00", 0.0, "02", 1.0, "report")
    recording = tables.chosen(recording, (0, 9), [moment, replace_id(moment)], {})
    draw(recording, tmp_path / "a.svg")
    picture = (tmp_path / "a.svg").read_text()
    for words in ("mine: 1 scene, 2 moments", "ego at its moment", "hidden, in conflict"):
        assert words in picture


def replace_id(moment: Moment) -> Moment:
    """Return a moment of somebody who is not there, which is not drawn."""
    return Moment(moment.scene, "nobody", moment.time_s, None, None, moment.purpose)
