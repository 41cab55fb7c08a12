"""The live world: physics, determinism, how episodes end, and thawing."""

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from former import SCENARIO
from frames import highway_envs_frame, poses
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.vehicle.behavior import IDMVehicle
from msgspec import to_builtins
from tiers import some
from together import act_together

from harness.core.files import digest
from harness.world.lockstep import Fleet
from harness.world.outcome import Outcome, outline
from harness.world.reference import drive
from harness.world.state import Snapshot, WorldState
from harness.world.world import World

NO_DANGER, FROM_RIGHT, FROM_LEFT, ONCOMING = 0, 1, 6, 10  # seeds
P: Any = SCENARIO.parameters
ACTIONS = SCENARIO.actions


def trajectory(seed, actions=("IDLE", "SLOWER", "FASTER", "IDLE")):
    """States at each decision, as JSON has them."""
    world = World.start(SCENARIO, seed)
    states = [to_builtins(world.state())]
    for action in actions:
        world.act(action)
        states.append(to_builtins(world.state()))
    return states


def through_json(world):
    """The world thawed from what is left of it in a file."""
    text = msgspec.json.encode((world.state(), world.snapshot()))
    return World.thaw(SCENARIO, *msgspec.json.decode(text, type=tuple[WorldState, Snapshot]))


def advance(world, frames):
    for _ in range(frames):
        world.advance(world.frame + 1)


def test_actions_are_highway_envs_by_name_and_order():
    assert World.start(SCENARIO, 0).actions == ACTIONS == tuple(IntersectionEnv.ACTIONS.values())


@pytest.mark.parametrize("seed", [NO_DANGER, FROM_RIGHT, FROM_LEFT, ONCOMING])
def test_an_episode_starts_at_14_mps_in_the_egos_lane_before_the_first_decision(seed):
    state = World.start(SCENARIO, seed).state()
    assert (state.ego.speed_mps, state.target_speed_mps, state.step, state.time_s) == (
        14.0,
        14.0,
        0,
        0.0,
    )
    assert (state.ego.id, state.ego.x_m, state.ego.route) == ("v1", 2.0, "straight")
    # the conflict zone is 0.54 m north
    assert P.ego_start_m[0] <= state.ego.y_m + 0.54 <= P.ego_start_m[1]


@pytest.mark.slow
def test_the_ego_brakes_and_accelerates_within_its_limits():
    world = World.start(SCENARIO, NO_DANGER)
    speeds = [world.state().ego.speed_mps]
    for action in ("SLOWER", "SLOWER", "FASTER", "FASTER", "SLOWER"):
        world.take(action)
        for _ in range(P.simulation_hz):
            advance(world, 1)
            speeds.append(world.state().ego.speed_mps)
    changes = np.diff(speeds) * P.simulation_hz
    # both limits are reached, neither is passed
    assert changes.min() == pytest.approx(-P.braking_mps2)
    assert changes.max() == pytest.approx(P.acceleration_mps2)


def test_one_decision_lasts_one_second_of_fifty_frames():
    world = World.start(SCENARIO, NO_DANGER)
    world.act("IDLE")
    state = world.state()
    assert (state.step, state.time_s, world.frame) == (1, 1.0, 50)
    assert state.ego.y_m == pytest.approx(World.start(SCENARIO, NO_DANGER).state().ego.y_m - 14.0)


def test_an_unhindered_cruise_clears_when_the_distance_is_covered():
    start = World.start(SCENARIO, NO_DANGER).state().ego.y_m
    outcome = drive(SCENARIO, "cruise", NO_DANGER)
    frames = np.ceil((start + 11.0 + P.cleared_m) / 14.0 * P.simulation_hz)
    assert (outcome.result, outcome.time_s) == ("cleared", pytest.approx(frames / P.simulation_hz))


def after_others(*names):
    """A trajectory's digest where environments of highway-env and another episode ran before."""
    defaults = (IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MAX, IDMVehicle.COMFORT_ACC_MIN)
    try:
        for name in names:
            env = gymnasium.make(name)
            env.reset(seed=3)
            for _ in range(3):
                env.step(1)
            env.close()
        drive(SCENARIO, "brake", 3)
        return digest(trajectory(ONCOMING))
    finally:
        IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MAX, IDMVehicle.COMFORT_ACC_MIN = (
            defaults
        )


@pytest.mark.slow
def test_the_same_seed_is_the_same_episode_whatever_ran_before():
    """intersection-v0 writes to a class that others share."""
    assert after_others("intersection-v0") == digest(trajectory(ONCOMING))


@pytest.mark.exhaustive
def test_the_same_seed_is_the_same_episode_in_a_process_of_its_own():
    here = after_others("intersection-v0", "highway-v0")
    code = (
        f"import sys; sys.path[:0] = {[str(folder) for folder in Path(__file__).parents[:2]]!r}; "
        "from harness.core.files import digest; import test_world as t; "
        "print(digest(t.trajectory(t.ONCOMING)))"
    )
    fresh = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert fresh.stdout.strip() == here


def test_a_world_leaves_highway_envs_classes_as_they_were():
    before = (IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MAX, IDMVehicle.COMFORT_ACC_MIN)
    World.start(SCENARIO, FROM_LEFT).act("IDLE")
    assert before == (
        IDMVehicle.DISTANCE_WANTED,
        IDMVehicle.COMFORT_ACC_MAX,
        IDMVehicle.COMFORT_ACC_MIN,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "actions"),
    [
        (ONCOMING, ("SLOWER", "FASTER", "SLOWER", "IDLE")),
        *(
            pytest.param(seed, actions, marks=pytest.mark.exhaustive)
            for seed in (NO_DANGER, FROM_RIGHT, FROM_LEFT, ONCOMING, 3, 12)
            for actions in (
                ("IDLE",) * 6,
                ("SLOWER", "FASTER", "SLOWER", "SLOWER", "FASTER", "IDLE"),
            )
        ),
    ],
)
def test_frames_are_highway_envs_to_the_last_bit(seed, actions):
    ours, theirs = World.start(SCENARIO, seed), World.start(SCENARIO, seed)
    for frame in range(len(actions) * P.simulation_hz):
        if frame % P.simulation_hz == 0 and not ours.outcome.ended:
            ours.take(actions[frame // P.simulation_hz])
            theirs.take(actions[frame // P.simulation_hz])
        if not ours.outcome.ended:
            advance(ours, 1)
            highway_envs_frame(theirs)
        assert poses(ours) == poses(theirs)
        assert ours.outcome.result == theirs.outcome.result


@pytest.mark.parametrize("seed", [FROM_RIGHT, FROM_LEFT, ONCOMING])
def test_a_second_at_once_and_frame_by_frame_are_the_same_second(seed):
    whole, frames = World.start(SCENARIO, seed), World.start(SCENARIO, seed)
    for action in ("SLOWER", "IDLE", "FASTER"):
        whole.act(action)
        advance(frames, P.lag_frames)
        frames.take(action)
        advance(frames, P.simulation_hz - P.lag_frames)
        assert frames.state().vehicles == whole.state().vehicles
        assert (frames.outcome, frames.journey.hard_brakings) == (
            whole.outcome,
            whole.journey.hard_brakings,
        )


def test_braking_hard_is_counted_once_each_time_it_begins():
    world = World.start(SCENARIO, NO_DANGER)
    for action, so_far in (("IDLE", 0), ("SLOWER", 1), ("IDLE", 1), ("SLOWER", 2), ("FASTER", 2)):
        world.act(action)
        assert world.journey.hard_brakings == so_far


def test_two_seeds_are_two_episodes():
    assert digest(trajectory(FROM_LEFT)) != digest(trajectory(FROM_RIGHT))


@pytest.mark.slow
@pytest.mark.parametrize("seed", some([ONCOMING], exhaustive=[FROM_RIGHT, FROM_LEFT]))
def test_a_collision_ends_the_episode_in_the_frame_in_which_outlines_meet(seed):
    world = World.start(SCENARIO, seed)
    gaps = []
    while not world.outcome.ended:
        advance(world, 1)
        state = world.state()
        gaps.append(min(outline(state.ego).distance(outline(v)) for v in state.vehicles[1:]))
    assert world.outcome.result == "collision"
    assert world.outcome.time_s == pytest.approx(len(gaps) / P.simulation_hz)
    assert gaps[-2] > 0.0
    assert gaps[-2] < 0.6  # 28 m/s is 0.56 m a frame, and no two vehicles close faster
    assert gaps[-1] < gaps[-2]
    assert world.outcome.partner == world.layout.danger_id
    assert world.outcome.least_gap_m == 0.0
    assert world.outcome.other_crashes == 0


@pytest.mark.parametrize(
    ("seed", "blamed"), [(FROM_RIGHT, "ego"), (FROM_LEFT, "ego"), (ONCOMING, "other")]
)
def test_a_cruising_ego_owes_way_to_the_crossing_road_and_is_owed_it_by_a_left_turn(seed, blamed):
    assert drive(SCENARIO, "cruise", seed).fault == blamed


def test_an_ego_beside_its_lane_has_left_the_road():
    world = World.start(SCENARIO, NO_DANGER)
    world.road.vehicles[0].position[0] += 6.0
    world.act("IDLE")
    assert (world.outcome.result, world.outcome.time_s) == ("off_road", 1 / P.simulation_hz)


def test_always_braking_never_arrives():
    outcome = drive(SCENARIO, "brake", NO_DANGER)
    assert (outcome.result, outcome.time_s, outcome.partner) == ("time_out", P.time_limit_s, None)
    assert outcome.least_gap_m > 1.0


def test_running_into_the_car_ahead_is_the_egos_fault_and_its_partner_is_that_car():
    world = World.start(SCENARIO, NO_DANGER)
    ego, ahead = world.road.vehicles[0], world.road.vehicles[3]
    ahead.position, ahead.speed = ego.position - [0.0, 9.0], 4.0
    world.act("IDLE")
    assert world.outcome.result == "collision"
    assert (world.outcome.partner, world.outcome.striker, world.outcome.fault) == (
        "v4",
        "ego",
        "ego",
    )


@pytest.mark.usefixtures("asleep_at_the_wheel")
def test_a_crash_of_two_others_is_counted_apart_and_ends_nothing():
    world = World.start(SCENARIO, NO_DANGER)
    head_on(world, apart_m=6.0)
    world.act("IDLE")
    assert [v.id for v in world.state().vehicles if v.crashed] == ["v2", "v3"]
    assert (world.outcome.other_crashes, world.outcome.ended) == (2, False)


def head_on(world, apart_m):
    """Two helpers drive into each other, far from the ego; `apart_m` is between their bumpers."""
    first, second = world.road.vehicles[1:3]
    first.position, first.heading, first.speed = np.array([-40.0, -2.0]), 0.0, 6.0
    second.position, second.heading, second.speed = (
        np.array([-35.0 + apart_m, -2.0]),
        np.pi - 0.3,
        5.0,
    )


@pytest.fixture
def asleep_at_the_wheel(monkeypatch):
    """The two helpers neither steer nor brake."""
    act = Fleet._act

    def asleep(fleet):
        act(fleet)
        fleet.steering[:, 1:3] = fleet.acceleration[:, 1:3] = 0.0

    monkeypatch.setattr(Fleet, "_act", asleep)


def close(one, other):
    """Whether values as JSON has them are the same; numbers to a tenth of a millimetre.

    A state is kept to the micrometre, so that is where a thawed world goes on from.
    """
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(close(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(close, one, other))
    return one == (pytest.approx(other, abs=1e-4) if isinstance(one, float) else other)


def alike(one, other):
    """Whether two worlds are in the same state."""
    return close(to_builtins(one.state()), to_builtins(other.state()))


@pytest.mark.parametrize("seed", some([FROM_LEFT], exhaustive=[FROM_RIGHT, ONCOMING]))
def test_a_thawed_world_goes_on_as_the_one_it_was_taken_from(seed):
    world = World.start(SCENARIO, seed)
    for behaviour in ("IDLE", "SLOWER", "SLOWER", "FASTER"):
        thawed, originals = (
            [make(world) for _ in ACTIONS] for make in (through_json, World.branch)
        )
        for original in originals:
            # what happened before is not part of a frozen world
            original.journey.outcome = Outcome()
        for then in (ACTIONS, ("IDLE",) * len(ACTIONS)):
            act_together([*thawed, *originals], 2 * then)
            for one, other in zip(thawed, originals, strict=True):
                assert alike(one, other)
                assert one.snapshot() == other.snapshot()
        for one, other in zip(thawed, originals, strict=True):
            assert close(asdict(one.outcome), asdict(other.outcome))
        world.act(behaviour)


@pytest.mark.slow
def test_many_seeds_thaw_at_every_step_to_the_same_next_second():
    worlds = [World.start(SCENARIO, seed) for seed in range(20, 24)]
    for action in ("IDLE", "FASTER", "SLOWER"):
        thawed = [through_json(world) for world in worlds]
        act_together([*worlds, *thawed], [action] * 2 * len(worlds))
        assert all(map(alike, thawed, worlds))


@pytest.mark.usefixtures("asleep_at_the_wheel")
@pytest.mark.parametrize("apart_m", [9.6, 9.7, 9.9, 10.0, 11.0])
def test_wrecks_that_touch_when_frozen_are_pushed_apart_when_thawed(apart_m):
    world = World.start(SCENARIO, NO_DANGER)
    head_on(world, apart_m)
    world.act("IDLE")
    thawed = through_json(world)
    world.act("IDLE")
    thawed.act("IDLE")
    assert alike(thawed, world)
    assert [v.id for v in thawed.state().vehicles if v.crashed] == ["v2", "v3"]


def test_a_branch_goes_its_own_way():
    world = World.start(SCENARIO, FROM_LEFT)
    before = world.state()
    world.branch().act("SLOWER")
    assert world.state() == before


def test_a_snapshot_is_a_frame_a_section_a_vehicle_and_a_speed_level():
    world = World.start(SCENARIO, ONCOMING)
    world.act("SLOWER")
    snapshot = world.snapshot()
    assert isinstance(snapshot, Snapshot)
    values = [snapshot.frame, snapshot.speed_index, *snapshot.sections]
    assert {type(value) for value in values} == {int}
    assert len(snapshot.sections) == len(world.state().vehicles)
