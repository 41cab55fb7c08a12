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
    """Return the probability that a vehicle of a scenario which could decide for itself does so.

    It is for each vehicle but the ego, which always decides; 0 in scenarios where only the ego has
    a goal.
    """
    return getattr(scenario.parameters, "agent_share", 0.0)


def refuse_agents(scenario: Scenario, what: str) -> None:
    """Raise UserError if vehicles other than the ego decide in a scenario.

    `what` names, for the message, the operation that allows one deciding ego only.
    """
    if share := agent_share(scenario):
        raise UserError(
            f"{printable(scenario.name)}: agent_share is {share:g}, and {what} has one ego that "
            "decides; leave it out, or use `harness drive`"
        )


@lru_cache(maxsize=64)
def seats_of(scenario: Scenario) -> Mapping[PathKey, Seat]:
    """Return how each vehicle but the ego plays a scenario if it decides, by its first path.

    Such a vehicle is an agent, and how it plays, a seat, is the scenario with that agent as its
    ego; it has the parameters of `scenario`. The key is that of the path on which the agent starts,
    (approach, route). Empty if only the ego has a goal.
    """
    seats = scenario.seats() if scenario.seats else {}
    p = scenario.parameters
    return {
        key: replace(at, scenario=replace(at.scenario, parameters=p)) for key, at in seats.items()
    }


def agents_of(scenario: Scenario, layout: Layout, seed: int) -> tuple[Layout, tuple[int, ...]]:
    """Return a layout, and the indices among its vehicles of the agents, which decide.

    `layout` is the start situation of an episode of `scenario`, drawn by `seed`. The ego, an agent,
    comes first. If the parameter `agent_share` is 0 it is the only one and the layout is unchanged.
    Otherwise agents are drawn by the seed, and a vehicle that could be one and was not drawn
    becomes traffic (`other`).
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
    """Return by how many frames agents of a scenario may decide later than its ego, ascending.

    An agent is a vehicle that decides for itself. It is [0] unless the parameter `clock` is
    `apart`: then multiples of a quarter of the decision period, in frames of the simulation.
    """
    p = scenario.parameters
    quarters = range(4) if getattr(p, "clock", "together") == "apart" else range(1)
    return [round(quarter * p.decision_period_s * p.simulation_hz / 4) for quarter in quarters]


def offset_of(scenario: Scenario, seed: int, agent: int) -> int:
    """Return by how many frames one agent of a scenario decides later than the common clock.

    It is drawn by the layout `seed` and `agent`, the agent's index among the vehicles; 0 for all
    unless the parameter `clock` of `scenario` is `apart`.
    """
    times = offsets(scenario)
    if len(times) == 1:
        return 0
    return times[
        int(noise.uniforms((1 + agent,), scenario.name, seed, "clocks")[agent] * len(times))
    ]


def seat_of(scenario: Scenario, vehicle: VehicleState | Spawn) -> Seat:
    """Return the scenario as an agent other than the ego plays it: with that agent as its ego.

    An agent is a vehicle that decides for itself; `vehicle` is it, at any time. `scenario` is the
    shared one. Raises KeyError if nobody decides on its path.
    """
    return seats_of(scenario)[vehicle.approach, vehicle.route]


def places_by(scenarios: Iterable[Scenario]) -> dict[Scenario, list[int]]:
    """Return where each scenario stands in a sequence: its indices from 0, by scenario.

    So items that go with it can be handled scenario by scenario. Keys are in the order in which
    they first come in `scenarios`.
    """
    places: dict[Scenario, list[int]] = {}
    for n, scenario in enumerate(scenarios):
        places.setdefault(scenario, []).append(n)
    return places


def seated(scenario: Scenario, state: WorldState, agent: int) -> WorldState:
    """Return a state as one agent sees it: this agent is the ego, and the ego a helper.

    `agent` is its index among the vehicles, not 0. Vehicles are reordered, the agent first, and
    paths renamed as the scenario in which it is the ego names them.
    """
    names = seat_of(scenario, state.vehicles[agent]).names

    def renamed(v: VehicleState, part: str) -> VehicleState:
        approach, route = names[v.approach, v.route]
        return changed(v, part=part, approach=approach, route=route)

    others = [v for n, v in enumerate(state.vehicles) if n != agent]
    vehicles = [renamed(v, "helper" if v.part == "ego" else v.part) for v in others]
    return changed(state, vehicles=(renamed(state.vehicles[agent], "ego"), *vehicles))
