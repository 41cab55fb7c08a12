"""Changes of lane: where the ego goes, what it is to whom, and who brakes by itself."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.reference import drive, finish
from harness.world.scenarios import do_not_pass, hard_brake_ahead
from harness.world.scene_graph import Arrival, EgoArrival
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

MOTORWAY, TWO_WAY = hard_brake_ahead.SCENARIO, do_not_pass.SCENARIO
LEFT, RIGHT = hard_brake_ahead.LEFT, hard_brake_ahead.RIGHT
EGO = VehicleState("v1", "car", "ego", -40.0, 4.0, 0.0, 20.0, "own", RIGHT, False)


def on(scenario, *others, ego=EGO, target_mps=20.0):
    """The truth of a scene by hand."""
    return truth_graph(scenario, WorldState("by hand", 0, 1, 1.0, target_mps, (ego, *others), ()))


def car(x_m, y_m, speed_mps, heading_rad=0.0, way=("own", RIGHT), **more):
    return VehicleState(
        "v5", "car", "other", x_m, y_m, heading_rad, speed_mps, *way, **{"crashed": False, **more}
    )


def test_a_change_of_lane_takes_the_ego_over_and_one_where_there_is_no_lane_leaves_it_there() -> (
    None
):
    world = World.start(MOTORWAY, 2)
    assert (world.target(), world.target_after("LANE_RIGHT")) == ((RIGHT, 2), (RIGHT, 2))
    assert world.target_after("LANE_LEFT") == (LEFT, 2)
    for action in ("SLOWER", "LANE_LEFT", "FASTER"):  # falls behind the car beside it
        world.act(action)
    assert world.state().ego.route == LEFT
    assert world.state().ego.y_m == pytest.approx(0.0, abs=0.3)
    assert world.road.vehicles[0].on_road


def test_who_is_ahead_behind_and_beside() -> None:
    (ahead,) = on(MOTORWAY, car(-10.0, 4.0, 15.0)).conflicts
    assert (ahead.kind, ahead.lane, ahead.ego) == ("ahead", "own", EgoArrival(30.0, 6.0))
    assert ahead.other == Arrival(0.0, 6.0, 15.0, False)
    (behind,) = on(MOTORWAY, car(-60.0, 0.0, 25.0, way=("own", LEFT))).conflicts
    assert (behind.kind, behind.lane) == ("behind", "left")
    assert (behind.ego.arc_m, behind.other.arc_m, behind.other.time_s) == (0.0, 20.0, 4.0)


def test_who_comes_towards_the_ego_is_met_where_both_have_come_to() -> None:
    ego = structs.replace(EGO, speed_mps=5.0, route=do_not_pass.OWN)
    comes = car(35.0, 0.0, 10.0, np.pi, ("oncoming", "straight"))
    (oncoming,) = on(TWO_WAY, comes, ego=ego, target_mps=5.0).conflicts
    assert (oncoming.kind, oncoming.lane) == ("oncoming", "left")
    assert (oncoming.ego.arc_m, oncoming.other.arc_m) == (25.0, 50.0)
    assert oncoming.ego.time_s == 5.0
    gone = car(-60.0, 0.0, 10.0, np.pi, ("oncoming", "straight"))
    assert on(TWO_WAY, gone, ego=ego, target_mps=5.0).conflicts == ()


def test_the_planner_passes_a_car_that_stands_and_stays_where_the_lane_beside_is_taken() -> None:
    stands = car(-8.0, 4.0, 0.0)
    assert plan(MOTORWAY, on(MOTORWAY, stands)) == "LANE_LEFT"
    beside = structs.replace(stands, id="v6", x_m=-40.0, y_m=0.0, speed_mps=20.0, route=LEFT)
    assert plan(MOTORWAY, on(MOTORWAY, stands, beside)) == "SLOWER"
    # there is time
    assert plan(MOTORWAY, on(MOTORWAY, structs.replace(stands, x_m=20.0))) == "IDLE"


def test_who_is_seen_to_brake_is_taken_to_stand_soon() -> None:
    near = car(-23.0, 4.0, 18.0)
    assert plan(MOTORWAY, on(MOTORWAY, near)) == "IDLE"
    assert plan(MOTORWAY, on(MOTORWAY, structs.replace(near, braking=True))) == "LANE_LEFT"


def test_the_van_hides_who_brakes_and_sees_it() -> None:
    seed = next(s for s in range(20) if MOTORWAY.layout(s, MOTORWAY.parameters).danger)
    world = World.start(MOTORWAY, seed)
    for _ in range(2):
        world.act("IDLE")
    state = world.state()
    danger = state.vehicle(world.layout.danger_id)
    assert danger.braking
    assert danger.speed_mps < 20.0
    assert "v5" not in {n.id for n in scene_graph(MOTORWAY, state, "v1").nodes}
    told = {c.vehicle: c for c in scene_graph(MOTORWAY, state, "v2").conflicts}
    assert (told["v5"].kind, told["v5"].lane, told["v5"].other.braking) == ("ahead", "own", True)
    assert told["v2"].kind == "ahead"  # the van itself is in the ego's way too


def test_who_brakes_by_itself_comes_to_the_speed_it_was_given_and_no_lower() -> None:
    layout = MOTORWAY.layout(0, MOTORWAY.parameters)
    spawns = [
        replace(s, brakes_at_s=1.0, brakes_mps2=4.0, brakes_to_mps=15.0) for s in layout.spawns[4:5]
    ]
    alone = replace(MOTORWAY, layout=lambda *_: replace(layout, spawns=(layout.spawns[0], *spawns)))
    world = World.start(alone, 0)
    speeds = []
    for _ in range(4):
        world.act("IDLE")
        speeds.append(world.state().vehicles[1].speed_mps)
    assert speeds == pytest.approx([20.0, 16.0, 15.0, 15.0], abs=0.2)


def outcome(world: World, *actions: str) -> Outcome:
    """Of some actions, and of keeping on after them."""
    for action in actions:
        if not world.outcome.ended:
            world.act(action)
    return finish([world], ["cruise"])[0]


@pytest.mark.slow
def test_passing_and_waiting_both_clear_where_they_should_and_waiting_for_nothing_never_does() -> (
    None
):
    seeds = {TWO_WAY.layout(s, TWO_WAY.parameters).danger: s for s in range(20)}
    assert drive(TWO_WAY, "full-view", seeds[None]).success
    waits = outcome(World.start(TWO_WAY, seeds["oncoming"]), "IDLE")
    assert (waits.result, waits.time_s is not None and waits.time_s < 8.0) == ("cleared", True)
    passes = outcome(World.start(TWO_WAY, seeds["oncoming"]), "FASTER", "LANE_LEFT", "FASTER")
    assert passes.result == "collision"
