"""A crossing without signs: agents from two to four arms, their seats,
and no tell who goes first.
"""

from collections import defaultdict
from dataclasses import replace
from functools import cache
from itertools import combinations
from operator import attrgetter

import numpy as np
import pytest
from jointly import driven, who_list_the_danger
from scipy.stats import binomtest, ks_2samp
from tiers import QUICK

from harness.world import scenarios
from harness.world.crossroads import APPROACHES, ARM_M, JUNCTION_M, SECTORS
from harness.world.drivers import DRIVERS
from harness.world.perception.graph import truth_graph
from harness.world.planner import plan
from harness.world.reference import drive_all
from harness.world.scenarios.all_way_crossing import SIDES, Parameters, layout, seats
from harness.world.seats import seated
from harness.world.state import Part, VehicleState, WorldState
from harness.world.world import World

SCENARIO = scenarios.get("all-way-crossing")
P = Parameters()
WAYS = [(approach, "straight") for approach in APPROACHES]
LEAST_P = 0.001
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])  # a quarter, from the south to the west


@cache
def layouts():
    return [layout(seed, P) for seed in range(300 if QUICK else 1500)]


def agents(found):
    return [spawn for spawn in found.spawns if spawn.part != "other"]


def arrival_s(spawn):
    return (ARM_M + JUNCTION_M - spawn.arc_m) / spawn.speed_mps


def scene(*ways):
    """Agents 25 m before the middle at 10 m/s, one on each of some ways; the first is the ego."""
    road = SCENARIO.road()
    vehicles = []
    for n, way in enumerate(ways):
        x, y, heading = road.paths[way].at(ARM_M + JUNCTION_M - 25.0)
        part: Part = "helper" if n else "ego"
        vehicles.append(
            VehicleState(f"v{n + 1}", "car", part, x, y, heading, 10.0, way[0], way[1], False)
        )
    return WorldState(SCENARIO.name, 0, 0, 0.0, 10.0, tuple(vehicles), ())


def test_two_to_four_agents_come_from_different_arms_and_one_of_them_crosses():
    counts = {2: 0, 3: 0, 4: 0}
    for found in layouts():
        arms = [spawn.approach for spawn in agents(found)]
        assert arms[0] == "own"
        assert len({*arms}) == len(arms)
        assert {*arms} & {*SIDES}
        assert all(P.arrival_s[0] <= arrival_s(spawn) <= P.arrival_s[1] for spawn in agents(found))
        counts[len(arms)] += 1
    assert min(counts.values()) > len(layouts()) / 10


def test_a_car_that_is_no_agent_keeps_its_distance_from_the_agent_on_its_arm():
    for found in layouts():
        for car in found.spawns:
            before = [a for a in agents(found) if a.approach == car.approach]
            if car.part == "other" and before:
                assert arrival_s(car) - arrival_s(before[0]) >= P.follow_s[0] - 1e-9
                assert car.speed_mps <= before[0].speed_mps
        assert found.danger in (None, *SIDES)


def test_neither_arm_nor_id_tells_who_comes_first():
    for key in (attrgetter("approach"), attrgetter("id")):
        firsts = defaultdict(list)
        for found in layouts():
            for one, other in combinations(sorted(agents(found), key=key), 2):
                firsts[key(one), key(other)].append(arrival_s(one) < arrival_s(other))
        assert len(firsts) == 6
        for before in firsts.values():
            assert binomtest(sum(before), len(before)).pvalue > LEAST_P


def test_all_arms_have_one_distribution_of_times():
    times = {
        arm: [arrival_s(a) for found in layouts() for a in agents(found) if a.approach == arm]
        for arm in APPROACHES
    }
    for arm in SECTORS:
        assert ks_2samp(times["own"], times[arm]).pvalue > LEAST_P


def test_a_danger_is_hidden_from_the_egos_road_and_seen_from_the_one_that_it_comes_on():
    always = replace(SCENARIO, parameters=replace(P, danger_share=1.0))
    for seed in range(12):
        listed = who_list_the_danger(World.start(always, seed))
        assert listed
        assert listed <= {*SIDES}


def test_from_each_arm_the_road_is_the_same_turned():
    shared, south = SCENARIO.road(), seats()["own", "straight"].scenario.road()
    rotation = np.eye(2)
    for way in WAYS:
        seat = seats()[way]
        road = seat.scenario.road()
        assert seat.names[way] == road.ego == ("own", "straight")
        assert road is seat.scenario.road()
        assert road.network() is shared.network()
        assert {*seat.names} == {*shared.paths}
        for key, name in seat.names.items():
            assert np.array_equal(road.paths[name].points, shared.paths[key].points)
            assert road.paths[name].lanes == shared.paths[key].lanes
        for name, path in road.paths.items():
            assert path.points == pytest.approx(south.paths[name].points @ rotation, abs=1e-6)
            assert path.roles == south.paths[name].roles
        for key, at in road.crossings.items():
            here = south.crossings[key]
            assert (at.x_m, at.y_m) == pytest.approx(
                np.array([here.x_m, here.y_m]) @ rotation, abs=1e-6
            )
            assert (at.ego_arc_m, at.other_arc_m) == pytest.approx(
                (here.ego_arc_m, here.other_arc_m)
            )
        assert road.zone_m == pytest.approx(np.array(south.zone_m) @ rotation, abs=1e-6)
        for sector, points in road.sectors.items():
            assert points == pytest.approx(south.sectors[sector] @ rotation, abs=1e-6)
        rotation = rotation @ TURN


@pytest.mark.parametrize("turns", range(4))
def test_an_agent_in_any_seat_sees_who_crosses_its_way_and_gives_way(turns):
    way, left, oncoming = WAYS[turns], WAYS[(turns + 1) % 4], WAYS[(turns + 2) % 4]
    seat = seats()[way]
    meeting = seated(SCENARIO, scene(left, way, oncoming), 1)
    graph = truth_graph(seat.scenario, meeting)
    (conflict,) = [c for c in graph.conflicts if c.meets]
    assert (graph.viewer, conflict.vehicle, conflict.sector) == ("v2", "v1", "left")
    assert conflict.ego.arc_m == pytest.approx(23.0, abs=0.1)
    assert conflict.other.arc_m == pytest.approx(27.0, abs=0.1)
    assert plan(seat.scenario, graph) == "SLOWER"
    alone = seated(SCENARIO, scene(oncoming, way), 1)
    assert plan(seat.scenario, truth_graph(seat.scenario, alone)) == "IDLE"
    at_south = truth_graph(SCENARIO, scene(WAYS[0], WAYS[1], WAYS[2]))
    assert plan(SCENARIO, at_south) == "SLOWER"


@pytest.mark.parametrize("way", WAYS)
def test_an_agent_has_its_goal_behind_the_junction_on_the_other_side(way):
    seat, road = seats()[way], SCENARIO.road()
    arc = ARM_M + 2 * JUNCTION_M + P.cleared_m
    before, behind = (np.array([[road.paths[way].at(arc + m)[:2]]]) for m in (-0.1, 0.1))
    assert not seat.scenario.cleared(before, np.array([["own"]]), P).any()
    assert seat.scenario.cleared(behind, np.array([["own"]]), P).all()


@pytest.mark.slow
def test_who_keeps_its_speed_collides_in_many():
    drives = drive_all(SCENARIO, range(4))
    results = {driver: [outcomes[driver].result for outcomes in drives] for driver in DRIVERS}
    assert results["cruise"].count("collision") > 2
    assert {*results["brake"]} == {"time_out"}
    assert results["local-view"].count("cleared") < results["full-view"].count("cleared")


@pytest.mark.slow
def test_if_nobody_gives_way_many_collide():
    seeds = range(8)
    idle = [[["IDLE"] * P.decisions] * len(agents(layouts()[seed])) for seed in seeds]
    ends = [driven(SCENARIO, seed, plans) for seed, plans in zip(seeds, idle, strict=True)]
    assert sum("collision" in results for results in ends) > len(seeds) / 2
