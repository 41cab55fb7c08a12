"""Layouts with a declared number of witnesses."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import one_way_crossing
import pytest
from scipy.stats import chi2_contingency

from harness.core.errors import UserError
from harness.world import lookouts, scenarios
from harness.world.perception.graph import scene_graphs
from harness.world.reference import drive
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.world import World

ALWAYS: dict[str, Any] = {"danger_share": 1.0}
NEVER: dict[str, Any] = {"danger_share": 0.0}


@pytest.fixture(params=scenarios.witnessed())
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def layout(scenario: Scenario, seed: int, **changed: Any) -> Layout:
    return scenario.layout(seed, replace(scenario.parameters, **changed))


def declared(scenario: Scenario, seed: int) -> int | None:
    return lookouts.witnesses(scenario.name, scenario.parameters, seed)


def test_each_goes_by_the_seed() -> None:
    each = scenarios.get("parking-exit:witnesses=each")
    assert [declared(each, seed) for seed in range(8)] == [0, 1, 2, 3] * 2


def test_drawn_is_even_whatever_the_seed_is_modulo_4_and_of_each_scenario() -> None:
    count = 4000
    for name in ("parking-exit", "occluded-intersection"):
        scenario = scenarios.get(f"{name}:witnesses=drawn")
        table = np.zeros((4, 4), int)
        for seed in range(200_000, 200_000 + count):
            table[seed % 4, declared(scenario, seed)] += 1
        assert abs(table.sum(axis=0) / count - 0.25).max() < 0.03
        assert chi2_contingency(table).pvalue > 0.001
    parking, crossing = (
        [declared(scenarios.get(f"{name}:witnesses=drawn"), seed) for seed in range(40)]
        for name in ("parking-exit", "occluded-intersection")
    )
    assert parking != crossing


@pytest.mark.parametrize("how", ["each", "drawn"])
def test_a_danger_has_as_many_witnesses_as_are_declared(name: str, how: str) -> None:
    scenario = scenarios.get(f"{name}:witnesses={how}")
    scenario = replace(scenario, parameters=replace(scenario.parameters, **ALWAYS))
    for seed in range(8 if how == "each" else 4):
        world = World.start(scenario, seed)
        state = world.state()
        viewers = [state.ego, *state.helpers]
        listed = [world.layout.danger_id in graph.seen for graph in
                  scene_graphs(scenario, [(state, viewer.id) for viewer in viewers])]  # fmt: skip
        assert (len(viewers), listed[0]) == (4, False)
        assert sum(listed) == declared(scenario, seed)


def test_only_radios_move_with_the_number_of_witnesses(name: str) -> None:
    scenario = scenarios.get(name)
    for seed in range(4):
        layouts = [
            layout(scenario, seed, witnesses=str(count), radio_share=0.0) for count in range(4)
        ]
        helpers = [{s.id for s in made.spawns if s.part == "helper"} for made in layouts]
        places = [
            {replace(s, part="other") for s in made.spawns if s.part != "ego"} for made in layouts
        ]
        assert places[3] < places[2] < places[1] < places[0]
        for fewer, more in pairwise(helpers):
            assert len(fewer & set(lookouts.LOOKOUTS)) + 1 == len(more & set(lookouts.LOOKOUTS))
            assert fewer & set(lookouts.LOOKOUTS) <= more
            assert more - set(lookouts.LOOKOUTS) <= fewer


def test_who_is_where_and_who_has_a_radio_tells_nothing_of_a_danger(name: str) -> None:
    scenario = scenarios.get(name)
    for seed in range(4):
        made = layout(scenario, seed, witnesses="1", radio_share=0.5, **ALWAYS)
        without = layout(scenario, seed, witnesses="1", radio_share=0.5, **NEVER)

        def rest(spawns: tuple[Spawn, ...], danger: str | None = made.danger_id) -> set[Spawn]:
            return {s for s in spawns if s.id != danger}

        assert rest(made.spawns) == rest(without.spawns)
        assert made.buildings == without.buildings


@pytest.mark.slow
def test_blind_seats_are_on_their_path_and_out_of_an_ego_that_stops(name: str) -> None:
    scenario = scenarios.get(f"{name}:witnesses=0")
    for seed in range(8):
        made = layout(scenario, seed, witnesses="0")
        assert min(spawn.arc_m for spawn in made.spawns if spawn.part == "helper") >= 0.0
    ended = drive(scenario, "brake", 0)
    helpers = {spawn.id for spawn in layout(scenario, 0).spawns if spawn.part == "helper"}
    assert (ended.partner in helpers, ended.other_crashes) == (False, 0)


def test_a_world_of_witnesses_is_thawed_as_it_was(name: str) -> None:
    scenario = scenarios.get(f"{name}:witnesses=1,radio_share=0.5")
    world = World.start(scenario, 1)
    world.act("SLOWER")
    thawed = World.thaw(scenario, world.state(), world.snapshot())
    for one in (world, thawed):
        one.act("IDLE")
    assert [(v.id, v.part) for v in thawed.state().vehicles] == [
        (v.id, v.part) for v in world.state().vehicles
    ]
    assert thawed.outcome.result == world.outcome.result


def test_a_scenario_without_lookouts_has_no_such_settings() -> None:
    assert not {"witnesses", "radio_share"} & {*one_way_crossing.SCENARIO.dials}


def test_parameters_that_give_no_such_layout_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lookouts, "MOST_ATTEMPTS", 0)
    with pytest.raises(UserError, match=r"none of 0 draws of layout seed 991 gives witnesses=2"):
        layout(scenarios.get("parking-exit"), 991, witnesses="2")
