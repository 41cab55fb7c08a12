"""Scenario `parking-exit`: the ego pulls out between vans into a lane that it cannot see.

The ego rolls at 4 m/s along a kerbside space of a street and pulls out to the left, into the lane
beside it. A row of vans parked behind it hides who comes along that lane. In most episodes one
vehicle is dangerous: it comes from behind, timed to be where the ego comes into the lane. Three
helpers see it: the last van of the row, a car parked on the other side of the street, and a car
that has just driven past. Traffic keeps its lane and speed and yields to nobody: it brakes only for
who is in its lane, ahead and slower. The ego alone decides.

This is the kerbside variant, in which the ego drives forwards; nobody reverses. What the ego can
see before it is too late (vans, helpers, a car on the lane for the other direction, a car that
comes later) is drawn without knowing of the danger.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import Road, crossings, paths_along, straights, to_the_left
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import SIZES_M, Kind, Part

NAME = "parking-exit"
LANE_WIDTH_M = 3.5
KERB_M = 3.4  # from the middle of the lane to the middle of the ego's space
VANS_M = 3.0  # and to that of the row of vans, which are wide: 0.2 m off the lane
BEGIN_M, END_M = -110.0, 110.0  # of the street, to the east
PULL_OUT_M = 10.0  # along the street, from the space into the lane, in two arcs of 8 m
OUT_M = 0.0  # where the ego's way has come into the lane
SECTOR_REACH_M = (15.0, 45.0)  # stretch of the lane before that point that is looked at
VAN = SIZES_M["van"][0]
SEATS_M = 6.0, 7.5  # blind seats: cars parked ahead of the van ahead, from centre to centre


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `parking-exit`: the ego pulls out between vans into a hidden lane.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. An
    `_offset_s` is when a car is where the ego comes into the lane, in s after a cruising ego, one
    that keeps its speed. A danger is the vehicle that would meet that ego.

    The ego starts `ego_start_m` before it pulls out and has reached its goal `cleared_m` beyond the
    pull-out's end. Cars drive at `lane_mps`: from behind a danger or a later harmless one
    (`late_`), and on the other lane one (`oncoming_`) that starts so far ahead. Vans are parked
    `behind_m` behind the ego, `vans_m` apart, and `ahead_m` beyond the pull-out. Helpers are parked
    opposite (`opposite_m`) or have just driven past (`passed_`).
    """

    # speeds that the ego's actions step through, m/s: up to a driver's pace in a car park
    target_speeds_mps: tuple[float, ...] = (0.0, 2.0, 4.0)
    ego_speed_mps: float = 4.0  # speed of the ego at the start, m/s
    # how far before the pull-out's beginning the ego starts, m
    ego_start_m: tuple[float, float] = (2.0, 8.0)
    # distance beyond the pull-out's end at which the ego has reached its goal, m
    cleared_m: float = 6.0
    # probability of a danger: a car from behind that is where the ego comes into the lane
    danger_share: float = 0.65
    # seconds at which a danger is where the ego comes into the lane, after a cruising ego
    danger_offset_s: tuple[float, float] = (-0.5, 0.3)
    # speed of a car in a lane, dangerous or not, m/s: 8 to 28 km/h is what crossing-traffic alerts
    # cover, 30 km/h and more what a street has
    lane_mps: tuple[float, float] = (8.0, 11.0)
    # probability of a harmless car that comes from behind as well, but later
    late_share: float = 0.5
    # seconds at which that harmless car is where the ego comes into the lane, after a cruising ego
    late_offset_s: tuple[float, float] = (8.0, 10.5)
    oncoming_share: float = 0.5  # probability of a car on the lane for the other direction
    oncoming_m: tuple[float, float] = (30.0, 60.0)  # where that car starts, m ahead of the ego
    # gap from the ego's rear to the van behind it at the start, m
    behind_m: tuple[float, float] = (0.8, 2.0)
    vans_m: tuple[float, float] = (0.8, 1.6)  # gap between two vans of the row, m
    ahead_m: tuple[float, float] = (2.0, 8.0)  # gap from the pull-out's end to the van ahead, m
    # where the helper car that is parked opposite stands, m before the pull-out's end
    opposite_m: tuple[float, float] = (5.0, 20.0)
    # where the helper car that has just driven past is, m beyond the pull-out's end
    passed_m: tuple[float, float] = (10.0, 20.0)
    # speed of the helper car that has just driven past, m/s
    passed_mps: tuple[float, float] = (8.0, 11.0)


@cache
def network() -> Any:
    """Build the street's road network, a `highway_env.road.road.RoadNetwork`.

    It has a lane in each direction, the parking rows, and the pull-out.
    """
    from harness.world.highway import LineType

    none, edge, dashed = LineType.NONE, LineType.CONTINUOUS, LineType.STRIPED
    begins = OUT_M - PULL_OUT_M
    net = straights(
        LANE_WIDTH_M,
        ("west", "out", BEGIN_M, OUT_M, 0.0, (dashed, none)),
        ("out", "east", OUT_M, END_M, 0.0, (dashed, none)),
        ("east", "west", END_M, BEGIN_M, -LANE_WIDTH_M, (none, none)),
        ("kerb", "end", BEGIN_M, END_M, VANS_M, (none, edge)),
        ("opposite", "far", END_M, BEGIN_M, -LANE_WIDTH_M - VANS_M, (none, edge)),
        ("space", "pull", BEGIN_M, begins, KERB_M, (none, edge)),
    )
    first, second = to_the_left((begins, KERB_M), (OUT_M, 0.0), LANE_WIDTH_M)
    net.add_lane("pull", "swing", first)
    net.add_lane("swing", "out", second)
    return net


@cache
def road() -> Road:
    """Return the street as a `Road`, for an ego that pulls out of a kerbside space.

    The conflict zone is where the ego enters the lane beside it.
    """
    ego, behind = ("own", "pull-out"), ("behind", "straight")
    ego_lanes = [
        ("space", "pull", 0),
        ("pull", "swing", 0),
        ("swing", "out", 0),
        ("out", "east", 0),
    ]
    ways = {
        behind: ([("west", "out", 0), ego_lanes[-1]], ["lane behind", "lane ahead"], 1),
        ("oncoming", "straight"): ([("east", "west", 0)], ["oncoming lane"], 1),
        ("kerb", "parked"): ([("kerb", "end", 0)], ["kerb"], 0),
        ("opposite", "parked"): ([("opposite", "far", 0)], ["opposite kerb"], 0),
        ego: (ego_lanes, ["own space", "pull-out", "pull-out", "lane ahead"], 0),
    }
    paths = paths_along(network(), ways)
    at = crossings(paths, ego)[behind]
    back_m = np.linspace(*SECTOR_REACH_M, 13)
    return Road(
        facts={
            "kind": "street with parked vehicles",
            "lane_width_m": LANE_WIDTH_M,
            "ego": "/".join(ego),
        },
        paths=paths,
        ego=ego,
        crossings={behind: at},
        zone_m=(OUT_M, 0.0),
        sectors={"behind": np.column_stack([OUT_M - back_m, np.zeros(len(back_m))])},
        network=network,
    )


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego among parked vans, and who comes along.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car from behind in time to meet the ego; three helpers see it. The layout is the same for equal
    seeds and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    (at,) = road().crossings.values()

    start = OUT_M - PULL_OUT_M - draws.between("ego_start", p.ego_start_m)
    ego = start - BEGIN_M
    rear = start - SIZES_M["car"][0] / 2 - draws.between("behind", p.behind_m) - VAN / 2
    row = [rear]
    for n in range(2):
        row.append(row[-1] - VAN - draws.between(f"van_{n}", p.vans_m))
    ahead = OUT_M + draws.between("ahead", p.ahead_m) + VAN / 2

    def standing(id_: str, kind: Kind, part: Part, x_m: float, side: str = "kerb") -> Spawn:
        return Spawn(
            id_, kind, part, side, "parked", x_m - BEGIN_M if side == "kerb" else END_M - x_m, 0.0
        )

    def coming(name: str, bounds: tuple[float, float]) -> Spawn:
        """Return a car from behind that is where the ego enters the lane so long after a cruising
        ego.
        """
        speed = draws.between(f"{name}_speed", p.lane_mps)
        after_s = (at.ego_arc_m - ego) / p.ego_speed_mps + draws.between(f"{name}_offset", bounds)
        arc = at.other_arc_m - speed * after_s
        return Spawn(ids[name], "car", "other", "behind", "straight", arc, speed)

    ids = draws.ids(("danger", "late", "oncoming", "first van", "second van", "van ahead"))
    passed = at.other_arc_m + draws.between("passed", p.passed_m)
    passed_mps = draws.between("passed_speed", p.passed_mps)
    spawns = [
        Spawn("v1", "car", "ego", "own", "pull-out", ego, p.ego_speed_mps),
        standing("v2", "van", "helper", row[-1]),
        standing(
            "v3", "car", "helper", OUT_M - draws.between("opposite", p.opposite_m), "opposite"
        ),
        Spawn("v4", "car", "helper", "behind", "straight", passed, passed_mps),
        standing(ids["first van"], "van", "other", row[0]),
        standing(ids["second van"], "van", "other", row[1]),
        standing(ids["van ahead"], "van", "other", ahead),
    ]
    comes = coming("danger", p.danger_offset_s)
    danger = "behind" if draws.share("danger") < p.danger_share else None
    if danger:
        spawns.append(comes)
    if draws.share("late") < p.late_share:
        spawns.append(coming("late", p.late_offset_s))
    if draws.share("oncoming") < p.oncoming_share:
        arc = END_M - start - draws.between("oncoming", p.oncoming_m)
        speed = draws.between("oncoming_speed", p.lane_mps)
        spawns.append(Spawn(ids["oncoming"], "car", "other", "oncoming", "straight", arc, speed))
    seats = []
    for name in draws.seats:
        ahead += draws.between(name, SEATS_M)
        seats.append(standing(ids[name], "car", "helper", ahead))
    return Draft(Layout.arranged(spawns, danger, ids["danger"]), (comes,), tuple(seats))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is beyond its pull-out by `parameters.cleared_m`.

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, is not read. The result is (...).
    """
    return np.asarray(xy_m[..., 0, 0] > OUT_M + parameters.cleared_m)


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={"task": "pull out of a kerbside space into the lane beside it", "hiding": "parked vans"},
    one_sided="the kerb is on the right",
)
