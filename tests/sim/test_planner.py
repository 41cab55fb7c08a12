"""The reference planner: its model of motion, its gaps, and what it decides by hand-made graphs."""

from dataclasses import replace

import numpy as np
import pytest
from former import SCENARIO, SETTINGS
from msgspec import structs
from together import act_together, drive_together

from harness.world import lockstep, planner, scenarios
from harness.world.drivers import DRIVERS, choose
from harness.world.perception.graph import truth_graph, truth_graphs
from harness.world.planner import (
    MARGIN_M,
    STEP_S,
    Rollouts,
    cover,
    least_gap,
    levels,
    plan,
    plans,
    predicted,
)
from harness.world.state import SIZES_M, VehicleState, WorldState
from harness.world.world import World

P, ACTIONS = SCENARIO.parameters, SCENARIO.actions
EGO = VehicleState(
    "v1", "car", "ego", 2.0, 44.0, -np.pi / 2, 14.0, "own", "straight", False
)  # 42 m before (2, 2, False)

TOUCHING_M = 2 * cover(*SIZES_M["car"])[1] + MARGIN_M  # between the middles of two discs that touch

CLOSE = structs.replace(EGO, y_m=24.0)  # 22 m before


def graph(*others, ego=EGO, target_mps=14.0, step=1):
    return truth_graph(
        SCENARIO, WorldState("by hand", 0, step, float(step), target_mps, (ego, *others), ())
    )


def from_left(x_m, speed_mps=10.0):
    return VehicleState("v5", "car", "other", x_m, 2.0, 0.0, speed_mps, "left", "straight", False)


def travelled_m(sequences, left):
    """How far an ego at its target speed of 14 m/s comes by each sequence."""
    return planner.travelled_m(levels(sequences), np.array([14.0]), np.array([14.0]), left, P)[0]


def gap(travelled_m, scene):
    """The least gap of an ego that keeps its lane to the only other vehicle of a graph."""
    tried = Rollouts(travelled_m, None, np.arange(len(travelled_m)))
    (motion,) = predicted(SCENARIO.road(), scene, travelled_m.shape[1])
    return least_gap(tried, motion, within_m=100.0)


def test_on_an_empty_road_it_keeps_going():
    assert plan(SCENARIO, graph()) == "IDLE"


def test_it_speeds_up_on_an_empty_road_when_slow():
    assert (
        plan(SCENARIO, graph(ego=structs.replace(EGO, speed_mps=7.0), target_mps=7.0)) == "FASTER"
    )


def test_it_slows_for_a_car_that_it_would_meet_and_not_before_it_must():
    # 42 m before the crossing there is a second left to wait and see; 22 m before it there is none.
    assert plan(SCENARIO, graph(from_left(2.0 - 30.0))) == "IDLE"
    assert plan(SCENARIO, graph(from_left(2.0 - 15.7), ego=CLOSE)) == "SLOWER"


def test_it_keeps_going_before_a_car_that_comes_much_later_and_behind_one_that_has_passed():
    assert plan(SCENARIO, graph(from_left(2.0 - 60.0))) == "IDLE"
    assert plan(SCENARIO, graph(from_left(2.0 - 12.0))) == "IDLE"


def test_it_does_not_guess_at_what_the_graph_does_not_list():
    hidden = structs.replace(graph(from_left(2.0 - 15.7), ego=CLOSE), conflicts=())
    assert plan(SCENARIO, hidden) == "IDLE"


def test_where_every_way_ends_in_a_collision_it_takes_the_one_with_the_widest_gap():
    # 14 m before the crossing, with a car 10 m from it: too late for anything but the least of
    # evils.
    scene = graph(from_left(2.0 - 10.0), ego=structs.replace(EGO, y_m=16.0))
    gaps = {a: gap(travelled_m([(a,)], 5), scene)[0] for a in ACTIONS}
    assert max(gaps.values()) < 0.0
    assert gaps[plan(SCENARIO, scene)] == max(gaps.values())


@pytest.mark.parametrize("first", ACTIONS)
@pytest.mark.parametrize("second", ACTIONS)
def test_its_model_of_motion_follows_the_simulator(first, second):
    """Where a decision acts at once: the model has no lag."""
    world = World.start(replace(SCENARIO, parameters=replace(P, decision_lag_s=0.0)), 0)
    start = world.state().ego.y_m
    (travelled,) = travelled_m([(first, second)], P.decisions)
    for seconds, action in enumerate((first, second, "FASTER"), 1):
        world.act(action)
        model = travelled[round(seconds / STEP_S) - 1]
        assert model == pytest.approx(start - world.state().ego.y_m, abs=1.0)


def test_the_gap_to_a_car_standing_on_the_crossing_is_what_the_discs_leave():
    # An ego that stays 20 m short of a car standing at the crossing; discs reach 5/3 m plus their
    # radius.
    scene = graph(from_left(2.0, speed_mps=0.0))
    travelled = np.full((1, 90), scene.conflicts[0].ego.arc_m - 20.0)
    assert gap(travelled, scene) == pytest.approx([20.0 - 5.0 / 3 - TOUCHING_M], abs=0.1)


def test_an_ego_on_top_of_another_has_a_gap_below_zero():
    scene = graph(from_left(2.0, speed_mps=0.0))
    travelled = np.full((1, 90), scene.conflicts[0].ego.arc_m)
    assert gap(travelled, scene) == pytest.approx([-TOUCHING_M], abs=0.1)


@pytest.mark.slow
def test_who_overtakes_plans_the_way_back_under_limits_2():
    """What comes late hinders one who does not:
    in all that it plays it stays on the wrong lane for good.
    """
    seeds = 200006, 201020, 202134  # no danger, and a car that comes long after
    for limits, results in ((1, ["time_out", "time_out", "collision"]), (2, ["cleared"] * 3)):
        scenario = scenarios.get(f"do-not-pass:{SETTINGS},limits={limits}")
        driven = drive_together(scenario, "full-view", seeds)
        assert [driven[seed].result for seed in seeds] == results


def test_only_the_full_view_driver_reads_the_truth():
    hidden, truth = graph(ego=CLOSE), graph(from_left(2.0 - 15.7), ego=CLOSE)
    chosen = {driver: choose(SCENARIO, driver, hidden, truth) for driver in DRIVERS}
    assert chosen == {
        "cruise": "IDLE",
        "brake": "SLOWER",
        "local-view": "IDLE",
        "full-view": "SLOWER",
    }
    with pytest.raises(ValueError, match="not given the graph that it reads"):
        choose(SCENARIO, "full-view", hidden, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenarios.names())
def test_many_graphs_are_planned_together_as_each_alone(name):
    scenario = scenarios.get(name)
    states, worlds = [], [World.start(scenario, seed) for seed in range(2)]
    for step in range(2):
        states += [world.state() for world in worlds]
        act_together(
            worlds, [scenario.actions[(seed + step) % len(scenario.actions)] for seed in range(2)]
        )
    graphs = truth_graphs(scenario, states)
    assert plans(scenario, graphs) == [plan(scenario, graph) for graph in graphs]


@pytest.mark.slow
@pytest.mark.parametrize("name", scenarios.names())
def test_gaps_are_those_of_all_moments_wherever_the_ego_would_touch_somebody(name):
    """Moments in which two are far apart are left out;
    what is left decides each gap that is not wide.
    """
    scenario, rng = scenarios.get(name), np.random.default_rng(0)
    road, touched = scenario.road(), 0
    worlds = [World.start(scenario, seed) for seed in range(4)]
    lockstep.advance(worlds, [50] * len(worlds))
    for world in worlds:
        graph = truth_graph(scenario, world.state())
        speeds = rng.uniform(0.0, 14.0, (8, 1))
        travelled = speeds * STEP_S * np.arange(1, 91)
        tried = Rollouts(travelled, None, np.arange(8))
        for motion in predicted(road, graph, 90):
            near, all_moments = (
                least_gap(tried, motion, within_m=within_m) for within_m in (0.0, 1e4)
            )
            assert np.array_equal(np.minimum(near, 0.0), np.minimum(all_moments, 0.0))
            touched += int((near < 0).sum())
    assert touched
