"""What several agents are compared with: each of them alone on the road."""

from dataclasses import replace

from harness.world import lockstep
from harness.world.scenario import Layout, Scenario
from harness.world.seats import agents_of, seats_of
from harness.world.simulator import populated
from harness.world.world import World


def alone(scenario: Scenario, seed: int) -> dict[int, float]:
    """Return when each agent of a layout would reach its goal alone on the road, in s, by its place.

    It keeps the speed that it aims at in the beginning.
    """
    layout, agents = agents_of(scenario, scenario.layout(seed, scenario.parameters), seed)
    cleared_s = {}
    for agent in agents:
        spawn, its = layout.spawns[agent], scenario
        if agent:
            seat = seats_of(scenario)[spawn.approach, spawn.route]
            approach, route = seat.names[spawn.approach, spawn.route]
            spawn, its = replace(spawn, part="ego", approach=approach, route=route), seat.scenario
        layout_alone = Layout((spawn,), layout.buildings, None, None)
        world = World(its, seed, layout_alone, populated(its, layout_alone))
        p = its.parameters
        lockstep.advance([world], [round(p.time_limit_s * p.simulation_hz)])
        cleared_s[agent] = world.outcome.time_s if world.outcome.success else p.time_limit_s
    return {agent: time_s or 0.0 for agent, time_s in cleared_s.items()}
