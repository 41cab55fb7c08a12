"""The roundabout with several agents: one scene from three arms, who meets whom,
and what hedges hide.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace as replaced
from together import drive_together

from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.planner import plan
from harness.world.scenarios.roundabout_entries import (
    PLACE,
    SCENARIO,
    Parameters,
    key_of,
    layout,
    road,
    seats,
)
from harness.world.seats import seat_of, seated
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

P = Parameters()
KNOWN = replace(P, perfect_knowledge=True)  # of each other, but not of who has no radio
QUARTER_M = PLACE.ring_m * math.pi / 2


@cache
def layouts():
    return {seed: layout(seed, P) for seed in range(600)}


def at(id_, part, arm, leaves, before_m, speed_mps=7.0):
    """A car so far before its own entry."""
    way = key_of(arm, leaves)
    path = road().paths[way]
    x_m, y_m, heading_rad = path.at(path.ends_m[1] - before_m)
    return VehicleState(id_, "car", part, x_m, y_m, heading_rad, speed_mps, *way, False)


def scene(*vehicles, seed=0):
    return WorldState("by hand", 0, 1, 1.0, 7.0, vehicles, layouts()[seed].buildings)


def enters_s(found, id_):
    """When a vehicle would enter from its own arm at the speed that it has."""
    spawn = next(s for s in found.spawns if s.id == id_)
    return (road().paths[spawn.approach, spawn.route].ends_m[1] - spawn.arc_m) / spawn.speed_mps


def agents(found):
    """The id of each agent by its approach."""
    return {s.approach: s.id for s in found.spawns if s.part != "other"}


def test_a_way_is_the_same_from_every_seat_whatever_its_name():
    for arm, key in (("w", ("left", "straight")), ("e", ("right", "straight"))):
        seat = seats()[key]
        assert seat.names.keys() == road().paths.keys() == set(seat.names.values())
        assert seat.names[key] == seat.scenario.road().ego == ("own", "straight")
        assert seat.scenario.road() is road(arm)
        for shared, its in seat.names.items():
            assert road(arm).paths[its].lanes == road().paths[shared].lanes
            assert np.array_equal(road(arm).paths[its].points, road().paths[shared].points)
    assert seats() is seats()


@pytest.mark.parametrize("arm", ["s", "w", "e"])
def test_it_meets_who_passes_its_entry_and_whose_entry_it_passes(arm):
    meets = road(arm).crossings
    begin = road(arm).ego_path.ends_m
    here = {
        key for key, meet in meets.items() if meet.ego_arc_m == pytest.approx(begin[1], abs=0.01)
    }
    assert here == {("left", "straight"), ("left", "left"), ("oncoming", "left")}
    assert meets.keys() - here == {("right", "straight"), ("right", "right")}
    assert {meets[key].ego_arc_m for key in meets.keys() - here} == {begin[3]}
    assert {meet.kind for meet in meets.values()} == {"merging"}


def views(state, agent):
    """An agent's scenario, the scene from its seat,
    what is true there and what it knows of agents.
    """
    scenario = seat_of(SCENARIO, state.vehicles[agent]).scenario if agent else SCENARIO
    mine = seated(SCENARIO, state, agent) if agent else state
    known = scene_graph(replace(scenario, parameters=KNOWN), mine, mine.ego.id)
    return scenario, mine, truth_graph(scenario, mine), known


@pytest.mark.parametrize(("chain", "agent"), [(("w", "s"), 0), (("s", "e"), 1)])
def test_who_enters_gives_way_to_who_comes_round_from_whichever_seat(chain, agent):
    circulating, entering = chain
    parts = {arm: "ego" if arm == "s" else "helper" for arm in chain}
    cars = [
        at("v1" if parts[arm] == "ego" else "v2", parts[arm], arm, 2, before_m)
        for arm, before_m in ((circulating, 18.0 - QUARTER_M), (entering, 18.0))
    ]
    scenario, mine, truth, known = views(scene(*sorted(cars, key=lambda v: v.id)), agent)
    for graph in (truth, known):
        assert [(c.sector, c.route, c.kind) for c in graph.conflicts] == [
            ("left", "straight", "merging")
        ]
    assert plan(scenario, truth) == "SLOWER"
    assert plan(scenario, truth_graph(scenario, replaced(mine, vehicles=(mine.ego,)))) == "IDLE"


def test_who_circulates_meets_at_the_next_entry_who_enters_there():
    cars = at("v1", "ego", "s", 2, 10.0), at("v2", "helper", "e", 2, 10.0 + QUARTER_M)
    _, _, truth, _ = views(scene(*cars), 0)
    [meeting] = truth.conflicts
    assert (meeting.sector, meeting.kind) == ("right", "merging")
    assert meeting.ego.arc_m == pytest.approx(10.0 + QUARTER_M, abs=0.1)
    assert meeting.other.arc_m == pytest.approx(10.0 + QUARTER_M, abs=0.1)


def test_a_car_that_leaves_before_the_ego_is_harmless_and_shows_it():
    for leaves, expected in ((3, "SLOWER"), (2, "IDLE")):
        cars = at("v1", "ego", "s", 2, 14.0), at("v5", "other", "n", leaves, 14.0 - 2 * QUARTER_M)
        _, _, truth, known = views(scene(*cars), 0)
        assert plan(SCENARIO, truth) == expected
        assert known.nodes == ()
        assert {sector.sector for sector in known.sectors if sector.occluded} == {
            "left",
            "oncoming",
        }
        assert truth.nodes[0].indicator == ("right" if leaves == 2 else "left")


def test_a_danger_comes_behind_the_car_from_the_west_and_the_ego_does_not_see_it_at_first():
    behind = 0
    for seed, found in layouts().items():
        if not found.danger:
            continue
        ego_s, quarter_s = enters_s(found, "v1"), QUARTER_M / P.speed_mps
        passes_s = enters_s(found, found.danger_id) + 2 * quarter_s
        if west := agents(found).get("left"):
            behind += 1
            after_s = passes_s - enters_s(found, west) - quarter_s
            assert P.headway_s[0] - 0.01 <= after_s <= P.headway_s[1] + 0.01  # chords for arcs
        else:
            assert abs(passes_s - ego_s) <= P.danger_offset_s[1] + 0.01
        if seed < 40:
            state = World.start(SCENARIO, seed).state()
            assert found.danger_id not in {n.id for n in scene_graph(SCENARIO, state, "v1").nodes}
    assert behind > 150


def test_neither_of_two_who_meet_comes_first_more_often_and_no_id_tells():
    """600 layouts; each share is within three standard errors of a half."""
    quarter_s, first = QUARTER_M / P.speed_mps, dict[str, list[bool]]()
    for found in layouts().values():
        by_approach = agents(found)
        assert 2 <= len(by_approach) <= 3
        ego_s = enters_s(found, "v1")
        for approach, ahead_s in (("left", quarter_s), ("right", -quarter_s)):
            if id_ := by_approach.get(approach):
                late_s = enters_s(found, id_) + ahead_s - ego_s
                assert abs(late_s) <= P.offset_s[1] + 1e-6
                first.setdefault(approach, []).append(late_s < 0)
                first.setdefault(f"{approach} with {found.danger}", []).append(late_s < 0)
        if len(by_approach) == 3:
            first.setdefault("ids", []).append(by_approach["left"] == "v2")
    for name, each in first.items():
        share, error = sum(each) / len(each), 0.5 / len(each) ** 0.5
        assert abs(share - 0.5) < 3 * error, name
    assert len(first) == 7


@pytest.mark.parametrize("arm", ["s", "w", "e"])
def test_an_agent_has_cleared_where_it_has_left_the_ring_past_the_next_entry(arm):
    scenario = SCENARIO if arm == "s" else seats()[key_of(arm, 2)].scenario
    path, goal_m = road(arm).ego_path, road(arm).goal_m(P)
    assert goal_m > road(arm).crossings["right", "straight"].ego_arc_m + 8.0
    xy_m = path.points_at(path.arc_m)[:, None]
    reached = scenario.cleared(xy_m, np.full(xy_m.shape[:2], "own"), P)
    assert np.array_equal(reached, path.arc_m >= path.arc_m[reached.argmax()])
    assert path.arc_m[reached.argmax()] == pytest.approx(goal_m)


@pytest.mark.exhaustive
def test_who_sees_everything_clears_and_who_cruises_meets_agents_and_dangers():
    cruising = drive_together(SCENARIO, "cruise", range(60))
    met = [
        layouts()[seed].danger_id == out.partner
        for seed, out in cruising.items()
        if not out.success
    ]
    assert 0.6 < len(met) / len(cruising) < 0.95
    assert 0.1 < sum(met) / len(met) < 0.9
    assert all(out.success for out in drive_together(SCENARIO, "full-view", range(8)).values())
