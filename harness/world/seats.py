"""Seats: a scene as it is for one of its agents, in whose own eyes it is the ego.

What an agent sees, is asked, aims at and is judged by is that of an ego, in the scenario of its
seat. So with several agents nothing but the names of vehicles' parts and of paths differs between
them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache

from msgspec.structs import replace as changed

from harness.core import noise
from harness.core.errors import UserError, printable
from harness.world.road import PathKey
from harness.world.scenario import Layout, Scenario, Seat, Spawn
from harness.world.state import VehicleState, WorldState


def agent_share(scenario: Scenario) -> float:
    """Return the share of the vehicles beside the ego that decide;
    0 where only an ego has a goal.
    """
    return getattr(scenario.parameters, "agent_share", 0.0)


def refuse_agents(scenario: Scenario, what: str) -> None:
    """Raise UserError if vehicles beside the ego decide in a scenario,
    and in `what` the ego alone does.
    """
    if share := agent_share(scenario):
        raise UserError(
            f"{printable(scenario.name)}: agent_share is {share:g}, and {what} has one ego that "
            "decides; leave it out, or use `harness drive`"
        )


@lru_cache(maxsize=64)
def seats_of(scenario: Scenario) -> Mapping[PathKey, Seat]:
    """Return the seats of a scenario by the path that an agent is on;
    none if only the ego has a goal.

    Their scenarios have its parameters.
    """
    seats = scenario.seats() if scenario.seats else {}
    p = scenario.parameters
    return {
        key: replace(at, scenario=replace(at.scenario, parameters=p)) for key, at in seats.items()
    }


def agents_of(scenario: Scenario, layout: Layout, seed: int) -> tuple[Layout, tuple[int, ...]]:
    """Return the places of a layout's agents, the ego's first,
    and the layout with those who are none.

    With a share of 0, helpers decide nothing, but answer.
    With a greater one, whoever could be an agent and is none is other traffic.
    """
    share, seats = agent_share(scenario), seats_of(scenario)
    if not share:
        return layout, (0,)
    able = [
        n
        for n, s in enumerate(layout.spawns)
        if s.part == "helper" and (s.approach, s.route) in seats
    ]
    draws = noise.uniforms((len(layout.spawns),), scenario.name, seed, "agents")
    agents = (0, *(n for n in able if draws[n] < share))
    spawns = tuple(
        replace(spawn, part="other") if n in able and n not in agents else spawn
        for n, spawn in enumerate(layout.spawns)
    )
    return replace(layout, spawns=spawns), agents


def offsets(scenario: Scenario) -> list[int]:
    """Return how many frames after a common clock an agent may decide, ascending."""
    p = scenario.parameters
    quarters = range(4) if getattr(p, "clock", "together") == "apart" else range(1)
    return [round(quarter * p.decision_period_s * p.simulation_hz / 4) for quarter in quarters]


def offset_of(scenario: Scenario, seed: int, agent: int) -> int:
    """Return how many frames after a common clock an agent of a layout decides, by its place."""
    times = offsets(scenario)
    if len(times) == 1:
        return 0
    return times[
        int(noise.uniforms((1 + agent,), scenario.name, seed, "clocks")[agent] * len(times))
    ]


def seat_of(scenario: Scenario, vehicle: VehicleState | Spawn) -> Seat:
    """Return the seat of an agent that is not the ego."""
    return seats_of(scenario)[vehicle.approach, vehicle.route]


def places_by(scenarios: Iterable[Scenario]) -> dict[Scenario, list[int]]:
    """Return the places at which each scenario stands, in the order in which they come first."""
    places: dict[Scenario, list[int]] = {}
    for n, scenario in enumerate(scenarios):
        places.setdefault(scenario, []).append(n)
    return places


def seated(scenario: Scenario, state: WorldState, agent: int) -> WorldState:
    """Return a state as it is for an agent, by its place:
    it is the ego, and the ego is a helper.
    """
    names = seat_of(scenario, state.vehicles[agent]).names

    def renamed(v: VehicleState, part: str) -> VehicleState:
        approach, route = names[v.approach, v.route]
        return changed(v, part=part, approach=approach, route=route)

    others = [v for n, v in enumerate(state.vehicles) if n != agent]
    vehicles = [renamed(v, "helper" if v.part == "ego" else v.part) for v in others]
    return changed(state, vehicles=(renamed(state.vehicles[agent], "ego"), *vehicles))
