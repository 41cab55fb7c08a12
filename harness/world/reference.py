"""Drive the reference drivers in closed loop, from start to outcome."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from harness.core.parallel import Workers, spread
from harness.core.statistics import Estimate, mean_of, rate_interval
from harness.world import lockstep
from harness.world.drivers import DRIVERS, LOOKING, PRIVILEGED, choices
from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graphs, truth_graphs
from harness.world.scenario import Scenario
from harness.world.seats import places_by
from harness.world.world import World

T = TypeVar("T")
TOGETHER = 16  # episodes that are simulated together
BY_DANGER = ("balanced", "dangerous", "harmless")  # success by danger, in a `summary`


def decide(worlds: Sequence[World], drivers: Sequence[str]) -> list[dict[int, str]]:
    """Return the meta-action of each world's driver for each of its agents under way,
    by their places.

    The worlds are of one scenario.
    """
    deciding = [
        (n, agent)
        for n, world in enumerate(worlds)
        for agent, journey in world.journeys.items()
        if not journey.outcome.ended
    ]
    actions: list[dict[int, str]] = [{} for _ in worlds]
    for scenario, at_seat in places_by(worlds[n].seat(agent) for n, agent in deciding).items():
        places = [deciding[at] for at in at_seat]
        states = {
            (n, agent): worlds[n].state(agent) for n, agent in places if drivers[n] in LOOKING
        }
        truthful = [at for at in states if drivers[at[0]] == PRIVILEGED]
        others = [at for at in states if drivers[at[0]] != PRIVILEGED]
        seen = scene_graphs(scenario, [(states[at], states[at].ego.id) for at in others])
        graphs = dict(zip(others, seen, strict=True))
        graphs |= zip(
            truthful, truth_graphs(scenario, [states[at] for at in truthful]), strict=True
        )
        asked = [
            (drivers[n], graphs.get((n, agent)), graphs.get((n, agent))) for n, agent in places
        ]
        for (n, agent), action in zip(places, choices(scenario, asked), strict=True):
            actions[n][agent] = action
    return actions


def finish(worlds: Sequence[World], drivers: Sequence[str]) -> list[Outcome]:
    """Let each world's driver take all remaining decisions of each agent;
    return the ego's outcomes.

    The worlds are of one scenario.
    """
    turns(worlds, drivers)
    return [world.outcome for world in worlds]


def turns(worlds: Sequence[World], drivers: Sequence[str]) -> list[dict[int, list[str]]]:
    """Do what `finish` says; return each world's actions of each agent, by its place."""
    taken: list[dict[int, list[str]]] = [
        {agent: [] for agent in world.journeys} for world in worlds
    ]
    while going := [n for n, world in enumerate(worlds) if not world.ended]:
        driven = [worlds[n] for n in going]
        actions = decide(driven, [drivers[n] for n in going])
        for n, chosen in zip(going, actions, strict=True):
            for agent, action in chosen.items():
                taken[n][agent].append(action)
        take_turn(driven, actions)
    return taken


def take_turn(worlds: Sequence[World], actions: Sequence[Mapping[int, str]]) -> None:
    """Let the agents of each world act, by their places, after the lag,
    and simulate to the next decision.
    """
    p = worlds[0].scenario.parameters
    lockstep.advance(worlds, [p.due_frame(world.step) + p.lag_frames for world in worlds])
    for world, chosen in zip(worlds, actions, strict=True):
        for agent, action in chosen.items():
            if not world.journeys[agent].outcome.ended:
                world.take(action, agent)
        world.step += 1
    lockstep.advance(worlds, [p.due_frame(world.step) for world in worlds])


def drive(scenario: Scenario, driver: str, seed: int) -> Outcome:
    """Drive one whole episode; the outcome is not yet compared with the full-view driver's time."""
    [outcome] = finish([World.start(scenario, seed)], [driver])
    return outcome


def drive_all(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, Outcome]]:
    """Drive episodes with every driver;
    one that clears too long after the full-view driver is `late`.
    """
    worlds = [World.start(scenario, seed) for seed in seeds for _ in DRIVERS]
    ended = iter(finish(worlds, DRIVERS * len(seeds)))
    outcomes = [{driver: next(ended) for driver in DRIVERS} for _ in seeds]
    dangers = [world.layout.danger for world in worlds[:: len(DRIVERS)]]
    return [
        {
            driver: out.judged(of[PRIVILEGED], danger, scenario.parameters)
            for driver, out in of.items()
        }
        for of, danger in zip(outcomes, dangers, strict=True)
    ]


def drive_apart(
    scenario: Scenario, seeds: Sequence[int], workers: Workers, progress: Callable[[int], None]
) -> list[dict[str, Outcome]]:
    """Run `drive_all` on workers; `progress` is called with the number of episodes just done."""
    return in_chunks(partial(drive_all, scenario), seeds, TOGETHER, workers, progress)


def in_chunks(
    drives: Callable[[Sequence[int]], list[T]],
    seeds: Sequence[int],
    together: int,
    workers: Workers,
    progress: Callable[[int], None],
) -> list[T]:
    """Return what comes of some layouts, so many of which are driven together, on workers."""
    chunks = [seeds[at : at + together] for at in range(0, len(seeds), together)]
    # all but the last have one size, so the order of completion is no matter
    sizes = iter(map(len, chunks))
    parts = spread(
        drives,
        chunks,
        workers,
        lambda done: progress(next(sizes)),
        lambda chunk: f"layout seeds {chunk[0]} to {chunk[-1]}",
    )
    return [of_layout for part in parts for of_layout in part]


def check(
    scenario: Scenario, episodes: int, seed: int, workers: Workers, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Drive every reference driver through the same episodes; return the `summary` of each."""
    seeds = range(seed, seed + episodes)
    outcomes = drive_apart(scenario, seeds, workers, progress)
    dangerous = [scenario.layout(each, scenario.parameters).danger is not None for each in seeds]
    return {driver: summary([o[driver] for o in outcomes], dangerous) for driver in DRIVERS}


def summary(outcomes: list[Outcome], dangerous: Sequence[bool] = ()) -> dict[str, Any]:
    """Return rates of results (Wilson, n is episodes), collisions by fault, and crashes of others.

    Where some episodes are `dangerous` and some are not, also success in either,
    and the mean of both.
    """
    by_danger: dict[str, Estimate] = {}
    if any(dangerous) and not all(dangerous):
        success, has_danger = (
            np.array([float(outcome.success) for outcome in outcomes]),
            np.array(dangerous),
        )
        halves = [rate_interval(success[of_half]) for of_half in (has_danger, ~has_danger)]
        by_danger = dict(zip(BY_DANGER, (mean_of(halves), *halves), strict=True))
    rates = {
        result: rate_interval(np.array([float(outcome.result == result) for outcome in outcomes]))
        for result in ("cleared", "collision", "late", "time_out", "off_road")
    }
    return {
        "success": rates.pop("cleared"),
        **rates,
        **by_danger,
        "ego_at_fault": sum(outcome.fault == "ego" for outcome in outcomes),
        "other_at_fault": sum(outcome.fault == "other" for outcome in outcomes),
        "other_crashes": sum(outcome.other_crashes for outcome in outcomes),
    }
