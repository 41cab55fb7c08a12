"""What comes of several agents together, and what they are compared with: each alone on the road."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from harness.world import lockstep
from harness.world.scenario import Layout, Scenario
from harness.world.seats import agents_of, seat_of
from harness.world.simulator import populated
from harness.world.world import Journey, World

GRAVEST = ("collision", "off_road", "time_out")


def alone(scenario: Scenario, seed: int) -> dict[int, float]:
    """Return when each agent of a layout would reach its goal alone on the road, in s, by its place.

    It keeps the speed that it aims at in the beginning.
    """
    layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
    cleared_s = {}
    for agent in agents:
        its, layout_alone = on_seat(scenario, layout, agent)
        world = World(its, seed, layout_alone, populated(its, layout_alone))
        p = its.parameters
        lockstep.advance([world], [round(p.time_limit_s * p.simulation_hz)])
        cleared_s[agent] = world.outcome.time_s if world.outcome.success else p.time_limit_s
    return {agent: time_s or 0.0 for agent, time_s in cleared_s.items()}


def on_seat(
    scenario: Scenario, layout: Layout, agent: int, others: Sequence[int] = ()
) -> tuple[Scenario, Layout]:
    """Return an agent's own scenario, and the layout in it with nobody but the agent and some others."""
    spawns, its = [layout.spawns[n] for n in (agent, *others)], scenario
    if agent:
        seat = seat_of(scenario, spawns[0])
        its, spawns[0] = seat.scenario, replace(spawns[0], part="ego")
        names = [seat.names[spawn.approach, spawn.route] for spawn in spawns]
        spawns = [
            replace(spawn, approach=approach, route=route)
            for spawn, (approach, route) in zip(spawns, names, strict=True)
        ]
    return its, Layout(tuple(spawns), layout.buildings, None, None)


def gravest(journeys: Mapping[int, Journey]) -> int | None:
    """Return the place of the agent whose failure is the episode's: the gravest, and of those the first.

    None if nobody has failed.
    """
    failed = [
        (GRAVEST.index(o.result), o.time_s or 0.0, agent)
        for agent, o in ((agent, journey.outcome) for agent, journey in journeys.items())
        if o.ended and not o.success
    ]
    return min(failed)[2] if failed else None
