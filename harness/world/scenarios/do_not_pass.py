"""Scenario `do-not-pass`: the ego follows a slow truck that hides the oncoming lane.

The ego follows a slow truck on a two-way road. It may change to the oncoming lane, pass the truck
and come back. The truck hides that lane: from behind it the ego sees no farther than some forty
metres. In part of the episodes a car comes there in time to meet an ego that passes at once; else
none comes, or one comes long after. Three helpers know more: the truck, a car that drives ahead of
it, and one that comes behind the ego.

This is the do-not-pass warning of V2V (DNPW, see-through). Traffic keeps its lane and speed and
yields to nobody. The ego has cleared the episode when it is back on its lane ahead of the truck, or
when what came towards it has gone by while it kept its lane behind the truck; so one that waits
where nothing comes never does.

What the ego can see (truck, gap, the car behind) is drawn without knowing of the danger.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import Road, paths_along, straights
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import SIZES_M, Kind

NAME = "do-not-pass"
LANE_WIDTH_M = 4.0
BEGIN_M, END_M = -150.0, 350.0  # of the road, to the east
OWN, BESIDE = "own lane", "oncoming lane"  # the ego's ways
CAR, TRUCK = SIZES_M["car"][0], SIZES_M["truck"][0]
# Where witnesses are declared, the third lookout is a second car ahead of the truck, from centre to
# centre, and the blind seats are behind the ego, which hides what the truck does not.
SECOND_M = 10.0, 16.0
SEATS_M = (8.0, 9.5), (7.5, 8.5), (7.5, 8.5)  # from the ego to the first, and from one to the next


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `do-not-pass`: the ego follows a truck that hides the oncoming lane.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode.
    `danger_s` and `late_s` are when an oncoming car is where the ego started, in s from the start.
    A danger is the vehicle that would meet an ego which passes at once.

    The ego starts at `speed_mps`, `ego_start_m` before the place where it would be beside the
    truck, and `gap_m` behind the truck. It has reached its goal `ahead_m` before the truck, or at
    most `behind_m` behind it once the oncoming car went by. Oncoming cars, a danger or a harmless
    one (`late_`), drive at `oncoming_mps`. Helpers are the truck, the car before it (`leader_`) and
    the one behind the ego (`follower_m`).
    """

    # speeds that the ego's actions step through, m/s: up to 54 km/h
    target_speeds_mps: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0)
    # seconds after which an ego that has not reached its goal has failed
    time_limit_s: float = 12.0
    # seconds later than the full-view driver at which an ego may still reach its goal
    delay_allowance_s: float = 1.0
    # speed at the start, m/s, of the ego, of the truck and of the helper behind the ego: one of the
    # target speeds
    speed_mps: float = 5.0
    # where the ego starts, m before the conflict zone, which is where it would be beside the truck
    ego_start_m: tuple[float, float] = (28.0, 32.0)
    # gap from the ego's rear to the truck's front, m, with which it has passed the truck
    ahead_m: float = 6.0
    # gap from the ego's front to the truck's rear, m, at most, with which an ego that let the
    # oncoming vehicle go by has reached its goal
    behind_m: float = 40.0
    # probability that a danger comes: a car in time to meet an ego that passes at once
    danger_share: float = 0.6
    gap_m: tuple[float, float] = (8.0, 11.0)  # gap from the ego to the truck, bumper to bumper, m
    # speed of a car on the oncoming lane, dangerous or not, m/s
    oncoming_mps: tuple[float, float] = (12.0, 16.0)
    # seconds from the start until a danger is where the ego started
    danger_s: tuple[float, float] = (4.2, 5.9)
    late_share: float = 0.4  # probability of a harmless car on the oncoming lane that comes later
    # seconds from the start until that harmless car is where the ego started: 9 s is what a
    # deployed do-not-pass warning takes for safe (Open-V2X)
    late_s: tuple[float, float] = (15.0, 19.0)
    # gap from the truck to the helper ahead of it, bumper to bumper, m
    leader_m: tuple[float, float] = (20.0, 35.0)
    # speed of the helper ahead of the truck, m/s: it has just passed
    leader_mps: tuple[float, float] = (11.0, 14.0)
    # gap from the ego to the helper behind it, bumper to bumper, m
    follower_m: tuple[float, float] = (12.0, 20.0)


@cache
def road() -> Road:
    """Return the two-way road as a `Road`: the ego's lane to the east, and one to the west.

    The conflict zone is where the ego, which passes at once, would be beside the truck.
    """
    ways = {
        ("own", BESIDE): ([("a", "b", 0)], [BESIDE], 0),
        ("own", OWN): ([("a", "b", 1)], [OWN], 1),
        ("oncoming", "straight"): ([("b", "a", 0)], [BESIDE], 2),
    }
    paths = paths_along(network(), ways)
    ahead = np.linspace(-10.0, 100.0, 12)
    return Road(
        facts={"kind": "two-way road", "lane_width_m": LANE_WIDTH_M},
        paths=paths,
        ego=("own", OWN),
        crossings={},
        zone_m=(0.0, LANE_WIDTH_M),
        sectors={"oncoming": np.column_stack([ahead, np.zeros(len(ahead))])},
        network=network,
        ways=(("own", BESIDE), ("own", OWN)),
    )


@cache
def network() -> Any:
    """Build the road network, a `highway_env.road.road.RoadNetwork`, like that of `TwoWayEnv`.

    The left lane is in it twice, once in each direction, so that the ego may use it to pass.
    """
    from harness.world.highway import LineType

    striped, edge, none = LineType.STRIPED, LineType.CONTINUOUS_LINE, LineType.NONE
    return straights(
        LANE_WIDTH_M,
        ("a", "b", BEGIN_M, END_M, 0.0, (edge, none)),
        ("a", "b", BEGIN_M, END_M, LANE_WIDTH_M, (striped, edge)),
        ("b", "a", END_M, BEGIN_M, 0.0, (none, none)),
    )


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego behind a truck, and who comes towards it.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car in time to meet an ego that passes at once; three helpers, the truck among them, know more.
    The layout is the same for equal seeds and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""

    def own_lane_spawn(
        id_: str, kind: Kind, part: Any, arc_m: float, speed_mps: float = p.speed_mps
    ) -> Spawn:
        return Spawn(id_, kind, part, "own", OWN, arc_m, speed_mps)

    ego = -BEGIN_M - draws.between("ego_start", p.ego_start_m)
    truck = ego + (CAR + TRUCK) / 2 + draws.between("gap", p.gap_m)
    leader = truck + (CAR + TRUCK) / 2 + draws.between("leader", p.leader_m)
    leader_mps = draws.between("leader_mps", p.leader_mps)
    itself = own_lane_spawn("v1", "car", "ego", ego)
    if draws.seats:
        second = leader + draws.between("second", SECOND_M)
        last = own_lane_spawn("v4", "car", "helper", second, leader_mps)
    else:
        follower = ego - CAR - draws.between("follower", p.follower_m)
        last = own_lane_spawn("v4", "car", "helper", follower)
    spawns = [
        itself,
        own_lane_spawn("v2", "truck", "helper", truck),
        own_lane_spawn("v3", "car", "helper", leader, leader_mps),
        last,
    ]

    def oncoming(id_: str, after_s: float) -> Spawn:
        speed = draws.between(f"{id_} speed", p.oncoming_mps)
        arc = END_M - BEGIN_M - ego - speed * after_s
        return Spawn(id_, "car", "other", "oncoming", "straight", arc, speed)

    ids = draws.ids(("danger", "late"))
    coming = oncoming(ids["danger"], draws.between("danger_s", p.danger_s))
    danger = "oncoming" if draws.share("danger") < p.danger_share else None
    if danger:
        spawns.append(coming)
    if draws.share("late") < p.late_share:
        spawns.append(oncoming(ids["late"], draws.between("late_s", p.late_s)))
    made = Layout.arranged(spawns, danger, ids["danger"])
    return Draft(made, (coming,), queue(draws, ids, itself, SEATS_M, (p.speed_mps, p.speed_mps)))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego has passed the truck, or safely stayed behind.

    It has if it is on its own lane and either `parameters.ahead_m` ahead of the truck, or at most
    `parameters.behind_m` behind it after an oncoming vehicle went by. `xy_m`, (..., V, 2), are the
    centres of the V vehicles of each of any number of episodes at one moment, m in highway-env's
    frame, the ego first and then the truck; `approaches`, (..., V), are where their paths come
    from. The result is (...).
    """
    x, lengths = xy_m[..., 0], (CAR + TRUCK) / 2
    in_lane = np.abs(xy_m[..., 0, 1] - LANE_WIDTH_M) <= LANE_WIDTH_M / 4
    ahead_m = x[..., 0] - x[..., 1]
    passed = ((approaches == "oncoming") & (x < x[..., :1])).any(axis=-1)
    let_go = passed & (-lengths - parameters.behind_m < ahead_m) & (ahead_m < -lengths)
    return np.asarray(in_lane & ((ahead_m > lengths + parameters.ahead_m) | let_go))


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER", "LANE_LEFT", "LANE_RIGHT"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={"task": "pass a slow truck, or stay behind it", "hiding": "the truck"},
    brake_lamps=True,
    one_sided="traffic keeps to the right, and what comes towards it is on the left",
)
