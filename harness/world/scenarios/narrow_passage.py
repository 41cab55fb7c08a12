"""Scenario `narrow-passage`: cars from both sides come to an underpass that is too narrow for two.

A street goes under a railway where only one car fits, and both directions share that lane. The ego
comes from the west at 8 m/s, and one or two agents from the east; another may follow the ego. The
first of either side would be in the middle at times of one distribution, so they often meet there
unless a side waits, and nothing says which. Behind the embankment, a side road comes from the ego's
right. In half of the episodes a car that is no agent comes along it, timed to be where a cruising
ego crosses it, and yields to nobody. The embankment hides it from the ego; those who come the other
way see it.

Without `agent_share` the other agents keep their speed,
and the ego has to let them pass or be through before they come.

Where agents are, and when they come, is drawn without knowing of the danger.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed
from harness.world.parameters import SHARED, Shared
from harness.world.road import Crossing, Lane, PathKey, Road, crossings, paths_along
from harness.world.scenario import Draws, Layout, Scenario, Seat, Spawn
from harness.world.state import Building, Part

NAME = "narrow-passage"
LANE_WIDTH_M = 4.0
PASSAGE_M = 4.0  # from the middle of the lane that is shared to its ends
END_M = 90.0  # from the middle to where the street ends
APART = 0.3  # how far the lanes of either direction part outside, m to the side per m along
SIDE_M = 16.0  # where the side road is, m to the east
SIDE_END_M = 100.0  # its ends, to the north and to the south
EMBANKMENT_M = 70.0  # how far it reaches to the north and to the south
SECTOR_REACH_M = (4.0, 44.0)  # stretch of a road before the place to meet that is looked at
OWN, ONCOMING, RIGHT = ("own", "straight"), ("oncoming", "straight"), ("right", "straight")
FROM_EAST = {
    OWN: ONCOMING,
    ONCOMING: OWN,
    RIGHT: ("left", "straight"),
}  # names of paths for who comes from the east


@dataclass(frozen=True)
class Parameters(Shared):
    """Hold the settings of `narrow-passage`: cars from both sides meet where only one fits.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. An
    `_offset_s` is when a danger is where the ego crosses the side road, in s after a cruising ego,
    one that keeps its speed. A danger is the vehicle that would meet it, and an agent a vehicle
    that decides.

    Agents start at `speed_mps`; the first of each side is in the middle of the passage after
    `arrival_s`, a second one `headway_s` behind it with `second_share`. A danger drives at
    `side_mps`. The passage is `opening_m` wide on each side of its middle, and the embankment that
    hides a danger stands `embankment_m` from there along the street; an agent has reached its goal
    `cleared_m` beyond it.
    """

    # speeds that an agent's actions step through, m/s: up to 29 km/h
    target_speeds_mps: tuple[float, ...] = (0.0, 4.0, 8.0)
    # seconds after which an agent that has not reached its goal has failed
    time_limit_s: float = 18.0
    speed_mps: float = 8.0  # speed of every agent at the start, m/s
    # seconds from the start until the first agent of a side, if it keeps its speed, is in the
    # middle of the passage
    arrival_s: tuple[float, float] = (3.5, 4.7)
    second_share: float = 0.5  # probability of a second agent on a side
    # seconds by which a second agent is behind the first of its side
    headway_s: tuple[float, float] = (1.1, 1.4)
    # probability of a danger: a car from the side road, which is no agent
    danger_share: float = 0.5
    # seconds at which a danger is where the ego crosses the side road, after a cruising ego
    danger_offset_s: tuple[float, float] = (-0.4, 0.4)
    side_mps: tuple[float, float] = (6.0, 8.0)  # speed of a danger, m/s
    # distance of the middle of the passage to the foot of the embankment, along the street, m
    embankment_m: tuple[float, float] = (3.0, 4.0)
    # distance of the middle of the lane to the walls of the passage, m
    opening_m: tuple[float, float] = (1.6, 2.0)
    # distance beyond the middle of the passage at which an agent has reached its goal, m
    cleared_m: float = 21.0


@cache
def network() -> Any:
    """Build the street's road network, a `highway_env.road.road.RoadNetwork`.

    It has three lanes in a row for each direction, the middle one in the passage, and the side
    road.
    """
    from harness.world.highway import LineType, RoadNetwork, StraightLane

    net, lines = RoadNetwork(), (LineType.NONE, LineType.NONE)
    apart_m = APART * (END_M - PASSAGE_M)
    corners = np.array([(-END_M, apart_m), (-PASSAGE_M, 0.0), (PASSAGE_M, 0.0), (END_M, apart_m)])
    for name, ahead in (("e", 1), ("w", -1)):
        for n, (begin, end) in enumerate(pairwise(ahead * corners)):
            net.add_lane(
                f"{name}{n}", f"{name}{n + 1}", StraightLane(begin, end, LANE_WIDTH_M, lines)
            )
    side = StraightLane([SIDE_M, SIDE_END_M], [SIDE_M, -SIDE_END_M], LANE_WIDTH_M, lines)
    net.add_lane("south", "north", side)
    return net


@cache
def road(from_east: bool = False) -> Road:
    """Return the street as a `Road`, for an ego from the west or, if `from_east`, from the east.

    The conflict zone is the middle of the narrow passage.
    """
    names = FROM_EAST if from_east else {key: key for key in FROM_EAST}

    def street(direction: str, whose: str) -> tuple[Sequence[Lane], Sequence[str], int]:
        """Return the lanes of a direction, their roles, and its right of way."""
        lanes = [(f"{direction}{n}", f"{direction}{n + 1}", 0) for n in range(3)]
        return lanes, [f"{whose} lane", "passage", f"{whose} lane behind"], 0

    beside = names[RIGHT]
    ways = {
        names[OWN]: street("e", names[OWN][0]),
        names[ONCOMING]: street("w", names[ONCOMING][0]),
        beside: ([("south", "north", 0)], ["side road"], 1),
    }
    paths, ego, other = paths_along(network(), ways), OWN, ONCOMING
    # An ego that waits does so before the passage, until who comes the other way is through.
    x = PASSAGE_M if from_east else -PASSAGE_M
    meeting = Crossing(x, 0.0, paths[ego].project(x, 0.0)[0], paths[other].project(x, 0.0)[0])
    back_m = np.linspace(*SECTOR_REACH_M, 11)
    side = crossings(paths, ego)[beside]
    return Road(
        facts={
            "kind": "street with a narrow passage",
            "lane_width_m": LANE_WIDTH_M,
            "ego": "/".join(ego),
        },
        paths=paths,
        ego=ego,
        crossings={beside: side, other: meeting},
        zone_m=(0.0, 0.0),
        sectors={
            beside[0]: paths[beside].points_at(side.other_arc_m - back_m),
            other[0]: paths[other].points_at(paths[other].ends_m[0] - back_m),
        },
        network=network,
    )


@cache
def seats() -> dict[PathKey, Seat]:
    """Return the scenario as an agent from either side plays it: with that agent as its ego.

    An agent is a vehicle that decides. Keys are the paths on which agents start, (approach, route).
    """
    from_east = replace(SCENARIO, road=partial(road, True), cleared=partial(cleared, ahead=-1))
    return {
        OWN: Seat(SCENARIO, {key: key for key in FROM_EAST}),
        ONCOMING: Seat(from_east, FROM_EAST),
    }


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: cars from both sides of a passage for one.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car from a side road that the embankment hides. The layout is the same for equal seeds and
    `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    here = road()

    def agent(id_: str, part: Part, way: PathKey, after_s: float) -> Spawn:
        """Return an agent that is in the middle of the passage at a time if it keeps its speed."""
        middle_m = here.paths[way].project(0.0, 0.0)[0]
        return Spawn(id_, "car", part, *way, middle_m - p.speed_mps * after_s, p.speed_mps)

    times_s = {}
    for way in (OWN, ONCOMING):
        first_s = draws.between(f"{way[0]}_arrival", p.arrival_s)
        second_s = first_s + draws.between(f"{way[0]}_headway", p.headway_s)
        times_s[way] = [
            first_s,
            *([second_s] if draws.share(f"{way[0]}_second") < p.second_share else []),
        ]
    ego_s, *others_s = times_s[OWN]
    helpers = [
        *((OWN, time_s) for time_s in others_s),
        *((ONCOMING, time_s) for time_s in times_s[ONCOMING]),
    ]
    order = sorted(range(3), key=lambda n: draws.share(f"{n}_id"))
    spawns = [
        agent("v1", "ego", OWN, ego_s),
        *(agent(f"v{2 + n}", "helper", *helper) for n, helper in zip(order, helpers, strict=False)),
    ]

    (id_,) = draws.ids(("danger",)).values()
    at, speed = here.crossings[RIGHT], draws.between("danger_speed", p.side_mps)
    after_s = (at.ego_arc_m - spawns[0].arc_m) / p.speed_mps + draws.between(
        "offset", p.danger_offset_s
    )
    danger = "right" if draws.share("danger") < p.danger_share else None
    if danger:
        spawns.append(Spawn(id_, "car", "other", *RIGHT, at.other_arc_m - speed * after_s, speed))
    foot, wall = draws.between("embankment", p.embankment_m), draws.between("opening", p.opening_m)
    sides = (wall, EMBANKMENT_M), (-EMBANKMENT_M, -wall)
    walls = [
        Building(f"b{n}", -foot, north, foot, south) for n, (north, south) in enumerate(sides, 1)
    ]
    return Draft(Layout.arranged(spawns, danger, id_, walls), (), ())


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters, ahead: int = 1) -> Bools:
    """Return whether the ego is beyond the passage by `parameters.cleared_m`.

    `ahead` is 1 for an ego that goes east and -1 for one that goes west. `xy_m`, (..., V, 2), are
    the centres of the V vehicles of each of any number of episodes at one moment, m in
    highway-env's frame, the ego first. `approaches`, (..., V), where their paths come from, is not
    read. The result is (...).
    """
    return np.asarray(ahead * xy_m[..., 0, 0] > parameters.cleared_m)


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=SHARED,
    words={
        "task": "drive through an underpass that is too narrow for two",
        "hiding": "the embankment",
    },
    one_sided="the side road comes from the right",
    seats=seats,
)
