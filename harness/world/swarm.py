"""What comes of several agents together, and what they are compared with:
each alone on the road.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from harness.world import lockstep
from harness.world.outcome import End
from harness.world.scenario import Layout, Scenario
from harness.world.seats import agents_of, seat_of
from harness.world.simulator import populated
from harness.world.world import Journey, World

GRAVEST = ("collision", "off_road", "time_out")
W = TypeVar("W", bound=World)


def alone(scenario: Scenario, seeds: Sequence[int]) -> dict[int, dict[int, float]]:
    """Return when each agent would reach its goal with the road to itself, in s.

    An agent is a vehicle that decides for itself. The result is keyed by layout seed, one of
    `seeds`, then by the agent's index among the vehicles (0 is the ego). The agent keeps its
    initial target speed; one that does not arrive gets the scenario's time limit.
    """
    worlds: dict[tuple[int, int], World] = {}
    for seed in seeds:
        layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
        for agent in agents:
            scenario_alone, layout_alone = on_seat(scenario, layout, agent)
            worlds[seed, agent] = World(
                scenario_alone, seed, layout_alone, populated(scenario_alone, layout_alone)
            )
    p = scenario.parameters
    for group in by_scenario(list(worlds.values())):
        lockstep.advance(group, [round(p.time_limit_s * p.simulation_hz)] * len(group))
    cleared_s: dict[int, dict[int, float]] = {seed: {} for seed in seeds}
    for (seed, agent), world in worlds.items():
        time_s = world.outcome.time_s if world.outcome.success else p.time_limit_s
        cleared_s[seed][agent] = time_s or 0.0
    return cleared_s


def by_scenario(worlds: Sequence[W]) -> list[list[W]]:
    """Return worlds, simulated episodes, in one list for each scenario.

    Those of one list can be simulated together; lists are in the order of their first world.
    """
    groups: dict[Scenario, list[W]] = {}
    for world in worlds:
        groups.setdefault(world.scenario, []).append(world)
    return list(groups.values())


def on_seat(
    scenario: Scenario, layout: Layout, agent: int, others: Sequence[int] = ()
) -> tuple[Scenario, Layout]:
    """Return a scenario and a layout with one vehicle as the ego, to play it apart from others.

    The vehicle is an agent, which decides; `agent` is its index among the layout's vehicles. The
    returned layout, a start situation as the returned scenario names it, holds only this agent,
    first, and `others`, given by their indices.
    """
    spawns = [layout.spawns[n] for n in (agent, *others)]
    if not agent:
        return scenario, Layout(tuple(spawns), layout.buildings, None, None)
    seat = seat_of(scenario, spawns[0])
    spawns[0] = replace(spawns[0], part="ego")
    renamed = []
    for spawn in spawns:
        approach, route = seat.names[spawn.approach, spawn.route]
        renamed.append(replace(spawn, approach=approach, route=route))
    return seat.scenario, Layout(tuple(renamed), layout.buildings, None, None)


def ends(world: World, alone_s: Mapping[int, float]) -> tuple[End, ...]:
    """Return how each agent of a finished episode ended, in the order of `world.journeys`.

    An agent is a vehicle that decides. `alone_s` has the time (s) at which each would arrive on an
    empty road, by its index among the vehicles, as `alone` returns it for the episode's seed.
    """
    ids = {agent: world.vehicles[agent].spawn.id for agent in world.journeys}
    agent_ends = []
    for agent, journey in world.journeys.items():
        o = journey.outcome
        lost_s = round((o.time_s or 0.0) - alone_s[agent], 3) if o.success else None
        met = o.partner in ids.values()
        agent_ends.append(End(ids[agent], o.result, o.time_s, lost_s, o.partner, met))
    return tuple(agent_ends)


def gravest(journeys: Mapping[int, Journey]) -> int | None:
    """Return the index of the agent with the worst failure, or None if no agent has failed.

    `journeys` has the record of each agent, a vehicle that decides, by its index among the
    vehicles. Collision is worse than leaving the road, which is worse than a time-out; of equals
    the earliest counts, then the lowest index.
    """
    failures: list[tuple[int, float, int]] = []
    for agent, journey in journeys.items():
        o = journey.outcome
        if o.ended and not o.success:
            failures.append((GRAVEST.index(o.result), o.time_s or 0.0, agent))
    return min(failures)[2] if failures else None
