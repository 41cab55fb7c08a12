"""Freezing an episode: one record a decision point, with an outcome table for look-up later.

The behaviour that leads the ego through is declared and varied (`Behaviour`): it drives as `cruise` or
`local-view`, now and then takes a random action, and a guard stops it at the last instant: where its action
would end badly, it takes the best safe action instead and `full-view` drives on. So every episode comes as
close to failure as that behaviour gets, and still has all its decision points.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from harness.core import noise
from harness.world.beacons import known
from harness.world.drivers import PRIVILEGED
from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graph
from harness.world.reference import decide, finish
from harness.world.scenario import Scenario
from harness.world.state import VehicleState, WorldState
from harness.world.world import World

Record = dict[str, Any]


@dataclass(frozen=True)
class Behaviour:
    """Who drives the ego through a frozen episode.

    Attributes:
        cruise_share: probability that an episode is led by `cruise`, else by `local-view`.
        random_share: probability that a decision is a random action instead.
    """

    cruise_share: float = 0.6
    random_share: float = 0.1


def freeze(scenario: Scenario, seed: int, episode: int, behaviour: Behaviour) -> list[Record]:
    """Every decision point of one episode."""
    world = World.start(scenario, seed)
    chance = noise.generator("behaviour", seed)
    driver = "cruise" if chance.random() < behaviour.cruise_share else "local-view"
    records = []
    while not world.outcome.ended and world.step < scenario.parameters.decisions:
        outcomes = {action: rollout(world, action) for action in world.actions}
        action, reason = decide(driver, world), driver
        if chance.random() < behaviour.random_share:
            action, reason = world.actions[int(chance.integers(len(world.actions)))], "random"
        safe = [a for a in world.actions if outcomes[a].success]
        if safe and action not in safe:
            action, reason = min(safe, key=lambda a: outcomes[a].time_s or np.inf), "guard"
            driver = PRIVILEGED
        records.append(_record(world, episode, outcomes, {"action": action, "reason": reason}))
        world.act(action)
    return records


def rollout(world: World, action: str) -> Outcome:
    """What becomes of the ego if it takes an action now and the full-view driver takes the rest.

    `least_gap_m` and `other_crashes` count from now on.
    """
    branch = world.branch()
    branch.outcome = Outcome()
    branch.act(action)
    return finish(branch, PRIVILEGED)


def _record(world: World, episode: int, outcomes: dict[str, Outcome], behaviour: dict[str, str]) -> Record:
    state = world.state()
    return {
        **moment(world, state, episode, (state.ego, *state.helpers)),
        "road": world.scenario.road().facts,
        "behaviour": behaviour,
        "outcomes": {action: _row(outcome) for action, outcome in outcomes.items()},
        "snapshot": world.snapshot(),
    }


def moment(world: World, state: WorldState, episode: int, viewers: Sequence[VehicleState]) -> Record:
    """What is there at a decision point, and what the viewers see of it; the ego is the first of them.

    Distances to the conflict zone and to the ego are those that the ego knows.
    """
    zone, ego = world.scenario.road().zone_m, viewers[0]
    taken = {v.id: known(state, v.id, ego.id) for v in viewers}
    return {
        "scene": f"{episode:05d}-{state.step}",
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


def _row(outcome: Outcome) -> dict[str, Any]:
    return asdict(replace(outcome, least_gap_m=round(outcome.least_gap_m, 3)))
