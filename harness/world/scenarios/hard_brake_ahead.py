"""Scenario `hard-brake-ahead`: a car brakes hard beyond the van that the ego follows.

The ego follows a van on the right lane of a motorway at a short headway; the van hides the car
before it. In most episodes that car brakes until it stands. The van brakes late and hard, and only
then does the ego see that anything is wrong. A car beside the ego keeps it from swerving: who knows
early drops back, changes lane behind that car and passes. Three helpers know more than the ego: the
van, which sees the car before it, the car beside, and one farther ahead on the left lane.

This is the emergency electronic brake light of V2V (EEBL). Traffic keeps its lane, and its speed
unless it would run into the vehicle ahead in its lane; its brake lamps show, to whom a camera sees.

What the ego can see (van, headway, cars on the left) is drawn without knowing of the danger. So is
a car on the left lane, far ahead, which slows down in some episodes and concerns nobody on the
right.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import Road, paths_along
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import SIZES_M, Kind

NAME = "hard-brake-ahead"
LANE_WIDTH_M = 4.0
BEGIN_M, END_M = -150.0, 350.0  # of the motorway, to the east
ZONE_M = 18.0  # the conflict zone, where a car that brakes hard comes to stand
LEFT, RIGHT = "left lane", "right lane"
# Blind seats: cars behind the ego that have just begun to drive on, too slow to reach it wherever
# it stops; from centre to centre.
SEATS_M = (42.0, 46.0), (11.0, 14.0), (11.0, 14.0)
SEATS_MPS = (3.0, 4.5)


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `hard-brake-ahead`: a car brakes beyond the van that the ego follows.

    Numbers end in their unit (`_m`, `_mps`, `_mps2`, `_s`), and a `_share` is a probability. A pair
    of numbers bounds a uniform draw, made anew for each layout, the start situation of an episode.
    A headway is in s between bumpers, and an `_at_s` in s from the start. A danger is the vehicle
    that would meet an ego which keeps its speed: here the car that brakes.

    All start at `speed_mps`, the ego `ego_start_m` before the conflict zone, where the danger comes
    to stand; `cleared_m` behind it is the goal. `headway_s` is from the ego to the van and
    `lead_headway_s` from the van to the danger. On the left lane, so far ahead of the ego, are
    helpers (`beside_m`, `front_m`) and, farthest, a car that may slow down (`slow_`, `slows_`).
    """

    # speeds that the ego's actions step through, m/s: 72 km/h, half of it, and standing
    target_speeds_mps: tuple[float, ...] = (0.0, 10.0, 20.0)
    # seconds after which an ego that has not reached its goal has failed
    time_limit_s: float = 14.0
    # seconds later than the full-view driver at which an ego may still reach its goal
    delay_allowance_s: float = 1.0
    # speed of everybody at the start, m/s: motorway traffic that has come close together
    speed_mps: float = 20.0
    # where the ego starts, m before the conflict zone
    ego_start_m: tuple[float, float] = (88.0, 92.0)
    # distance behind the conflict zone at which the ego has reached its goal, m
    cleared_m: float = 45.0
    danger_share: float = 0.65  # probability of a danger: that the car beyond the van brakes
    # seconds from the ego to the van, bumper to bumper. Below 1 s, half of a motorway's drivers in
    # dense traffic; at 1.5 s the van's own lamps come in time, and no message is needed
    headway_s: tuple[float, float] = (0.55, 0.75)
    # seconds from the van to the car beyond it, bumper to bumper: from 1.7 s on the van, which
    # brakes late, does not crash itself
    lead_headway_s: tuple[float, float] = (1.7, 2.0)
    # seconds from the start until the car beyond the van begins to brake
    brakes_at_s: tuple[float, float] = (0.1, 1.4)
    # how hard it brakes, m/s2: an emergency, 6 to 9 m/s2 (SUMO's defaults; NHTSA DOT HS 811 731:
    # above 0.6 g)
    brakes_mps2: tuple[float, float] = (6.0, 8.0)
    # how far ahead of the ego's middle the helper car beside it is, on the left lane, m
    beside_m: tuple[float, float] = (-3.0, 4.0)
    # how far ahead of the ego the other helper on the left lane is, m
    front_m: tuple[float, float] = (48.0, 60.0)
    slow_share: float = 0.4  # probability that the farthest car on the left lane slows down
    slow_m: tuple[float, float] = (85.0, 100.0)  # how far ahead of the ego that farthest car is, m
    # seconds from the start until that farthest car begins to slow down
    slows_at_s: tuple[float, float] = (0.5, 2.5)
    slows_to_mps: tuple[float, float] = (14.0, 16.0)  # speed down to which it slows, m/s


@cache
def road() -> Road:
    """Return the motorway of two lanes to the east as a `Road`, with the ego on the right one.

    The conflict zone is where a car that brakes hard comes to stand.
    """
    lanes = {RIGHT: ("0", "1", 1), LEFT: ("0", "1", 0)}
    paths = paths_along(
        network(), {("own", name): ([lane], [name], 0) for name, lane in lanes.items()}
    )
    ahead = ZONE_M + np.linspace(-60.0, 40.0, 11)
    return Road(
        facts={"kind": "motorway of two lanes", "lane_width_m": LANE_WIDTH_M},
        paths=paths,
        ego=("own", RIGHT),
        crossings={},
        zone_m=(ZONE_M, LANE_WIDTH_M),
        sectors={
            "ahead": np.column_stack([ahead, np.full(11, LANE_WIDTH_M)]),
            "left ahead": np.column_stack([ahead, np.zeros(11)]),
        },
        network=network,
        ways=(("own", LEFT), ("own", RIGHT)),
    )


@cache
def network() -> Any:
    """Return the road network of highway-env's `HighwayEnv`, straight and with two lanes.

    It is a `highway_env.road.road.RoadNetwork`.
    """
    from harness.world.highway import RoadNetwork

    return RoadNetwork.straight_road_network(2, start=BEGIN_M, length=END_M - BEGIN_M)


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego behind a van, and who else is on the motorway.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is the
    car beyond the van, which brakes; three helpers, the van among them, know more. The layout is
    the same for equal seeds and `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""

    def spawn(id_: str, kind: Kind, part: Any, lane: str, arc_m: float, *brakes: float) -> Spawn:
        return Spawn(id_, kind, part, "own", lane, arc_m, p.speed_mps, *brakes)

    car, van = SIZES_M["car"][0], SIZES_M["van"][0]
    ego = ZONE_M - BEGIN_M - draws.between("ego_start", p.ego_start_m)
    before = ego + (car + van) / 2 + p.speed_mps * draws.between("headway", p.headway_s)
    leader = (
        before + (car + van) / 2 + p.speed_mps * draws.between("lead_headway", p.lead_headway_s)
    )
    danger = draws.share("danger") < p.danger_share
    slows = draws.share("slow") < p.slow_share
    brakes = draws.between("brakes_at", p.brakes_at_s), draws.between("brakes", p.brakes_mps2)
    eases = draws.between("slows_at", p.slows_at_s), 2.0, draws.between("slows_to", p.slows_to_mps)
    beside, front, slow = (
        ego + draws.between(what, bounds)
        for what, bounds in (("beside", p.beside_m), ("front", p.front_m), ("slow_m", p.slow_m))
    )
    spawns = [
        spawn("v1", "car", "ego", RIGHT, ego),
        spawn("v2", "van", "helper", RIGHT, before),
        spawn("v3", "car", "helper", LEFT, beside),
        spawn("v4", "car", "helper", LEFT, front),
        spawn("v5", "car", "other", RIGHT, leader, *(brakes if danger else ())),
        spawn("v6", "car", "other", LEFT, slow, *(eases if slows else ())),
    ]
    made = Layout.arranged(spawns, "ahead" if danger else None, "v5")
    ids = dict(zip(draws.seats, ("v7", "v8", "v9"), strict=False))
    return Draft(made, (spawns[4],), queue(draws, ids, spawns[0], SEATS_M, SEATS_MPS))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is behind the conflict zone by `parameters.cleared_m`.

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, is not read. The result is (...).
    """
    return np.asarray(xy_m[..., 0, 0] > ZONE_M + parameters.cleared_m)


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER", "LANE_LEFT", "LANE_RIGHT"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={"task": "drive on along a motorway", "hiding": "the van ahead"},
    brake_lamps=True,
    one_sided="traffic keeps to the right lane and passes on the left",
)
