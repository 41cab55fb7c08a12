"""Freezing a layout: its decision tree, with every course that the ego's decisions can take.

From the first decision point on every meta-action is taken, each a lag after its moment, and the decision
points that come are frozen. Those in the same state are one, whatever led there; actions that set the same
target are one edge. So the tree of six decisions has some hundred decision points, and every leaf of it
is an episode that is decided.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from harness.core.files import digest
from harness.dataset.schema import Branching, Edge, End
from harness.world import lockstep
from harness.world.beacons import known
from harness.world.drivers import DRIVERS, choose
from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.scenario import Scenario
from harness.world.state import VehicleState, WorldState
from harness.world.world import Target, World

Record = dict[str, Any]


def freeze(scenario: Scenario, seed: int, episode: int) -> tuple[list[list[Branching]], list[list[Record]]]:
    """The decision tree of a layout, and the scene of each of its decision points, both level by level."""
    level = [World.start(scenario, seed)]
    branchings, scenes = [], []
    while level:
        ways, following = edges(level, episode)
        records, points = [], []
        for world, out in zip(level, ways, strict=True):
            state = world.state()
            record = _record(world, state, episode)
            drivers = _drivers(scenario, state, record["graphs"][state.ego.id])
            points.append(Branching(record["scene"], drivers, out))
            records.append(record)
        scenes.append(records)
        branchings.append(points)
        level = following
    return branchings, scenes


def edges(worlds: Sequence[World], episode: int) -> tuple[list[list[Edge]], list[World]]:
    """Where each action of some decision points of one step leads, and the decision points that come."""
    waiting = [world.branch() for world in worlds]
    p = worlds[0].scenario.parameters
    for world in waiting:
        world.outcome, world.hard_brakings = Outcome(), 0  # what happens from here on
    lockstep.advance(waiting, [p.due_frame(world.step) + p.lag_frames for world in waiting])
    ways = [list(_parted(world)) for world in waiting]
    branches = [branch for parts in ways for _, branch in parts]
    lockstep.advance(branches, [p.due_frame(branch.step) for branch in branches])
    following: dict[str, tuple[int, World]] = {}
    out = [[_edge(*part, episode, following) for part in parts] for parts in ways]
    return out, [world for _, world in following.values()]


def _parted(world: World) -> Iterator[tuple[list[str], World]]:
    """The actions that set one target, and a world each in which one of them is taken."""
    by_target: dict[Target, list[str]] = {}
    for action in world.actions:
        target = world.target if world.outcome.ended else world.target_after(action)
        by_target.setdefault(target, []).append(action)
    for left, actions in zip(reversed(range(len(by_target))), by_target.values(), strict=True):
        branch = world.branch() if left else world
        branch.decide(actions[0])
        yield actions, branch


def _edge(actions: list[str], branch: World, episode: int, following: dict[str, tuple[int, World]]) -> Edge:
    """Where some actions led; a new decision point joins those `following`, by id with its number."""
    outcome, end, to = branch.outcome, None, None
    if outcome.ended:
        assert outcome.time_s is not None
        how = outcome.partner, outcome.striker, outcome.fault
        end = End(outcome.result, outcome.time_s, *how)  # type: ignore[arg-type]
    else:
        to, _ = following.setdefault(scene_id(episode, branch.state()), (len(following), branch))
    gap_m = round(outcome.least_gap_m, 3)
    return Edge(actions, to, end, gap_m, branch.hard_brakings, outcome.other_crashes)


def _drivers(scenario: Scenario, state: WorldState, seen: Mapping[str, Any]) -> dict[str, str]:
    """What each reference driver does at a decision point; `seen` is the ego's scene graph."""
    truth = truth_graph(scenario, state)
    return {driver: choose(scenario, driver, seen, truth) for driver in DRIVERS}


def _record(world: World, state: WorldState, episode: int) -> Record:
    return {
        **moment(world, state, episode, (state.ego, *state.helpers)),
        "road": world.scenario.road().facts,
        "snapshot": world.snapshot(),
    }


def scene_id(episode: int, state: WorldState) -> str:
    """`<episode>-<step>-<digest>`: equal states have equal ids, frozen and in the closed loop."""
    return f"{episode:05d}-{state.step}-{digest(state.to_dict())[:12]}"


def moment(world: World, state: WorldState, episode: int, viewers: Sequence[VehicleState]) -> Record:
    """What is there at a decision point, and what the viewers see of it; the ego is the first of them.

    Distances to the conflict zone and to the ego are those that the ego knows.
    """
    zone, ego = world.scenario.road().zone_m, viewers[0]
    taken = {v.id: known(state, v.id, ego.id) for v in viewers}
    return {
        "scene": scene_id(episode, state),
        "episode": episode,
        "episode_seed": world.seed,
        "step": state.step,
        "danger": {"sector": world.layout.danger, "vehicle": world.layout.danger_id},
        "state": state.to_dict(),
        "graphs": {v.id: scene_graph(world.scenario, state, v.id) for v in viewers},
        "distance_m": {id_: _apart_m(v, *zone) for id_, v in taken.items()},
        "range_m": {id_: _apart_m(v, ego.x_m, ego.y_m) for id_, v in taken.items() if id_ != ego.id},
    }


def _apart_m(v: VehicleState, x_m: float, y_m: float) -> float:
    return round(float(np.hypot(v.x_m - x_m, v.y_m - y_m)), 3)
