"""Reference drivers in closed loop, from start to outcome."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from harness.core.parallel import spread
from harness.core.statistics import Estimate, rate_interval
from harness.world.drivers import DRIVERS, PRIVILEGED, choose
from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graph, truth_graph
from harness.world.scenario import Scenario
from harness.world.world import World


def decide(driver: str, world: World) -> str:
    """A driver's meta-action now."""
    scenario, state = world.scenario, world.state()
    seen = scene_graph(scenario, state, state.ego.id) if driver == "local-view" else {}
    return choose(scenario, driver, seen, truth_graph(scenario, state) if driver == PRIVILEGED else None)


def finish(world: World, driver: str) -> Outcome:
    """Let a driver take every decision that is left."""
    while not world.outcome.ended:
        world.act(decide(driver, world))
    return world.outcome


def drive(scenario: Scenario, driver: str, seed: int) -> Outcome:
    """One whole episode, not yet compared with the full-view driver's time."""
    return finish(World.start(scenario, seed), driver)


def drive_all(scenario: Scenario, seed: int) -> dict[str, Outcome]:
    """One episode by every driver; who clears it too long after the full-view driver is `late`."""
    outcomes = {driver: drive(scenario, driver, seed) for driver in DRIVERS}
    reference = outcomes[PRIVILEGED]
    return {driver: outcome.judged(reference, scenario.parameters) for driver, outcome in outcomes.items()}


def check(
    scenario: Scenario, episodes: int, seed: int, workers: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Drive every reference driver through the same episodes.

    Returns:
        Per driver: success, collisions, late, time-outs and road departures as `Estimate`s (Wilson, n is
        episodes), collisions by fault, and how many crashes there were between other vehicles.
    """
    outcomes = spread(partial(drive_all, scenario), range(seed, seed + episodes), workers, progress)
    return {driver: summary([o[driver] for o in outcomes]) for driver in DRIVERS}


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Rates of each way to end, and who was to blame."""
    share = partial(_share, outcomes)
    return {
        "success": share("cleared"),
        "collision": share("collision"),
        "late": share("late"),
        "time_out": share("time_out"),
        "off_road": share("off_road"),
        "ego_at_fault": sum(o.fault == "ego" for o in outcomes),
        "other_at_fault": sum(o.fault == "other" for o in outcomes),
        "other_crashes": sum(o.other_crashes for o in outcomes),
    }


def _share(outcomes: list[Outcome], result: str) -> Estimate:
    return rate_interval(np.array([float(o.result == result) for o in outcomes]))
