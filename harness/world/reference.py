"""Drive the reference drivers in closed loop, from start to outcome."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from harness.core.arrays import Ints
from harness.core.parallel import Workers, spread
from harness.core.statistics import Estimate, cluster_numbers, mean_of, rate_interval
from harness.world import lockstep
from harness.world.drivers import BLIND, PRIVILEGED, choices, drivers_of
from harness.world.outcome import Outcome
from harness.world.perception.graph import scene_graphs, truth_graphs
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.seats import places_by
from harness.world.state import WorldState
from harness.world.world import World

T = TypeVar("T")
Place = tuple[int, int]  # number of a world, and an agent's place in it
TOGETHER = 16  # episodes that are simulated together
BY_DANGER = ("balanced", "dangerous", "harmless")  # success by danger, in a `summary`


def decide(worlds: Sequence[World], drivers: Sequence[str]) -> list[dict[int, str]]:
    """Return the meta-actions that drivers now take: for each world, those of its agents.

    Each of `worlds` is one simulated episode; all are of one scenario. `drivers` has the name of
    each world's reference driver, a rule such as `brake`, which decides for all of its agents, the
    vehicles that decide. Actions are keyed by an agent's index among the vehicles (0 is the ego);
    an agent whose drive has ended is left out.
    """
    deciding: list[Place] = []
    for n, world in enumerate(worlds):
        under_way = [a for a, journey in world.journeys.items() if not journey.outcome.ended]
        deciding += [(n, agent) for agent in under_way]
    scenarios = [worlds[n].seat(agent) for n, agent in deciding]
    actions: list[dict[int, str]] = [{} for _ in worlds]
    for scenario, numbers in places_by(scenarios).items():
        places = [deciding[number] for number in numbers]
        graphs = _graphs(scenario, worlds, drivers, places)
        cases = []
        for n, agent in places:
            graph = graphs.get((n, agent))
            cases.append((drivers[n], graph, graph))
        for (n, agent), action in zip(places, choices(scenario, cases), strict=True):
            actions[n][agent] = action
    return actions


def _graphs(
    scenario: Scenario, worlds: Sequence[World], drivers: Sequence[str], places: Sequence[Place]
) -> dict[Place, SceneGraph]:
    """Return the graphs of the agents whose drivers look, all of whom have one scenario."""
    sensing, truthful = dict[Place, WorldState](), dict[Place, WorldState]()
    for n, agent in places:
        if drivers[n] not in (*BLIND, *scenario.actions):
            if drivers[n] == PRIVILEGED:
                truthful[n, agent] = worlds[n].truth(agent)
            else:
                sensing[n, agent] = worlds[n].state(agent)
    looks = [(state, state.ego.id) for state in sensing.values()]
    graphs = dict(zip(sensing, scene_graphs(scenario, looks), strict=True))
    truth = truth_graphs(scenario, list(truthful.values()))
    return graphs | dict(zip(truthful, truth, strict=True))


def finish(worlds: Sequence[World], drivers: Sequence[str]) -> list[Outcome]:
    """Let each world's driver take all remaining decisions; return each ego's outcome.

    Each of `worlds` is one simulated episode; all are of one scenario, and are driven in place.
    `drivers` has the name of each world's reference driver, a rule such as `brake`, which decides
    for all of its agents, the vehicles that decide.
    """
    turns(worlds, drivers)
    return [world.outcome for world in worlds]


def turns(worlds: Sequence[World], drivers: Sequence[str]) -> list[dict[int, list[str]]]:
    """Drive simulated episodes to their ends with rules as drivers; return the actions taken.

    `worlds` are the episodes, all of one scenario. For each, the result has the meta-actions, in
    order, of each agent, a vehicle that decides, by the agent's index among the vehicles (0 is the
    ego). `drivers` has the name of each world's reference driver, a rule such as `brake`.
    """
    scripts: list[dict[int, list[str]]] = []
    for world in worlds:
        scripts.append({agent: [] for agent in world.journeys})
    while undecided := [n for n, world in enumerate(worlds) if not world.ended]:
        driven = [worlds[n] for n in undecided]
        actions = decide(driven, [drivers[n] for n in undecided])
        for n, by_agent in zip(undecided, actions, strict=True):
            for agent, action in by_agent.items():
                scripts[n][agent].append(action)
        take_turn(driven, actions)
    return scripts


def take_turn(worlds: Sequence[World], actions: Sequence[Mapping[int, str]]) -> None:
    """Apply each agent's action after the decision lag, and simulate to the next decision.

    The lag is the time from seeing to acting. `actions` has, for each world, a simulated episode,
    the meta-action of each agent by its index among the vehicles. The worlds are of one scenario,
    and are changed in place.
    """
    p = worlds[0].scenario.parameters
    lockstep.advance(worlds, [p.due_frame(world.step) + p.lag_frames for world in worlds])
    for world, by_agent in zip(worlds, actions, strict=True):
        for agent, action in by_agent.items():
            if not world.journeys[agent].outcome.ended:
                world.take(action, agent)
        world.step += 1
    lockstep.advance(worlds, [p.due_frame(world.step) for world in worlds])


def drive(scenario: Scenario, driver: str, seed: int) -> Outcome:
    """Drive the episode of a layout seed with a reference driver, and return the ego's outcome.

    The seed draws the episode's start in `scenario`. `driver` is a name of `drivers_of`, such
    as `full-view`, which sees everything. Success is not yet judged for being `late`
    (`Outcome.judged`).
    """
    [outcome] = finish([World.start(scenario, seed)], [driver])
    return outcome


def drive_all(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, Outcome]]:
    """Drive each seed's episode with every driver of its trees; return outcomes by driver.

    There is one dict for each of `seeds`, layout seeds that draw the episodes' starts in
    `scenario`; a driver is a rule such as `brake`. An outcome is `late` if that driver reached the
    goal too long after `full-view`, which sees everything.
    """
    drivers = drivers_of(scenario)
    worlds = [World.start(scenario, seed) for seed in seeds for _ in drivers]
    outcomes = finish(worlds, drivers * len(seeds))
    layouts: list[dict[str, Outcome]] = []
    for begin in range(0, len(worlds), len(drivers)):
        danger = worlds[begin].layout.danger
        unjudged = dict(zip(drivers, outcomes[begin : begin + len(drivers)], strict=True))
        full_view, judged = unjudged[PRIVILEGED], {}
        for driver, outcome in unjudged.items():
            judged[driver] = outcome.judged(full_view, danger, scenario.parameters)
        layouts.append(judged)
    return layouts


def drive_apart(
    scenario: Scenario, seeds: Sequence[int], workers: Workers, progress: Callable[[int], None]
) -> list[dict[str, Outcome]]:
    """Drive the episodes of layout seeds on workers; return, for each, outcomes by driver.

    They are those of `drive_all`: of every reference driver of `scenario`, judged for being late.
    `workers` are processes or a cluster; `progress` is called with the number of episodes just
    done.
    """
    return in_chunks(partial(drive_all, scenario), seeds, TOGETHER, workers, progress)


def in_chunks(
    drives: Callable[[Sequence[int]], list[T]],
    seeds: Sequence[int],
    together: int,
    workers: Workers,
    progress: Callable[[int], None],
) -> list[T]:
    """Compute something for many layout seeds on workers, in chunks; return results in order.

    A layout seed draws the start of an episode. `drives` takes some seeds and returns one result
    for each; it gets `together` of them at a time. `progress` is called with the number of seeds of
    each finished chunk.
    """
    chunks = [seeds[at : at + together] for at in range(0, len(seeds), together)]
    # all but the last have one size, so the order of completion is no matter
    sizes = iter([len(chunk) for chunk in chunks])
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
    """Drive every reference driver through the same episodes; return how well each did.

    The result has, by driver's name, a `summary`: how often episodes ended in each way. The layout
    seeds of the episodes in `scenario` are `episodes` ones from `seed` on. `workers` are processes
    or a cluster; `progress` is called with the number of episodes just done.
    """
    seeds = range(seed, seed + episodes)
    layouts = drive_apart(scenario, seeds, workers, progress)
    dangerous = [scenario.layout(each, scenario.parameters).danger is not None for each in seeds]
    clusters = cluster_numbers([scenario.cluster_of(each) for each in seeds])
    summaries = {}
    for driver in drivers_of(scenario):
        outcomes = [by_driver[driver] for by_driver in layouts]
        summaries[driver] = summary(outcomes, dangerous, clusters)
    return summaries


def summary(
    outcomes: list[Outcome], dangerous: Sequence[bool] = (), clusters: Ints | None = None
) -> dict[str, Any]:
    """Return how often episodes ended in each way, and counts of collisions and crashes.

    `outcomes` has one of each episode. The keys `success`, `collision`, `late`, `time_out` and
    `off_road` have rates with Wilson intervals; `ego_at_fault`, `other_at_fault` and
    `other_crashes` (of vehicles without the ego) have counts. `dangerous` says which episodes hold
    a danger, a vehicle that would meet a cruising ego; if some do and some do not, success is also
    given as `dangerous`, `harmless` and their mean `balanced`. Intervals are over the episodes'
    `clusters`, (E,), such as recordings that layouts are cut from, if they have some.
    """
    rates: dict[str, Estimate] = {}
    for result in ("cleared", "collision", "late", "time_out", "off_road"):
        ended_so = np.array([float(outcome.result == result) for outcome in outcomes])
        rates["success" if result == "cleared" else result] = rate_interval(ended_so, clusters)
    by_danger: dict[str, Estimate] = {}
    if any(dangerous) and not all(dangerous):
        success = np.array([float(outcome.success) for outcome in outcomes])
        has_danger = np.array(dangerous)
        halves = []
        for half in (has_danger, ~has_danger):
            of_half = None if clusters is None else clusters[half]
            halves.append(rate_interval(success[half], of_half))
        mean = mean_of(halves, together=clusters is not None)
        by_danger = dict(zip(BY_DANGER, (mean, *halves), strict=True))
    return {
        **rates,
        **by_danger,
        "ego_at_fault": sum(outcome.fault == "ego" for outcome in outcomes),
        "other_at_fault": sum(outcome.fault == "other" for outcome in outcomes),
        "other_crashes": sum(outcome.other_crashes for outcome in outcomes),
    }
