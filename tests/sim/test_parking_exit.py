"""Pulling out between vans: what they hide, who sees it,
and that a car that comes later is harmless.
"""

from itertools import pairwise

import former
import numpy as np
import pytest
from msgspec.structs import replace

from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.reference import drive
from harness.world.scenarios.parking_exit import (
    KERB_M,
    PULL_OUT_M,
    VANS_M,
    layout,
    road,
)
from harness.world.state import SIZES_M, VehicleState, WorldState

SCENARIO = former.scenes("parking-exit")
P = SCENARIO.parameters
LAYOUTS = {seed: layout(seed, P) for seed in range(200)}
EGO = VehicleState("v1", "car", "ego", -14.0, KERB_M, 0.0, 4.0, "own", "pull-out", False)
VAN = VehicleState("v5", "van", "other", -21.0, VANS_M, 0.0, 0.0, "kerb", "parked", False)
LAST_VAN = replace(VAN, id="v2", part="helper", x_m=-36.5)
OPPOSITE = VehicleState("v3", "car", "helper", -10.0, -6.5, np.pi, 0.0, "opposite", "parked", False)
PASSED = VehicleState("v4", "car", "helper", 15.0, 0.0, 0.0, 9.0, "behind", "straight", False)
COMES = VehicleState("v6", "car", "other", -34.0, 0.0, 0.0, 9.0, "behind", "straight", False)


def scene(*others, ego=EGO):
    """An ego 4 m before it begins to pull out, at 4 m/s."""
    return WorldState("by hand", 0, 0, 0.0, 4.0, (ego, LAST_VAN, OPPOSITE, PASSED, *others), ())


def listed(graph):
    return {node.id for node in graph.nodes}


def test_the_egos_way_comes_into_the_lane_behind_what_is_parked():
    (meet,) = road().crossings.values()
    assert (meet.x_m, meet.y_m) == pytest.approx((0.0, 0.0), abs=0.01)
    assert meet.kind == "merging"
    x, y, _ = road().ego_path.at(meet.ego_arc_m - PULL_OUT_M - 3.0)
    assert x < -PULL_OUT_M
    assert y == pytest.approx(KERB_M)


def test_a_van_hides_the_lane_from_the_ego_and_three_helpers_see_it():
    assert "v6" not in listed(scene_graph(SCENARIO, scene(VAN, COMES), "v1"))
    assert "v6" in listed(scene_graph(SCENARIO, scene(COMES), "v1"))
    for helper in ("v2", "v3", "v4"):
        meets = scene_graph(SCENARIO, scene(VAN, COMES), helper).conflicts
        (conflict,) = [c for c in meets if c.kind == "merging"]
        assert (conflict.vehicle, conflict.sector) == ("v6", "behind")
        assert conflict.other.arc_m == pytest.approx(34.0, abs=0.5)


def test_with_its_nose_in_the_lane_the_ego_sees_along_it():
    x, y, heading = road().ego_path.at(road().zone_arc_m - 5.0)
    out = replace(EGO, x_m=x, y_m=y, heading_rad=heading)
    assert "v6" in listed(scene_graph(SCENARIO, scene(VAN, COMES, ego=out), "v1"))


def test_it_waits_for_who_meets_it_and_for_nobody_who_comes_long_after_or_the_other_way():
    assert plan(SCENARIO, truth_graph(SCENARIO, scene(VAN, COMES))) == "SLOWER"
    late = replace(COMES, x_m=-100.0)
    oncoming = VehicleState(
        "v7", "car", "other", 30.0, -3.5, np.pi, 9.0, "oncoming", "straight", False
    )
    assert plan(SCENARIO, truth_graph(SCENARIO, scene(VAN, late, oncoming))) == "IDLE"


@pytest.mark.slow
def test_a_danger_hits_an_ego_that_does_not_know_of_it():
    dangerous = [seed for seed, found in LAYOUTS.items() if found.danger]
    for seed in dangerous[:2]:
        assert drive(SCENARIO, "cruise", seed).partner == LAYOUTS[seed].danger_id
        assert drive(SCENARIO, "full-view", seed).success


def test_dangerous_and_later_cars_are_alike_but_for_when_they_come():
    (meet,) = road().crossings.values()
    for found in LAYOUTS.values():
        ego_s = (meet.ego_arc_m - found.spawns[0].arc_m) / P.ego_speed_mps
        for spawn in found.spawns:
            if (spawn.approach, spawn.part) == ("behind", "other"):
                after_s = (meet.other_arc_m - spawn.arc_m) / spawn.speed_mps - ego_s
                least_s, most_s = (
                    P.danger_offset_s if spawn.id == found.danger_id else P.late_offset_s
                )
                assert least_s <= after_s <= most_s
                assert P.lane_mps[0] <= spawn.speed_mps <= P.lane_mps[1]


def test_four_vans_and_the_ego_stand_in_a_row_and_do_not_touch():
    for found in LAYOUTS.values():
        path, ego = road().paths["kerb", "parked"], found.spawns[0]
        own = road().ego_path.at(ego.arc_m)[0]
        row = [
            (path.at(s.arc_m)[0], SIZES_M["van"][0]) for s in found.spawns if s.approach == "kerb"
        ]
        row = sorted([*row, (own, SIZES_M["car"][0])])
        assert [length for _, length in row] == [6.5, 6.5, 6.5, 5.0, 6.5]
        for (x, length), (ahead, its_length) in pairwise(row):
            assert ahead - x - (length + its_length) / 2 >= min(P.vans_m[0], P.behind_m[0]) - 1e-9
