"""Plans with which all agents of a layout reach their goals, which tests of several agents share."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.world.planner import RESPONSE_S, SPEED, STEP_S
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import SIZES_M, separation_m
from harness.world.world import World

FAR_M = 15.0  # farther apart, two vehicles do not touch
APART_M = 1.0
EVERYBODY: dict[str, Any] = {"agent_share": 1.0}
MOST = 3  # decisions that a plan goes on, or slows down


def plans_for_all(scenario: Scenario, layout: Layout) -> list[tuple[str, ...]] | None:
    """Return a plan of each agent with which nobody meets anybody, the ego's first; None if there is none.

    A plan is to go on, slow down, wait and then hurry, each for some decisions. Who is no agent keeps its
    speed, and its distance from who is ahead on its arm.
    """
    p, paths, seats = scenario.parameters, scenario.road().paths, scenario.seats()
    agents = [spawn for spawn in layout.spawns if spawn.part != "other"]
    traffic = [spawn for spawn in layout.spawns if spawn.part == "other"]
    choices = [
        (*["IDLE"] * before, *["SLOWER"] * slower, *["IDLE"] * wait, *["FASTER"] * p.decisions)[: p.decisions]
        for before, slower, wait in product(range(MOST), range(MOST), range(p.decisions - 2))
    ]
    time_s = STEP_S * np.arange(round(p.time_limit_s / STEP_S))

    def poses(spawn: Spawn, travelled_m: Floats) -> Floats:
        """Return x, y and heading, (n, steps, 3)."""
        return np.stack(paths[spawn.approach, spawn.route].places(spawn.arc_m + travelled_m), axis=-1)

    ways = {s.id: poses(s, _travelled_m(choices, s.speed_mps, scenario)) for s in agents}
    ways |= {s.id: poses(s, np.asarray(s.speed_mps * time_s[None])) for s in traffic}

    def arrives(spawn: Spawn) -> Bools:
        seat = seats[spawn.approach, spawn.route].scenario
        return seat.cleared(ways[spawn.id][:, -1, None, :2], np.array([["own"]] * len(choices)), p)

    def fits(one: Spawn, other: Spawn) -> Bools:
        """Return which plans of two vehicles fit together, (m, n)."""
        its, others = ways[one.id], ways[other.id]
        away_m = np.hypot(its[:, None, :, 0] - others[:, :, 0], its[:, None, :, 1] - others[:, :, 1])
        m, n, step = np.nonzero(away_m < FAR_M)
        sizes = [np.tile(SIZES_M[s.kind], (len(m), 1)) for s in (one, other)]
        near = separation_m(its[m, step], sizes[0], others[n, step], sizes[1]) < APART_M
        fit = np.ones(away_m.shape[:2], dtype=bool)
        fit[m[near], n[near]] = False
        return fit

    alone = [
        np.logical_and.reduce([arrives(a), *(fits(a, t)[:, 0] for t in traffic if t.approach != a.approach)])
        for a in agents
    ]
    pairs = {(i, j): fits(agents[i], agents[j]) for j in range(len(agents)) for i in range(j)}

    def search(taken: tuple[int, ...] = ()) -> tuple[int, ...] | None:
        if (j := len(taken)) == len(agents):
            return taken
        open_ = np.logical_and.reduce([pairs[i, j][k] for i, k in enumerate(taken)], initial=True) & alone[j]
        return next((found for k in np.flatnonzero(open_) if (found := search((*taken, int(k))))), None)

    found = search()
    return None if found is None else [choices[k] for k in found]


def _travelled_m(plans: Sequence[Sequence[str]], speed_mps: float, scenario: Scenario) -> Floats:
    """Return how far an agent comes with each plan until the time limit, (plans, steps), as it is driven."""
    p, levels = scenario.parameters, np.array(scenario.parameters.target_speeds_mps)
    moves = np.array([[SPEED.get(action, 0) for action in plan] for plan in plans])
    speed, target, travelled = (np.full(len(plans), start) for start in (speed_mps, speed_mps, 0.0))
    every, steps = round(p.decision_period_s / STEP_S), []
    for k in range(round(p.time_limit_s / STEP_S)):
        steps.append(travelled)
        decision, late = divmod(k - round(p.decision_lag_s / STEP_S), every)
        if late == 0 and 0 <= decision < p.decisions:
            level = np.abs(speed[:, None] - levels).argmin(axis=1) + moves[:, decision]
            target = np.where(moves[:, decision], levels[level.clip(0, len(levels) - 1)], target)
        travelled = travelled + speed * STEP_S
        speed = speed + ((target - speed) / RESPONSE_S).clip(-p.braking_mps2, p.acceleration_mps2) * STEP_S
    return np.stack(steps, axis=1)


def driven(scenario: Scenario, seed: int, plans: Sequence[Sequence[str]]) -> list[str]:
    """Return how an episode ends for each agent, if each takes the actions of its plan."""
    p = replace(scenario.parameters, **EVERYBODY)
    world = World.start(replace(scenario, parameters=p), seed)
    for actions in zip(*plans, strict=True):
        world.advance(p.due_frame(world.step) + p.lag_frames)
        for (agent, journey), action in zip(world.journeys.items(), actions, strict=True):
            if not journey.outcome.ended:
                world.take(action, agent)
        world.step += 1
        world.advance(p.due_frame(world.step))
    return [journey.outcome.result for journey in world.journeys.values()]
