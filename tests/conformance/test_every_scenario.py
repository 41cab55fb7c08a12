"""What holds for every scenario: the contract of `harness.world.scenario.Scenario`."""

import pickle
from dataclasses import replace
from typing import Any

import former
import msgspec
import numpy as np
import one_way_crossing
import pytest
from together import act_together

from harness.coordination.consensus import Messages, inverse_distance_weights
from harness.coordination.trust import Trust
from harness.dataset.load import Scene
from harness.evaluate.claims import claims
from harness.evaluate.live_world import look
from harness.world import scenarios
from harness.world.perception.graph import scene_graph, scene_graphs, truth_graph, truth_graphs
from harness.world.reference import finish
from harness.world.scenario import Scenario
from harness.world.state import Snapshot, WorldState
from harness.world.world import World

SEEDS = range(6)


def some_or_the_rest(some: range, rest: range) -> pytest.MarkDecorator:
    """Some layout seeds, and where everything is tested the rest of them."""
    wide = pytest.param(rest, marks=pytest.mark.exhaustive)
    return pytest.mark.parametrize("seeds", [some, wide], ids=["some", "the rest"])


one_or_the_rest = some_or_the_rest(range(1), range(1, 6))


@pytest.fixture(
    params=[*map(scenarios.get, scenarios.names()), former.SCENARIO, one_way_crossing.SCENARIO],
    ids=lambda s: s.name,
)
def scenario(request: pytest.FixtureRequest) -> Scenario:
    found: Scenario = request.param
    return found


def test_it_says_what_it_is(scenario: Scenario) -> None:
    assert scenario.description.startswith(f"Scenario `{scenario.name}`: {scenario.summary}")
    assert {"SLOWER", "IDLE", "FASTER"} <= set(scenario.actions)


def test_equal_seeds_are_equal_layouts_with_the_ego_first_and_its_helpers_next(
    scenario: Scenario,
) -> None:
    for seed in SEEDS:
        found = scenario.layout(seed, scenario.parameters)
        assert found == scenario.layout(seed, scenario.parameters)
        parts = [spawn.part for spawn in found.spawns]
        # else who helps is drawn among vehicles of fixed places
        if scenario.parameters.witnesses == "any":
            assert parts == sorted(parts, key=("ego", "helper", "other").index)
        assert (parts.count("ego"), found.spawns[0].id) == (1, "v1")
        assert len({spawn.id for spawn in found.spawns}) == len(parts)
        assert found.danger in (None, *scenario.road().sectors)
        assert (found.danger is None) == (found.danger_id is None)
    layouts = [scenario.layout(seed, scenario.parameters) for seed in SEEDS]
    assert any(one != layouts[0] for one in layouts[1:])


@some_or_the_rest(range(10), range(10, 40))
def test_whatever_is_not_its_danger_is_where_it_would_be_without_it(
    scenario: Scenario, seeds: range
) -> None:
    p = scenario.parameters
    if not hasattr(p, "danger_share"):
        pytest.skip("no dial for dangers")
    safe: dict[str, Any] = {"danger_share": 0.0}
    for seed in seeds:
        found = scenario.layout(seed, p)
        without = scenario.layout(seed, replace(p, **safe))
        rest = [{s for s in of.spawns if s.id != found.danger_id} for of in (found, without)]
        assert (rest[0], found.buildings) == (rest[1], without.buildings)


def test_its_paths_run_along_the_middle_of_their_lanes(scenario: Scenario) -> None:
    road = scenario.road()
    for path in road.paths.values():
        assert len(path.lanes) == len(path.roles) == len(path.ends_m) + 1
        starts = (0.0, *path.ends_m)
        for section, (lane, start) in enumerate(zip(path.lanes, starts, strict=True)):
            street = road.network().get_lane(lane)
            along = street.length / 2
            assert path.section(start + along) == section
            place = street.local_coordinates(np.array(path.at(start + along)[:2]))
            assert place == pytest.approx((along, 0.0), abs=0.01)


def test_its_ego_comes_through_every_crossing(scenario: Scenario) -> None:
    road = scenario.road()
    assert not road.ways or road.ego in road.ways
    for key, at in road.crossings.items():
        assert road.ego_path.at(at.ego_arc_m)[:2] == pytest.approx((at.x_m, at.y_m), abs=0.05)
        assert road.paths[key].at(at.other_arc_m)[:2] == pytest.approx((at.x_m, at.y_m), abs=0.05)


def test_it_travels_as_its_name_and_parameters(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenarios, "get", {scenario.name: scenario}.__getitem__)
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    assert len(pickle.dumps(scenario)) < 2000


def test_a_thawed_world_goes_on_as_the_one_it_was_taken_from(scenario: Scenario) -> None:
    start = World.start(scenario, 1)
    start.act("SLOWER")
    text = msgspec.json.encode((start.state(), start.snapshot()))
    stored = msgspec.json.decode(text, type=tuple[WorldState, Snapshot])
    every = [
        (start.branch(), World.thaw(scenario, *stored), start.branch().branch())
        for _ in scenario.actions
    ]
    acting = [world for worlds in every for world in worlds]
    for actions in (scenario.actions, ("IDLE",) * len(every)):
        act_together(acting, np.repeat(actions, 3).tolist())
        for world, thawed, branch in every:
            assert branch.state() == world.state()
            # A state is kept to the micrometre.
            for mine, its in zip(thawed.state().vehicles, world.state().vehicles, strict=True):
                assert (mine.x_m, mine.y_m) == pytest.approx((its.x_m, its.y_m), abs=1e-3)
                assert mine.speed_mps == pytest.approx(its.speed_mps, abs=1e-3)
            assert thawed.outcome.result == world.outcome.result


@pytest.mark.slow
@some_or_the_rest(range(1), SEEDS)  # who waits need not fail to arrive in each of them
def test_a_driver_who_sees_everything_reaches_the_goal_and_one_who_waits_does_not(
    scenario: Scenario, seeds: range
) -> None:
    drivers = ["full-view", "brake"]
    worlds = [World.start(scenario, seed) for seed in seeds for _ in drivers]
    results = [outcome.result for outcome in finish(worlds, drivers * len(seeds))]
    assert {*results[::2]} == {"cleared"}
    assert {*results[1::2]} - {"cleared"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "decisions"), [(range(1), 3), pytest.param(SEEDS, 10, marks=pytest.mark.exhaustive)]
)
def test_none_of_its_vehicles_is_distrusted_for_where_it_drives(
    scenario: Scenario, seeds: range, decisions: int
) -> None:
    """All that could speak against a helper is what it claims: everybody is undecided."""
    rule = Trust()
    for seed in seeds:
        world, moments = World.start(scenario, seed), list[Scene]()
        while (
            len(moments) < min(decisions, scenario.parameters.decisions) and not world.outcome.ended
        ):
            moments.append(look(world, 0, seed, len(moments), ego_alone=False))
            world.act(scenario.actions[0])
        said = claims(scenario, moments)
        state = rule.start((), said.speed_mps.shape[1], len(scenario.actions))
        for n, scene in enumerate(moments):
            now, there = said.take(n), np.isfinite(said.speed_mps[n])
            distance_m = np.linalg.norm(now.xy_m, axis=-1)
            assert distance_m[np.insert(there, 0, True)] == pytest.approx(
                [scene.record.distance_m[viewer] for viewer in scene.viewers], abs=1e-3
            )
            undecided = np.full((1 + len(there), len(scenario.actions)), 1 / len(scenario.actions))
            weights = inverse_distance_weights(distance_m, there, 1.0)
            arrival_s, range_m = np.where(there, 0.1, np.inf), np.ones(len(there))
            fused = rule.fuse(
                Messages(undecided, weights, there, arrival_s, distance_m, range_m, now), state
            )
            assert fused.trust is not None
            assert (fused.trust[there] > 0.8).all()
            state = fused.state


@some_or_the_rest(range(6), range(6, 40))
def test_a_graph_is_the_same_without_a_vehicle_that_it_does_not_list(
    scenario: Scenario, seeds: range
) -> None:
    scenario = replace(scenario, parameters=replace(scenario.parameters, perception=2))
    looks, less = list[tuple[WorldState, str]](), list[tuple[WorldState, str, int]]()
    worlds = [World.start(scenario, seed) for seed in seeds]
    act_together(worlds, [scenario.actions[seed % len(scenario.actions)] for seed in seeds])
    for world in worlds:
        state = world.state()
        looks += [(state, v.id) for v in (state.ego, *state.helpers)]
    graphs = scene_graphs(scenario, looks)
    for n, ((state, viewer), graph) in enumerate(zip(looks, graphs, strict=True)):
        listed = {node.id for node in graph.nodes} | {viewer, state.ego.id}
        for unlisted in {v.id for v in state.vehicles} - listed:
            rest = tuple(v for v in state.vehicles if v.id != unlisted)
            less.append((msgspec.structs.replace(state, vehicles=rest), viewer, n))
    assert [graphs[n] for *_, n in less] == scene_graphs(scenario, [each[:2] for each in less])
    assert scenario.name == one_way_crossing.SCENARIO.name or len(less) > 5


@pytest.mark.slow
@one_or_the_rest
def test_many_viewers_see_together_what_each_sees_alone(scenario: Scenario, seeds: range) -> None:
    states = []
    for seed in seeds:
        world = World.start(scenario, seed)
        for step in range(scenario.parameters.decisions):
            states.append(world.state())
            if world.outcome.ended:
                break
            world.act(scenario.actions[(seed + step) % len(scenario.actions)])
    looks = [(state, v.id) for state in states for v in (state.ego, *state.helpers)]
    assert scene_graphs(scenario, looks) == [scene_graph(scenario, *each) for each in looks]
    truths = truth_graphs(scenario, states)
    assert truths == [truth_graph(scenario, state) for state in states]


@pytest.mark.slow
@pytest.mark.parametrize("on_each", [6, pytest.param(60, marks=pytest.mark.exhaustive)])
def test_many_points_are_projected_as_each_alone_on_the_nearest_point(
    scenario: Scenario, on_each: int
) -> None:
    road, rng, far_m = scenario.road(), np.random.default_rng(1), 2.2
    paths = list(road.paths.values())
    on = np.concatenate(
        [path.points[rng.integers(len(path.points), size=on_each)] for path in paths]
    )
    beyond = np.concatenate([path.points[[0, -1]] for path in paths]) * 1.2
    points = np.concatenate(
        [on, on + rng.normal(0.0, far_m, on.shape), beyond, rng.uniform(-99, 99, on.shape)]
    )
    for key, path in road.paths.items():
        projected = road.project([key] * len(points), *points.T)
        alone = [path.project(x, y) for x, y in points.tolist()]
        assert np.array_equal(projected.T, alone)
        away_m = np.hypot(*(points[:, None] - path.points).T)
        foot = projected[0] - path.arc_m[away_m.argmin(axis=0)]
        assert np.allclose(np.hypot(projected[1], foot), away_m.min(axis=0), atol=1e-6)
