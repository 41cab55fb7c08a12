"""The reference planner behind `local-view` and `full-view`: looks ahead along the ego's path.

It knows what a scene graph says, and nothing else. It plays every sequence of meta-actions over the next
decisions, then FASTER, against the conflicts of the graph at constant speed, and takes the first action of
the sequence that clears the conflict points soonest without meeting anyone. It does not guess at what it
cannot see, which is what makes occlusion cost something.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.scene import SIZES_M

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What the planner knows of the ego and of time.

    Attributes:
        target_speeds_mps: what the meta-actions step through.
        braking_mps2: hardest braking.
        acceleration_mps2: hardest acceleration.
        response_s: time constant of the speed controller (highway-env's TAU_ACC).
        decision_period_s: seconds between two decisions.
        horizon: decisions that are played through.
        look_ahead_s: how far into the future a conflict is looked for.
        margin_m: added to every outline, for noise and for what the model of motion leaves out.
    """

    target_speeds_mps: tuple[float, ...] = (0.0, 7.0, 14.0)
    braking_mps2: float = 8.0
    acceleration_mps2: float = 3.0
    response_s: float = 0.6
    decision_period_s: float = 1.0
    horizon: int = 4
    look_ahead_s: float = 9.0
    margin_m: float = 1.0


STEP_S = 0.1


def plan(graph: Mapping[str, Any], actions: tuple[str, ...], limits: Limits = Limits()) -> str:
    """The planner's meta-action for a scene graph."""
    sequences = list(product(actions, repeat=limits.horizon))
    travelled = rollouts(sequences, graph["ego"]["speed_mps"], graph["ego"]["target_speed_mps"], limits)
    gap = np.full(len(sequences), np.inf)
    for conflict in graph["conflicts"]:
        gap = np.minimum(gap, least_gap(travelled, conflict, limits))
    # The goal lies well behind the conflict points, so that a late burst of speed counts too.
    to_go = graph["ego"]["zone_m"] + 15.0
    arrival = (travelled < to_go).sum(axis=1) * STEP_S - 1e-3 * travelled[:, -1]
    safe = gap > 0
    score = np.where(safe, -arrival, -1e3 + np.minimum(gap, 0.0))
    best = np.flatnonzero(score >= score.max() - 1e-9)
    # Among equals the calmest: IDLE before FASTER before SLOWER, compared decision by decision.
    calm = {"IDLE": 0, "FASTER": 1, "SLOWER": 2}
    return min((sequences[i] for i in best), key=lambda s: [calm[a] for a in s])[0]


def rollouts(sequences: list[tuple[str, ...]], speed_mps: float, target_mps: float, limits: Limits) -> Array:
    """Distance travelled (m) by each sequence, shape (sequences, look_ahead_s / STEP_S).

    Follows highway-env's `MDPVehicle`: FASTER and SLOWER move one level from the level nearest to the
    present speed, IDLE keeps the target.
    """
    levels = np.array(limits.target_speeds_mps)
    steps, every = round(limits.look_ahead_s / STEP_S), round(limits.decision_period_s / STEP_S)
    shift = {"FASTER": 1, "SLOWER": -1, "IDLE": 0}
    moves = np.array([[shift[a] for a in s] for s in sequences])
    speed, target = np.full(len(sequences), speed_mps), np.full(len(sequences), target_mps)
    travelled = np.empty((len(sequences), steps))
    gone = np.zeros(len(sequences))
    spacing = levels[-1] / (len(levels) - 1)
    for k in range(steps):
        if k % every == 0:
            n = k // every
            move = moves[:, n] if n < moves.shape[1] else np.ones(len(sequences), dtype=int)
            level = np.clip(np.round(speed / spacing).astype(int) + move, 0, len(levels) - 1)
            target = np.where(move == 0, target, levels[level])
        change = np.clip((target - speed) / limits.response_s, -limits.braking_mps2, limits.acceleration_mps2)
        gone = gone + speed * STEP_S
        speed = np.maximum(speed + change * STEP_S, 0.0)
        travelled[:, k] = gone
    return travelled


def least_gap(travelled: Array, conflict: Mapping[str, Any], limits: Limits) -> Array:
    """Smallest gap (m) to one other vehicle, per sequence; at or below zero they meet.

    Both are boxes that cross at right angles at the conflict point: the gap is the larger of the two
    distances, along the ego's path and along the other's, by which they miss each other.
    """
    length, width = SIZES_M["car"]
    reach = length / 2 + width / 2 + limits.margin_m
    time_s = (np.arange(travelled.shape[1]) + 1) * STEP_S
    mine = np.abs(conflict["ego"]["arc_m"] - travelled) - reach
    its = np.abs(conflict["other"]["arc_m"] - conflict["other"]["speed_mps"] * time_s) - reach
    return np.asarray(np.maximum(mine, its).min(axis=1))
