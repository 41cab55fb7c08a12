"""Scenario `blind-merge`: the ego comes up a ramp behind a wall and merges into a lane that it
cannot see.

The ego comes at 14 m/s along a ramp whose lane runs into the right lane of the main road. A noise
wall between them hides who drives there until shortly before. In most episodes one vehicle is
dangerous: it is on the right lane, timed to be where the ego comes into it. A car on the left lane
at the same time is harmless: the lane decides. Three helpers see both: a truck on the left lane,
and a car ahead on either lane. Traffic keeps its lane and speed and makes room for nobody: it
brakes only for who is in its lane, ahead and slower. The ego alone decides.

What the ego can see before it is too late (wall, helpers, cars that pass before or come later) is
drawn without knowing of the danger.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import Road, crossings, paths_along, straights, to_the_left
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import Building, Kind, Part

NAME = "blind-merge"
LANE_WIDTH_M = 4.0
RAMP_M = 6.5  # from the middle of the right lane to that of the ramp, beside the wall
# along the road, from the ramp's straight to where it has run into the right lane
CONVERGE_M = 40.0
WALL_M = 2.7, 3.5  # from the middle of the right lane to the wall's faces
BEGIN_M, END_M = -250.0, 250.0  # of the main road, to the east; the ramp has merged at 0
SECTOR_REACH_M = (15.0, 60.0)  # stretch of the right lane before that point that is looked at
# Blind seats: cars that have just turned onto the ramp, too slow to reach the ego wherever it
# stops. from the ego to the first, and from one to the next
SEATS_M = (45.0, 55.0), (12.0, 18.0), (12.0, 18.0)
SEATS_MPS = (3.0, 4.5)


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `blind-merge`: the ego merges from a ramp into a lane hidden by a wall.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode. An
    `_offset_s` is when a vehicle is at the merge, in s after a cruising ego, one that keeps its
    speed. A danger is the vehicle that would meet that ego.

    The ego starts `ego_start_m` before the merge and has reached its goal `cleared_m` beyond it;
    the wall ends `wall_end_m` before it. Cars drive at `main_mps`: a danger, and harmless ones on
    the left lane (`left_`), shortly before the ego (`before_`) and long after it (`late_`). Helpers
    are a truck on the left lane (`truck_`) and two cars, one on each lane, that start `ahead_m`
    beyond the merge (`ahead_`).
    """

    ego_speed_mps: float = 14.0  # speed of the ego at the start, m/s: 50 km/h
    # distance of the ego's start to the merge, m: where its way has run into the right lane
    ego_start_m: tuple[float, float] = (58.0, 70.0)
    cleared_m: float = 12.0  # distance beyond the merge at which the ego has reached its goal, m
    # probability of a danger: a car on the right lane that is at the merge when the ego is
    danger_share: float = 0.65
    # seconds at which a danger is at the merge, after a cruising ego
    danger_offset_s: tuple[float, float] = (-0.1, 0.5)
    # speed of cars on the main road, dangerous or not, m/s: 50 to 60 km/h
    main_mps: tuple[float, float] = (14.0, 16.5)
    # probability of a harmless car on the left lane, beside the merge when a danger would be there
    left_share: float = 0.5
    before_share: float = 0.4  # probability of a harmless car on the right lane before the ego
    # seconds at which that car is at the merge, after a cruising ego
    before_offset_s: tuple[float, float] = (-3.2, -2.2)
    # probability of a harmless car on the right lane that comes later than the critical headway of
    # a merge, 3.7 s (HCM 7, equation 31-50)
    late_share: float = 0.4
    # seconds at which that later car is at the merge, after a cruising ego
    late_offset_s: tuple[float, float] = (5.5, 7.5)
    # distance of the wall's end to the merge, m
    wall_end_m: tuple[float, float] = (30.0, 42.0)
    # seconds at which the helper truck on the left lane is beside the merge, after a cruising ego
    truck_offset_s: tuple[float, float] = (2.6, 3.6)
    truck_mps: tuple[float, float] = (13.0, 14.0)  # speed of that truck, m/s
    # where a helper car starts, m beyond the merge: within LiDAR's reach of a danger
    ahead_m: tuple[float, float] = (-10.0, 5.0)
    # speed of a helper car, m/s, not below that of who is behind it
    ahead_mps: tuple[float, float] = (16.5, 17.5)


@cache
def network() -> Any:
    """Build the road network, a `highway_env.road.road.RoadNetwork`: a main road and a ramp.

    It is a shorter version of that of highway-env's `MergeEnv`. The ramp's last lane ends in the
    right lane of the main road.
    """
    from harness.world.highway import LineType

    none, edge, dashed = LineType.NONE, LineType.CONTINUOUS, LineType.STRIPED
    net = straights(
        LANE_WIDTH_M,
        ("a", "b", BEGIN_M, 0.0, -LANE_WIDTH_M, (edge, none)),
        ("a", "b", BEGIN_M, 0.0, 0.0, (dashed, edge)),
        ("b", "c", 0.0, END_M, -LANE_WIDTH_M, (edge, none)),
        ("b", "c", 0.0, END_M, 0.0, (dashed, edge)),
        ("j", "k", BEGIN_M, -CONVERGE_M, RAMP_M, (edge, edge)),
    )
    first, second = to_the_left((-CONVERGE_M, RAMP_M), (0.0, 0.0), LANE_WIDTH_M)
    net.add_lane("k", "m", first)
    net.add_lane("m", "b", second)
    return net


@cache
def road() -> Road:
    """Return the main road and its ramp as a `Road`, for an ego that comes along the ramp.

    The conflict zone is where the ramp has merged into the right lane.
    """
    ego, main = ("ramp", "merge"), ("main", "straight")
    ways = {
        main: ([("a", "b", 1), ("b", "c", 1)], ["right lane behind", "right lane"], 1),
        ("main left", "straight"): (
            [("a", "b", 0), ("b", "c", 0)],
            ["left lane behind", "left lane"],
            1,
        ),
        ego: (
            [("j", "k", 0), ("k", "m", 0), ("m", "b", 0), ("b", "c", 1)],
            ["ramp", "merge", "merge", "right lane"],
            0,
        ),
    }
    paths = paths_along(network(), ways)
    back_m = np.linspace(*SECTOR_REACH_M, 16)
    return Road(
        facts={"kind": "ramp that merges", "lane_width_m": LANE_WIDTH_M, "ego": "/".join(ego)},
        paths=paths,
        ego=ego,
        crossings=crossings(paths, ego),
        zone_m=(0.0, 0.0),
        sectors={"main": np.column_stack([-back_m, np.zeros(len(back_m))])},
        network=network,
    )


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego on a ramp, traffic, and a wall between them.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car that is at the merge when the ego is; three helpers see it. The layout is the same for equal
    seeds and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    (at,) = road().crossings.values()

    start = draws.between("ego_start", p.ego_start_m)

    def timed(
        id_: str, kind: Kind, part: Part, approach: str, speed: float, late_s: float
    ) -> Spawn:
        """Return a vehicle that is beside the merge so long after a cruising ego."""
        arc = at.other_arc_m - speed * (start / p.ego_speed_mps + late_s)
        return Spawn(id_, kind, part, approach, "straight", arc, speed)

    ego = Spawn("v1", "car", "ego", "ramp", "merge", at.ego_arc_m - start, p.ego_speed_mps)
    truck_mps = draws.between("truck_speed", p.truck_mps)
    late_s = draws.between("truck_offset", p.truck_offset_s)
    spawns = [ego, timed("v2", "truck", "helper", "main left", truck_mps, late_s)]
    for id_, approach in (("v3", "main"), ("v4", "main left")):
        arc = at.other_arc_m + draws.between(f"{id_}_ahead", p.ahead_m)
        speed = draws.between(f"{id_}_speed", p.ahead_mps)
        spawns.append(Spawn(id_, "car", "helper", approach, "straight", arc, speed))
    cars = {
        "danger": ("main", p.danger_share, p.danger_offset_s),
        "left": ("main left", p.left_share, p.danger_offset_s),
        "before": ("main", p.before_share, p.before_offset_s),
        "late": ("main", p.late_share, p.late_offset_s),
    }
    ids = draws.ids(cars)

    def car(name: str) -> Spawn:
        approach, _, offset_s = cars[name]
        speed = draws.between(f"{name}_speed", p.main_mps)
        late_s = draws.between(f"{name}_offset", offset_s)
        return timed(ids[name], "car", "other", approach, speed, late_s)

    spawns += [car(name) for name, (_, share, _) in cars.items() if draws.share(name) < share]
    danger = "main" if draws.share("danger") < p.danger_share else None
    wall = Building("b1", BEGIN_M, WALL_M[0], -draws.between("wall_end", p.wall_end_m), WALL_M[1])
    made = Layout.arranged(spawns, danger, ids["danger"], [wall])
    return Draft(made, (car("danger"),), queue(draws, ids, ego, SEATS_M, SEATS_MPS))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is beyond the merge by `parameters.cleared_m`.

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, is not read. The result is (...).
    """
    return np.asarray(xy_m[..., 0, 0] > parameters.cleared_m)


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={
        "task": "merge from a ramp into the right lane of a road",
        "hiding": "a wall beside the ramp",
    },
    one_sided="the ramp comes from the right",
)
