"""Recorded traffic: replayed to the centimetre, or reacting to an ego that drives otherwise."""

import filecmp
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studied import trials

from harness.backends import driver as driver_backend
from harness.backends.base import Request
from harness.core.errors import UserError
from harness.core.seeds import FIRST
from harness.dataset.load import load
from harness.dataset.verify import check
from harness.extensions.roads import family, fitness, held, tables
from harness.extensions.roads.family import RECORDINGS, recording_of
from harness.extensions.roads.fitness import is_mastered
from harness.extensions.roads.held import sessions_of
from harness.extensions.roads.network import ground, streets
from harness.extensions.roads.replay import HARDEST_MPS2, Cast, Play
from harness.extensions.roads.scene import House, Lane, Scene, Track
from harness.extensions.roads.tables import Moment
from harness.extensions.roads.traffic import Recorded, box, frames_a_second, nth, setting
from harness.extensions.roads.world import RecordedWorld
from harness.world import scenarios
from harness.world.reference import drive_all, finish
from harness.world.scenario import Scenario
from harness.world.sight_lines import site
from harness.world.world import World

TIMES = np.arange(0.0, 20.01, 0.1)
QUARTER = np.pi / 2
Drive = Callable[[float], tuple[float, float, float, float]]


def track(
    key: str, drive: Drive, kind: str = "car", size: tuple[float, float] = (4.6, 1.8)
) -> Track:
    """Return who is at x, y, heading and speed for 20 seconds, as a function of the time says."""
    return Track(key, kind, *size, TIMES, np.array([drive(time_s) for time_s in TIMES.tolist()]))


def lane(key: str, ends: object, after: tuple[str, ...] = (), **beside: str) -> Lane:
    points = np.array(ends, dtype=float)
    return Lane(key, points, 3.5, 14.0, after, beside.get("left"), beside.get("right"))


def crossing() -> Scene:
    """Return a road of two lanes to the east that another crosses from the south, behind a house.

    Five cars follow each other at 10 m/s; `x` comes from the south and passes between them. `p` is
    parked beside the road, `w` waits in its left lane, and `b` cycles along the road to the south.
    """
    lanes = [
        lane("a0", [(0, 0), (300, 0)], ("b0",), left="a1"),
        lane("a1", [(0, 3.5), (300, 3.5)], ("b1",), right="a0"),
        lane("b0", [(300, 0), (500, 0)], left="b1"),
        lane("b1", [(300, 3.5), (500, 3.5)], right="b0"),
        lane("c0", [(200, -200), (200, 200)]),
    ]

    def following(n: int) -> Track:
        return track(f"e{n}", lambda time_s: (150 - 30 * n + 10 * time_s, 0, 0, 10))

    tracks = [
        *map(following, range(5)),
        track("x", lambda time_s: (200, -69 + 8 * time_s, QUARTER, 8)),
        track("p", lambda _: (180, 7.2, 0, 0)),
        track("w", lambda time_s: (120 + 5 * max(0.0, time_s - 12), 3.5, 0, 5.0 * (time_s > 12))),
        track("b", lambda time_s: (196, -60 + 4 * time_s, QUARTER, 4), "bicycle", (1.6, 0.65)),
    ]
    corner = np.array([(175.0, -30.0), (193, -30), (193, -8), (175, -8)])
    houses = (House("h", corner),)
    by_id = {each.id: each for each in tracks}
    return Scene("s", "s.xml", "0" * 64, False, by_id, {each.id: each for each in lanes}, houses)


MOMENTS = (
    Moment("s", "e1", 2.0, None, None, "tune"),
    Moment("s", "w", 3.0, None, None, "tune"),
    Moment("s", "e2", 3.0, "x", 5.6, "report"),
)


@pytest.fixture(autouse=True)
def no_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(family.FOLDERS, "")
    # moments that are chosen by hand are not of the purposes and the speeds that a rule gives
    monkeypatch.setattr(held, "hold", lambda recording: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("hand-made")
    speeds_mps = (0.0, 5.0, 10.0, 15.0)
    facts = {"rule": "by hand", "candidates": 3, "left_out": {}}
    tables.write(
        place, "hand", "made by hand", "CC0-1.0", 80.0, [crossing()], MOMENTS, facts, speeds_mps
    )
    return place


@pytest.fixture
def scenario(folder: Path) -> Scenario:
    return scenarios.get(RECORDINGS.named({"recording": str(folder)}))


def cast_of(folder: Path, seed: int = 0) -> Cast:
    recording = tables.read(folder)
    return setting(recording, nth(recording, seed), 10, 8.0).cast


@pytest.mark.parametrize("react", [False, True])
@pytest.mark.parametrize("seed", [0, 1, FIRST["report"]])
def test_as_long_as_nobody_is_off_it_is_the_recording(folder: Path, seed: int, react: bool) -> None:
    cast = cast_of(folder, seed)
    play, came = Play.start(cast, react), 0
    for frame in range(80):
        play.move(cast.poses[0, frame])
        there = np.flatnonzero(play.there)[1:]
        expected = cast.poses[there, frame + 1]
        assert np.abs(play.poses[there] - expected).max() < 0.01
        assert set(there) == {
            n for n in range(1, len(cast.tracks)) if cast.enters[n] <= frame + 1 <= cast.leaves[n]
        }
        came += len(there)
    assert came > 80


def driven(folder: Path, react: bool, actions: dict[int, str]) -> tuple[Recorded, list[np.ndarray]]:
    """Drive the first moment's ego by actions at frames; return where all are after each frame."""
    env = Recorded(tables.read(folder), react)
    env.reset(seed=0)
    places = []
    for frame in range(80):
        if frame in actions:
            env.vehicle.act(actions[frame])
        env.road.act()
        env.road.step(0.1)
        places.append(env.road.play.poses.copy())
    return env, places


BRAKES = {0: "SLOWER", 10: "SLOWER"}


@pytest.mark.parametrize(("react", "crashes"), [(True, False), (False, True)])
def test_a_braking_ego_is_struck_by_who_replays(folder: Path, react: bool, crashes: bool) -> None:
    env, places = driven(folder, react, BRAKES)
    names = [each.id for each in env.setting.cast.tracks]
    assert bool(env.vehicle.crashed) == crashes
    follower = np.array([each[names.index("e2"), :4] for each in places])
    stands = bool((follower[-1, 3] < 1.0) and not crashes)
    assert stands == react
    if react:
        speeds = np.array([each[:, 3] for each in places])
        assert np.nanmax((speeds[:-1] - speeds[1:]) * 10) <= HARDEST_MPS2 + 1e-6
        ahead = np.array([each[names.index("e0"), 0] for each in places[:60]])
        assert np.allclose(ahead, 171 + np.arange(60))  # who is ahead drives on
        recorded = env.setting.cast.poses[names.index("e2"), 1:81, 0]
        assert (follower[:, 0] <= recorded + 1e-6).all()  # nobody is ahead of the recording
        assert (np.diff(follower[:, 0]) >= -1e-9).all()


def test_who_crosses_stops_for_an_ego_that_stands_on_its_path(folder: Path) -> None:
    ends = {}
    for react in (True, False):
        play = Play.start(cast_of(folder), react)
        x = [each.id for each in play.cast.tracks].index("x")
        stands = np.array([200.0, 0.0, 0.0, 0.0])  # where the other road crosses, seen from above
        for _ in range(75):
            play.move(stands)
        ends[react] = play.poses[x, 1], play.speed_mps[x]
    assert ends[False] == pytest.approx((-7.0, 8.0), abs=0.1)  # it has gone through
    assert ends[True][0] > (4.6 + 1.8) / 2 + 0.5
    assert ends[True][1] < 3.0


def test_who_stands_on_the_first_place_of_a_path_is_met_at_once() -> None:
    poses = np.array([[[10.0 * n, 0, 0, 10] for n in range(3)], [[2.0, 0, 0, 0]] * 3])
    cars = (track("e", lambda _: (0, 0, 0, 0)), track("o", lambda _: (2, 0, 0, 0)))
    cast = Cast(1, cars, poses, np.zeros(2, dtype=int), np.full(2, 2))
    n, k, gaps, along = cast.contacts(np.array([0]), np.array([1]), np.zeros(2), poses[:, 0])
    assert [n.tolist(), k.tolist(), gaps.tolist(), along.tolist()] == [[0], [1], [0.0], [1.0]]


def test_who_was_late_catches_up_and_is_the_recording_again(folder: Path) -> None:
    play = Play.start(cast_of(folder), True)
    cast = play.cast
    follower = [each.id for each in cast.tracks].index("e2")
    for frame in range(75):
        pose = cast.poses[0, frame].copy()
        if 5 <= frame < 15:
            pose[0] -= 8.0  # the ego is behind for a second
        play.move(pose)
        if frame == 14:
            assert play.late[follower]
    behind_m = cast.poses[follower, 75, 0] - play.poses[follower, 0]
    assert 0 <= behind_m < 2.0


def test_a_world_at_a_moment(scenario: Scenario) -> None:
    world = World.start(scenario, 0)
    assert isinstance(world, RecordedWorld)
    ids = {v.track.id: v.spawn.id for v in world.vehicles[1:]}
    parts = {v.track.id: v.spawn.part for v in world.vehicles[1:]}
    kinds = {v.track.id: v.spawn.kind for v in world.vehicles[1:]}
    assert [v.id for v in world.state().vehicles] == ["v1", *ids.values()]
    assert parts == {key: "helper" if key in ("w", "e0", "e2") else "other" for key in parts}
    assert kinds["b"] == "bicycle"
    assert "p" in parts
    [house] = world.state().buildings
    size_m = house.east_m - house.west_m, house.south_m - house.north_m
    assert size_m == pytest.approx((18, 22))
    assert world.state().ego.speed_mps == pytest.approx(10)
    assert (world.layout.danger, world.layout.danger_id) == (None, None)


def test_dangers_goals_and_seeds(scenario: Scenario) -> None:
    goals = {seed: scenario.at(seed).road().facts["goal"] for seed in (0, 1, FIRST["report"])}
    assert goals == {0: "50m", 1: "5s", FIRST["report"]: "50m"}
    dangerous = World.start(scenario, FIRST["report"])
    [hidden] = [v for v in dangerous.vehicles if v.spawn.id == dangerous.layout.danger_id]
    assert hidden.track.id == "x"
    assert dangerous.layout.danger == hidden.spawn.approach
    assert dangerous.layout.danger in dangerous.scenario.road().sectors
    assert scenario.cluster is not None
    [session] = sessions_of(recording_of(scenario.name)).session.values()
    assert scenario.cluster(0) == f"traffic {session[:12]}"
    with pytest.raises(
        UserError, match=r"hand has 2 moments to tune \(seeds 0 to 1\), and no more are to be had"
    ):
        World.start(scenario, 2)
    with pytest.raises(UserError, match=r"0 moments to train \(none\)"):
        scenario.at(FIRST["train"])


def test_right_of_way_is_unknown_but_for_who_drives_into_a_back(scenario: Scenario) -> None:
    """Crossing, nobody is said to be at fault; behind one another, who is behind is."""
    world = World.start(scenario, FIRST["report"])
    ego, other = world.vehicles[:2]
    for turn_rad, at_fault in ((np.pi / 2, None), (0.0, "ego")):
        ahead = *(ego.position + 4 * direction(ego.heading)), ego.heading + turn_rad
        world.env.road.play.poses[other.number, :3] = ahead  # type: ignore[attr-defined]
        assert world._collision(ego, [other]).get("fault") == at_fault


def direction(heading: float) -> np.ndarray:
    return np.array([np.cos(heading), np.sin(heading)])


def test_a_radio_is_told_the_names_and_the_time_of_the_recording(scenario: Scenario) -> None:
    layout, world = scenario.at(FIRST["report"]), World.start(scenario, FIRST["report"])
    state, moment = world.state(), world.env.setting.moment  # type: ignore[attr-defined]
    ids = [vehicle.id for vehicle in (state.ego, *state.helpers)]
    links = site([(state, ids)], names=[layout.names])
    tracks = {v.spawn.id: v.track.id for v in world.vehicles[1:]}
    names = [moment.vehicle, *(tracks[id_] for id_ in ids[1:])]
    assert links.names[0].tolist() == [f"s/{name}" for name in names]
    assert len(ids) > 1
    assert links.time_s.tolist() == [moment.time_s]


def test_a_branch_is_as_a_fresh_drive(scenario: Scenario) -> None:
    for seed, actions in ((0, ["SLOWER", "FASTER"]), (FIRST["report"], ["LANE_LEFT", "SLOWER"])):
        first = World.start(scenario, seed)
        first.act(actions[0])
        branch = first.branch()
        branch.act(actions[1])
        before = first.state()
        other = first.branch()
        other.act("IDLE")
        assert first.state() == before
        thawed = World.thaw(scenario, before, first.snapshot())
        assert thawed.state() == before
        thawed.act(actions[1])
        assert thawed.state() == branch.state()
        assert branch.state() != other.state()


def test_the_recorded_driver_arrives_and_waits(scenario: Scenario) -> None:
    for seed in (0, 1, FIRST["report"]):
        world = World.start(scenario, seed)
        [outcome] = finish([world], ["recorded"])
        assert outcome.result == "cleared"
        assert outcome.time_s == pytest.approx(5.0, abs=0.3)


def test_a_moment_that_its_recorded_driver_does_not_master_is_none(tmp_path: Path) -> None:
    scene = crossing()
    far = lane("d0", [(0, 400), (900, 400)])
    fast = track("f", lambda time_s: (40 * time_s, 400, 0, 40))  # as fast as no ego can drive
    scene = replace(scene, lanes={**scene.lanes, "d0": far}, tracks={**scene.tracks, "f": fast})
    recording = tables.write(tmp_path, "fast", "", "", 80.0, [scene], (), {})
    moments = {name: Moment("s", name, 2.0, None, None, "") for name in ("f", "e1")}
    mastered = {name: is_mastered(recording, moment) for name, moment in moments.items()}
    assert mastered == {"f": False, "e1": True}


def test_nobody_was_recorded_elsewhere() -> None:
    backend = driver_backend.DriverBackend("recorded")
    scenario = scenarios.get("blind-merge")
    request = Request("1", "ego", (), ("IDLE",), 100, scenario=scenario)
    with pytest.raises(UserError, match=r"unknown driver of blind-merge 'recorded'.* a dataset"):
        backend.complete([request])


def test_a_recording_and_an_environment_are_two_scenarios(
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    given = ("--recording", "mine", "--env", "merge-v0")
    code, _, err = harness("dataset", "build", *given, "--out", "made")
    assert (code, err.count("\n")) == (2, 1)
    assert "are of several scenarios; give those of one" in err


def test_what_is_beside_a_dataset_goes_before_what_a_variable_names(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "recording.json").write_bytes((folder / "recording.json").read_bytes())
    monkeypatch.setenv(family.FOLDERS, str(tmp_path))  # which has no tables
    name = family.name_of(tables.read(folder))
    RECORDINGS.kept_in(name, folder)
    assert recording_of(name).folder == folder


@pytest.mark.slow
def test_a_dataset_is_sound_and_has_its_recording(
    once: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    monkeypatch.setenv(family.FOLDERS, "")  # it has its own
    trials()["reaction"].lays(tmp_path, once)
    assert not check(tmp_path / "with")
    dataset = load(tmp_path / "with")
    assert dataset.manifest.source == "made by hand"
    success = dataset.reference_success()
    assert success["recorded"].tolist() == [1, 1]
    [closed] = drive_all(dataset.scenario, [0])
    assert {name: bool(success[name][0]) for name in closed} == {
        name: outcome.success for name, outcome in closed.items()
    }
    card = (tmp_path / "with/README.md").read_text()
    command = card.split("Built by `harness ")[1].split("`")[0]
    assert command.startswith("dataset build --recording with --episodes 2 --seed 0")
    assert harness(*command.split())[0] == 0
    written = [path.name for path in (tmp_path / "with").iterdir()]
    same, *others = filecmp.cmpfiles(tmp_path / "with", tmp_path / "again/with", written, False)
    assert (sorted(same), others) == (sorted(written), [[], []])


def without_the_first(facts: dict[str, Any]) -> None:
    facts["moments"] = facts["moments"][1:]


def with_another(facts: dict[str, Any]) -> None:
    facts["moments"].append({**facts["moments"][0], "vehicle": "e0", "time_s": 2.0})


CHOICES: dict[str, Callable[[dict[str, Any]], object]] = {
    "": lambda facts: None,
    "no moment of s, e0 at 4 s, which its rule chooses": without_the_first,
    "a moment of s, e0 at 2 s, which its rule does not choose": with_another,
    "its moments in another order": lambda facts: facts["moments"].reverse(),
    "another rule of its choice": lambda facts: facts["choice"].update(rule="All were taken."),
    "another candidates of its": lambda facts: facts["choice"].update(candidates=4),
    "another left_out of its": lambda facts: facts["choice"]["left_out"].popitem(),
}


@pytest.mark.slow
def test_a_recorded_driver_who_fails_is_found(
    once: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(family.FOLDERS, "")
    trials()["reaction"].lays(tmp_path, once)
    scenario = scenarios.get(RECORDINGS.named({"recording": str(tmp_path / "with")}))
    fitness.other_choice.cache_clear()
    monkeypatch.setattr(fitness, "is_mastered", lambda recording, moment: False)
    with pytest.raises(UserError, match="its recorded driver does not reach the goal; make"):
        RecordedWorld.examine(scenario, 0)


@pytest.mark.slow
@pytest.mark.parametrize("words", CHOICES)
def test_moments_are_those_that_the_rule_chooses(
    words: str, once: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(family.FOLDERS, "")
    folder = tmp_path / "mine"
    trials()["reaction"].lays(tmp_path, once)
    folder.mkdir()
    for name in ("recording.json", *tables.SCHEMAS):
        shutil.copy(tmp_path / "with" / name, folder / name)
    facts = json.loads((folder / "recording.json").read_text())
    CHOICES[words](facts)
    (folder / "recording.json").write_text(json.dumps(facts))
    scenario = scenarios.get(RECORDINGS.named({"recording": str(folder)}))
    if not words:
        RecordedWorld.examine(scenario, 0)
        return
    with pytest.raises(UserError) as refusal:
        RecordedWorld.examine(scenario, 0)
    assert f"recording.json states {words}" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_who_learns_from_others_that_do_not_react_is_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    moments = [Moment("s", "e1", 2.0, None, None, "train")]
    facts = {"rule": "by hand", "candidates": 1, "left_out": {}}
    place = tmp_path / "street"
    place.mkdir()
    speeds_mps = (0.0, 5.0, 10.0)
    tables.write(place, "hand", "", "CC0-1.0", 80.0, [crossing()], moments, facts, speeds_mps, 1)
    name = RECORDINGS.named({"recording": str(place)})
    harness("init", "project")
    monkeypatch.chdir("project")
    for settings, lines in ((":react=true", 1), (":react=false", 2)):
        Path("prompts/mine/examples.json").unlink(missing_ok=True)
        typed = ("prompt", "examples", "mine", "--scenario", name + settings, "--count", 1)
        code, out, err = harness(*typed)
        assert (code, err) == (0, "")
        assert len(out.splitlines()) == lines
        assert (family.REPLAYED in out) == (lines == 2)


def test_a_recording_is_found_by_its_digest_alone(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = RECORDINGS.named({"recording": f"{folder}:react=false"})
    name, settings = RECORDINGS.split(typed)
    assert settings == "react=false"
    monkeypatch.setenv(family.FOLDERS, "")
    (tmp_path / "recording.json").write_text("{}")
    RECORDINGS.kept_in(name, tmp_path)
    with pytest.raises(UserError, match="folder that is known; set its folder: SWARMDRIVE_R"):
        recording_of(name)
    RECORDINGS.kept_in(name, folder)
    assert recording_of(name).folder == folder
    for text in (name, f"{name}:decisions=2,react=false"):
        title, settings = RECORDINGS.split(text)
        assert RECORDINGS.joined(title, settings.split(",") if settings else []) == text


def test_lanes_side_by_side_are_one_street(folder: Path) -> None:
    scene = crossing()
    rows = [street.lanes for street in streets(scene)]
    assert rows == [("a1", "a0"), ("b1", "b0"), ("c0",)]
    whole = ground(scene, np.array([250.0, 0.0]), 400.0)
    assert sorted(whole.lanes) == [("n1", "n2", 0), ("n1", "n2", 1), ("n2", "n3", 0), ("n2", "n3", 1),
        ("n4", "n5", 0)]  # fmt: skip
    left = whole.lanes["n1", "n2", 0]
    assert left.position(10.0, 0.0).tolist() == [10.0, -3.5]  # y is to the south
    assert left.local_coordinates(np.array([20.0, -2.5])) == pytest.approx((20.0, 1.0))
    near = ground(scene, np.array([250.0, 0.0]), 60.0)
    assert near.lanes["n1", "n2", 1].length == pytest.approx(110.0, abs=2.0)
    diagonal = np.stack([np.linspace(280, 320, 9), np.linspace(0, -3.5, 9), *np.zeros((2, 9))], 1)
    changes = whole.matched(diagonal)
    assert changes[0] == ("n1", "n2", 1)
    assert changes[-1] == ("n2", "n3", 0)


def test_a_house_that_stands_askew_hides_only_what_it_does() -> None:
    turned = House("h", np.array([(0.0, 10.0), (10, 0), (20, 10), (10, 20)]))
    low, high = box(turned)
    assert ((high - low) > 7).all()
    assert ((high - low) < 11).all()
    assert (np.abs((low + high) / 2 - [10, -10]) < 2).all()


@pytest.mark.parametrize(
    ("step_s", "hz"), [(0.1, 10), (0.04, 10), (1.0, 10), (0.08, 10), (1 / 15, 15)]
)
def test_frames_fall_on_recorded_times(step_s: float, hz: int) -> None:
    assert frames_a_second(step_s) == hz
