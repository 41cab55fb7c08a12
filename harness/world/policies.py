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
from harness.world import joint, reference
from harness.world.drivers import PRIVILEGED
from harness.world.outcome import ROUNDING_S
from harness.world.precedence import RULES
from harness.world.regret import Regret, regret
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
    """How the agents of a layout ended under a policy."""

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
        """When agents reached their goals, in sum; NaN unless all did."""
        return self.sum_s if self.success else np.nan


UNSOLVED = Fate(0.0, False, False, np.inf, np.nan, np.nan)


def fate(world: World, alone_s: dict[int, float], exact: bool, cost: Regret) -> Fate:
    """Return how the agents of a world that has ended fared;
    `alone_s` has when each would arrive alone.
    """
    its, worst = ends(world, alone_s), gravest(world.journeys)
    lost_s = np.array([np.nan if end.lost_s is None else end.lost_s for end in its])
    times_s = np.where(np.isnan(lost_s), joint.NEVER_S, [end.time_s or 0.0 for end in its])
    return Fate(
        float(np.mean(~np.isnan(lost_s))),
        any(end.met for end in its),
        worst is not None and world.journeys[worst].outcome.result == "time_out",
        float(times_s.sum()),
        float(lost_s.sum()),
        float(lost_s.max()),
        exact,
        cost,
    )


def drive_all(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, Fate]]:
    """Drive layouts under every policy."""
    drivers = POLICIES[:-1]
    worlds = [World.start(scenario, seed) for seed in seeds for _ in drivers]
    actions = reference.turns(worlds, drivers * len(seeds))
    able, alone_s = joint.options(scenario, seeds), alone(scenario, seeds)
    plans, unended = joint.plans(scenario, able)
    where = [(seed, driver) for seed in seeds for driver in drivers] + [
        (seed, JOINT) for seed in plans
    ]
    worlds += [world for _, world in plans.values()]
    taken = [*actions, *(plan.actions for plan, _ in plans.values())]
    courses = joint.courses(
        scenario, able, [(seed, of) for (seed, _), of in zip(where, taken, strict=True)]
    )
    fates = {seed: {JOINT: replace(UNSOLVED, exact=seed not in unended)} for seed in seeds}
    for (seed, policy), world, its in zip(where, worlds, courses, strict=True):
        exact = policy != JOINT or plans[seed][0].exact
        fates[seed][policy] = fate(world, alone_s[seed], exact, regret(able[seed], its))
    return [
        {policy: of[policy] for policy in POLICIES} | {JOINT: best_of(of)} for of in fates.values()
    ]


def best_of(fates: Mapping[str, Fate]) -> Fate:
    """Return the fate under the joint plan, or under the driver that does better than it.

    Whoever has more agents arrive does, and then who has the smaller sum of times. A plan leaves
    out what a driver may do: turns that differ after `joint.HORIZON` decisions, and gaps below
    `joint.MARGIN_M`.
    """
    plan = fates[JOINT]
    best = min(fates.values(), key=lambda of: of.sum_s)
    return replace(best, exact=False) if best.sum_s < plan.sum_s - ROUNDING_S else plan


def check(
    scenario: Scenario, episodes: int, seed: int, workers: Workers, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Drive every policy through the same layouts;
    return the `summary` of each, and what `joint` left open.

    `unsolved` are the seeds without a joint plan in which all arrive. `inexact` are those in which
    the plan is the best found and may not be the best: it was not searched to the end, or a driver
    did better. Raises UserError where agents decide at times of their own.
    """
    if len(offsets(scenario)) > 1:
        raise UserError(
            f"{printable(scenario.name)}: clock is apart, and a joint plan has one clock for all; "
            "leave it out, or use `harness drive`"
        )
    seeds = range(seed, seed + episodes)
    fates = reference.in_chunks(partial(drive_all, scenario), seeds, TOGETHER, workers, progress)
    best = [of[JOINT] for of in fates]
    return {
        "policies": {
            policy: summary([of[policy] for of in fates], best, policy) for policy in POLICIES
        },
        "unsolved": [each for each, of in zip(seeds, best, strict=True) if not of.success],
        "inexact": [each for each, of in zip(seeds, best, strict=True) if not of.exact],
    }


def summary(fates: Sequence[Fate], best: Sequence[Fate], policy: str) -> dict[str, Estimate]:
    """Return figures of a policy over layouts, and beside the `best` plan on the same layouts.

    `anarchy` is the summed time of trips divided by that of the plan, where all arrive under both:
    the price of anarchy (Koutsoupias and Papadimitriou 1999), of the mean and not of the worst
    case. Its interval is that of a bootstrap over layouts. `less_than_joint` is the difference of
    success. The figures of `Regret` are means over layouts.
    """

    def each(of: Sequence[object], name: str) -> Any:
        return np.array([float(getattr(one, name)) for one in of])

    costs = [each_of.cost for each_of in fates]
    trips_s, least_s = each(fates, "trips_s"), each(best, "trips_s")
    both = ~np.isnan(trips_s) & ~np.isnan(least_s)
    n = int(both.sum())
    counts = (
        resampled(noise.generator("price of anarchy", policy), n, RESAMPLES)
        if n
        else np.ones((1, 0))
    )
    anarchy = (counts @ trips_s[both]) / (counts @ least_s[both]) if n else np.array([np.nan])
    return {
        **{
            name: rate_interval(each(fates, name))
            for name in ("success", "arrived", "met", "stuck")
        },
        **{name: episode_interval(each(fates, name)) for name in ("lost_s", "most_lost_s")},
        **{name: rate_interval(each(costs, name)) for name in ("best_decisions", "gave_away")},
        "regret_s": episode_interval(each(costs, "regret_s")),
        "anarchy": resampled_estimate(anarchy, n),
        "less_than_joint": paired_difference([each(fates, "success") - each(best, "success")]),
    }
