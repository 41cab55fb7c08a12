"""Where an environment takes place: its goal, roads that differ by layout, and a window."""

import json
import pickle
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from evaluating import scenes_of
from highway_env.envs import HighwayEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Obstacle
from my_roads import Breakdown

from harness.core.errors import UserError
from harness.dataset.build import build
from harness.dataset.load import load
from harness.dataset.verify import check
from harness.extensions.environments.environment import joined, named, reset
from harness.extensions.environments.examination import examine
from harness.extensions.environments.goal import Goal
from harness.extensions.environments.window import quicken
from harness.extensions.environments.world import EnvironmentWorld
from harness.world import scenarios
from harness.world.reference import drive
from harness.world.world import World

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
from maps import Grid

OWN = "my_roads:breakdown-v0"
FEW = {"vehicles_count": 3}


class Declares(Breakdown):
    """Declares another goal for each layout seed, which gymnasium has for it."""

    GOALS = ("3s", "40m", (60.0, 0.0), "3s/30m")

    def goal(self):
        return self.GOALS[(self.np_random_seed or 0) % len(self.GOALS)]


class Wrong(Breakdown):
    """Declares what is no goal: the layout seed says which."""

    several_roads = True
    GOALS = ("soon", 7, (10.0, 0.0), (60.0, 30.0), (60.0, "x"), "0m", ZeroDivisionError("no"))

    @property
    def goal(self):
        goal = self.GOALS[(self.np_random_seed or 0) % len(self.GOALS)]
        if isinstance(goal, Exception):
            raise goal
        return goal


class Boundless(Breakdown):
    window_m = "none"


class Proclaims(Breakdown):
    """Says after two seconds that it is a success, and ends nothing."""

    def _info(self, obs, action=None):
        return super()._info(obs, action) | {"is_success": self.time >= 2}


class Rebuilt(HighwayEnv):
    """Has another road for each layout."""

    lanes: tuple[int, ...] = (2, 3, 4)

    def _reset(self):
        stated = self.config["lanes_count"]
        self.config["lanes_count"] = self.lanes[(self.np_random_seed or 0) % len(self.lanes)]
        super()._reset()
        self.config["lanes_count"] = stated


class Late(Rebuilt):
    """Has another road only in each sixth layout."""

    lanes = (2, 2, 2, 2, 2, 3)


class Houses(Grid):
    """Has a house at each side of the ego's crossing, and one far away; a car comes from there."""

    @classmethod
    def default_config(cls):
        return super().default_config() | {"crossings": 3}

    def _reset(self):
        super()._reset()
        for x_m in (90.0, 300.0):
            self.road.objects.append(Obstacle(self.road, [x_m, 120.0]))
        lane = self.road.network.get_lane(("2 1 out 2", "1 1 in 2", 0))
        self.road.vehicles.append(IDMVehicle(self.road, lane.position(0.0, 0), np.pi, 14))


for kind in (Boundless, Declares, Wrong, Proclaims, Rebuilt, Late, Grid, Houses):
    gymnasium.register(f"places-{kind.__name__.lower()}-v0", entry_point=kind)


@pytest.fixture(scope="module", autouse=True)
def _imports():
    with pytest.MonkeyPatch.context() as changed:
        changed.setenv("SWARMDRIVE_IMPORTS", "my_roads")
        yield


@pytest.mark.parametrize(
    ("text", "goal"),
    [
        ("speed", Goal()),
        ("own", Goal("own")),
        ("120m", Goal("place", 120.0)),
        ("6.5s", Goal("time", 0.0, 6.5)),
        ("6s/5m", Goal("stay", 5.0, 6.0)),
        *((wrong, None) for wrong in ("", "6", "0s", "6s/0m", "-3m", "m", "6m/5s", "1e3m", "6s ")),
    ],
)
def test_a_goal_is_a_text(text, goal):
    if goal is None:
        with pytest.raises(UserError, match="it must be speed, own, a place such as"):
            Goal.of(text)
    else:
        assert Goal.of(text) == goal
        assert goal.text == text


@pytest.mark.parametrize(
    ("goal", "driver", "ends", "at_s"),
    [
        ("30m", "cruise", "cleared", 30 / 14),
        ("3s", "cruise", "cleared", 3.0),
        ("3s", "brake", "cleared", 3.0),
        ("3s/30m", "brake", "cleared", 3.0),
        ("3s/30m", "full-view", "cleared", 3.0),
        ("3s/30m", "cruise", "time_out", 3.0),
        ("speed", "cruise", "collision", 3.87),
    ],
)
def test_who_reaches_a_goal(goal, driver, ends, at_s):
    scenario = scenarios.get(f"env:{OWN}:decisions=2,goal={goal}")
    outcome = drive(scenario, driver, 0)
    assert outcome.result == ends
    assert outcome.time_s == pytest.approx(at_s, abs=0.07)


def test_a_goal_is_said_where_it_is_read():
    said = {}
    for goal in ("speed", "own", "120m", "6s", "6s/5m"):
        scenario = scenarios.get(f"env:{OWN}:goal={goal}")
        said[goal] = scenario.prompt_words["task"]
        assert scenario.road().facts.get("goal", "speed") == goal
        assert (scenario.road().goal_m is None) == (goal not in ("speed", "120m"))
        assert scenarios.get(scenarios.argument(scenario)) == scenario
    assert said == {
        "speed": "follow your road, to b, and keep up speed",
        "own": "follow your road, to b, to the goal of Breakdown",
        "120m": "follow your road, to b, for 120 m from your start",
        "6s": "follow your road, to b, and be unhurt 6 s after your start",
        "6s/5m": "be unhurt 6 s after your start, and then at most 5 m from it",
    }
    plain = scenarios.get(f"env:{OWN}")
    assert {"goal", "window_m"}.isdisjoint(plain.parameters.stated())
    assert "goal" not in plain.road().facts


@pytest.mark.slow
def test_an_environment_may_say_itself_that_it_is_a_success():
    for goal, ends in (("own", "cleared"), ("speed", "collision")):
        scenario = scenarios.get(f"env:places-proclaims-v0:goal={goal}")
        assert drive(scenario, "cruise", 0).result == ends


@pytest.mark.slow
def test_each_layout_may_declare_a_goal():
    scenario = scenarios.get("env:places-declares-v0:decisions=1")
    own = [scenario.at(seed) for seed in range(4)]
    assert [each.road().facts["goal"] for each in own] == ["3s", "40m", "40m", "3s/30m"]
    for seed, each in enumerate(own):
        assert pickle.loads(pickle.dumps(each)) == each
        assert drive(scenario, "cruise", seed).success == (seed != 3)
    typed = scenarios.get("env:places-declares-v0:decisions=1,goal=50m")
    assert typed.layouts is None
    assert typed.prompt_words["task"].endswith("for 50 m from your start")


@pytest.mark.parametrize(
    ("seed", "said"),
    enumerate(
        (
            "goal is 'soon'; it must be speed",
            "its goal is 7; it must be speed",
            "its goal is -10 m along the ego's path, 4 m beside it; it must be ahead",
            "its goal is 40 m along the ego's path, 26 m beside it",
            "its goal is (60.0, 'x'); it must be speed",
            "goal is '0m'; it must be speed",
            "its goal fails: ZeroDivisionError: no",
        )
    ),
)
def test_what_is_no_goal_is_a_line(seed, said):
    scenario = scenarios.get("env:places-wrong-v0:decisions=1")
    with pytest.raises(UserError) as error:
        World.start(scenario, seed)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_window_is_a_line():
    with pytest.raises(UserError, match="its window_m is no number: ValueError: could not convert"):
        scenarios.get("env:places-boundless-v0")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("goal=20s", "its goal is at 20 s, after the time limit of 9 s; set time_limit_s"),
        ("goal=far", "goal is 'far'; it must be speed, own, a place"),
        ("window_m=5", "window_m is 5; it must be 0 for none, or from 20 to 500"),
        ("window_m=30", "the ego's way to its goal is 84 m; set window_m=52, or a nearer goal"),
    ],
)
def test_what_no_episode_can_be_is_a_line(settings, said):
    with pytest.raises(UserError) as error:
        World.start(scenarios.get(f"env:{OWN}:{settings}"), 0)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_road_of_another_seed_is_refused_if_nothing_says_that_there_are_several():
    scenario = scenarios.get(named("places-late-v0", FEW))
    assert scenario.layouts is None
    with pytest.raises(UserError, match="its road is another in seed 5 than in seed 0; fix it"):
        World.start(scenario, 5)


@pytest.mark.exhaustive
def test_layouts_may_have_roads_of_their_own(tmp_path, harness):
    scenario = scenarios.get(joined(named("places-rebuilt-v0", FEW), ["decisions=1"]))
    build(scenario, tmp_path / "set", 3, 0, 1, lambda done: None)
    assert check(tmp_path / "set") == []
    lanes = [len(scenario.at(seed).road().paths) for seed in range(3)]
    assert lanes == [2, 3, 4]
    for scene in scenes_of(load(tmp_path / "set")):
        assert scene.seat == scenario.at(scene.state.episode_seed)
    ran = harness("eval", "--model", "proxy", "--dataset", "set", "--seeds", "0", "--out", "run")
    assert ran[0] == 0, ran
    assert harness("dataset", "rank", "set")[0] == 0


@pytest.mark.slow
def test_what_is_beyond_the_window_is_not_there():
    name = named("places-houses-v0")
    scenario = scenarios.get(joined(name, ["decisions=2", "window_m=60"]))
    road = scenario.road()
    assert len(road.network().lanes_list()) < len(
        EnvironmentWorld.begun(scenario, 0).env.road.network.lanes_list()
    )
    assert all(np.hypot(*path.points.T).max() < 62 for path in road.paths.values())
    world = EnvironmentWorld.begun(scenario, 0)
    assert len(world.state().buildings) == 1
    counts = []
    for _ in range(4):
        counts.append(len(world.state().vehicles))
        inside = [v for v in world.env.road.vehicles if world.here.has(v) or v is world.env.vehicle]
        assert len(world.vehicles) == len(inside)
        for vehicle in world.state().vehicles[1:]:
            assert np.hypot(vehicle.x_m, vehicle.y_m) < 60
        world.advance(world.frame + world.period)
    assert len(set(counts)) > 1
    assert len(world.env.road.vehicles) == 8


@pytest.mark.exhaustive
def test_a_window_makes_a_dataset_of_a_large_map(tmp_path):
    name = named("places-grid-v0", {"crossings": 4})
    scenario = scenarios.get(joined(name, ["decisions=2", "window_m=60"]))
    build(scenario, tmp_path / "set", 1, 0, 1, lambda done: None)
    assert check(tmp_path / "set") == []
    assert load(tmp_path / "set").scenario == scenario
    manifest = json.loads((tmp_path / "set/manifest.json").read_text())
    assert manifest["parameters"]["window_m"] == 60.0


@pytest.mark.slow
def test_in_a_window_vehicles_drive_as_they_do_without():
    name = named("places-grid-v0", {"crossings": 2})
    worlds = []
    for window_m in (0, 80):
        scenario = scenarios.get(joined(name, ["decisions=2", f"window_m={window_m}"]))
        worlds.append(EnvironmentWorld.begun(scenario, 1))
        worlds[-1].advance(45)
    whole, cut = ([v.position.tolist() for v in world.env.road.vehicles] for world in worlds)
    assert whole == cut
    examine(scenario, 1)


@pytest.mark.slow
@pytest.mark.parametrize("env", ["merge-v0", "roundabout-v0", "two-way-v0", "places-grid-v0"])
def test_who_looks_among_near_lanes_finds_the_lane_of_all(env):
    network = reset(named(env), 0).road.network
    of_all, draws = network.get_closest_lane_index, np.random.default_rng(0)
    quicken(network)
    for _ in range(150):
        lane = draws.choice(np.array(network.lanes_list(), dtype=object))
        along_m = draws.uniform(-20, lane.length + 20)
        position = lane.position(along_m, draws.normal(0, 6))
        for heading in (None, draws.uniform(-4, 4)):
            index = network.get_closest_lane_index(position, heading)
            assert index == of_all(position, heading)


def test_a_map_of_too_many_routes_is_a_line():
    with pytest.raises(UserError, match="more than 200 routes; set window_m"):
        World.start(scenarios.get(named("places-grid-v0", {"crossings": 4})), 0)


@pytest.mark.slow
def test_a_goal_that_no_course_reaches_is_a_line_before_the_dataset_is_there(harness, tmp_path):
    built = ("dataset", "build", "--env", f"{OWN}:decisions=1,goal=390m", "--episodes", "2")
    shards = ("--workers", "1", "--shard", "1/1", "--out")
    code, _, err = harness(*built, "--workers", "1", "--out", "set")
    assert (code, err.count("\n")) == (2, 1)
    said = "no course of 2 layouts of env:my_roads:breakdown-v0 reaches the goal (follow your road,"
    assert said in err
    assert "declare another, as in env:my_roads:breakdown-v0:goal=6s, or type --unreachable" in err
    assert not (tmp_path / "set/manifest.json").exists()
    code, wrote, _ = harness(*built, "--workers", "1", "--out", "set", "--unreachable")
    assert (code, "2 layouts" in wrote) == (0, True)
    card = (tmp_path / "set/README.md").read_text()
    assert "| the best policy | 0.0 |" in card
    assert "--seed 0 --out again/set --unreachable`" in card
    assert harness(*built, *shards, "part")[0] == 0
    assert harness("run", "merge", "part", "--out", "merged")[0] == 2
    assert harness("run", "merge", "part", "--out", "merged", "--unreachable")[0] == 0
