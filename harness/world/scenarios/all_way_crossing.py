"""Scenario `all-way-crossing`: two to four cars that decide come to a crossing without signs.

The ego comes from the south at 10 m/s. One to three other agents come from other arms, at least one
of them from a side; each goes straight on, and buildings on the corners hide those from the sides
from each other. All keep a speed that brings them to the middle at times of one distribution, so
those who cross often meet unless somebody gives way, and nothing says who has to. In half of the
episodes one more car, which is no agent, comes from the ego's left or right and yields to nobody:
the agents on that road see it, and those on the ego's do not. Behind an agent it keeps its
distance.

Without `agent_share` the other agents keep their speed, and the ego has to pass between them.

Where agents are, and when they come, is drawn without knowing of the danger.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.crossroads import APPROACHES, ARM_M, JUNCTION_M, ROUTES, SECTORS, road, seen_from
from harness.world.lookouts import Draft, placed
from harness.world.parameters import SHARED, Shared
from harness.world.road import PathKey
from harness.world.scenario import Draws, Layout, Scenario, Seat, Spawn
from harness.world.state import Building, Part

NAME = "all-way-crossing"
BUILDING_END_M = 70.0  # outer walls, from the centre lines
SIDES = ("left", "right")  # where a danger comes from
# The direction of travel from each arm: south, west, north and east.
AHEAD = np.array([(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])


@dataclass(frozen=True)
class Parameters(Shared):
    """Hold the settings of `all-way-crossing`: cars meet at a crossing without signs.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. An
    `_offset_s` is when a car is in the middle, in s after a cruising ego, one that keeps its speed.
    A danger is the vehicle that would meet that ego, and an agent a vehicle that decides.

    Agents start at `speed_mps` and are in the middle after `arrival_s`: from both sides with
    `both_share`, else from one, and from ahead with `oncoming_share`. Other cars drive at
    `car_mps`, `follow_s` or more behind an agent: a danger and, much later, a harmless car
    (`late_`). Buildings stand `corner_m` from the roads' middle; an agent has reached its goal
    `cleared_m` behind the junction.
    """

    # speeds that an agent's actions step through, m/s: up to 36 km/h
    target_speeds_mps: tuple[float, ...] = (0.0, 5.0, 10.0)
    speed_mps: float = 10.0  # speed of every agent at the start, m/s
    # seconds from the start until an agent that keeps its speed is in the middle of the crossing
    arrival_s: tuple[float, float] = (3.2, 4.8)
    # probability of agents from both the left and the right of the ego; else from one of them
    both_share: float = 0.4
    oncoming_share: float = 0.5  # probability of an agent from ahead of the ego
    # probability of a danger: a car from the left or right, which is no agent
    danger_share: float = 0.5
    # seconds at which a danger would be in the middle, after a cruising ego; behind an agent on its
    # arm, later if need be
    danger_offset_s: tuple[float, float] = (-0.3, 0.8)
    # seconds by which a car that is no agent is behind the agent on its arm, at the least
    follow_s: tuple[float, float] = (1.2, 1.8)
    car_mps: tuple[float, float] = (8.5, 10.0)  # speed of a car that is no agent, m/s
    late_share: float = 0.4  # probability of a harmless car from any other arm, long after
    # seconds at which that harmless car is in the middle, after a cruising ego
    late_offset_s: tuple[float, float] = (4.5, 6.0)
    # distance of a building's walls from the centre lines of the roads, m
    corner_m: tuple[float, float] = (7.0, 11.0)
    # distance of an agent's centre behind the junction's exit at which it has reached its goal, m
    cleared_m: float = 2.5


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: cars from two to four arms, all in time to meet.

    A layout is the start situation of an episode. Buildings stand on the corners; a danger, with
    probability `danger_share`, is one more car that yields to nobody. The layout is the same for
    equal seeds and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    middle_m = ARM_M + JUNCTION_M
    chosen = SIDES[int(draws.share("side") * len(SIDES))]
    there = {side for side in SIDES if side == chosen or draws.share("both") < p.both_share}
    if draws.share("oncoming") < p.oncoming_share:
        there.add("oncoming")

    def car(
        id_: str, approach: str, speed_mps: float, after_s: float, part: Part = "other"
    ) -> Spawn:
        """Return a car that is in the middle at a time if it keeps its speed."""
        return Spawn(
            id_, "car", part, approach, "straight", middle_m - speed_mps * after_s, speed_mps
        )

    arrival_s = {
        approach: draws.between(f"{approach}_arrival", p.arrival_s) for approach in APPROACHES
    }
    order = sorted(SECTORS, key=lambda approach: draws.share(f"{approach}_id"))
    spawns = [car("v1", "own", p.speed_mps, arrival_s["own"], "ego")]
    spawns += [
        car(f"v{2 + n}", approach, p.speed_mps, arrival_s[approach], "helper")
        for n, approach in enumerate(order)
        if approach in there
    ]

    ids = draws.ids(("danger", "late"))

    def coming(name: str, approach: str, offset_s: tuple[float, float]) -> Spawn:
        after_s = arrival_s["own"] + draws.between(f"{name}_offset", offset_s)
        if approach in there:
            after_s = max(
                after_s, arrival_s[approach] + draws.between(f"{name}_follow", p.follow_s)
            )
        return car(ids[name], approach, draws.between(f"{name}_speed", p.car_mps), after_s)

    danger = None
    if draws.share("danger") < p.danger_share:
        danger = SIDES[int(draws.share("sector") * len(SIDES))]
        spawns.append(coming("danger", danger, p.danger_offset_s))
    if draws.share("late") < p.late_share:
        arm = SECTORS[int(draws.share("late_sector") * len(SECTORS))]
        spawns.append(coming("late", arm, p.late_offset_s))

    buildings = []
    for n, (east, south) in enumerate(((-1, 1), (1, 1), (-1, -1), (1, -1))):
        xs = sorted((east * draws.between(f"corner_{n}_x", p.corner_m), east * BUILDING_END_M))
        ys = sorted((south * draws.between(f"corner_{n}_y", p.corner_m), south * BUILDING_END_M))
        buildings.append(Building(f"b{n + 1}", xs[0], ys[0], xs[1], ys[1]))
    return Draft(Layout.arranged(spawns, danger, ids["danger"], buildings), (), ())


def cleared(arm: int, xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is past the crossing by `parameters.cleared_m`.

    `arm` is the number of the arm that the ego comes from: 0 to 3 for south, west, north, east.
    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, is not read. The result is (...).
    """
    return np.asarray(xy_m[..., 0, :] @ AHEAD[arm] >= JUNCTION_M + parameters.cleared_m)


@cache
def seats() -> dict[PathKey, Seat]:
    """Return the scenario as an agent from each arm plays it: with that agent as its ego.

    An agent is a vehicle that decides. Keys are the paths on which agents start: approach and route
    as the ego's own road names them.
    """
    return {(seen_from(0, arm), "straight"): _seat(arm) for arm in range(len(AHEAD))}


def _seat(arm: int) -> Seat:
    seat_road = partial(road, arm, 2)
    names = {
        (seen_from(0, other), route): (seen_from(arm, other), route)
        for other, route in product(range(len(APPROACHES)), ROUTES)
    }
    return Seat(replace(SCENARIO, road=seat_road, cleared=partial(cleared, arm)), names)


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=partial(road, 0, 2),
    layout=layout,
    cleared=partial(cleared, 0),
    dials=SHARED,
    words={
        "task": "go straight over a crossing without signs",
        "hiding": "buildings on the corners",
    },
    one_sided=None,  # nobody has right of way, so that times decide and sides do not
    seats=seats,
)
