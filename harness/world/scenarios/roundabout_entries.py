"""Scenario `roundabout-entries`: cars enter a small roundabout from several arms,
each in the next one's way.

The ego comes from the south, and other agents from the west, from the east, or from both; all go
straight on. Who has entered goes round past the next arm when the one from there is about to enter:
the car from the west past the south arm, and the ego past the east arm. Each has a seat of its own.
Without `agent_share` they keep their way and speed, as all other traffic does: it brakes only for
who is in its lane, ahead and slower.

In most episodes one more car is dangerous. It is no agent, has come from the north arm and goes on
past the south arm, closely behind the car from the west, or, where there is none, when the ego
enters. Hedges beside every arm and a planted mound in the middle hide it. A car just like it that
leaves at the south arm does not harm the ego.

When two agents meet is drawn evenly about the moment at which both are at the entry,
so neither is first more often; ids tell nobody's place.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed
from harness.world.parameters import SHARED, Shared
from harness.world.road import PathKey, Road, crossings
from harness.world.roundabouts import ARM_M, ARMS, LANE_WIDTH_M, Roundabout, name_of
from harness.world.scenario import Draws, Layout, Scenario, Seat, Spawn
from harness.world.state import Building, Part

NAME = "roundabout-entries"
PLACE = Roundabout(ring_m=12.0, entry_m=10.0, beside_m=3.0)  # 28 m from kerb to kerb
# arms that agents come from, the way cars go round
FROM = (("w", "s"), ("s", "e"), ("w", "s", "e"))
EGO = "s"
# The arms from which cars come that pass an agent's entry, and the way of these.
SECTORS = {"left": ("left", "straight"), "oncoming": ("oncoming", "left")}
SECTOR_REACH_M = (6.0, 30.0)  # stretch before the point of entry that is looked at
# The route of a car by where it has come from, and at which arm from there on it leaves. Who leaves
# at the agent's own arm is named `right` and shows it, since that is what matters there. The first
# of equally good ways is what a car on the ring is taken for.
ROUTES = {
    ("own", 2): "straight",
    ("own", 3): "left",
    ("left", 2): "straight",
    ("left", 3): "left",
    ("right", 2): "straight",
    ("oncoming", 2): "right",
    ("oncoming", 3): "left",
    ("right", 3): "right",
}
# who is on the ring goes before who enters
PRIORITY = {"left": 2, "oncoming": 2, "own": 1, "right": 0}


@dataclass(frozen=True)
class Parameters(Shared):
    """Hold the settings of `roundabout-entries`: cars enter a roundabout from several arms.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. An
    agent is a vehicle that decides; `offset_s` is when one enters, in s after the agent from the
    arm before has passed there. A danger is the vehicle that would meet an ego which keeps its
    speed.

    All start at `speed_mps`. The ego enters after `ego_s` if it keeps its speed, and agents come
    from three arms with `third_share`, else from two. A danger passes the ego's entry `headway_s`
    behind the car from the west or, without that, `danger_offset_s` after the ego would;
    without a danger, a car in its place leaves the ring before with `leaver_share`. Sight is
    blocked by a mound on the island, of radius `mound_m`, and by hedges, which end `hedge_end_m`
    from the ring's centre and are `hedge_half_m` wide on each side of their middle.
    """

    # speeds that an agent's actions step through, m/s
    target_speeds_mps: tuple[float, ...] = (0.0, 3.5, 7.0)
    # seconds after which an agent that has not reached its goal has failed
    time_limit_s: float = 18.0
    # speed of everybody at the start, m/s: 25 km/h; NCHRP 672 has 23 for a circle of 12 m (8.76
    # R^0.386)
    speed_mps: float = 7.0
    third_share: float = 0.34  # probability of agents from three arms, not two
    # seconds from the start until the ego enters the ring if it keeps its speed
    ego_s: tuple[float, float] = (3.4, 4.0)
    # seconds at which an agent enters, after the one from the arm before passes there, if both keep
    # their speed
    offset_s: tuple[float, float] = (-1.4, 1.4)
    # probability of a danger: a car that is no agent and goes on past the south arm
    danger_share: float = 0.65
    # seconds by which a danger passes the south entry behind the car from the west
    headway_s: tuple[float, float] = (1.1, 1.5)
    # without a car from the west: seconds at which a danger passes the south entry, after a
    # cruising ego would
    danger_offset_s: tuple[float, float] = (-0.4, 0.4)
    # probability, without a danger, of a car in its place that leaves at the south arm
    leaver_share: float = 0.6
    mound_m: tuple[float, float] = (6.0, 8.0)  # radius of the planted part of the island, m
    # distance of the ring's centre to the end of a hedge, m
    hedge_end_m: tuple[float, float] = (15.0, 17.0)
    # half the width of a hedge, m; the splitter islands are 2 m wide
    hedge_half_m: float = 0.8


def key_of(begin: str, leaves: int, home: str = EGO) -> PathKey:
    """Return the path key (approach, route), as an agent from arm `home` names it.

    An agent is a vehicle that decides. The path enters at the arm `begin` (`s`, `e`, `n` or `w`)
    and leaves `leaves` arms farther on, the way traffic goes round.
    """
    approach = name_of(begin, home)
    return approach, ROUTES[approach, leaves]


@cache
def road(home: str = EGO) -> Road:
    """Return the roundabout as a `Road`, for an agent from the arm `home` as its ego.

    An agent is a vehicle that decides; arms are `s`, `e`, `n` and `w`. The conflict zone is where
    the agent's path joins the ring.
    """
    ego = key_of(home, 2, home)
    arms = {name_of(arm, home): arm for arm in ARMS}
    paths = {}
    for (approach, leaves), route in ROUTES.items():
        begin = arms[approach]
        end = ARMS[(ARMS.index(begin) + leaves) % len(ARMS)]
        path = PLACE.path(approach, route, begin, end, PRIORITY[approach], home)
        paths[approach, route] = path
    meetings = crossings(paths, ego)
    at, ego_path = meetings["left", "straight"], paths[ego]
    beyond_goal = cleared(home, ego_path.points[:, None], np.array(ego[0]), None)
    goal_m = float(ego_path.arc_m[beyond_goal.argmax()])
    back_m = np.linspace(*SECTOR_REACH_M, 13)
    sectors = {}
    for sector, key in SECTORS.items():
        sectors[sector] = paths[key].points_at(meetings[key].other_arc_m - back_m)
    return Road(
        facts={
            "kind": "roundabout",
            "lane_width_m": LANE_WIDTH_M,
            "ring_m": PLACE.ring_m,
            "ego": "/".join(ego),
        },
        paths=paths,
        ego=ego,
        crossings=meetings,
        zone_m=(at.x_m, at.y_m),
        sectors=sectors,
        network=PLACE.network,
        goal_m=lambda parameters: goal_m,
    )


def cleared(home: str, xy_m: Floats, approaches: Texts, parameters: Any) -> Bools:
    """Return whether the ego has left the ring past the next entry.

    `home` is the arm that it comes from (`s`, `e`, `n` or `w`).

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, and `parameters` are not read. The result is (...).
    """
    turned_rad, edge_m = math.pi / 2 * ARMS.index(home), PLACE.ring_m + LANE_WIDTH_M / 2
    x, y = xy_m[..., 0, 0], xy_m[..., 0, 1]
    at_rad = (np.arctan2(y, x) + turned_rad + math.pi) % (2 * math.pi) - math.pi
    beyond = (-math.pi / 2 < at_rad) & (at_rad < PLACE.ring_rad(3))
    return np.asarray(beyond & (np.hypot(x, y) > edge_m))


@cache
def seats() -> dict[PathKey, Seat]:
    """Return the scenario as an agent from the west or the east plays it: with it as the ego.

    An agent is a vehicle that decides. Keys are the paths on which agents start, (approach, route).
    """
    seats = {}
    for arm in "we":
        mine = replace(SCENARIO, road=partial(road, arm), cleared=partial(cleared, arm))
        names = {key_of(a, leaves): key_of(a, leaves, arm) for a in ARMS for leaves in (2, 3)}
        seats[key_of(arm, 2)] = Seat(mine, names)
    return seats


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: cars from two or three arms, in each other's way.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car on the ring that decides nothing; hedges hide it. The layout is the same for equal seeds and
    `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    paths, at = road().paths, road().crossings[SECTORS["oncoming"]]
    quarter_s = PLACE.ring_m * math.pi / 2 / p.speed_mps  # from one entry to the next
    arms = (
        FROM[2] if draws.share("third") < p.third_share else FROM[int(draws.share("which") < 0.5)]
    )
    ego_s = draws.between("ego", p.ego_s)
    enters_s = {
        "w": ego_s - quarter_s - draws.between("offset w", p.offset_s),
        EGO: ego_s,
        "e": ego_s + quarter_s + draws.between("offset e", p.offset_s),
    }
    helpers = sorted((arm for arm in arms if arm != EGO), key=lambda arm: draws.share(f"id {arm}"))
    ids = {EGO: "v1", **{arm: f"v{n}" for n, arm in enumerate(helpers, 2)}}
    spawns = []
    for arm in (EGO, *helpers):
        key = key_of(arm, 2)
        arc = paths[key].ends_m[1] - p.speed_mps * enters_s[arm]
        part: Part = "ego" if arm == EGO else "helper"
        spawns.append(Spawn(ids[arm], "car", part, *key, arc, p.speed_mps))
    passes_s = ego_s + draws.between("danger_offset", p.danger_offset_s)
    if "w" in arms:
        passes_s = enters_s["w"] + quarter_s + draws.between("headway", p.headway_s)
    (comes,) = draws.ids(("comes",)).values()
    arc = at.other_arc_m - p.speed_mps * passes_s
    goes_on = Spawn(comes, "car", "other", *key_of("n", 3), arc, p.speed_mps)
    turns_off = Spawn(comes, "car", "other", *key_of("n", 2), arc, p.speed_mps)
    danger = "oncoming" if draws.share("danger") < p.danger_share else None
    if danger:
        spawns.append(goes_on)
    elif draws.share("leaver") < p.leaver_share:
        spawns.append(turns_off)

    half, far = p.hedge_half_m, PLACE.arc_y_m + ARM_M
    ends = {arm: draws.between(f"hedge {arm}", p.hedge_end_m) for arm in ARMS}
    boxes = [
        (-half, ends["s"], half, far),
        (ends["e"], -half, far, half),
        (-half, -far, half, -ends["n"]),
        (-far, -half, -ends["w"], half),
        *PLACE.mound(draws.between("mound", p.mound_m)),
    ]
    buildings = [Building(f"b{n}", *box) for n, box in enumerate(boxes, 1)]
    return Draft(Layout.arranged(spawns, danger, comes, buildings), (goes_on,), ())


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=partial(cleared, EGO),
    dials=SHARED,
    seats=seats,
    words={
        "task": "enter a roundabout, go round past the next arm and straight on",
        "hiding": "hedges and a planted island",
    },
    one_sided="traffic goes round one way and comes from the left",
)
