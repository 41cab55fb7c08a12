"""The roundabout: what hides who comes round, who sees it,
and that a car which leaves is harmless.
"""

import math
from dataclasses import replace
from functools import cache

import former
import pytest
from msgspec import structs

from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.reference import drive
from harness.world.scenarios.roundabout_entry import PLACE, layout, road
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

SCENARIO = former.scenes("roundabout-entry")
P = SCENARIO.parameters
LAYOUTS = {seed: layout(seed, P) for seed in range(300)}


@cache
def seeds(danger):
    return [seed for seed, found in LAYOUTS.items() if found.danger == danger]


def at(id_, part, way, arc_m, speed_mps):
    x_m, y_m, heading_rad = road().paths[way].at(arc_m)
    return VehicleState(id_, "car", part, x_m, y_m, heading_rad, speed_mps, way[0], way[1], False)


def scene(route, back_m=20.0, buildings=None):
    """An ego 20 m before it enters, a car as far before the same place on the ring,
    and two helpers.
    """
    meet = road().crossings["left", "straight"]
    vehicles = (
        at("v1", "ego", ("own", "straight"), meet.ego_arc_m - 20.0, 8.0),
        at(
            "v2",
            "helper",
            ("oncoming", "right"),
            road().paths["oncoming", "right"].ends_m[-2] + 18.0,
            6.0,
        ),
        at("v3", "helper", ("own", "left"), road().paths["own", "left"].ends_m[-2] + 12.0, 6.0),
        at("v5", "other", ("left", route), meet.other_arc_m - back_m, 8.0),
    )
    found = (
        layout(0, replace(P, hedge_end_m=(24.0, 24.0))).buildings
        if buildings is None
        else buildings
    )
    return WorldState("by hand", 0, 1, 1.0, 8.0, vehicles, found)


def listed(graph):
    return {node.id for node in graph.nodes}


def test_only_who_goes_on_past_the_egos_arm_meets_it_and_where_it_enters():
    assert road().crossings.keys() == {("left", "straight"), ("oncoming", "straight")}
    for meet in road().crossings.values():
        assert (math.hypot(meet.x_m, meet.y_m), meet.kind) == (
            pytest.approx(PLACE.ring_m, abs=0.01),
            "merging",
        )


def test_the_hedge_hides_from_the_ego_what_two_helpers_see():
    hidden = scene("straight")
    assert "v5" not in listed(scene_graph(SCENARIO, hidden, "v1"))
    assert "v5" in listed(scene_graph(SCENARIO, scene("straight", buildings=()), "v1"))
    for helper in ("v2", "v3"):
        (conflict,) = [
            c for c in scene_graph(SCENARIO, hidden, helper).conflicts if c.kind == "merging"
        ]
        assert (conflict.vehicle, conflict.sector) == ("v5", "left")
        assert conflict.ego.arc_m == pytest.approx(20.0, abs=0.5)
        assert conflict.other.arc_m == pytest.approx(20.0, abs=0.5)


def test_past_the_hedge_the_ego_sees_the_ring():
    near = scene("straight", back_m=12.0)
    ego = at("v1", "ego", ("own", "straight"), road().zone_arc_m - 10.0, 8.0)
    assert "v5" in listed(
        scene_graph(SCENARIO, structs.replace(near, vehicles=(ego, *near.vehicles[1:])), "v1")
    )


def test_where_it_goes_decides_and_its_indicator_tells():
    goes_on, leaves = scene("straight", 24.0), scene("right", 24.0)
    assert [c.vehicle for c in truth_graph(SCENARIO, goes_on).conflicts] == ["v5"]
    assert plan(SCENARIO, truth_graph(SCENARIO, goes_on)) == "SLOWER"
    assert truth_graph(SCENARIO, leaves).conflicts == ()
    assert plan(SCENARIO, truth_graph(SCENARIO, leaves)) == "IDLE"
    (seen,) = [n for n in scene_graph(SCENARIO, leaves, "v2").nodes if n.id == "v5"]
    assert seen.indicator == "right"
    assert "v5" not in {c.vehicle for c in scene_graph(SCENARIO, leaves, "v2").conflicts}


@pytest.mark.slow
@pytest.mark.parametrize("sector", ["left", "oncoming"])
def test_a_danger_hits_an_ego_that_does_not_know_of_it(sector):
    for seed in seeds(sector)[:1]:
        assert drive(SCENARIO, "cruise", seed).partner == LAYOUTS[seed].danger_id
        assert drive(SCENARIO, "full-view", seed).success


@pytest.mark.slow
def test_in_a_dangers_place_a_car_that_leaves_is_harmless():
    twins = [
        (seed, spawn)
        for seed in seeds(None)
        for spawn in LAYOUTS[seed].spawns
        if spawn.route == "right" and spawn.part == "other"
    ]
    assert twins
    for seed, _ in twins[:3]:
        assert drive(SCENARIO, "cruise", seed).success


def test_a_danger_is_where_the_ego_enters_within_the_drawn_offset_and_at_a_real_speed():
    for found in LAYOUTS.values():
        for spawn in found.spawns:
            if spawn.id == found.danger_id:
                meet = road().crossings[spawn.approach, spawn.route]
                its_s = (meet.other_arc_m - spawn.arc_m) / spawn.speed_mps
                ego_s = (meet.ego_arc_m - found.spawns[0].arc_m) / P.ego_speed_mps
                assert P.danger_offset_s[0] <= its_s - ego_s <= P.danger_offset_s[1]
            assert spawn.speed_mps <= 8.0


def test_who_begins_in_the_midst_of_its_way_keeps_to_it_and_so_does_its_copy():
    world = World.start(SCENARIO, seeds("oncoming")[0])
    helper, danger = (
        next(v for v in world.road.vehicles if v.spawn.id == id_)
        for id_ in ("v3", world.layout.danger_id)
    )
    for _ in range(3):
        world.act("SLOWER")
    assert helper.target_lane_index == ("wxs", "wxr", 0)
    assert danger.target_lane_index[:2] in {("sx", "se"), ("se", "ex")}
    again = World.thaw(SCENARIO, world.state(), world.snapshot())
    assert [v.target_lane_index for v in again.road.vehicles] == [
        v.target_lane_index for v in world.road.vehicles
    ]
