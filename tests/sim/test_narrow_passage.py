"""A passage that is too narrow for two: who comes first is open, and each side has its seat."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from jointly import driven, who_list_the_danger
from scipy.stats import binomtest, ks_2samp
from tiers import QUICK

from harness.world import scenarios
from harness.world.perception.graph import truth_graph
from harness.world.planner import plan
from harness.world.reference import drive_all
from harness.world.scenarios.narrow_passage import (
    FROM_EAST,
    ONCOMING,
    OWN,
    PASSAGE_M,
    RIGHT,
    Parameters,
    layout,
    road,
    seats,
)
from harness.world.seats import seated
from harness.world.state import Part, VehicleState, WorldState
from harness.world.world import World

SCENARIO = scenarios.get("narrow-passage")
P = Parameters()
MIDDLE_M = road().zone_arc_m
LEAST_P = 0.001


@cache
def layouts():
    return [layout(seed, P) for seed in range(300 if QUICK else 1500)]


def agents(found):
    return [spawn for spawn in found.spawns if spawn.part != "other"]


def arrival_s(spawn):
    return (MIDDLE_M - spawn.arc_m) / spawn.speed_mps


def scene(ego_m, other_m, speed_mps=8.0):
    """The ego, and an agent from the other side, each so far before the middle."""
    vehicles = []
    for n, (way, to_go_m) in enumerate(((OWN, ego_m), (ONCOMING, other_m))):
        x, y, heading = road().paths[way].at(MIDDLE_M - to_go_m)
        part: Part = "helper" if n else "ego"
        vehicles.append(
            VehicleState(f"v{n + 1}", "car", part, x, y, heading, speed_mps, way[0], way[1], False)
        )
    return WorldState(SCENARIO.name, 0, 0, 0.0, speed_mps, tuple(vehicles), ())


def test_one_or_two_agents_come_from_either_side_one_behind_the_other():
    counts = set()
    for found in layouts():
        sides = [
            [arrival_s(a) for a in agents(found) if (a.approach, a.route) == way]
            for way in (OWN, ONCOMING)
        ]
        for first_s, *second_s in map(sorted, sides):
            assert P.arrival_s[0] <= first_s <= P.arrival_s[1]
            assert all(
                P.headway_s[0] - 1e-9 <= s - first_s <= P.headway_s[1] + 1e-9 for s in second_s
            )
        assert agents(found)[0].id == "v1"
        assert arrival_s(agents(found)[0]) == min(sides[0])
        assert found.danger in (None, "right")
        counts.add(tuple(map(len, sides)))
    assert counts == {(1, 1), (1, 2), (2, 1), (2, 2)}


def test_neither_side_nor_id_tells_who_comes_first():
    first, seconds, by_id = [], [], {}
    for found in layouts():
        there = agents(found)
        own, oncoming = (
            [arrival_s(a) for a in there if a.approach == way[0]] for way in (OWN, ONCOMING)
        )
        first.append(min(own) < min(oncoming))
        seconds.append((len(own), len(oncoming)))
        for one, other in combinations(there[1:], 2):
            by_id.setdefault((one.id, other.id), []).append(arrival_s(one) < arrival_s(other))
    own, oncoming = np.array(seconds).T
    shares = [first, own[own != oncoming] == 2, *by_id.values()]
    assert len(shares) == 5
    for share in shares:
        assert binomtest(int(np.sum(share)), len(share)).pvalue > LEAST_P
    times = [
        [min(arrival_s(a) for a in agents(found) if a.approach == way[0]) for found in layouts()]
        for way in (OWN, ONCOMING)
    ]
    assert ks_2samp(times[0], times[1]).pvalue > LEAST_P


def test_from_the_other_side_the_road_is_the_same_turned():
    seat = seats()[ONCOMING]
    theirs = seat.scenario.road()
    assert seats()[OWN].scenario.road() is road()
    assert theirs is seat.scenario.road()
    assert theirs.network() is road().network()
    for key, name in seat.names.items():
        assert np.array_equal(theirs.paths[name].points, road().paths[key].points)
        assert theirs.paths[name].lanes == road().paths[key].lanes
    for name in (OWN, ONCOMING):
        assert theirs.paths[name].points == pytest.approx(-road().paths[name].points)
        assert theirs.paths[name].roles == road().paths[name].roles
    mine, their = road().crossings[ONCOMING], theirs.crossings[ONCOMING]
    assert (their.x_m, their.ego_arc_m, their.other_arc_m) == pytest.approx(
        (-mine.x_m, mine.ego_arc_m, mine.other_arc_m)
    )
    assert theirs.sectors["oncoming"] == pytest.approx(-road().sectors["oncoming"])
    assert {*theirs.crossings} == {FROM_EAST[RIGHT], ONCOMING}
    goals = [
        [
            seats()[way].scenario.cleared(np.array([[[x, 0.0]]]), None, P).item()
            for x in (-P.cleared_m - 1, P.cleared_m + 1)
        ]
        for way in (OWN, ONCOMING)
    ]
    assert goals == [[False, True], [True, False]]


@pytest.mark.parametrize("agent", [0, 1])
def test_an_agent_in_either_seat_sees_who_comes_the_other_way_and_waits(agent):
    def seen(state):
        scenario = seats()[(OWN, ONCOMING)[agent]].scenario
        return scenario, truth_graph(scenario, seated(SCENARIO, state, agent) if agent else state)

    scenario, graph = seen(scene(30.0, 30.0))
    (conflict,) = graph.conflicts
    assert (conflict.vehicle, conflict.sector) == (f"v{2 - agent}", "oncoming")
    assert conflict.ego.arc_m == pytest.approx(30.0 - PASSAGE_M, abs=0.1)
    assert conflict.other.arc_m == pytest.approx(30.0 + PASSAGE_M, abs=0.1)
    assert plan(scenario, graph) == "SLOWER"
    far = scene(*((18.0, 80.0) if agent == 0 else (80.0, 18.0)))
    assert plan(*seen(far)) == "IDLE"
    through = scene(*((18.0, -18.0) if agent == 0 else (-18.0, 18.0)))
    assert seen(through)[1].conflicts == ()


def test_who_waits_goes_on_knowing_of_a_car_within_the_passage_until_it_is_out():
    """A car in the shared lane is on the ego's way, but meets it only where the passage ends."""
    for to_go_m, meets in ((5.0, True), (0.0, True), (-7.0, True), (-9.5, False)):
        graph = truth_graph(SCENARIO, scene(20.0, to_go_m, 4.0))
        assert [c.kind for c in graph.conflicts] == ["crossing"] * meets


def test_the_embankment_hides_a_danger_from_one_side_that_meets_an_ego_whom_others_let_through():
    always = replace(SCENARIO, parameters=replace(P, danger_share=1.0))
    for seed in range(1 if QUICK else 2):
        world = World.start(always, seed)
        viewers = [v for v in world.state().vehicles if v.part != "other"]
        assert who_list_the_danger(world) == {"oncoming"}
        plans = [
            ["IDLE"] * P.decisions
            if v.approach == "own"
            else ["SLOWER", "SLOWER", *["IDLE"] * (P.decisions - 2)]
            for v in viewers
        ]
        assert driven(always, seed, plans)[0] == "collision"


@pytest.mark.slow
def test_who_sees_everything_waits_and_who_keeps_its_speed_meets_somebody():
    for drives in drive_all(SCENARIO, range(2)):
        results = {driver: outcome.result for driver, outcome in drives.items()}
        assert (results["cruise"], results["brake"], results["full-view"]) == (
            "collision",
            "time_out",
            "cleared",
        )


@pytest.mark.slow
def test_if_nobody_gives_way_they_collide():
    for seed in range(4):
        idle = [["IDLE"] * P.decisions] * len(agents(layouts()[seed]))
        assert "collision" in driven(SCENARIO, seed, idle)
