"""Layouts with a declared number of witnesses:
helpers with the danger in sight at the first decision.

Three lookouts have in sight wherever a danger may be; three cars in blind seats and the ego do not.
All six are there whatever the number of witnesses is, and whether or not there is a danger: only
the radio moves. With k witnesses, k lookouts and the first 3 - k blind seats help, in an order that
is drawn; lookouts without a radio stay as traffic, and further blind seats stay empty.

So that this holds without telling anything, a layout is drawn again, as a whole, until the sensors
find it so with a phantom of the danger of each sector in turn, drawn as the danger would be, there
or not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from harness.core import noise
from harness.core.errors import UserError
from harness.world.parameters import Parameters
from harness.world.perception.rays import Look, surfaces
from harness.world.perception.sensors import reported
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import WorldState

LOOKOUTS = ("v2", "v3", "v4")
SEATS = ("first seat", "second seat", "third seat")
MOST_ATTEMPTS = 2000
DANGER = "danger"


@dataclass(frozen=True)
class Draft:
    """Hold one random draw of an episode's start, not yet checked for who sees the danger.

    A danger is the vehicle that would meet an ego which keeps its speed; a sector is a direction
    that it may come from. Lookouts are helpers that see a danger wherever it comes from. Blind
    seats are places for cars from which none can be seen, by which fewer helpers see it.
    """

    layout: Layout  # the start situation, with lookouts as helpers and nobody in the blind seats
    # for each sector, the vehicle that would be its danger; it takes the place of the one in
    # `layout` with the same id
    phantoms: tuple[Spawn, ...]
    seats: tuple[Spawn, ...]  # further cars, in blind seats; empty if the draws name none


def placed(
    scenario: Scenario, draft: Callable[[Draws, Any], Draft], seed: int, parameters: Parameters
) -> Layout:
    """Return the layout of a seed, with the witnesses and radios that the parameters declare.

    A layout is the start situation of an episode, and a witness a helper that has the danger in
    sight at the first decision. `draft` makes one random draw of the situation; it takes the
    `Draws`, which draw its quantities by the seed, and the `parameters`. It is called again until
    the vehicles meant to see the danger do, and no others. Raises UserError if none of
    `MOST_ATTEMPTS` draws fits.
    """
    if parameters.witnesses == "any":
        layout = draft(Draws(scenario.name, seed), parameters).layout
    else:
        layout = _witnessed(scenario, draft, seed, parameters)
    if not parameters.radio_share:
        return layout

    def equipped(spawn: Spawn) -> Spawn:
        vehicle = DANGER if spawn.id == layout.danger_id else spawn.id
        return replace(spawn, radio=has_radio(scenario.name, parameters, seed, vehicle))

    spawns = (equipped(spawn) if spawn.part == "other" else spawn for spawn in layout.spawns)
    return replace(layout, spawns=tuple(spawns))


def witnesses(scenario: str, parameters: Parameters, seed: int) -> int | None:
    """Return how many witnesses, 0 to 3, a layout has; None if the parameters say `any`.

    A layout is the start situation that `seed` draws, and a witness a helper that has the danger in
    sight at the first decision. For `each` the number is the seed modulo 4, so that consecutive
    seeds are balanced; for `drawn` it is a random draw keyed by the seed. `scenario` is the name.
    """
    counts = len(LOOKOUTS) + 1
    if parameters.witnesses == "any":
        return None
    if parameters.witnesses == "each":
        return seed % counts
    if parameters.witnesses == "drawn":
        return int(noise.uniforms((1,), scenario, seed, "witnesses")[0] * counts)
    return int(parameters.witnesses)


def radios(scenario: Scenario, seed: int, danger: str | None) -> dict[str, Any]:
    """Return how many helpers see an episode's danger at first, and whether the danger has a radio.

    They are columns of a table's row: `witnesses` (a count) and `danger_radio` (a bool: whether the
    danger broadcasts its pose). The start situation is the one that `seed` draws; `danger` is the
    sector (direction) that its danger comes from, None without one. A value is None where the
    scenario's parameters declare none.
    """
    p = scenario.parameters
    radio = has_radio(scenario.name, p, seed) if danger and p.radio_share else None
    return {"witnesses": witnesses(scenario.name, p, seed), "danger_radio": radio}


def queue(
    draws: Draws,
    ids: dict[str, str],
    ego: Spawn,
    gaps_m: tuple[tuple[float, float], ...],
    speed_mps: tuple[float, float],
) -> tuple[Spawn, ...]:
    """Return helper cars lined up behind the ego, from where they cannot see the danger.

    Args:
        draws: draws the layout's random quantities; one car is made for each name in its `seats`,
            none if it has none.
        ids: id of the vehicle, such as `v7`, for each name in `draws.seats`.
        ego: the ego's start, whose path the cars share.
        gaps_m: bounds of the uniform gap between centres, m, for each car from the ego backwards.
        speed_mps: bounds of the speed that they have in common, m/s.
    """
    mps, arc_m, cars = draws.between("seats_speed", speed_mps), ego.arc_m, []
    for name, bounds in zip(draws.seats, gaps_m, strict=False):
        arc_m -= draws.between(name, bounds)
        cars.append(Spawn(ids[name], "car", "helper", ego.approach, ego.route, arc_m, mps))
    return tuple(cars)


def has_radio(scenario: str, parameters: Parameters, seed: int, vehicle: str = DANGER) -> bool:
    """Return whether a vehicle that does not help broadcasts its pose, as drawn for an episode.

    It is drawn by the layout seed `seed`, with probability `parameters.radio_share`. `scenario` is
    the scenario's name, and `vehicle` the vehicle's id, or `DANGER` for the one that would meet the
    ego.
    """
    draw = noise.uniforms((1,), scenario, seed, "radio", vehicle)[0]
    return bool(draw < parameters.radio_share)


@lru_cache(maxsize=256)  # a frozen scene asks again for each action that it follows
def _witnessed(
    scenario: Scenario, draft: Callable[[Draws, Any], Draft], seed: int, parameters: Parameters
) -> Layout:
    """Return the layout of a seed with exactly as many witnesses as its parameters declare.

    Raises UserError if none of MOST_ATTEMPTS draws has blind seats and lookouts.
    """
    for attempt in range(MOST_ATTEMPTS):
        start = draft(Draws(scenario.name, seed, attempt, SEATS), parameters)
        if _fits(scenario, start, seed, parameters):
            break
    else:
        raise UserError(
            f"scenario {scenario.name}: none of {MOST_ATTEMPTS} draws of layout seed {seed} gives "
            f"witnesses={parameters.witnesses}; it needs other parameters"
        )
    count = witnesses(scenario.name, parameters, seed)
    assert count is not None
    order = noise.generator(scenario.name, seed, "radios").permutation(len(LOOKOUTS)).tolist()
    silent = {LOOKOUTS[n] for n in order[count:]}
    spawns = [replace(s, part="other") if s.id in silent else s for s in start.layout.spawns]
    spawns += [start.seats[n] for n in order[count:]]
    danger, danger_id = start.layout.danger, start.phantoms[0].id
    return Layout.arranged(spawns, danger, danger_id, start.layout.buildings)


def _fits(scenario: Scenario, start: Draft, seed: int, parameters: Parameters) -> bool:
    """Return whether exactly the lookouts have each phantom of the danger in sight.

    They have it with all blind seats taken, and nobody else has it with no other one taken:
    so it holds whichever seats are.
    """
    looks: list[Look] = []
    targets: list[str] = []
    sees: list[bool] = []  # whether the viewer is a lookout
    for phantom in start.phantoms:
        spawns = [spawn for spawn in start.layout.spawns if spawn.id != phantom.id]
        spawns.append(phantom)
        full = _state(scenario, start.layout, [*spawns, *start.seats], seed)
        empty = _state(scenario, start.layout, spawns, seed)  # nobody is in a blind seat
        blind = [empty.ego, *(full.vehicle(seat.id) for seat in start.seats)]
        looks += [(full, full.vehicle(id_)) for id_ in LOOKOUTS]
        looks += [(empty, viewer) for viewer in blind]
        sees += [True] * len(LOOKOUTS) + [False] * len(blind)
        targets += [phantom.id] * (len(LOOKOUTS) + len(blind))
    around = surfaces(looks)
    sensed = around.by_viewer(reported(looks, around, parameters))
    return all(
        sensed[n, ids.index(target)] == is_lookout
        for n, (ids, target, is_lookout) in enumerate(zip(around.ids, targets, sees, strict=True))
    )


def _state(scenario: Scenario, layout: Layout, spawns: Sequence[Spawn], seed: int) -> WorldState:
    """Return the state in which some vehicles start; the ego is first."""
    from harness.world.simulator import populated, state_of  # imports highway-env

    road = populated(scenario, replace(layout, spawns=tuple(spawns)))
    vehicles = tuple(state_of(v, origin_m=scenario.road().origin_m) for v in road.vehicles)
    return WorldState(scenario.name, seed, 0, 0.0, 0.0, vehicles, layout.buildings)
