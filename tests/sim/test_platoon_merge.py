"""The merge into a platoon: rows of cars, who sees whom from which seat,
and that somebody must give way.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest
from msgspec import structs
from together import drive_together

from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.scenarios.blind_merge import RAMP_M
from harness.world.scenarios.platoon_merge import MAIN, SCENARIO, Parameters, layout, road, seats
from harness.world.state import VehicleState, WorldState

P = Parameters()
MEET = road().crossings[MAIN]
SEAT = seats()[MAIN].scenario
EGO = VehicleState("v1", "car", "ego", -50.0, RAMP_M, 0.0, 15.0, "ramp", "merge", False)
MEMBER = VehicleState("v2", "car", "helper", -49.0, 0.0, 0.0, 15.0, "main", "straight", False)
OTHER = VehicleState("v5", "car", "other", -64.0, 0.0, 0.0, 15.0, "main", "straight", False)
BESIDE = structs.replace(OTHER, y_m=-4.0, approach="main left")
(WALL,) = layout(0, replace(P, wall_end_m=(34.0, 34.0))).buildings
KNOWN = replace(P, perfect_knowledge=True)  # of each other, but not of who has no radio


@cache
def layouts():
    return {seed: layout(seed, P) for seed in range(600)}


def scene(*vehicles, wall=(WALL,)):
    return WorldState("by hand", 0, 1, 1.0, 15.0, vehicles, wall)


def graph(scenario, viewer, *vehicles):
    return scene_graph(replace(scenario, parameters=KNOWN), scene(*vehicles), viewer)


def meetings(found):
    return {(c.vehicle, c.sector, c.kind) for c in found.conflicts}


def late_s(found):
    """When each vehicle is at the merge, by id, in seconds after a cruising ego."""
    start_m = MEET.ego_arc_m - found.spawns[0].arc_m
    return {s.id: (MEET.other_arc_m - s.arc_m - start_m) / s.speed_mps for s in found.spawns[1:]}


def members(found):
    return [spawn.id for spawn in found.spawns if spawn.part == "helper"]


def test_a_row_has_two_or_three_agents_and_one_place_more_that_may_be_taken():
    counts = {2: 0, 3: 0}
    for found in layouts().values():
        counts[len(members(found))] += 1
        times = late_s(found)
        row = [
            times[id_] for id_ in (*members(found), *([found.danger_id] if found.danger else []))
        ]
        steps = [later - earlier for earlier, later in pairwise(sorted(row))]
        wide = [step for step in steps if step > P.headway_s[1] + 1e-9]
        assert len(wide) <= (not found.danger)
        assert all(2 * P.headway_s[0] <= step <= 2 * P.headway_s[1] for step in wide)
        assert all(step >= P.headway_s[0] - 1e-9 for step in steps)
        assert {s.speed_mps for s in found.spawns} == {P.speed_mps}
        assert all(
            road().paths[MAIN].at(s.arc_m)[0] < P.cleared_m
            for s in found.spawns
            if s.approach == "main"
        )
        if found.danger:
            assert P.offset_s[0] <= times[found.danger_id] <= P.offset_s[1]
    assert min(counts.values()) > 250


def test_the_ego_comes_as_often_before_an_agent_as_behind_it_and_no_id_tells():
    """600 layouts; each share is within three standard errors of a half."""
    before: dict[str, list[bool]] = {}
    for found in layouts().values():
        times = late_s(found)
        for id_ in members(found):
            before.setdefault(id_, []).append(times[id_] > 0)
            before.setdefault(f"{id_}, with {bool(found.danger)}", []).append(times[id_] > 0)
        ids = members(found)
        before.setdefault("a lower id", []).append(times[ids[0]] < times[ids[1]])
    for name, each in before.items():
        share, error = sum(each) / len(each), 0.5 / len(each) ** 0.5
        assert abs(share - 0.5) < 3 * error, name
    assert len(before) == 10


def test_the_wall_hides_the_row_but_agents_are_known_by_their_beacons():
    found = graph(SCENARIO, "v1", EGO, MEMBER, OTHER)
    assert [(n.id, n.sensors) for n in found.nodes] == [("v2", ("v2x",))]
    assert meetings(found) == {("v2", "main", "merging")}
    assert "v5" in {n.id for n in graph(SCENARIO, "v2", EGO, MEMBER, OTHER).nodes}
    assert scene_graph(SCENARIO, scene(EGO, MEMBER, OTHER, wall=()), "v1").seen == ("v2", "v5")


def test_from_the_main_lane_the_car_on_the_ramp_merges_and_one_gives_way():
    agent, ramp = structs.replace(MEMBER, part="ego"), structs.replace(EGO, part="helper")
    ahead = structs.replace(OTHER, x_m=-20.0)
    found = graph(SEAT, "v2", agent, ramp, ahead)
    assert meetings(found) == {("v1", "ramp", "merging"), ("v5", "main", "ahead")}
    assert [s.sector for s in found.sectors] == ["ramp"]
    assert found.occluded == ("ramp",)
    assert plan(SEAT, truth_graph(SEAT, scene(agent, ramp))) == "SLOWER"
    assert plan(SEAT, truth_graph(SEAT, scene(agent, structs.replace(ramp, x_m=-90.0)))) == "IDLE"
    assert plan(SEAT, truth_graph(SEAT, scene(agent, structs.replace(OTHER, x_m=-100.0)))) == "IDLE"


def test_each_seat_has_its_words_and_its_goal():
    assert (SEAT.name, SEAT.parameters, SEAT.actions) == (SCENARIO.name, P, SCENARIO.actions)
    assert SEAT.words["task"] != SCENARIO.words["task"]
    assert SEAT.road().ego == MAIN
    assert set(seats()[MAIN].names) == set(road().paths)
    assert seats() is seats()


def test_a_car_on_the_left_lane_is_nobodys_business():
    assert (
        plan(SCENARIO, truth_graph(SCENARIO, scene(EGO, structs.replace(BESIDE, x_m=-50.0))))
        == "IDLE"
    )
    assert (
        plan(SCENARIO, truth_graph(SCENARIO, scene(EGO, structs.replace(OTHER, x_m=-50.0))))
        == "SLOWER"
    )


@pytest.mark.exhaustive
def test_who_sees_everything_clears_and_who_cruises_meets_agents_and_dangers():
    cruising = drive_together(SCENARIO, "cruise", range(60))
    met = [
        layouts()[seed].danger_id == out.partner
        for seed, out in cruising.items()
        if not out.success
    ]
    assert 0.3 < len(met) / len(cruising) < 0.7
    assert 0.1 < sum(met) / len(met) < 0.9
    assert all(out.success for out in drive_together(SCENARIO, "full-view", range(8)).values())
    assert all(out.other_crashes == 0 for out in cruising.values())
