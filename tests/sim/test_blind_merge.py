"""The blind merge: what the wall hides, who sees it,
and that a car on the other lane is harmless.
"""

from dataclasses import replace

import former
import pytest
from msgspec import structs
from together import drive_together, go_on_together

from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.scenarios.blind_merge import RAMP_M, layout, road
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

SCENARIO = former.scenes("blind-merge")
P = SCENARIO.parameters
LAYOUTS = {seed: layout(seed, P) for seed in range(200)}
EGO = VehicleState("v1", "car", "ego", -50.0, RAMP_M, 0.0, 14.0, "ramp", "merge", False)
TRUCK = VehicleState(
    "v2", "truck", "helper", -95.0, -4.0, 0.0, 14.0, "main left", "straight", False
)
AHEAD = VehicleState("v3", "car", "helper", 5.0, 0.0, 0.0, 17.0, "main", "straight", False)
COMES = VehicleState("v5", "car", "other", -55.0, 0.0, 0.0, 15.0, "main", "straight", False)
BESIDE = structs.replace(COMES, y_m=-4.0, approach="main left")
(WALL,) = layout(0, replace(P, wall_end_m=(34.0, 34.0))).buildings


def scene(*others, ego=EGO, wall=(WALL,)):
    """An ego on the ramp, 50 m before it merges."""
    return WorldState("by hand", 0, 1, 1.0, 14.0, (ego, TRUCK, AHEAD, *others), wall)


def listed(graph):
    return {node.id for node in graph.nodes}


def test_the_wall_hides_both_lanes_from_the_ego_and_helpers_see_which_lane_it_is():
    assert "v5" not in listed(scene_graph(SCENARIO, scene(COMES), "v1"))
    assert "v5" in listed(scene_graph(SCENARIO, scene(COMES, wall=()), "v1"))
    for helper in ("v2", "v3"):
        merging = {}
        for car in (COMES, BESIDE):
            graph = scene_graph(SCENARIO, scene(car), helper)
            assert "v5" in listed(graph)
            merging[car] = [(c.vehicle, c.sector) for c in graph.conflicts if c.kind == "merging"]
        assert merging == {COMES: [("v5", "main")], BESIDE: []}


def test_past_the_walls_end_the_ego_sees_who_is_beside_it():
    ego = structs.replace(EGO, x_m=-25.0, y_m=3.5)
    assert "v5" in listed(
        scene_graph(SCENARIO, scene(structs.replace(COMES, x_m=-30.0), ego=ego), "v1")
    )


def test_it_lets_go_first_who_is_on_its_lane_and_minds_nobody_on_the_other():
    assert plan(SCENARIO, truth_graph(SCENARIO, scene(COMES))) == "SLOWER"
    assert plan(SCENARIO, truth_graph(SCENARIO, scene(BESIDE))) == "IDLE"
    assert (
        plan(SCENARIO, truth_graph(SCENARIO, scene(structs.replace(COMES, x_m=-150.0)))) == "IDLE"
    )


@pytest.mark.slow
def test_who_sees_everything_clears_and_who_cruises_meets_a_danger_or_nobody():
    dangerous = [seed for seed, found in LAYOUTS.items() if found.danger]
    free = [seed for seed, found in LAYOUTS.items() if not found.danger]
    assert all(out.success for out in drive_together(SCENARIO, "full-view", dangerous[:4]).values())
    assert {out.partner for out in drive_together(SCENARIO, "cruise", free[:4]).values()} == {None}
    cruising = drive_together(SCENARIO, "cruise", dangerous[:6])
    assert any(out.partner == LAYOUTS[seed].danger_id for seed, out in cruising.items())


def test_cars_come_when_they_are_drawn_to_and_at_one_band_of_speeds():
    meet = road().crossings["main", "straight"]
    allowed = (P.danger_offset_s, P.before_offset_s, P.late_offset_s)
    for found in LAYOUTS.values():
        ego_s = (meet.ego_arc_m - found.spawns[0].arc_m) / P.ego_speed_mps
        for spawn in found.spawns:
            if spawn.part == "other":
                after_s = (meet.other_arc_m - spawn.arc_m) / spawn.speed_mps - ego_s
                alone = spawn.id == found.danger_id or spawn.approach == "main left"
                bounds = allowed[:1] if alone else allowed[1:]
                assert any(least_s <= after_s <= most_s for least_s, most_s in bounds)
                assert P.main_mps[0] <= spawn.speed_mps <= P.main_mps[1]


@pytest.mark.slow
def test_nobody_but_the_ego_touches_anybody():
    worlds = [World.start(SCENARIO, seed) for seed in range(15)]
    go_on_together(worlds, "SLOWER")
    assert all(world.ended and world.outcome.other_crashes == 0 for world in worlds)


@pytest.mark.parametrize("back_m", [10.0, 30.0, 44.0])
def test_the_egos_way_runs_from_the_ramp_into_the_right_lane(back_m):
    y = road().ego_path.at(road().zone_arc_m - back_m)[1]
    assert (y == pytest.approx(RAMP_M), 0 < y < RAMP_M) == (back_m > 41.0, back_m < 41.0)
