"""Plans with which all agents of a layout reach their goals, which tests of several agents share."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.world.planner import STEP_S, levels, travelled_m
from harness.world.scenario import Layout, Scenario, Spawn
from harness.world.state import SIZES_M, separation_m
from harness.world.world import World

FAR_M = 15.0  # farther apart, two vehicles do not touch
APART_M = 1.0
EVERYBODY: dict[str, Any] = {"agent_share": 1.0}


def plans_for_all(scenario: Scenario, layout: Layout) -> list[tuple[str, ...]] | None:
    """Return a plan of each agent with which nobody meets anybody, the ego's first; None if there is none.

    A plan is three actions of any kind, then FASTER. Who is no agent keeps its speed, and its distance from
    who is ahead on its arm.
    """
    p = scenario.parameters
    agents = [spawn for spawn in layout.spawns if spawn.part != "other"]
    traffic = [spawn for spawn in layout.spawns if spawn.part == "other"]
    choices = [(*three, *["FASTER"] * (p.decisions - 3)) for three in product(scenario.actions[:3], repeat=3)]
    speeds = np.array([spawn.speed_mps for spawn in agents])
    plans = travelled_m(levels(choices), speeds, speeds, p.decisions, p)
    steps = STEP_S * np.arange(1, plans.shape[-1] + 1)

    def fits(one: Spawn, its: Floats, other: Spawn, others: Floats) -> Bools:
        """Return which distances travelled by two vehicles, (m, steps) and (n, steps), fit, (m, n)."""
        if one.approach == other.approach:
            return np.ones((len(its), len(others)), dtype=bool)
        poses = [
            np.stack(scenario.road().paths[s.approach, s.route].places(s.arc_m + travelled), axis=-1)
            for s, travelled in ((one, its), (other, others))
        ]
        away_m = np.hypot(*np.moveaxis(poses[0][:, None] - poses[1], -1, 0)[:2])
        m, n, step = np.nonzero(away_m < FAR_M)
        sizes = [np.tile(SIZES_M[s.kind], (len(m), 1)) for s in (one, other)]
        gaps_m = separation_m(poses[0][m, step], sizes[0], poses[1][n, step], sizes[1])
        fit = np.ones((len(its), len(others)), dtype=bool)
        fit[m[gaps_m < APART_M], n[gaps_m < APART_M]] = False
        return fit

    alone = [
        np.logical_and.reduce(
            [fits(a, plan, t, t.speed_mps * steps[None])[:, 0] for t in traffic], initial=True
        )
        for a, plan in zip(agents, plans, strict=True)
    ]
    pairs = {
        (i, j): fits(agents[i], plans[i], agents[j], plans[j]) for j in range(len(agents)) for i in range(j)
    }

    def search(taken: tuple[int, ...] = ()) -> tuple[int, ...] | None:
        if (j := len(taken)) == len(agents):
            return taken
        open_ = np.logical_and.reduce([pairs[i, j][k] for i, k in enumerate(taken)], initial=True) & alone[j]
        return next((found for k in np.flatnonzero(open_) if (found := search((*taken, int(k))))), None)

    found = search()
    return None if found is None else [choices[k] for k in found]


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
