"""Environments of highway-env as scenarios: stock ones, and one that a user wrote."""

import html
import io
import json
import sys
import threading
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import cast

import gymnasium
import msgspec
import numpy as np
import pytest
from evaluating import scenes_of
from highway_env.envs import MergeEnv
from highway_env.road.lane import StraightLane
from highway_env.utils import class_from_path
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle
from matplotlib.patches import Polygon
from my_roads import Breakdown, Truck

from harness.core.errors import UserError
from harness.dataset.build import build
from harness.dataset.load import load
from harness.dataset.verify import check
from harness.extensions.environments.environment import named, reset
from harness.extensions.environments.examination import examine
from harness.extensions.environments.place import CAREFUL_FIRST
from harness.extensions.environments.world import EnvironmentWorld, _kind
from harness.prompts import versions as prompts
from harness.report.drawing.artists import body
from harness.report.drawing.scene import draw
from harness.runs import formats
from harness.runs.folder import read
from harness.world import scenarios
from harness.world.drivers import DRIVERS
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.reference import drive
from harness.world.state import SIZES_M, ActionsTaken, WorldState
from harness.world.world import World

OWN = "env:my_roads:breakdown-v0"
SPEED_ONLY = {
    "action": {"type": "DiscreteMetaAction", "lateral": False, "target_speeds": [0, 4.5, 9]}
}

LANES_ONLY = {"action": {"type": "DiscreteMetaAction", "longitudinal": False}}


class Without(Breakdown):
    """One vehicle has no lane, or was made before it knew its road."""

    lane = True

    def _reset(self):
        super()._reset()
        vehicle = Vehicle(self.road if self.lane else None, [200.0, 60.0], 0, 5)
        vehicle.road = self.road
        if self.lane:
            vehicle.lane_index = vehicle.lane = None
        self.road.vehicles.append(vehicle)


class Roadless(Without):
    lane = False


class Crashed(Breakdown):
    """Another vehicle stands where the ego begins."""

    def _reset(self):
        super()._reset()
        self.road.vehicles.append(
            Vehicle(self.road, self.vehicle.position + np.array([2.0, 0.0]), 0, 10)
        )


class Ghost(Vehicle):
    """A vehicle that follows the ego, and that nothing collides with."""

    def __init__(self, road, position, heading=0, speed=0):
        super().__init__(road, position, heading, speed)
        self.check_collisions = self.collidable = False
        self.follows = road.vehicles[0]

    def step(self, dt):
        self.position, self.heading = self.follows.position.copy(), self.follows.heading


class Haunted(Breakdown):
    """Ghosts: two where the ego is, a vehicle and an object ahead that are passed through."""

    def _reset(self):
        super()._reset()
        for _ in range(2):
            self.road.vehicles.append(Ghost(self.road, self.vehicle.position, 0, 14))
        thin = Vehicle(self.road, self.vehicle.position + np.array([8.0, 0.0]), 0, 14)
        mirage = Obstacle(self.road, self.vehicle.position + np.array([12.0, 0.0]))
        thin.solid = mirage.collidable = False
        self.road.vehicles.append(thin)
        self.road.objects.append(mirage)


class Fading(Breakdown):
    """Each second the first of the other vehicles turns into a ghost."""

    def step(self, action):
        result = super().step(action)
        next(v for v in self.road.vehicles[1:] if v.collidable).collidable = False
        return result


class Arriving(Breakdown):
    """Onto an empty road comes, after a second, a car, behind two that are passed through."""

    def _reset(self):
        super()._reset()
        del self.road.vehicles[1:]

    def step(self, action):
        result = super().step(action)
        if self.steps == self.config["simulation_frequency"]:
            ahead_m = self.vehicle.position[0] + np.array([10, 14, 40])
            ghost, thin, car = (Vehicle(self.road, [x_m, 4.0], 0, 10) for x_m in ahead_m)
            ghost.collidable = thin.solid = False
            self.road.vehicles += [ghost, thin, car]
        return result


class Littered(Breakdown):
    """An obstacle stands beside the road; a landmark and two obstacles hit nobody."""

    def _reset(self):
        super()._reset()
        self.road.objects += [Obstacle(self.road, [x_m, -6.0]) for x_m in (30, 34, 38)]
        self.road.objects.append(Landmark(self.road, [26.0, -6.0]))
        _, ghost, thin, _ = self.road.objects
        ghost.collidable = thin.solid = False


class Van(IDMVehicle):
    LENGTH, WIDTH = 6.0, 2.1


class Bicycle(IDMVehicle):
    LENGTH, WIDTH = 1.8, 0.6


class Motorcycle(IDMVehicle):
    kind = "motorcycle"  # as long as a car, so it says what it is


class Pedestrian(Vehicle):
    LENGTH, WIDTH = 0.3, 0.5


class Street(Breakdown):
    """A crossing for pedestrians, and one road user of each kind."""

    def _reset(self):
        super()._reset()
        crossing = StraightLane([60, 14], [60, -8], width=3)
        self.road.network.add_lane("south", "north", crossing)
        heading = crossing.heading_at(0)
        self.road.vehicles[1:] = [
            IDMVehicle(self.road, [90.0, 4.0], 0, 12),
            Van(self.road, [8.0, 0.0], 0, 12),
            Truck(self.road, [84.0, 0.0], 0, 12),
            Bicycle(self.road, [48.0, 4.0], 0, 5),
            Motorcycle(self.road, [34.0, 0.0], 0, 12),
            Pedestrian(self.road, [60.0, 10.0], heading, 1.4),
        ]


class Vanishing(Breakdown):
    """Its ego is taken off the road after a second."""

    def step(self, action):
        result = super().step(action)
        self.road.vehicles = self.road.vehicles[1:]
        return result


class OwnVehicle(ControlledVehicle):
    pass


class OwnEgo(Breakdown):
    """The ego is of a class of its own, which has no target speeds."""

    ego_class = OwnVehicle

    def _reset(self):
        super()._reset()
        ego = self.ego_class(self.road, self.road.vehicles[0].position, speed=14)
        self.road.vehicles[0] = self.vehicle = ego


class IdmEgo(OwnEgo):
    ego_class = IDMVehicle


class PlainEgo(OwnEgo):
    ego_class = Vehicle


class Speedless(MDPVehicle):
    def __init__(self, *where, **how):
        super().__init__(*where, **how)
        self.target_speeds = None


class SpeedlessEgo(OwnEgo):
    ego_class = Speedless


class Through(MDPVehicle):
    def __init__(self, *where, **how):
        super().__init__(*where, **how)
        self.collidable = False


class GhostEgo(OwnEgo):
    ego_class = Through


class AbsentEgo(Breakdown):
    """The ego is not among the road's vehicles."""

    def _reset(self):
        super()._reset()
        self.road.vehicles.remove(self.vehicle)


EGOS = {
    OwnEgo: "is a OwnVehicle, which has no target_speeds, speed_index; make it of self.action_type",
    IdmEgo: "is a IDMVehicle, which has no target_speeds, speed_index; make it of self.action_type",
    PlainEgo: "is a Vehicle, which has no target_speeds, "
    "target_speed, speed_index, route; make it of",
    SpeedlessEgo: "is a Speedless, which has target_speeds None, no "
    "speeds; make it of self.action_type",
    GhostEgo: "is a Through, which hits nothing; leave it collidable and solid",
    AbsentEgo: "is not on the road; append self.vehicle to self.road.vehicles",
}
for kind in (
    Without, Roadless, Crashed, Haunted, Fading, Arriving, Littered, Street, Vanishing, *EGOS,
):  # fmt: skip
    gymnasium.register(f"{kind.__name__.lower()}-v0", entry_point=kind)


@pytest.mark.parametrize(("kind", "said"), EGOS.items())
def test_an_ego_that_meta_actions_do_not_drive_is_named(kind, said):
    with pytest.raises(UserError) as error:
        scenarios.get(f"env:{kind.__name__.lower()}-v0:decisions=2")
    assert f"its ego {said}" in str(error.value)


def test_an_ego_that_leaves_the_road_is_named():
    with pytest.raises(
        UserError, match=r"its ego leaves the road in seed 0; keep it in self\.road"
    ):
        examine(scenarios.get("env:vanishing-v0"), 0)


def test_who_turns_into_a_ghost_has_gone():
    world = EnvironmentWorld.begun(scenarios.get("env:fading-v0:decisions=2"), 0)
    seen = []
    for _ in range(3):
        seen.append(len(world.state().vehicles))
        world.advance(world.frame + world.period)
    assert seen == [5, 4, 3]


def test_what_collides_with_nothing_hides_nothing_and_helps_nobody(tmp_path):
    own, haunted = (
        scenarios.get(f"{name}:decisions=1,helpers=2") for name in (OWN, "env:haunted-v0")
    )
    seen = [World.start(each, 0).state() for each in (own, haunted)]
    assert (seen[1].vehicles, seen[1].buildings) == (seen[0].vehicles, seen[0].buildings)
    graphs = [
        scene_graph(each, state, "v1") for each, state in zip((own, haunted), seen, strict=True)
    ]
    assert graphs[0].sectors == graphs[1].sectors


def test_what_enters_later_and_collides_with_nothing_is_nowhere():
    scenario = scenarios.get("env:arriving-v0:decisions=2")
    world = EnvironmentWorld.begun(scenario, 0)
    world.advance(world.frame + world.period)
    state = world.state()
    [ego, car] = state.vehicles
    assert car.x_m - ego.x_m == pytest.approx(40.0, abs=0.1)
    graph = scene_graph(scenario, state, "v1")
    assert (graph.seen, graph.sectors[1].by) == ((car.id,), (car.id,))
    assert len(world.env.road.vehicles) == 4


def test_of_objects_only_what_can_be_hit_is_a_building():
    state = World.start(scenarios.get("env:littered-v0:decisions=2"), 0).state()
    [building] = state.buildings
    ego_x_m = state.ego.x_m - 20  # it starts 20 m along
    assert building.east_m - ego_x_m == pytest.approx(31.0)
    assert building.west_m - ego_x_m == pytest.approx(29.0)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "config", "seed"),
    [("u-turn-v0", {}, "44"), ("highway-v0", {"vehicles_count": 6}, "3")],
)
def test_at_its_own_15_frames_a_second_it_freezes_as_it_drives(
    name, config, seed, tmp_path, harness
):
    """In these layouts a vehicle arrives 5.067 s after another:
    in 38 moments, and after the horizon.
    """
    (tmp_path / "config.json").write_text(json.dumps(config))
    env = ("--env", f"{name}:decisions=3", "--env-config", "config.json", "--workers", "1")
    ask = ("--model", "local-view", "--condition", "single-local", "--seeds", "0")
    for typed in (
        ("dataset", "build", *env, "--episodes", "1", "--seed", seed, "--out", "set"),
        ("eval", *ask, "--dataset", "set", "--out", "walked"),
        ("drive", *ask, *env, "--episodes", "1", "--first-seed", seed, "--out", "drove"),
    ):
        code, _, err = harness(*typed)
        assert code == 0, err
    walked, drove = (read(tmp_path / run) for run in ("walked", "drove"))
    for measure in ("failure", "time_s", "least_gap_m", "least_ttc_s", "least_pet_s"):
        assert [getattr(e, measure) for e in walked.episodes] == [
            getattr(e, measure) for e in drove.episodes
        ]
    for measure in ("ttc_s", "pet_s"):
        np.testing.assert_array_equal(walked.decisions[measure], drove.decisions[measure])


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "name",
    sorted(
        name for name, spec in gymnasium.registry.items() if "highway_env" in str(spec.entry_point)
    ),
)
def test_every_environment_of_highway_env_freezes_or_says_why_not(name, tmp_path):
    continuous = (
        name.startswith(("parking", "racetrack", "lane-keeping")) or name == "intersection-v1"
    )
    says = pytest.raises(UserError, match="has no meta-actions but ContinuousAction; config")
    with says if continuous else nullcontext():
        build(
            scenarios.get(f"env:{name}:decisions=2"), tmp_path / "set", 2, 0, 1, lambda done: None
        )
    assert continuous or check(tmp_path / "set") == []


@pytest.mark.parametrize("kind", [Without, Roadless])
def test_a_vehicle_without_a_lane_is_named(kind, tmp_path):
    scenario = scenarios.get(f"env:{kind.__name__.lower()}-v0:decisions=1")
    said = r"v\d, a Vehicle at 200\.0, 60\.0 m, has no lane; make every vehicle"
    with pytest.raises(UserError, match=said):
        build(scenario, tmp_path / "set", 1, 0, 1, lambda done: None)


@pytest.mark.exhaustive
def test_an_ego_that_begins_in_a_collision_is_said_by_the_check_and_by_runs(tmp_path, harness):
    scenario = scenarios.get("env:crashed-v0:decisions=1")
    build(scenario, tmp_path / "set", 2, 0, 1, lambda done: None)
    assert check(tmp_path / "set") == []
    assert load(tmp_path / "set").lost == 2
    code, said, _ = harness("dataset", "check", tmp_path / "set")
    assert (code, "2 of 2 episodes are lost before the ego's first action" in said) == (0, True)
    code, said, _ = harness(
        "eval", "--model", "full-view", "--dataset", tmp_path / "set", "--out", "run", "--verbose"
    )
    assert code == 0
    lost = "2 of 2 episodes are lost before the ego's first action"
    assert lost in said
    assert lost in html.unescape((tmp_path / "run/report.html").read_text())
    drive_it = (
        "drive",
        "--model",
        "full-view",
        "--env",
        "crashed-v0",
        "--episodes",
        "2",
        "--workers",
        "1",
    )
    code, said, err = harness(
        *drive_it, "--first-seed", "0", "--seeds", "0", "--verbose", "--out", "driven"
    )
    assert code == 0, err
    assert lost in " ".join(said.split())


@pytest.mark.slow
@pytest.mark.usefixtures("unrebuilt")
def test_a_sound_environment_loses_nothing_at_once(folder, harness):
    assert load(folder).lost == 0
    code, said, _ = harness("dataset", "check", folder, "--json")
    assert (code, json.loads(said)["lost_before_first_action"]) == (0, 0)


def places(env):
    return [(*v.position.tolist(), float(v.heading), float(v.speed)) for v in env.road.vehicles]


@pytest.fixture(scope="module", autouse=True)
def _imports():
    """Allow the module of this user's own environment, and another that is not installed."""
    with pytest.MonkeyPatch.context() as changed:
        changed.setenv("SWARMDRIVE_IMPORTS", "my_roads,no_such_package")
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "breakdown"
    build(scenarios.get(f"{OWN}:decisions=2,helpers=2"), folder, 2, 0, 1, lambda done: None)
    return folder


@pytest.mark.parametrize(
    "env",
    [
        "merge-v0",
        "two-way-v0",
        *(
            pytest.param(env, marks=pytest.mark.exhaustive)
            for env in ("roundabout-v0", "highway-fast-v0")
        ),
    ],
)
def test_its_frames_are_those_of_its_own_step(env):
    scenario = scenarios.get(f"env:{env}")
    theirs, ours = reset(scenario.name, 3), EnvironmentWorld.begun(scenario, 3)
    for number in (1, 3, 0, 4):
        *_, terminated, _, _ = theirs.step(number)
        ours.take(theirs.action_type.actions[number])
        ours.advance(ours.frame + ours.period)
        if terminated:
            break
        assert places(ours.env) == places(theirs)
        assert (ours.env.steps, ours.env.time) == (theirs.steps, theirs.time)


@pytest.mark.exhaustive
def test_traffic_that_it_spawns_enters():
    scenario = scenarios.get(named("intersection-v1", SPEED_ONLY))
    assert (scenario.actions, scenario.parameters.decisions) == (CAREFUL_FIRST[:3], 6)
    theirs, ours = reset(scenario.name, 0), EnvironmentWorld.begun(scenario, 0)
    born = {v.id for v in ours.state().vehicles}
    for _ in range(8):
        theirs.step(1)
        ours.advance(ours.frame + ours.period)
        now = {v.id for v in ours.state().vehicles}
        assert places(ours.env) == places(theirs)
        assert len(now) == len(theirs.road.vehicles)
    assert now > born
    assert ours.state().ego.route == "left"


class Leaving(MergeEnv):
    """Lets a vehicle go after each second."""

    def step(self, action):
        result = super().step(action)
        self.road.vehicles = self.road.vehicles[:-1]
        return result


gymnasium.register("leaving-v0", entry_point=Leaving)


def test_traffic_that_it_takes_away_has_gone():
    world = EnvironmentWorld.begun(scenarios.get("env:leaving-v0:decisions=2"), 0)
    seen = []
    for _ in range(3):
        seen.append({v.id for v in world.state().vehicles})
        world.advance(world.frame + world.period)
    assert [len(ids) for ids in seen] == [5, 4, 3]
    assert seen[0] > seen[1] > seen[2]
    assert {beacon.sender for beacon in world.state().beacons} <= seen[2]


@pytest.mark.slow
def test_another_environment_does_not_change_its_traffic():
    """highway-env's intersection sets constants of the class of all IDM vehicles."""
    scenario = scenarios.get("env:merge-v0")
    world = World.start(scenario, 0)
    alone, beside = world.branch(), world.branch()
    alone.advance(45)
    reset(named("intersection-v1", SPEED_ONLY), 0)
    beside.advance(45)
    assert beside.state() == alone.state()
    again = World.start(scenario, 0)
    again.advance(45)
    assert again.state() == alone.state()


def test_the_state_says_who_is_where_and_helpers_are_the_nearest():
    state = World.start(scenarios.get(f"{OWN}:helpers=2"), 0).state()
    assert [(v.id, v.part, v.kind) for v in state.vehicles] == [
        ("v1", "ego", "car"), ("v2", "helper", "car"), ("v3", "helper", "truck"), ("v4", "other", "car"),
        ("v5", "other", "car"),
    ]  # fmt: skip
    gaps = [np.hypot(v.x_m - state.ego.x_m, v.y_m - state.ego.y_m) for v in state.vehicles]
    assert gaps == sorted(gaps)
    assert {v.route for v in state.vehicles} == {"to b lane 1", "to b lane 2"}


@pytest.mark.slow
def test_bicycles_motorcycles_and_pedestrians_stay_what_they_are(tmp_path):
    """By a `kind` of their own, else by size: in states, graphs, prompts and pictures."""
    scenario = scenarios.get("env:street-v0:decisions=1")
    build(scenario, tmp_path / "street", 1, 0, 1, lambda done: None)
    assert check(tmp_path / "street") == []
    scene = scenes_of(load(tmp_path / "street"))[0]
    kinds = {v.id: v.kind for v in scene.state.vehicles}
    assert kinds == {
        "v1": "car", "v2": "van", "v3": "motorcycle", "v4": "bicycle", "v5": "pedestrian",
        "v6": "truck", "v7": "car",
    }  # fmt: skip
    assert [v.id for v in scene.state.helpers] == ["v2", "v6", "v7"], "who has sensors"

    truth = truth_graph(scenario, scene.state)
    assert {"v1": "car", **{node.id: node.type for node in truth.nodes}} == kinds
    assert json.loads(msgspec.json.encode(truth))["nodes"][2]["type"] == "bicycle"
    walks = next(conflict for conflict in truth.conflicts if conflict.vehicle == "v5")
    assert (walks.kind, walks.sector, walks.other.arc_m) == ("crossing", "south", 6.0)
    near = msgspec.structs.replace(truth, nodes=truth.nodes[1:4])
    *_, user = prompts.load("v4").render(near, scenario.actions, (), scenario.prompt_words)
    for line in ("v3 motorcycle 14 4 12 ", "v4 bicycle 28 0 5 ", "v5 pedestrian 40 -6 1 "):
        assert f"\n{line}" in user["content"]

    svg = io.BytesIO()
    draw(scene, svg, "svg")
    for name, kind in kinds.items():
        assert f">{name} {kind}</" in svg.getvalue().decode()
    for v in scene.state.vehicles:
        outline = cast("Polygon", body(v, v.part, hidden=False)).get_xy()
        sides_m = np.hypot(*np.diff(outline, axis=0).T)
        np.testing.assert_allclose(sorted({*sides_m.round(6)}), sorted(SIZES_M[v.kind]))


class Named(Vehicle):
    def __init__(self, kind, length=5.0, width=2.0):
        self.kind, self.LENGTH, self.WIDTH = kind, length, width


@pytest.mark.parametrize(
    ("vehicle", "kind"),
    [
        (Named("pedestrian"), "pedestrian"),
        (Named("tank"), "car"),  # a kind that nobody knows
        (Named(["truck"]), "car"),
        (Named(None, 1.7, 0.6), "bicycle"),
        (Named(None, 2.2, 1.0), "motorcycle"),
        (Named(None, 0.5, 0.5), "pedestrian"),
        (Named(None, 4.2, 1.7), "car"),
        (Named(None, 18.0, 2.5), "truck"),
    ],
)
def test_a_vehicle_says_its_kind_or_its_size_does(vehicle, kind):
    assert _kind(vehicle) == kind


@pytest.mark.exhaustive
def test_other_controlled_vehicles_help_first_and_keep_to_their_course():
    several = {
        "controlled_vehicles": 2,
        "vehicles_count": 5,
        "action": {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction"}},
        "observation": {
            "type": "MultiAgentObservation",
            "observation_config": {"type": "Kinematics"},
        },
    }
    scenario = scenarios.get(named("highway-fast-v0", several))
    examine(scenario, 0)
    world = EnvironmentWorld.begun(scenario, 0)
    _, other = world.env.controlled_vehicles
    assert (other.spawn.id, other.spawn.part) == ("v2", "helper")
    before = other.target_lane_index, other.target_speed
    world.act("LANE_LEFT")
    assert (other.target_lane_index, other.target_speed) == before
    assert world.state().ego.route == "to 1 lane 2"


def test_the_truck_hides_the_breakdown_from_the_ego_and_helpers_see_it():
    scenario = scenarios.get(OWN)
    state = World.start(scenario, 0).state()
    conflicts = {
        viewer: [(c.vehicle, c.kind, c.lane) for c in graph.conflicts]
        for viewer, graph in {
            "truth": truth_graph(scenario, state),
            **{v.id: scene_graph(scenario, state, v.id) for v in (state.ego, *state.helpers)},
        }.items()
    }
    assert ("v5", "ahead", "own") in conflicts["truth"]
    assert ("v5", "ahead", "own") not in conflicts["v1"]
    assert ("v5", "ahead", "own") in conflicts["v3"]
    sectors = {s.sector: s for s in scene_graph(scenario, state, "v1").sectors}
    assert sectors["to b lane 2"].seen_share < 0.5
    assert "v3" in sectors["to b lane 2"].by


def test_cruising_hits_what_stands_and_full_view_passes():
    scenario = scenarios.get(OWN)
    cruise, full_view = (drive(scenario, driver, 0) for driver in ("cruise", "full-view"))
    assert (cruise.result, cruise.striker) == ("collision", "ego")
    assert full_view.result == "cleared"


def test_a_thawed_world_goes_on_as_the_one_it_was_taken_from():
    scenario = scenarios.get("env:roundabout-v0")
    world = World.start(scenario, 1)
    world.act("FASTER")
    world.advance(world.frame + 4)
    world.take("SLOWER")
    text = msgspec.json.encode((world.state(), world.snapshot()))
    stored = msgspec.json.decode(text, type=tuple[WorldState, ActionsTaken])
    thawed, branch = World.thaw(scenario, *stored), world.branch()
    for each in (world, thawed, branch):
        each.act("IDLE")
    assert world.state() == thawed.state() == branch.state()


@pytest.mark.slow
def test_its_dataset_is_sound_and_pins_its_configuration(folder):
    assert check(folder) == []
    data = load(folder)
    assert data.scenario == scenarios.get(f"{OWN}:decisions=2,helpers=2")
    assert data.manifest.environment["stands_m"] == 95.0
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["environment"]["stands_m"] = 90.0
    changed = folder.parent / "changed"
    changed.mkdir()
    (changed / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(
        UserError, match=r"its configuration has another stands_m; build the dataset again"
    ):
        load(changed)


@pytest.mark.exhaustive
def test_equal_builds_are_equal_bytes(folder, tmp_path):
    """The manifest has the digests of all bytes of each layout."""
    build(
        scenarios.get(f"{OWN}:decisions=2,helpers=2"),
        tmp_path / "breakdown",
        1,
        0,
        1,
        lambda done: None,
    )
    again, first = (
        json.loads((of / "manifest.json").read_text()) for of in (tmp_path / "breakdown", folder)
    )
    assert again["trees_sha256"] == first["trees_sha256"][:1]
    assert {key for key in first if again[key] != first[key]} == {
        "episodes",
        "nodes",
        "trees_sha256",
        "files",
    }


@pytest.mark.parametrize(
    ("env", "config"),
    [
        pytest.param("merge-v0", None, marks=pytest.mark.slow),
        pytest.param("roundabout-v0", None, marks=pytest.mark.exhaustive),
        pytest.param("intersection-v1", SPEED_ONLY, marks=pytest.mark.exhaustive),
    ],
)
def test_stock_environments_freeze_as_they_drive_and_are_drawn(env, config, tmp_path):
    """`build` drives every reference driver too, and compares."""
    scenario = scenarios.get(named(env, config))
    scenario = replace(
        scenario, parameters=replace(scenario.parameters, decisions=2, time_limit_s=4.0)
    )
    build(scenario, tmp_path / "stock", 1, 0, 1, lambda done: None)
    assert check(tmp_path / "stock") == []
    scenes = scenes_of(load(tmp_path / "stock"))
    assert {
        driver for tree in load(tmp_path / "stock").trees for driver in tree.levels[0][0].drivers
    } == {*DRIVERS}
    picture = io.BytesIO()
    draw(scenes[0], picture, "svg")
    assert picture.getvalue().startswith(b"<?xml")


@pytest.mark.parametrize(
    "models",
    [
        pytest.param(["proxy"], marks=pytest.mark.slow),
        pytest.param(["proxy", "swarm-tiny"], marks=pytest.mark.exhaustive),
    ],
)
def test_the_commands_take_it_from_end_to_end(harness, folder, models):
    assert harness("dataset", "show", folder, "00000-0", "--out", "scene.png")[0] == 0
    for model in models:
        if model == "swarm-tiny":
            pytest.importorskip("torch")
        ran = harness(
            "eval",
            "--model",
            model,
            "--dataset",
            folder,
            "--seeds",
            "0",
            "--condition",
            "6g",
            "--out",
            model,
        )
        assert ran[0] == 0, ran
        answers = [
            json.loads(line) for line in Path(model, "answers.jsonl").read_text().splitlines()
        ]
        assert answers
    assert harness("report", *models, "--out", "page.html")[0] == 0
    drove = harness(
        "drive", "--env", f"{OWN.removeprefix('env:')}:decisions=2", "--episodes", "1", "--seeds", "0",
        "--condition", "single-local", "--workers", "1", "--out", "driven",
    )  # fmt: skip
    assert drove[0] == 0, drove
    assert harness("report", "driven", "--out", "driven.html")[0] == 0


class Forgetful(MergeEnv):
    """Draws from nobody's generator."""

    def _reset(self):
        super()._reset()
        self.road.vehicles[1].speed += np.random.default_rng().uniform()


class Locked(MergeEnv):
    def _reset(self):
        super()._reset()
        self.lock = threading.Lock()


class Hasty(MergeEnv):
    """Changes something before its frames."""

    def step(self, action):
        self.road.vehicles[1].target_speed = 5.0
        return super().step(action)


class Broken(MergeEnv):
    def _reward(self, action):
        return 1 / 0


class Unlike(Breakdown):
    """Starts without an ego."""

    def _reset(self):
        raise ValueError("nobody\nis here")


for kind in (Forgetful, Locked, Hasty, Broken, Unlike):
    gymnasium.register(f"{kind.__name__.lower()}-v0", entry_point=kind)


@pytest.mark.parametrize(
    ("env", "config", "said"),
    [
        ("merge", {}, "give its version too, as in merge-v0"),
        ("mrge-v0", {}, "`mrge` doesn't exist"),
        ("no_such_package:MyEnv-v0", {}, "No module named 'no_such_package'; install the package"),
        ("CartPole-v1", {}, 
            "is a CartPoleEnv, no environment of "
            "highway-env; its class must be a subclass"),
        ("racetrack-v0", {}, "has no meta-actions but ContinuousAction; config"),
        ("intersection-v1", {}, "has no meta-actions but ContinuousAction; config"),
        ("racetrack-v0", SPEED_ONLY, "cannot be reset: AttributeError: 'functools.partial'"),
        ("merge-v0", LANES_ONLY, 
            "has no action FASTER, SLOWER; set "
            "`longitudinal` in its action config"),
        ("merge-v0", {"policy_frequency": 2}, 
            "simulation_frequency 15 is no "
            "multiple of policy_frequency 2"),
        ("merge-v0", {"policy_freqency": 1}, "did you mean 'policy_frequency'?"),
        ("forgetful-v0", {}, 
            "its traffic differs between two runs of "
            "seed 0; draw from env.np_random"),
        ("locked-v0", {}, "cannot be copied: TypeError: cannot pickle '_thread.lock' object"),
        ("hasty-v0", {}, "frame by frame its traffic is another than by its step()"),
        ("broken-v0", {}, "its step() fails: ZeroDivisionError: division by zero"),
        ("unlike-v0", {}, r"cannot be made: ValueError: nobody\nis here"),
    ],
)  # fmt: skip
def test_what_an_environment_lacks_is_said_in_a_line(env, config, said):
    with pytest.raises(UserError) as error:
        examine(scenarios.get(named(env, config)), 0)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "give either a scenario or --env"),
        (("do-not-pass", "--env", "merge-v0"), "give either a scenario or --env"),
        (("do-not-pass", "--env-config", "c.json"), "--env-config changes an environment"),
        (
            ("--env", "merge-v0", "--env-config", "missing.json"),
            "--env-config missing.json cannot be read",
        ),
        (("--env", "merge-v0", "--env-config", "list.json"), "its config is no JSON object"),
        (("--env", "merge-v0:decisions=0"), "decisions is 0; it must be from 1 to 10"),
        (("--env", "merge-v0:decisions=many"), "decisions is 'many'; give a number"),
        (("--env", "merge-v0:goals=3"), "unknown setting of scenario env:merge-v0 'goals'"),
        (("--env", "\x1b[31mred"), r"\x1b[31mred"),
    ],
)
def test_bad_input_is_a_line(harness, tmp_path, arguments, said):
    (tmp_path / "list.json").write_text("[1]")
    code, _, err = harness("dataset", "build", *arguments, "--out", "made")
    assert (code, err.count("\n")) == (2, 1)
    assert said in err


def test_the_page_shows_the_environment_of_these_tests():
    root = Path(__file__).parents[3]
    assert (root / "tests/my_roads.py").read_text() in (root / "docs/environments.md").read_text()


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("env:my_roads:breakdown-v0", "my_roads"),
        ("env:my_roads.inner:breakdown-v0", "my_roads.inner"),
        ("env:os.path:breakdown-v0", "os.path"),
        *(
            (named("merge-v0", {"other_vehicles_type": f"{module}.Car"}), module)
            for module in ("my_roads", "my_roads.inner", "my-roads", "highway_environment")
        ),
    ],
)
def test_a_name_that_would_import_a_module_is_refused_unless_it_is_listed(
    name, module, monkeypatch
):
    monkeypatch.setenv("SWARMDRIVE_IMPORTS", "other,my_road")
    with pytest.raises(
        UserError, match=f"would import the module {module}; if you trust it, set SWARM"
    ):
        reset(name, 0)
    monkeypatch.setenv("SWARMDRIVE_IMPORTS", f"other, {module.partition('.')[0]}")
    said = ""
    try:
        reset(name, 0)
    # something else is wrong with it, now that it may be imported
    except (UserError, ValueError) as error:
        said = str(error)
    assert not said if name == OWN else "would import" not in said


class Imports(Breakdown):
    """Names a street by a number, a file by its path, and a class of its own by its path."""

    @classmethod
    def default_config(cls):
        own = {
            "street": "1.0",
            "map": "a/b.c.xml",
            "breaks": "my_roads.Truck",
            "late": "my_roads.Truck",
        }
        return super().default_config() | own

    def step(self, action):
        class_from_path(self.config["late" if self.time else "breaks"])
        return super().step(action)


gymnasium.register("imports-v0", entry_point=Imports)


def test_a_text_with_a_dot_is_a_module_only_where_it_is_imported(monkeypatch):
    monkeypatch.delenv("SWARMDRIVE_IMPORTS")
    changes = {"street": "1.5", "map": "../no.such/map.net.xml", "breaks": "my_roads.Truck"}
    examine(scenarios.get(named("imports-v0", changes)), 0)
    hostile = scenarios.get(named("imports-v0", {"late": "antigravity.Car"}))
    with pytest.raises(UserError, match="would import the module antigravity"):
        examine(hostile, 0)
    with pytest.raises(UserError, match="would import the module antigravity"):
        World.start(hostile, 0).advance(31)
    assert "antigravity" not in sys.modules


def test_classes_of_highway_env_need_no_listing(monkeypatch):
    monkeypatch.delenv("SWARMDRIVE_IMPORTS")
    traffic = {"other_vehicles_type": "highway_env.vehicle.behavior.AggressiveVehicle"}
    env = reset(named("merge-v0", traffic), 0)
    assert any(type(v).__name__ == "AggressiveVehicle" for v in env.road.vehicles)


@pytest.mark.slow
def test_what_is_typed_may_be_imported_and_what_a_file_names_may_not(harness, folder, monkeypatch):
    monkeypatch.delenv("SWARMDRIVE_IMPORTS")
    assert harness("dataset", "scenario", "show", OWN)[0] == 0
    for command in ("check", "rank"):
        code, _, err = harness("dataset", command, folder)
        assert (code, err.count("\n")) == (2, 1)
        assert "set SWARMDRIVE_IMPORTS=my_roads in your environment" in err


@pytest.mark.parametrize(
    ("typed", "name", "may_be"),
    [
        ('env:a-v0:decisions=3:config={"a":1,"b":2}', 'env:a-v0:config={"a":1,"b":2}', True),
        ('env:a-v0:config={"a":1,"b":2}', 'env:a-v0:config={"a":1}', False),
        ("env:a-v0", "env:b-v0", False),
    ],
)
def test_what_was_typed_may_open_the_environment_of_its_id_and_configuration(
    typed: str, name: str, may_be: bool
) -> None:
    assert formats._may_be(typed, name) == may_be
