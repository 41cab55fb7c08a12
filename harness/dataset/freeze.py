"""Freeze layouts: compute the decision tree of each,
with every course that the ego's decisions can take.

From the first decision point on, every meta-action is taken one lag after it, and the decision
points that follow are frozen. Those in the same state are one, whatever led there, and actions that
set the same target are one edge. So the tree of six decisions has some hundred decision points, and
each of its leaves is a decided episode.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from harness.dataset.schema import Branching, Danger, Edge, End, Record, scene_id
from harness.world import lockstep
from harness.world.beacons import state_by_beacon
from harness.world.conflict_measures import rounded
from harness.world.drivers import choices, drivers_of
from harness.world.perception.graph import scene_graphs, truth_graphs
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.state import VehicleState, WorldState
from harness.world.world import Target, World


class Frozen(NamedTuple):
    """Hold a layout's decision tree and the record of each decision point.

    A layout is the start situation of an episode, and its tree has every decision point that
    decisions can lead to. Both lists have a list for each step, the number of the decision from 0,
    with an entry for each decision point there, in the same order: `branchings` what each action
    does there, and `scenes` the state and what each vehicle knows of it.
    """

    branchings: list[list[Branching]]  # what each action does at each decision point of a step
    # the state at each decision point of a step, and what each vehicle knows: its scene graph
    scenes: list[list[Record]]


def freeze(scenario: Scenario, seeds: Mapping[int, int]) -> list[Frozen]:
    """Simulate and return the decision tree of each layout, in the order of `seeds`.

    A layout is the start situation of an episode of `scenario`, and its tree has every decision
    point that decisions can lead to. `seeds` has the seed that draws a layout, by the number of its
    episode.
    """
    if scenario.layouts is not None:
        alone = [freeze(scenario.at(seed), {episode: seed}) for episode, seed in seeds.items()]
        return [frozen for [frozen] in alone]
    level = [(episode, World.start(scenario, seed)) for episode, seed in seeds.items()]
    trees = {episode: Frozen([], []) for episode in seeds}
    facts = dict(scenario.road().facts)
    while level:
        episodes, worlds = zip(*level, strict=True)
        out_edges, following = edges(worlds, episodes)
        states = [world.state() for world in worlds]
        viewers = [(state.ego, *state.helpers) for state in states]
        records = records_of(scenario, list(zip(worlds, states, episodes, viewers, strict=True)))
        ego_graphs = [record.graphs[record.state.ego.id] for record in records]
        drivers = _drivers(scenario, states, ego_graphs)
        for episode in dict.fromkeys(episodes):
            trees[episode].branchings.append([])
            trees[episode].scenes.append([])
        for world, record, actions, out in zip(worlds, records, drivers, out_edges, strict=True):
            tree = trees[record.episode]
            tree.branchings[-1].append(Branching(record.scene, actions, out))
            tree.scenes[-1].append(replace(record, road=facts, snapshot=world.snapshot()))
        level = following
    return list(trees.values())


def edges(
    worlds: Sequence[World], episodes: Sequence[int]
) -> tuple[list[list[Edge]], list[tuple[int, World]]]:
    """Simulate every action at the decision points of one step.

    `worlds` are the simulations at these decision points, and `episodes` the number of each one's
    episode. Returned are for each point the list of its edges, each what one or several actions
    lead to, and then the distinct decision points of the next step, each as (number of the episode,
    simulation). `Edge.to` is an index from 0 among the next points of the same episode.
    """
    waiting = [world.branch() for world in worlds]
    p = worlds[0].scenario.parameters
    for world in waiting:
        world.journeys = {agent: journey.anew() for agent, journey in world.journeys.items()}
    lockstep.advance(waiting, [p.due_frame(world.step) + p.lag_frames for world in waiting])
    branches_of_world = [list(_branches(world)) for world in waiting]
    advancing = [branch for branches in branches_of_world for _, branch in branches]
    lockstep.advance(advancing, [p.due_frame(branch.step) for branch in advancing])
    following: dict[int, dict[str, tuple[int, World]]] = {episode: {} for episode in episodes}
    out_edges: list[list[Edge]] = []
    for branches, episode in zip(branches_of_world, episodes, strict=True):
        by_id = following[episode]
        out_edges.append([_edge(actions, branch, episode, by_id) for actions, branch in branches])
    points: list[tuple[int, World]] = []
    for episode, by_id in following.items():
        points += [(episode, world) for _, world in by_id.values()]
    return out_edges, points


def _branches(world: World) -> Iterator[tuple[list[str], World]]:
    """Yield the actions that set each target, with a world in which one of them is taken."""
    by_target: dict[Target, list[str]] = {}
    for action in world.actions:
        target = world.target() if world.outcome.ended else world.target_after(action)
        by_target.setdefault(target, []).append(action)
    for remaining, actions in zip(reversed(range(len(by_target))), by_target.values(), strict=True):
        branch = world.branch() if remaining else world
        branch.decide(actions[0])
        yield actions, branch


def _edge(
    actions: list[str], branch: World, episode: int, following: dict[str, tuple[int, World]]
) -> Edge:
    """Return the edge of some actions, after which a world is `branch`.

    `following` has the points of the next level by their ids, each with its place; a new one is
    added.
    """
    outcome, end, child = branch.outcome, None, None
    if outcome.ended:
        assert outcome.time_s is not None
        contact = outcome.partner, outcome.striker, outcome.fault
        end = End(outcome.result, outcome.time_s, *contact)  # type: ignore[arg-type]
    else:
        # Where several edges lead to one state, the post-encroachment times after it are by the
        # past of the first. No tree that ships has such edges.
        child, _ = following.setdefault(scene_id(episode, branch.state()), (len(following), branch))
    journey = branch.journey
    return Edge(
        actions,
        child,
        end,
        round(outcome.least_gap_m, 3),
        journey.hard_brakings,
        outcome.other_crashes,
        rounded(journey.conflicts.ttc_s),
        rounded(journey.conflicts.pet_s),
    )


def _drivers(
    scenario: Scenario, states: Sequence[WorldState], ego_graphs: Sequence[SceneGraph]
) -> list[dict[str, str]]:
    """Return each reference driver's action at some decision points, by the driver's name."""
    drivers, cases = drivers_of(scenario), []
    for graph, truth in zip(ego_graphs, truth_graphs(scenario, states), strict=True):
        cases += [(driver, graph, truth) for driver in drivers]
    actions = iter(choices(scenario, cases))
    return [dict(zip(drivers, actions, strict=False)) for _ in states]


def record_of(
    world: World, state: WorldState, episode: int, viewers: Sequence[VehicleState]
) -> Record:
    """Return a decision point's state with the scene graphs of its viewers, as a dataset has it.

    A scene graph is what one vehicle, a viewer, knows of the state; the ego is the first of
    `viewers`. `world` is the simulation that is in this state, and `episode` the number of the
    episode. Distances to the conflict zone and to the ego are as the ego knows them from beacons.
    """
    [record] = records_of(world.scenario, [(world, state, episode, viewers)])
    return record


def records_of(
    scenario: Scenario, points: Sequence[tuple[World, WorldState, int, Sequence[VehicleState]]]
) -> list[Record]:
    """Return the record of each decision point, as a dataset has it: state and scene graphs.

    Each of `points` is the simulation, its state, the number of the episode, and the vehicles whose
    scene graphs (what they know) are made, the ego first. All are of `scenario`.
    """
    looks = [(state, viewer.id) for _, state, _, viewers in points for viewer in viewers]
    graphs, zone_m = iter(scene_graphs(scenario, looks)), scenario.road().zone_m
    records = []
    for world, state, episode, viewers in points:
        graph_of = {viewer.id: next(graphs) for viewer in viewers}
        records.append(_record(world, state, episode, graph_of, zone_m))
    return records


def _record(
    world: World,
    state: WorldState,
    episode: int,
    graphs: dict[str, SceneGraph],
    zone_m: tuple[float, float],
) -> Record:
    """Return the record of a decision point, with distances to the conflict zone at `zone_m`."""
    ego_id, *helpers = graphs
    ego = state.vehicle(ego_id)
    known_states = {name: state_by_beacon(state, name, ego_id) for name in graphs}
    return Record(
        scene=scene_id(episode, state),
        episode=episode,
        episode_seed=world.seed,
        step=state.step,
        danger=Danger(world.layout.danger, world.layout.danger_id),
        state=state,
        graphs=graphs,
        distance_m={name: _distance_m(v, *zone_m) for name, v in known_states.items()},
        range_m={name: _distance_m(known_states[name], ego.x_m, ego.y_m) for name in helpers},
    )


def _distance_m(v: VehicleState, x_m: float, y_m: float) -> float:
    return round(float(np.hypot(v.x_m - x_m, v.y_m - y_m)), 3)
