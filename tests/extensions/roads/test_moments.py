"""Moments of recorded traffic: what is decisive, what falls and why, and that no order matters."""

import itertools
import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from harness.core.arrays import Floats
from harness.extensions.roads.moments import (
    GAP,
    LEAVES,
    LIGHTS,
    NEAR,
    NOT_REACHED,
    OFF_LANE,
    STILL,
    STRAYS,
    TWICE,
    Choice,
    Chooser,
    key_of,
)
from harness.extensions.roads.scene import House, Lane, Scene, Track, checked
from harness.extensions.roads.sessions import Sessions, Traffic, dealt, part_of

HORIZON_S = 6.0
EAST, NORTH = 0.0, np.pi / 2
HOUSE = House("h", np.array([[-35.0, -35.0], [-6.0, -35.0], [-6.0, -6.0], [-35.0, -6.0]]))
ANY = object()


def driven(
    key: str,
    begin: tuple[float, float],
    heading: float,
    speeds_mps: Floats,
    **changed: Any,
) -> Track:
    """Return a car that drives straight on from a place, with a speed each tenth of a second."""
    way_m = np.concatenate([[0.0], np.cumsum((speeds_mps[1:] + speeds_mps[:-1]) / 20)])
    x_m, y_m = begin[0] + way_m * np.cos(heading), begin[1] + way_m * np.sin(heading)
    poses = np.stack([x_m, y_m, np.full(len(way_m), heading), speeds_mps], axis=-1)
    times_s = np.arange(len(way_m)) / 10
    return replace(Track(key, "car", 5.0, 2.0, times_s, poses), **changed)


def steady(key: str, begin: tuple[float, float], heading: float, **changed: Any) -> Track:
    """Return a car that drives at 10 m/s for 14 s."""
    return driven(key, begin, heading, np.full(141, 10.0), **changed)


def crossing(*tracks: Track, **changed: Any) -> Scene:
    """Return a crossing of a lane to the east and one to the north, both through 0, 0."""
    ends = np.array([-300.0, 300.0])
    lanes = {
        "east": Lane("east", np.stack([ends, 0 * ends], axis=-1), 4.0, None, (), None, None),
        "north": Lane("north", np.stack([0 * ends, ends], axis=-1), 4.0, None, (), None, None),
    }
    by_id = {track.id: track for track in tracks}
    scene = replace(Scene("s", "s.xml", "0" * 64, False, by_id, lanes), **changed)
    checked(scene)
    return scene


def chooser_of(*scenes: Scene, **changed: Any) -> Chooser:
    """Return a chooser that has looked at some scenes."""
    chooser = Chooser(80.0, HORIZON_S, **changed)
    for scene in scenes:
        chooser.look(scene)
    return chooser


def of(*scenes: Scene, **changed: Any) -> Choice:
    choice = chooser_of(*scenes, **changed).choice()
    assert choice.candidates == len(choice.moments) + sum(choice.left_out.values())
    hides = [m.hidden is not None for m in choice.moments]
    assert hides == [True, False] * (len(hides) // 2) or not any(hides)
    return choice


def decisive(choice: Choice) -> set[tuple[str, str | None]]:
    return {(m.vehicle, m.hidden) for m in choice.moments if m.hidden is not None}


# One crosses half a second after the other has left the place.
EGO, OTHER = steady("e", (-40.0, 0.0), EAST), steady("o", (0.0, -52.0), NORTH)
PLATOON = {"e": (-60.0, 0.0), "t": (-50.0, 0.0), "o": (-41.0, 0.0)}


def platoon(braking_mps: float) -> list[Track]:
    """Return a car, a truck and a car that follow each other; after 4 s all slow down in 1 s."""
    speeds = np.interp(np.arange(141) / 10, [4.0, 5.0], [10.0, 10.0 - braking_mps])
    tracks = [driven(key, begin, EAST, speeds) for key, begin in PLATOON.items()]
    return [replace(t, kind="truck", length_m=8.0, width_m=2.5) if t.id == "t" else t
            for t in tracks]  # fmt: skip


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (crossing(EGO, OTHER, houses=(HOUSE,)), {("e", "o"), ("o", "e")}),
        (crossing(EGO, OTHER), set()),
        # Three seconds later is no conflict.
        (crossing(EGO, steady("o", (0.0, -75.0), NORTH), houses=(HOUSE,)), set()),
        # A truck that stands beside the lane hides as a house does; a bicycle does not.
        (
            crossing(
                EGO,
                OTHER,
                driven("t", (-14.0, -7.0), NORTH, np.zeros(141), kind="truck", length_m=18.0),
                driven("u", (-14.0, -25.0), NORTH, np.zeros(141), kind="truck", length_m=18.0),
                driven("v", (-14.0, -43.0), NORTH, np.zeros(141), kind="truck", length_m=18.0),
            ),
            {("e", "o"), ("o", "e")},
        ),
        (crossing(*platoon(0.0)), set()),
        (crossing(*platoon(5.0)), {("e", "o")}),
        (crossing(*platoon(3.0)), set()),
    ],
    ids=["house", "seen", "later", "truck", "follows", "brakes", "slows"],
)
def test_a_moment_is_decisive_if_who_is_hidden_comes_into_conflict(
    scene: Scene, expected: set[tuple[str, str]]
) -> None:
    choice = of(scene)
    assert decisive(choice) == expected
    for moment in choice.moments:
        assert (moment.hidden is None) == (moment.conflict_s is None)
        assert moment.purpose == "report", "14 s are too short to be cut in three"
    if expected == {("e", "o"), ("o", "e")}:
        # o is where e was (its front reaches the lane at 5.2 - .35 s) for the first time then
        for moment in choice.moments:
            if moment.conflict_s is not None:
                assert moment.time_s + moment.conflict_s == pytest.approx(4.9, abs=0.11)


def test_each_candidate_that_falls_has_its_reason() -> None:
    still = driven("p", (150.0, 0.0), EAST, np.zeros(141))
    beside = steady("b", (-60.0, 30.0), EAST)
    against = steady("w", (280.0, 0.0), np.pi)
    person = driven("f", (5.0, 5.0), EAST, np.full(141, 1.0), kind="pedestrian",
                    length_m=0.5, width_m=0.5)  # fmt: skip
    scene = crossing(EGO, still, beside, person)
    choice = of(scene)
    # Each of three vehicles is there at 15 whole seconds, and has 6 s more at nine of them.
    assert choice.candidates == 45
    assert choice.left_out == {LEAVES: 18, STILL: 9, OFF_LANE: 9, NEAR: 7}
    assert [m.hidden for m in choice.moments] == [None, None], "nobody hidden is in conflict"
    assert of(crossing(against)).left_out == {LEAVES: 6, OFF_LANE: 9}
    assert of(replace(scene, lights=True)).left_out == {LIGHTS: 45}
    chooser = chooser_of(scene)
    chooser.drop([key_of(choice.moments[0])], NOT_REACHED)
    lost = chooser.choice()
    assert (lost.left_out[NOT_REACHED], lost.moments) == (1, choice.moments[1:])
    assert lost.record["left_out"] == lost.left_out
    assert "no building" not in lost.rule
    assert "6 s more" in lost.rule
    alone = of(crossing(person))
    assert (alone.candidates, alone.moments, alone.left_out) == (0, (), {})
    brief = replace(EGO, time_s=EGO.time_s[:2] + 0.01, poses=EGO.poses[:2])
    assert of(crossing(brief)).candidates == 0


def odd(track: Track, time_s: float, column: int, value: float) -> Track:
    """Return a track whose pose at one time states another speed or heading."""
    poses = np.array(track.poses)
    poses[round(time_s * 10), column] = value
    return replace(track, poses=poses)


@pytest.mark.parametrize(("column", "value"), [(3, 20.0), (3, 0.0), (3, 6.9), (2, 3.0)])
def test_no_moment_begins_with_a_speed_or_heading_that_is_not_of_its_movement(
    column: int, value: float
) -> None:
    """The ego's nor that of who is hidden, within a second: the median of a track is another."""
    for who, other in ((EGO, OTHER), (OTHER, EGO)):
        choice = of(crossing(odd(who, 3.0, column, value), other, houses=(HOUSE,)))
        assert choice.left_out[STRAYS] >= 2
        for moment in choice.moments:
            assert moment.vehicle != who.id or abs(moment.time_s - 3) > 1
            assert moment.hidden != who.id or abs(moment.time_s - 3) > 1
    slightly = of(crossing(odd(EGO, 3.0, 3, 12.9), OTHER, houses=(HOUSE,)))
    assert STRAYS not in slightly.left_out


def long(name: str, sha256: str, times: int = 10) -> Scene:
    """Return a crossing of a hundred seconds, with a pair of cars every ten.

    Where they begin is by its digit.
    """
    tracks, farther_m = [], 0.17 * int(sha256, 16)
    ego = steady("e", (-40.0 + farther_m, 0.0), EAST)
    other = steady("o", (0.0, -52.0 + farther_m), NORTH)
    for n in range(times):
        for car in (replace(ego, id=f"e{n}"), replace(other, id=f"o{n}")):
            tracks.append(replace(car, time_s=car.time_s + 10.0 * n))
    return crossing(*tracks, houses=(HOUSE,), name=name, sha256=sha256 * 64)


def cut(scene: Scene, begin_s: float, end_s: float, name: str) -> Scene:
    """Return a part of a scene as a file of its own would have it, whose clock begins at 0 s."""
    tracks = {}
    for track in scene.tracks.values():
        there = (begin_s - 1e-6 <= track.time_s) & (track.time_s <= end_s + 1e-6)
        if there.any():
            times_s = track.time_s[there] - begin_s
            tracks[track.id] = replace(track, time_s=times_s, poses=track.poses[there])
    return replace(scene, name=name, sha256=f"{name:0>64}", tracks=tracks)


def test_calm_moments_are_taken_for_a_purpose_that_has_no_decisive_one() -> None:
    """Then at most `CALM`; a purpose that has decisive ones leaves calm scenes out."""
    busy = long("a", "1")
    quiet = replace(busy, name="q", sha256="2" * 64, houses=())
    alone = of(quiet)
    assert {m.hidden for m in alone.moments} == {None}
    assert {m.purpose for m in alone.moments} == {"tune", "train", "report"}
    both = of(
        busy, replace(quiet, tracks={key: t for key, t in quiet.tracks.items() if t.id > "e4"})
    )
    assert {m.scene for m in both.moments if m.hidden} == {"a"}
    many = of(quiet, most=1)
    assert max(Counter(m.purpose for m in many.moments).values()) == 1


def test_scenes_are_dealt_whole_and_few_are_cut_by_time() -> None:
    scenes = [long(name, digit) for name, digit in zip("abcdef", "123456", strict=True)]
    choice = of(*scenes)
    purposes = {m.scene: m.purpose for m in choice.moments}
    assert {(m.scene, m.purpose) for m in choice.moments} == set(purposes.items())
    assert purposes == {scene.name: dealt(Traffic.of(scene).content) for scene in scenes}
    assert set(purposes.values()) > {"report"}
    assert "half of all digests" in choice.rule
    fewer = {(m.scene, m.vehicle, m.time_s, m.purpose) for m in of(*scenes[1:]).moments}
    assert fewer < {(m.scene, m.vehicle, m.time_s, m.purpose) for m in choice.moments}
    alone = of(scenes[0])
    renamed = {f"{key}x": replace(track, id=f"{key}x") for key, track in scenes[0].tracks.items()}
    # Whom nobody meets, and what a file and those in it are called, draws nothing else.
    far = steady("z", (-40.0, 5000.0), EAST)
    other_names = {**renamed, "z": replace(far, time_s=far.time_s + 10)}
    others = of(replace(scenes[0], sha256="9" * 64, tracks=other_names)).moments
    assert [(m.vehicle[:-1], m.time_s) for m in others] == [
        (m.vehicle, m.time_s) for m in alone.moments
    ]
    twice = of(replace(scenes[0], name="copy", sha256="9" * 64, tracks=renamed), scenes[0])
    assert twice.moments == alone.moments, "one content under several names is one scene"
    assert twice.left_out[TWICE] == (alone.candidates - alone.left_out[LEAVES]
                                     - alone.left_out[NEAR])  # fmt: skip
    quiet = replace(scenes[1], houses=())
    assert of(scenes[0], quiet, replace(quiet, name="q", sha256="9" * 64)).moments == alone.moments
    assert alone.left_out[GAP] > 0
    times: dict[str, list[float]] = {"tune": [], "train": [], "report": []}
    for moment in alone.moments:
        times[moment.purpose].append(moment.time_s)
    assert all(times.values())
    assert max(times["tune"]) + HORIZON_S <= min(times["train"])
    assert max(times["train"]) + HORIZON_S <= min(times["report"])
    few = of(scenes[0], most=2)
    assert {p: sum(m.purpose == p for m in few.moments) for p in times} == dict.fromkeys(times, 2)
    assert [m for m in alone.moments if m.purpose == "tune"][:2] == list(few.moments[:2])


def drawn(number: int) -> Scene:
    """Return an hour of cars that come by chance, at speeds by chance, as simulated ones do."""
    draws = np.random.default_rng(number)
    tracks = []
    for n in range(60):
        speed_mps, begin_s = draws.uniform(8, 13), draws.uniform(0, 180)
        car = driven(f"e{n}", (-300.0, 0.0), EAST, np.full(400, speed_mps))
        tracks.append(replace(car, time_s=np.round(car.time_s + begin_s, 1)))
    return replace(crossing(tracks[0]), name=f"d{number}", tracks={t.id: t for t in tracks})


SESSIONS: dict[str, tuple[list[Scene], list[list[str]]]] = {
    "by themselves": ([drawn(1), drawn(2), drawn(3)], [["d1"], ["d2"], ["d3"]]),
    "overlapping cuts": (
        [drawn(2), *(cut(drawn(1), 40.3 * n, 40.3 * n + 60, f"c{n}") for n in range(4))],
        [["c0", "c1", "c2", "c3"], ["d2"]],
    ),
    "cuts that touch": (
        [cut(drawn(1), 60 * n, 60 * n + 59.9, f"c{n}") for n in range(3)],
        [["c0"], ["c1"], ["c2"]],
    ),
    "later and by other names": (
        [drawn(1), cut(drawn(1), -1e6, 1e6, "late"), drawn(2)], [["d1", "late"], ["d2"]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("which", SESSIONS)
def test_scenes_that_share_traffic_are_one_session(which: str) -> None:
    scenes, expected = SESSIONS[which]
    found = Sessions.of({scene.name: Traffic.of(scene) for scene in scenes})
    groups: dict[str, list[str]] = {}
    for name in sorted(found.session):
        groups.setdefault(found.session[name], []).append(name)
    assert sorted(groups.values()) == expected
    for session, names in groups.items():
        contents = sorted({found.traffic[name].content for name in names})
        assert [found.contents_of(name) for name in names] == [contents] * len(names)
        assert contents[0] == session
        if which == "overlapping cuts" and len(names) > 1:
            purposes = [found.purpose(name, 5.0, HORIZON_S) for name in names]
            assert purposes == [dealt(session)] * len(names)
            assert found.shared == len(names)


@given(st.floats(0, 100), st.floats(0, 100), st.floats(1, 10))
def test_no_second_of_a_scene_is_in_two_parts(one_s: float, other_s: float, horizon: float) -> None:
    first, second = (part_of(time_s, (0.0, 100.0), horizon) for time_s in (one_s, other_s))
    if first and second and first != second:
        assert abs(one_s - other_s) >= horizon - 1e-6
    assert part_of(one_s, (0.0, 3 * horizon), horizon) == "report"


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(st.data())
def test_no_order_of_scenes_or_tracks_and_no_name_of_a_scene_moves_the_choice(
    data: st.DataObject,
) -> None:
    scenes = [long(name, digit, 3) for name, digit in zip("abcd", "1234", strict=True)]
    shuffled = []
    for scene in data.draw(st.permutations(scenes)):
        ids = data.draw(st.permutations(list(scene.tracks)))
        tracks = {key: scene.tracks[key] for key in ids}
        shuffled.append(
            replace(scene, tracks=tracks, lanes=dict(reversed(list(scene.lanes.items()))))
        )
    assert of(*shuffled) == of(*scenes)


def outlines(track: Track) -> Any:
    """Return the outline of a car in each tenth of a second, (n,)."""
    half_m, across_m = track.length_m / 2, track.width_m / 2
    box = shapely.box(-half_m, -across_m, half_m, across_m)
    shapes = []
    for x_m, y_m, heading, _ in track.poses:
        turned = affinity.rotate(box, heading, origin=(0, 0), use_radians=True)
        shapes.append(affinity.translate(turned, x_m, y_m))
    return np.array(shapes)


def meets(first: Track, second: Track, shapes: dict[str, Any], now: int, last: int) -> list[int]:
    """Return when the second is where the first was at most 1.5 s before, unless it follows it."""
    there, here = shapes[first.id][now : last + 1], shapes[second.id][now : last + 1]
    is_alike = math.cos(second.poses[now, 2] - first.poses[now, 2]) > math.cos(math.pi / 4)
    if is_alike and shapely.intersects(here, there[0]).any():
        return []
    frame, later = np.nonzero(shapely.intersects(there[:, None], here[None, :]))
    return [now + int(g) for f, g in zip(frame, later, strict=True) if 0 <= g - f <= 15]


def plainly(scene: Scene, ego: Track, shapes: dict[str, Any], now: int) -> dict[str, float]:
    """Return who is hidden from a car and in conflict with it, and after how long, one by one."""
    conflicts = {}
    for other in scene.tracks.values():
        if other is ego or math.dist(ego.poses[now, :2], other.poses[now, :2]) > 80:
            continue
        blocks = [shapely.Polygon(house.outline) for house in scene.houses]
        for track in scene.tracks.values():
            if track not in (ego, other):
                blocks.append(shapes[track.id][now])
        is_hidden = True
        for end in (other.poses[now, :2], *list(shapes[other.id][now].exterior.coords)[:4]):
            line = shapely.LineString([ego.poses[now, :2], end])
            is_hidden = is_hidden and any(line.intersects(block) for block in blocks)
        last = now + round(10 * HORIZON_S)
        arrivals = meets(ego, other, shapes, now, last)
        arrivals += meets(other, ego, shapes, now, last)
        if is_hidden and arrivals:
            conflicts[other.id] = (min(arrivals) - now) / 10
    return conflicts


@pytest.mark.exhaustive
def test_who_is_hidden_and_in_conflict_is_as_one_by_one() -> None:
    """Cars on straight ways through a place with a house, drawn; none brakes."""
    draws = np.random.default_rng(3)
    decisive_moments = 0
    for number in range(40):
        tracks, lanes = {}, {}
        for key in "abcdef":
            heading, speed_mps = draws.uniform(-np.pi, np.pi), draws.uniform(3, 12)
            way = np.array([np.cos(heading), np.sin(heading)])
            begin = draws.uniform(-8, 8, 2) - way * speed_mps * draws.uniform(2, 6)
            kind = str(draws.choice(["car", "van", "truck"]))
            tracks[key] = driven(key, (begin[0], begin[1]), heading, np.full(91, speed_mps),
                                 kind=kind, length_m=draws.uniform(4, 12))  # fmt: skip
            points = np.stack([begin - 5 * way, begin + 200 * way])
            lanes[key] = Lane(key, points, 4.0, None, (), None, None)
        corner = draws.uniform(-20, 10, 2)
        house = House("h", corner + np.array([[0, 0], [12, 0], [12, 12], [0, 12]]))
        scene = Scene("s", "s.xml", f"{number:064}", False, tracks, lanes, (house,))
        asked = chooser_of(scene).moments
        assert asked
        shapes = {key: outlines(track) for key, track in tracks.items()}
        for moment in asked:
            now = round(10 * moment.time_s)
            conflicts = plainly(scene, tracks[moment.vehicle], shapes, now)
            assert (moment.hidden is not None) == bool(conflicts), (number, moment, conflicts)
            if moment.hidden is not None:
                decisive_moments += 1
                assert moment.conflict_s == min(conflicts.values())
                assert conflicts[moment.hidden] == moment.conflict_s
    assert decisive_moments > 20


def crowd(cars: int, seconds: int) -> Scene:
    """Return six lanes of cars that change them, as on US-101."""
    draws = np.random.default_rng(0)
    xs = np.array([-100.0, 8000.0])
    lanes = {}
    for n in range(6):
        points = np.stack([xs, np.full(2, 3.7 * n)], axis=-1)
        lanes[str(n)] = Lane(str(n), points, 3.7, None, (), None, None)
    times_s = np.arange(10 * seconds + 1) / 10
    tracks = {}
    for n, lane in zip(range(cars), itertools.cycle(range(6)), strict=False):
        x_m = 19.0 * (n // 6) + draws.uniform(0, 8) + 12 * times_s
        x_m = x_m + draws.uniform(0, 3) * np.sin(times_s / 7)
        change = np.clip((times_s - draws.uniform(5, seconds)) / 4, 0, 1) * (draws.random() < 0.2)
        y_m = 3.7 * (lane + change * (1 if lane < 5 else -1))
        heading = np.arctan2(np.gradient(y_m, times_s), np.gradient(x_m, times_s))
        speed = np.gradient(x_m, times_s)
        poses = np.stack([x_m, y_m, heading, speed], axis=-1)
        tracks[f"c{n}"] = Track(f"c{n}", "car", 4.6, 1.9, times_s, poses)
    return Scene("us", "us.xml", "7" * 64, False, tracks, lanes)


@pytest.mark.slow
def test_a_highway_of_a_hundred_cars_takes_seconds() -> None:
    choice = of(crowd(100, 30))
    assert choice.candidates == 3100
    assert all(moment.hidden != moment.vehicle for moment in choice.moments)
