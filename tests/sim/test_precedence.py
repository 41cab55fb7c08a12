"""Drivers that keep a rule of the road:
who goes first, and what a vehicle that gives way plans with.
"""

from dataclasses import replace

import pytest

from harness.world import reference, scenarios
from harness.world.perception.graph import scene_graphs
from harness.world.precedence import RULES, under
from harness.world.scenario import Scenario
from harness.world.scene_graph import BY_BEACON, SceneGraph
from harness.world.world import World

ASKED = ("v1", "v2", "v3", "v4")
KNOWN = "agent_share=1,perfect_knowledge=true"


def seat(world: World, agent: int) -> Scenario:
    return replace(world.seat(agent), parameters=world.scenario.parameters)


def graph(world: World, agent: int) -> SceneGraph:
    """Return what an agent sees from its seat."""
    state = world.state(agent)
    [seen] = scene_graphs(seat(world, agent), [(state, state.ego.id)])
    return seen


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("name", ["all-way-crossing", "platoon-merge", "roundabout-entries"])
def test_of_two_whose_paths_meet_exactly_one_gives_way(name: str, rule: str) -> None:
    pairs = dict[tuple[int, str, str], int]()
    for seed in range(12):
        world = World.start(scenarios.get(f"{name}:{KNOWN}"), seed)
        for agent in world.journeys:
            seen = graph(world, agent)
            kept = [c.vehicle for c in under(rule, seat(world, agent), seen).conflicts if c.meets]
            met = {c.vehicle for c in seen.conflicts if c.meets and c.vehicle in ASKED}
            pairs |= {(seed, seen.viewer, other): kept.count(other) for other in met}
    assert len(pairs) > 24
    for (seed, own, other), times in pairs.items():
        assert sorted((times, pairs[seed, other, own])) == [0, 3]


def test_of_two_who_come_head_on_nearly_always_one_gives_way() -> None:
    """Both go if each is too near to its own end of the passage to stop."""
    pairs = dict[tuple[int, str, str], int]()
    for seed in range(12):
        world = World.start(scenarios.get(f"narrow-passage:{KNOWN}"), seed)
        for agent in world.journeys:
            seen = graph(world, agent)
            kept = [
                c.vehicle
                for c in under("first-come", seat(world, agent), seen).conflicts
                if c.meets
            ]
            met = {c.vehicle for c in seen.conflicts if c.meets and c.vehicle in ASKED}
            pairs |= {(seed, seen.viewer, other): kept.count(other) for other in met}
    times = [
        sorted((count, pairs[seed, other, own])) for (seed, own, other), count in pairs.items()
    ]
    assert len(times) > 24
    assert times.count([0, 3]) > 0.9 * len(times)


def test_who_comes_from_the_right_goes_first_and_so_does_the_main_lane() -> None:
    left_out = {"left": set[bool](), "right": set[bool](), "main": set[bool](), "ramp": set[bool]()}
    for name in ("all-way-crossing", "platoon-merge"):
        for seed in range(8):
            world = World.start(scenarios.get(f"{name}:{KNOWN}"), seed)
            for agent in world.journeys:
                seen = graph(world, agent)
                kept = {c.vehicle for c in under("right-hand", seat(world, agent), seen).conflicts}
                for c in seen.conflicts:
                    if c.meets and c.vehicle in ASKED:
                        left_out[c.sector].add(c.vehicle not in kept)
    assert left_out == {"left": {True}, "right": {False}, "main": {False}, "ramp": {True}}


def test_a_rule_expects_nothing_of_traffic_that_keeps_none() -> None:
    scenario, others = scenarios.get(f"all-way-crossing:{KNOWN}"), 0
    for seed in range(6):
        world = World.start(scenario, seed)
        world.advance(100)
        for agent in world.journeys:
            seen = graph(world, agent)
            for rule in RULES:
                kept = under(rule, seat(world, agent), seen).conflicts
                for c in seen.conflicts:
                    if int(c.vehicle[1:]) > 4:
                        assert c in kept
                        others += 1
    assert others


def test_agents_hear_the_beacons_of_those_they_do_not_see() -> None:
    heard = 0
    for seed in range(6):
        world = World.start(scenarios.get("all-way-crossing:agent_share=1"), seed)
        for agent in world.journeys:
            seen = graph(world, agent)
            others = {world.vehicles[n].spawn.id for n in world.journeys} - {seen.viewer}
            assert others <= {node.id for node in seen.nodes}
            heard += sum(node.sensors == BY_BEACON and node.id == "v1" for node in seen.nodes)
    assert heard


@pytest.mark.slow
def test_a_reference_driver_drives_every_agent() -> None:
    scenario = scenarios.get("all-way-crossing:agent_share=1")
    worlds = [World.start(scenario, seed) for seed in range(8)]
    reference.finish(worlds, ["first-come"] * 4 + ["cruise"] * 4)
    assert all(world.ended for world in worlds)
    ended = [
        sum(j.outcome.success for w in half for j in w.journeys.values())
        for half in (worlds[:6], worlds[6:])
    ]
    assert ended[0] > ended[1]
