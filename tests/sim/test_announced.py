"""Traffic that sends beacons without helping: `radio_share`."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from harness.world import scenarios
from harness.world.beacons import state_by_beacon
from harness.world.perception.graph import scene_graph, scene_graphs
from harness.world.perception.shared import Heard, merged
from harness.world.scenario import Scenario
from harness.world.scene_graph import BY_BEACON, SceneGraph
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

CAM = "beacon_rule=cam,beacon_channel=its-g5"


def equipped(settings: str = "", **changed: Any) -> Scenario:
    scenario = scenarios.get(f"blind-merge:witnesses=0{settings}")
    whole = replace(scenario.parameters, **{"danger_share": 1.0, "radio_share": 1.0, **changed})
    return replace(scenario, parameters=whole)


def states(
    scenario: Scenario, seed: int = 3, decisions: int = 2
) -> Iterator[tuple[World, WorldState]]:
    world = World.start(scenario, seed)
    for _ in range(decisions):
        yield world, world.state()
        world.act("IDLE")


def graph_of(scenario: Scenario, state: WorldState) -> SceneGraph:
    return scene_graph(scenario, state, state.ego.id)


@pytest.mark.parametrize("settings", ["", f",{CAM}"])
def test_a_hidden_danger_with_a_radio_is_known_by_its_beacons(settings: str) -> None:
    scenario = equipped(settings)
    for world, state in states(scenario):
        danger = world.layout.danger_id
        for graph in scene_graphs(scenario, [(state, v.id) for v in (state.ego, *state.helpers)]):
            [node] = [node for node in graph.nodes if node.id == danger]
            assert (node.sensors, node.indicator, danger in graph.seen) == (BY_BEACON, None, False)
        ego, [node] = state.ego, [n for n in graph_of(scenario, state).nodes if n.id == danger]
        at = state_by_beacon(state, str(danger), ego.id)
        assert node.forward_m**2 + node.left_m**2 == pytest.approx(
            (at.x_m - ego.x_m) ** 2 + (at.y_m - ego.y_m) ** 2, rel=0.01
        )
        assert any(conflict.vehicle == danger for conflict in graph_of(scenario, state).conflicts)


def test_nobody_but_traffic_has_such_a_radio_and_without_one_nothing_changes() -> None:
    for _, state in states(equipped()):
        assert {v.id for v in state.vehicles if v.radio} == {
            v.id for v in state.vehicles if v.part == "other"
        }
    silent, loud = (World.start(equipped(radio_share=share), 3).state() for share in (0.0, 1.0))
    mute = tuple(msgspec.structs.replace(v, radio=False) for v in loud.vehicles)
    assert silent.vehicles == mute
    assert silent.beacons == tuple(b for b in loud.beacons if not loud.vehicle(b.sender).radio)
    assert b"radio" not in msgspec.json.encode(silent)


def test_where_everything_is_known_a_radio_gives_the_exact_place() -> None:
    scenario = equipped(",perfect_knowledge=true")
    for world, state in states(scenario, decisions=1):
        [node] = [
            node for node in graph_of(scenario, state).nodes if node.id == world.layout.danger_id
        ]
        assert node.speed_mps == round(state.vehicle(node.id).speed_mps, 1)


def test_one_who_is_left_out_is_not_known_by_beacons_either() -> None:
    scenario = equipped()
    for world, state in states(scenario, decisions=1):
        danger = str(world.layout.danger_id)
        assert danger not in {
            n.id for n in scene_graph(scenario, state, state.ego.id, [danger]).nodes
        }


def test_traffic_without_a_radio_hears_nobody() -> None:
    for world, state in states(equipped(), decisions=1):
        deaf = next(v for v in state.vehicles if v.part == "other")
        nodes = scene_graph(world.scenario, state, deaf.id).nodes
        assert BY_BEACON not in {node.sensors for node in nodes}


def test_helpers_share_what_they_see_and_no_beacons_of_others() -> None:
    scenario = equipped()
    for world, state in states(scenario, decisions=1):
        danger = world.layout.danger_id
        own, *helpers = scene_graphs(scenario, [(state, v.id) for v in (state.ego, *state.helpers)])
        unheard = msgspec.structs.replace(own, nodes=own.sensed, conflicts=())
        [graph] = merged(scenario, [Heard(state, unheard, helpers)])
        assert danger not in {node.id for node in graph.nodes}
        [graph] = merged(scenario, [Heard(state, own, helpers)])
        [node] = [node for node in graph.nodes if node.id == danger]
        assert node.sensors == BY_BEACON


def test_each_vehicle_has_a_radio_with_the_share_that_is_declared() -> None:
    scenario = scenarios.get("parking-exit:radio_share=0.3")
    traffic: list[VehicleState] = []
    for seed in range(60):
        spawns = scenario.layout(seed, scenario.parameters).spawns
        traffic += [spawn for spawn in spawns if spawn.part == "other"]  # type: ignore[misc]
    assert sum(v.radio for v in traffic) / len(traffic) == pytest.approx(0.3, abs=0.08)
