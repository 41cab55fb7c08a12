"""How all agents of a layout fare under reference drivers,
and under a plan for all of them together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.errors import UserError, printable
from harness.core.parallel import Workers
from harness.core.statistics import (
    Estimate,
    episode_interval,
    paired_difference,
    rate_interval,
    resampled,
    resampled_estimate,
)
from harness.extensions.joint_plans import joint
from harness.extensions.joint_plans.regret import Regret, regret
from harness.world import reference
from harness.world.drivers import PRIVILEGED
from harness.world.outcome import ROUNDING_S
from harness.world.precedence import RULES
from harness.world.scenario import Scenario
from harness.world.seats import offsets
from harness.world.swarm import alone, ends, gravest
from harness.world.world import World

JOINT = "joint"
POLICIES = ("cruise", "local-view", PRIVILEGED, *RULES, JOINT)  # every agent drives by it
TOGETHER = 8  # layouts that are driven together
RESAMPLES = 2000
UNKNOWN = Regret(np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Fate:
    """Describe how the agents of one layout fared under one policy that all of them follow.

    Agents are vehicles that decide for themselves, a layout is a start situation, and a policy is a
    rule driver or a plan for all agents together. `arrived` is the share that reached their goals;
    `met` whether agents collided with each other; `stuck` whether nobody came to harm, but somebody
    never arrived. `sum_s` is the sum of their times, with `joint.NEVER_S` for never; `lost_s` how
    much later than alone on the road, in sum, and `most_lost_s` of the one who lost most, both s,
    NaN unless all arrived. `exact` says of a plan that no better one exists; `cost` is that of the
    agents' decisions.
    """

    arrived: float  # share of agents that reached their goals
    met: bool  # whether agents collided with each other
    stuck: bool  # whether nobody came to harm, but somebody never arrived
    sum_s: float  # when agents reached their goals, in sum; `joint.NEVER_S` for who never did
    lost_s: float  # how much later than alone on the road, in sum; NaN unless all arrived
    most_lost_s: float  # the same of the one who loses most
    # of a joint plan: whether it was searched to the end, and no driver does better
    exact: bool = True
    cost: Regret = UNKNOWN  # of its agents' decisions

    @property
    def success(self) -> bool:
        return self.arrived == 1

    @property
    def trips_s(self) -> float:
        """Return the sum of the times, s, at which agents reached their goals; NaN unless all did.

        An agent is a vehicle that decides for itself.
        """
        return self.sum_s if self.success else np.nan


UNSOLVED = Fate(0.0, False, False, np.inf, np.nan, np.nan)


def fate(world: World, alone_s: dict[int, float], exact: bool, cost: Regret) -> Fate:
    """Return how the agents of a finished world fared.

    An agent is a vehicle that decides for itself. `alone_s` has the time (s) at which each would
    arrive on an empty road, by its index among the world's vehicles. `exact` (whether no better
    plan exists) and `cost`, that of the agents' decisions, are stored as they are.
    """
    agent_ends, worst = ends(world, alone_s), gravest(world.journeys)
    lost_s = np.array([np.nan if end.lost_s is None else end.lost_s for end in agent_ends])
    ended_s = [end.time_s or 0.0 for end in agent_ends]
    times_s = np.where(np.isnan(lost_s), joint.NEVER_S, ended_s)
    return Fate(
        float(np.mean(~np.isnan(lost_s))),
        any(end.met for end in agent_ends),
        worst is not None and world.journeys[worst].outcome.result == "time_out",
        float(times_s.sum()),
        float(lost_s.sum()),
        float(lost_s.max()),
        exact,
        cost,
    )


def drive_all(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, Fate]]:
    """Drive each layout (start situation, drawn by a seed) under every policy of `POLICIES`.

    An agent is a vehicle that decides for itself. A policy is a rule driver that every agent
    follows, or a plan for all of them. Returns how the agents fared, one dict a seed, in their
    order, by policy.
    """
    drivers = POLICIES[:-1]
    policies = [(seed, driver) for seed in seeds for driver in drivers]
    worlds = [World.start(scenario, seed) for seed, _ in policies]
    actions: list[joint.Scripts] = [*reference.turns(worlds, drivers * len(seeds))]
    able, alone_s = joint.options(scenario, seeds), alone(scenario, seeds)
    plans, unended = joint.plans(scenario, able)
    for seed, (plan, world) in plans.items():
        policies.append((seed, JOINT))
        worlds.append(world)
        actions.append(plan.actions)
    driven_seeds = [seed for seed, _ in policies]
    courses = joint.courses(scenario, able, list(zip(driven_seeds, actions, strict=True)))
    fates = {seed: {JOINT: replace(UNSOLVED, exact=seed not in unended)} for seed in seeds}
    for (seed, policy), world, course in zip(policies, worlds, courses, strict=True):
        exact = policy != JOINT or plans[seed][0].exact
        fates[seed][policy] = fate(world, alone_s[seed], exact, regret(able[seed], course))
    layouts = []
    for by_policy in fates.values():
        layout = {policy: by_policy[policy] for policy in POLICIES}
        layout[JOINT] = best_of(by_policy)
        layouts.append(layout)
    return layouts


def best_of(fates: Mapping[str, Fate]) -> Fate:
    """Return how agents fared under the plan for all of them, or under a driver that was faster.

    An agent is a vehicle that decides for itself, and a layout a start situation. `fates` says by
    policy (rule drivers, and the joint plan) how the agents of one layout fared. A driver's summed
    arrival time can be smaller than the plan's, because the search for plans leaves out sequences
    of actions that differ after `joint.HORIZON` decisions, and gaps below `joint.MARGIN_M`; then
    `exact` is False.
    """
    plan = fates[JOINT]
    best = min(fates.values(), key=lambda fate: fate.sum_s)
    return replace(best, exact=False) if best.sum_s < plan.sum_s - ROUNDING_S else plan


def check(
    scenario: Scenario, episodes: int, seed: int, workers: Workers, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Drive every policy of all agents through the same layouts, and compare how agents fare.

    Agents are vehicles that decide for themselves; a policy is a rule driver that all follow, or
    the best plan for all together. The layouts, start situations, have the seeds from `seed` on. In
    the dict that is returned, `policies` has by policy its figures by name, such as `success` and
    `lost_s` (seconds lost), as estimates over layouts; `unsolved` lists the seeds without a plan by
    which all arrive, and `inexact` those whose plan may not be optimal, since its search was cut
    off or a driver did better. `progress` is called with the number of layouts just done. Raises
    UserError if agents do not decide at the same times.
    """
    if len(offsets(scenario)) > 1:
        raise UserError(
            f"{printable(scenario.name)}: clock is apart, and a joint plan has one clock for all; "
            "leave it out, or use `harness drive`"
        )
    seeds = range(seed, seed + episodes)
    fates = reference.in_chunks(partial(drive_all, scenario), seeds, TOGETHER, workers, progress)
    best = [by_policy[JOINT] for by_policy in fates]
    summaries = {}
    for policy in POLICIES:
        of_policy = [by_policy[policy] for by_policy in fates]
        summaries[policy] = summary(of_policy, best, policy)
    by_seed = dict(zip(seeds, best, strict=True))
    return {
        "policies": summaries,
        "unsolved": [each for each, plan in by_seed.items() if not plan.success],
        "inexact": [each for each, plan in by_seed.items() if not plan.exact],
    }


def summary(fates: Sequence[Fate], best: Sequence[Fate], policy: str) -> dict[str, Estimate]:
    """Return estimates of a policy's figures over layouts, by name, with 95 % intervals.

    Agents are vehicles that decide for themselves, and a layout is a start situation. `fates` says
    how agents fared under the policy in each layout, and `best` under the joint plan on the same
    ones. `success` is the share of layouts where all arrive; `arrived`, `met`, `stuck`, `lost_s`,
    `most_lost_s` and, of decisions, `best_decisions`, `gave_away` and `regret_s` are means of the
    fields of these names. `less_than_joint` is success less the plan's. `anarchy` is the price of
    anarchy (Koutsoupias and Papadimitriou 1999): the summed arrival times over those of the plan,
    where all arrive under both, with a bootstrap over layouts.
    """

    def column(rows: Sequence[object], name: str) -> Any:
        """Return a field of all rows, (n,)."""
        return np.array([float(getattr(row, name)) for row in rows])

    costs = [fate.cost for fate in fates]
    trips_s, least_s = column(fates, "trips_s"), column(best, "trips_s")
    both = ~np.isnan(trips_s) & ~np.isnan(least_s)
    n = int(both.sum())
    anarchy = np.array([np.nan])
    if n:
        counts = resampled(noise.generator("price of anarchy", policy), n, RESAMPLES)
        anarchy = (counts @ trips_s[both]) / (counts @ least_s[both])
    figures = {}
    for name in ("success", "arrived", "met", "stuck"):
        figures[name] = rate_interval(column(fates, name))
    for name in ("lost_s", "most_lost_s"):
        figures[name] = episode_interval(column(fates, name))
    for name in ("best_decisions", "gave_away"):
        figures[name] = rate_interval(column(costs, name))
    figures["regret_s"] = episode_interval(column(costs, "regret_s"))
    figures["anarchy"] = resampled_estimate(anarchy, n)
    less = column(fates, "success") - column(best, "success")
    figures["less_than_joint"] = paired_difference([less])
    return figures
