"""The reference planner behind `local-view` and `full-view`: looks ahead along the ego's path.

It knows what a scene graph says, and nothing else. It plays every sequence of meta-actions over the next
decisions, then FASTER, against the conflicts of the graph at constant speed, and takes the first action of
the sequence that clears the conflict points soonest without meeting anyone. It does not guess at what it
cannot see, which is what makes occlusion cost something.
"""

from collections.abc import Mapping
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.world.road import Path, Road
from harness.world.scenario import Parameters, Scenario
from harness.world.state import SIZES_M

SHIFT = {"FASTER": 1, "SLOWER": -1, "IDLE": 0}  # what it plays through; it never changes lane
HORIZON = 4  # decisions that are played through; those after it are taken to be FASTER
LOOK_AHEAD_S = 9.0  # how far into the future a conflict is looked for
MARGIN_M = 0.5  # added to every outline, for noise and for what the model of motion leaves out
RESPONSE_S = 0.6  # time constant of the ego's speed controller (highway-env's TAU_ACC)
STEP_S = 0.1
# A car is covered by three discs on its long axis: a third of its length apart, reaching its corners.
DISCS_M = np.array([-1.0, 0.0, 1.0]) * SIZES_M["car"][0] / 3
DISC_RADIUS_M = float(np.hypot(SIZES_M["car"][0] / 6, SIZES_M["car"][1] / 2))


def plan(scenario: Scenario, graph: Mapping[str, Any]) -> str:
    """The planner's meta-action for a scene graph."""
    p, road, ego = scenario.parameters, scenario.road(), graph["ego"]
    actions = tuple(a for a in scenario.actions if a in SHIFT)
    left = p.decisions - graph["step"]
    sequences, travelled = _all_rollouts(actions, ego["speed_mps"], ego["target_speed_mps"], left, p)
    gap = np.full(len(sequences), np.inf)
    for conflict in graph["conflicts"]:
        gap = np.minimum(gap, least_gap(road, travelled, conflict))
    # The goal lies well behind the conflict points, so that a late burst of speed counts too.
    to_go = graph["ego"]["zone_m"] + 15.0
    arrival = (travelled < to_go).sum(axis=1) * STEP_S - 1e-3 * travelled[:, -1]
    safe = gap > 0
    score = np.where(safe, -arrival, -1e3 + np.minimum(gap, 0.0))
    best = np.flatnonzero(score >= score.max() - 1e-9)
    # Among equals the calmest: IDLE before FASTER before SLOWER, compared decision by decision.
    calm = {"IDLE": 0, "FASTER": 1, "SLOWER": 2}
    return min((sequences[i] for i in best), key=lambda s: [calm[a] for a in s])[0]


# Every viewer of a scene is told the ego's speed, so they share one set of rollouts.
@lru_cache(maxsize=64)
def _all_rollouts(
    actions: tuple[str, ...], speed_mps: float, target_mps: float, left: int, parameters: Parameters
) -> tuple[list[tuple[str, ...]], Floats]:
    """Every sequence that is played through, and its rollout. Shared: not to be written to."""
    sequences = list(product(actions, repeat=min(HORIZON, left)))
    travelled = rollouts(sequences, speed_mps, target_mps, left, parameters)
    travelled.flags.writeable = False
    return sequences, travelled


def rollouts(
    sequences: list[tuple[str, ...]], speed_mps: float, target_mps: float, left: int, parameters: Parameters
) -> Floats:
    """Distance travelled (m) by each sequence, shape (sequences, LOOK_AHEAD_S / STEP_S).

    Follows highway-env's `MDPVehicle`: FASTER and SLOWER move one level from the level nearest to the
    present speed, IDLE keeps the target. `left` is how many decisions there still are.
    """
    levels = np.array(parameters.target_speeds_mps)
    steps, every = round(LOOK_AHEAD_S / STEP_S), round(parameters.decision_period_s / STEP_S)
    moves = np.array([[SHIFT[a] for a in s] for s in sequences])
    speed, target = np.full(len(sequences), speed_mps), np.full(len(sequences), target_mps)
    travelled = np.empty((len(sequences), steps))
    gone = np.zeros(len(sequences))
    spacing = levels[-1] / (len(levels) - 1)
    for k in range(steps):
        n = k // every
        if k % every == 0 and n < left:
            move = moves[:, n] if n < moves.shape[1] else np.ones(len(sequences), dtype=int)
            level = np.clip(np.round(speed / spacing).astype(int) + move, 0, len(levels) - 1)
            target = np.where(move == 0, target, levels[level])
        change = np.clip(
            (target - speed) / RESPONSE_S, -parameters.braking_mps2, parameters.acceleration_mps2
        )
        gone = gone + speed * STEP_S
        speed = np.maximum(speed + change * STEP_S, 0.0)
        travelled[:, k] = gone
    return travelled


def least_gap(road: Road, travelled: Floats, conflict: Mapping[str, Any]) -> Floats:
    """Smallest gap (m) to another vehicle that keeps path and speed, per sequence; below zero they meet."""
    key = (conflict["sector"], conflict["route"])
    crossing = road.crossings[key]
    time_s = (np.arange(travelled.shape[1]) + 1) * STEP_S
    ego_arc = crossing.ego_arc_m - conflict["ego"]["arc_m"] + travelled
    other_arc = crossing.other_arc_m - conflict["other"]["arc_m"] + conflict["other"]["speed_mps"] * time_s
    mine, its = _discs(road.ego_path, ego_arc), _discs(road.paths[key], other_arc)
    squared = np.full(ego_arc.shape, np.inf)
    # The nearest pair is kept as it goes: arrays of all pairs would not fit into the processor's cache.
    for x, y in mine:
        for its_x, its_y in its:
            np.minimum(squared, (x - its_x) ** 2 + (y - its_y) ** 2, out=squared)
    return np.asarray(np.sqrt(squared.min(axis=1)) - 2 * DISC_RADIUS_M - MARGIN_M)


def _discs(path: Path, arc_m: Floats) -> list[tuple[Floats, Floats]]:
    """x and y of the discs of a car at arc lengths along a path."""
    heading = path.headings_rad[np.searchsorted(path.arc_m, arc_m).clip(0, len(path.arc_m) - 1)]
    x, y = (np.interp(arc_m, path.arc_m, along) for along in path.points.T)
    cos, sin = np.cos(heading), np.sin(heading)
    return [(x + cos * disc, y + sin * disc) for disc in DISCS_M]
