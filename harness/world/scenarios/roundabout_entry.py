"""Scenario `roundabout-entry`: the ego enters a roundabout past a hedge that hides who is on it.

The ego comes from the south at 8 m/s and enters a roundabout of one lane to go straight on. A hedge on the
splitter island beside it, and a planted mound in the middle, hide who comes round from the left. In most
episodes one vehicle is dangerous: it has come from the west or the north arm, goes on past the ego's arm, and
is timed to be where the ego enters. What matters is where it goes: a car just like it that leaves at the
ego's arm is harmless. Three helpers, one that has just left at the ego's arm, one that has left at the west
arm and one that has just entered ahead of the ego, see parts of the ring. Traffic keeps its lane and speed
and yields to nobody; the ego alone decides.

What the ego can see before it is too late (hedge, mound, helpers, a car that leaves first, a car that comes
later) is drawn without knowing of the danger.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.road import Lane, Path, PathKey, Road, crossings
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import Building

NAME = "roundabout-entry"
LANE_WIDTH_M = 4.0
RING_M = 20.0  # radius of the middle of the ring's lane: 44 m from kerb to kerb, 27 to 55 m are usual
ENTRY_M = 18.0  # radius of the arcs by which cars enter and leave
BESIDE_M = 4.0  # from an arm's centre line to the middle of its lanes, beside the splitter island
ARM_M = 80.0  # length of the straight before and behind the arcs
ARC_Y_M = math.sqrt((RING_M + ENTRY_M) ** 2 - (BESIDE_M + ENTRY_M) ** 2)  # where the south arm's arcs begin
TOUCH_RAD = math.atan2(ARC_Y_M, BESIDE_M + ENTRY_M)  # where on the ring the south entry joins it
ARMS = {"own": 0, "right": 1, "oncoming": 2, "left": 3}  # quarter turns from the south, the way cars go round
SECTORS = ("left", "oncoming")  # the arm that a danger has come from
SECTOR_REACH_M = (8.0, 45.0)  # stretch before the point of entry that is looked at
RING = ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx")  # as in highway-env: entries and exits in order
# Where witnesses are declared, the third lookout is a second car that leaves at the west arm, this far behind
# the first.
SECOND_M = 8.0, 10.0
# Blind seats: slow cars behind the ego, which they never reach; from centre to centre.
SEATS_M = (14.0, 18.0), (9.0, 11.0), (9.0, 11.0)
SEATS_MPS = (1.0, 2.0)
SEEN_AS = {"own": "south", "right": "east", "oncoming": "north", "left": "west"}


@dataclass(frozen=True)
class Parameters(Witnessed):
    """The scenario's own dials. Pairs are bounds of a uniform draw."""

    target_speeds_mps: tuple[float, ...] = (0.0, 4.0, 8.0)
    # speed at the start: 29 km/h, which a circle of 22 m allows (NCHRP 672: 8.76 R^0.386)
    ego_speed_mps: float = 8.0
    ego_start_m: tuple[float, float] = (33.0, 39.0)  # from the start to where the ego's way joins the ring
    danger_share: float = 0.65  # probability that an episode holds a danger
    sector_shares: tuple[float, float] = (0.5, 0.5)  # probability of left, oncoming, given a danger
    # when a danger passes where the ego enters, after a cruising ego would
    danger_offset_s: tuple[float, float] = (0.0, 0.6)
    # speed of everybody on the ring (NCHRP 672: 7.7 m/s for a circle of 20 m)
    ring_mps: tuple[float, float] = (6.8, 7.8)
    # probability, without a danger, of a car in its place that leaves at the ego's arm
    leaver_share: float = 0.6
    before_share: float = 0.4  # probability of a car that leaves there shortly before
    # when that car would pass where the ego enters if it went on
    before_offset_s: tuple[float, float] = (-1.8, -1.3)
    # probability of a car that comes as a danger would, but later than the critical headway of 4.98 s (HCM 7,
    # equation 22-1) allows the ego to be in its way
    late_share: float = 0.4
    # when it passes where the ego enters, after a cruising ego would
    late_offset_s: tuple[float, float] = (5.0, 7.0)
    mound_m: tuple[float, float] = (12.0, 15.0)  # radius of the planted part of the island
    hedge_end_m: tuple[float, float] = (24.0, 32.0)  # from the ring's centre to the end of the hedge
    hedge_half_m: float = 1.5  # half its width; the splitter island is 4 m wide at its narrowest
    # how far behind the ring's edge the helper that left at the ego's arm starts
    helper_south_m: tuple[float, float] = (16.0, 22.0)
    helper_west_m: tuple[float, float] = (6.0, 12.0)  # how far the one that left at the west arm is
    # how far beyond the point of entry the one that entered before the ego is
    helper_ahead_m: tuple[float, float] = (8.0, 14.0)
    helper_mps: tuple[float, float] = (5.5, 7.0)  # speed of helpers


@cache
def network() -> Any:
    """Build a ring with four arms of highway-env's lanes, which meet; its own ring has gaps."""
    from highway_env.road.lane import CircularLane, LineType, StraightLane
    from highway_env.road.road import RoadNetwork

    none, edge = LineType.NONE, LineType.CONTINUOUS
    streets = RoadNetwork()
    for arm, quarters in ARMS.items():
        turn, c = -math.pi / 2 * quarters, SEEN_AS[arm][0]
        rotate = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]).round(12)

        def at(x: float, y: float, rotate: Floats = rotate) -> Floats:
            turned: Floats = rotate @ np.array([x, y])
            return turned

        def arc(side: int, begin: float, end: float, at: Any = at, turn: float = turn) -> Any:
            centre = at(side * (BESIDE_M + ENTRY_M), ARC_Y_M)
            return CircularLane(centre, ENTRY_M, turn + begin, turn + end, True, line_types=(edge, edge))

        far = ARC_Y_M + ARM_M
        way_in = StraightLane(at(BESIDE_M, far), at(BESIDE_M, ARC_Y_M), line_types=(edge, edge))
        way_out = StraightLane(at(-BESIDE_M, ARC_Y_M), at(-BESIDE_M, far), line_types=(edge, edge))
        streets.add_lane(f"{c}er", f"{c}es", way_in)
        streets.add_lane(f"{c}es", f"{c}e", arc(1, math.pi, math.pi + TOUCH_RAD))
        streets.add_lane(f"{c}x", f"{c}xs", arc(-1, -TOUCH_RAD, 0.0))
        streets.add_lane(f"{c}xs", f"{c}xr", way_out)
    for n, (begin, end) in enumerate(zip(RING, RING[1:] + RING[:1], strict=True)):
        start_rad, end_rad = _ring_rad(n), _ring_rad(n + 1)
        lane = CircularLane((0.0, 0.0), RING_M, start_rad, end_rad, False, line_types=(none, edge))
        streets.add_lane(begin, end, lane)
    return streets


def _ring_rad(node: int) -> float:
    """Return the angle of the ring's nth node; angles fall the way cars go round."""
    exits = TOUCH_RAD if node % 2 == 0 else math.pi / 2 - TOUCH_RAD
    return exits - math.pi / 2 * (node // 2)


def _path(approach: str, route: str, begin: str, end: str, priority: int) -> Path:
    """Build the path from the arm of `begin`, by the ring, to the arm of `end` (arms by first letter)."""
    first, last = RING.index(f"{begin}e"), RING.index(f"{end}x")
    nodes = [RING[k % len(RING)] for k in range(first, last + 1 if last > first else last + len(RING) + 1)]
    lanes: list[Lane] = [(f"{begin}er", f"{begin}es", 0), (f"{begin}es", f"{begin}e", 0)]
    lanes += [(a, b, 0) for a, b in pairwise(nodes)]
    lanes += [(f"{end}x", f"{end}xs", 0), (f"{end}xs", f"{end}xr", 0)]
    return Path.along(network(), approach, route, lanes, [_role(lane) for lane in lanes], priority)


def _role(lane: Lane) -> str:
    """Name a lane as the ego sees it."""
    where = {c[0]: arm for arm, c in SEEN_AS.items()}[lane[1][0]]
    if lane[0] in RING and lane[1] in RING:
        return f"ring-{where}"  # before the exit of that arm, or between its exit and its entry
    return f"approach-{where}" if "e" in lane[1] else f"exit-{where}"


@cache
def road() -> Road:
    """Return the roundabout. Its conflict zone is where the ego's way joins the ring."""
    ego = ("own", "straight")
    # Routes are named at the ego's arm: `right` leaves there and shows it, `straight` goes on past it.
    paths = {
        ego: _path(*ego, "s", "n", 0),
        ("own", "left"): _path("own", "left", "s", "w", 0),
        ("left", "straight"): _path("left", "straight", "w", "e", 1),
        ("left", "right"): _path("left", "right", "w", "s", 1),
        ("oncoming", "straight"): _path("oncoming", "straight", "n", "e", 1),
        ("oncoming", "right"): _path("oncoming", "right", "n", "s", 1),
    }
    meetings = crossings(paths, ego)
    at = meetings["left", "straight"]
    back_m = np.linspace(*SECTOR_REACH_M, 15)
    watched = {
        sector: paths[sector, "straight"].points_at(meetings[sector, "straight"].other_arc_m - back_m)
        for sector in SECTORS
    }
    return Road(
        facts={"kind": "roundabout", "lane_width_m": LANE_WIDTH_M, "ring_m": RING_M, "ego": "/".join(ego)},
        paths=paths,
        ego=ego,
        crossings=meetings,
        zone_m=(at.x_m, at.y_m),
        sectors=watched,
        network=network,
    )


def layout(seed: int, parameters: Parameters) -> Layout:
    """Draw one episode."""
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    paths, meetings = road().paths, road().crossings

    def arm(what: str) -> str:
        return SECTORS[int(draws.share(what) >= p.sector_shares[0])]

    start, ring_mps = draws.between("ego_start", p.ego_start_m), draws.between("ring_speed", p.ring_mps)

    def helper(id_: str, key: PathKey, begin_m: float, what: str, beyond_m: tuple[float, float]) -> Spawn:
        arc = begin_m + draws.between(f"helper_{what}", beyond_m)
        return Spawn(id_, "car", "helper", *key, arc, draws.between(f"helper_{what}_speed", p.helper_mps))

    leaves, crosses, enters = ("oncoming", "right"), ("own", "left"), ("own", "straight")
    spawns = [
        Spawn("v1", "car", "ego", *enters, road().zone_arc_m - start, p.ego_speed_mps),
        helper("v2", leaves, paths[leaves].ends_m[-2], "south", p.helper_south_m),
        helper("v3", crosses, paths[crosses].ends_m[-2], "west", p.helper_west_m),
        helper("v4", enters, road().zone_arc_m, "ahead", p.helper_ahead_m),
    ]
    if draws.seats:
        second = spawns[2].arc_m - draws.between("second", SECOND_M)
        spawns[3] = replace(spawns[2], id="v4", arc_m=second)

    def car(name: str, sector: str, route: str, bounds: tuple[float, float]) -> Spawn:
        """Return a car that is, or would be, where the ego enters so long after a cruising ego."""
        late_s = draws.between(f"{name}_offset", bounds)
        arc = meetings[sector, "straight"].other_arc_m - ring_mps * (start / p.ego_speed_mps + late_s)
        return Spawn(ids[name], "car", "other", sector, route, arc, ring_mps)

    ids = draws.ids(("round", "before", "late"))
    danger = arm("sector") if draws.share("danger") < p.danger_share else None
    phantoms = {sector: car("round", sector, "straight", p.danger_offset_s) for sector in SECTORS}
    if danger:
        spawns.append(phantoms[danger])
    elif draws.share("leaver") < p.leaver_share:
        spawns.append(car("round", arm("sector"), "right", p.danger_offset_s))
    if draws.share("before") < p.before_share:
        spawns.append(car("before", arm("before_sector"), "right", p.before_offset_s))
    if draws.share("late") < p.late_share:
        spawns.append(car("late", arm("late_sector"), "straight", p.late_offset_s))

    half, mound = p.hedge_half_m, draws.between("mound", p.mound_m)
    boxes = [(-half, draws.between("hedge_end", p.hedge_end_m), half, ARC_Y_M + ARM_M)]
    for degrees in (22.5, 45.0, 67.5):  # three boxes whose corners lie on a circle
        x, y = mound * math.cos(math.radians(degrees)), mound * math.sin(math.radians(degrees))
        boxes.append((-x, -y, x, y))
    buildings = [Building(f"b{n}", *box) for n, box in enumerate(boxes, 1)]
    made = Layout.arranged(spawns, danger, ids["round"], buildings)
    return Draft(made, (*phantoms.values(),), queue(draws, ids, spawns[0], SEATS_M, SEATS_MPS))


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is past the first exit behind its entry."""
    x, y = xy_m[..., 0, 0], xy_m[..., 0, 1]
    return np.asarray((x > 0) & (np.arctan2(y, x) < _ring_rad(1)))


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={"task": "enter a roundabout and go straight on", "hiding": "a hedge and a planted island"},
    one_sided="traffic goes round one way and comes from the left",
)
