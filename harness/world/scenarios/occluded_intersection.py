"""Scenario `occluded-intersection`: the ego crosses where buildings and a truck hide what comes.

The ego comes from the south at 14 m/s and goes straight. Buildings on the four corners hide the
crossing road, and a truck that comes towards the ego hides what follows it. At most one vehicle is
dangerous: timed to meet a cruising ego at the conflict point, from the left, from the right, or
oncoming and turning left across the ego's path right behind the truck. Three helpers have just left
the junction on the three other arms and see what comes towards it there. Traffic keeps its lane and
speed and yields to nobody; the ego alone decides.

What the ego can see before it is too late (buildings, helpers, the truck, a car that passes later)
is drawn without knowing of the danger. Where the two would touch, the danger gives way: it comes
later.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.core.arrays import Bools, Floats, Texts
from harness.world.crossroads import JUNCTION_M, SECTORS, road
from harness.world.lookouts import Draft, placed, queue
from harness.world.parameters import WITNESSED, Witnessed
from harness.world.scenario import Draws, Layout, Scenario, Spawn
from harness.world.state import SIZES_M, Building, Kind

NAME = "occluded-intersection"
BUILDING_END_M = 70.0  # outer walls, from the centre lines
# of what comes from a sector
ROUTES = {"left": "straight", "right": "straight", "oncoming": "left"}
# Where witnesses are declared, the lookouts are still in the junction, m behind its end, to see
# every arm.
LOOKOUTS_M = -5.0, -1.0
# Blind seats: slow cars behind the ego, which they never reach; from centre to centre.
SEATS_M = (17.0, 20.0), (8.5, 10.0), (8.5, 10.0)
SEATS_MPS = (2.0, 3.5)
SPARE_S = 0.15  # more than rounding, between the truck's tail and a car that crosses behind it


@dataclass(frozen=True)
class Parameters(Witnessed):
    """Hold the settings of `occluded-intersection`: the ego crosses where buildings hide traffic.

    Numbers end in their unit (`_m`, `_mps`, `_s`), and a `_share` is a probability. A pair of
    numbers bounds a uniform draw, made anew for each layout, the start situation of an episode.
    `sector_shares` are probabilities of the directions that a danger comes from: left, right,
    oncoming. An `_offset_s` is when a vehicle is at the place where both meet, in s after a
    cruising ego, one that keeps its speed. A danger is the vehicle that would meet that ego.

    The ego starts `ego_start_m` before the conflict zone and has reached its goal `cleared_m`
    behind the junction. Cars from a side drive at `crossing_speed_mps`, a danger or a harmless one
    that comes later (`late_`); a truck comes towards the ego (`truck_`), an oncoming danger
    `follow_m` behind it. Buildings stand `corner_m` from the roads' middle. Helpers start
    `helper_start_m` behind the junction.
    """

    # seconds after which an ego that has not cleared the intersection never will
    time_limit_s: float = 10.0
    # seconds later than the full-view driver at which an ego may still clear the intersection. A
    # needless SLOWER costs about 0.65 s: one is forgiven, two are not
    delay_allowance_s: float = 1.0
    ego_speed_mps: float = 14.0  # speed of the ego at the start, m/s
    # distance of the ego's start to the centroid of the conflict zone, m
    ego_start_m: tuple[float, float] = (61.0, 69.0)
    # distance of the ego's centre behind the junction's exit at which it has reached its goal, m
    cleared_m: float = 2.5
    danger_share: float = 0.75  # probability that an episode holds a danger
    # probability that a danger comes from the left, from the right, oncoming (`mechanism`:
    # .40/.27/.33)
    sector_shares: tuple[float, float, float] = (0.40, 0.27, 0.33)
    # seconds at which a danger from a side is at the conflict point, after a cruising ego would be;
    # as soon as the truck has passed, if that is later
    danger_offset_s: tuple[float, float] = (-0.4, 0.9)
    # speed of a car from a side, dangerous or not, m/s
    crossing_speed_mps: tuple[float, float] = (8.5, 12.5)
    # seconds at which the oncoming truck passes where an oncoming danger would meet the ego, after
    # a cruising ego would
    truck_offset_s: tuple[float, float] = (-2.3, -1.9)
    # speed of the truck, and of an oncoming car, dangerous or not, m/s
    truck_speed_mps: tuple[float, float] = (7.5, 8.5)
    # distance of the truck's centre to that of an oncoming danger behind it, m
    follow_m: tuple[float, float] = (10.5, 13.0)
    # distance of a building's walls from the centre lines of the roads, m
    corner_m: tuple[float, float] = (8.0, 15.0)
    # probability of a harmless car that comes as a danger would, from any sector, but later
    late_share: float = 0.4
    # seconds at which that harmless car is at the conflict point, after a cruising ego would be
    late_offset_s: tuple[float, float] = (4.0, 7.0)
    # how far behind the junction helpers are at the start, m
    helper_start_m: tuple[float, float] = (2.0, 8.0)
    helper_speed_mps: tuple[float, float] = (4.0, 7.0)  # speed at which helpers leave, m/s


def layout(seed: int, parameters: Parameters) -> Layout:
    """Return the layout that a seed draws: the ego, three helpers, a truck and buildings.

    A layout is the start situation of an episode. A danger, with probability `danger_share`, is a
    car in time to meet an ego that keeps its speed. The layout is the same for equal seeds and
    `parameters`.
    """
    return placed(SCENARIO, _draft, seed, parameters)


def _draft(draws: Draws, p: Parameters) -> Draft:
    """Draw where everybody starts, with a danger or without."""
    paths, crossings = road().paths, road().crossings

    danger = None
    if draws.share("danger") < p.danger_share:
        drawn = int(np.searchsorted(np.cumsum(p.sector_shares)[:2], draws.share("sector")))
        danger = SECTORS[drawn]

    start = draws.between("ego_start", p.ego_start_m)
    # The centroid of the conflict zone lies 1.46 m before the ego's farthest conflict point.
    ego_arc = crossings["right", "straight"].ego_arc_m - 1.46 - start

    def timed(approach: str, speed: float, late: float) -> float:
        """Return the arc from which a vehicle is at its conflict point `late` s after a cruising
        ego.
        """
        at = crossings[approach, ROUTES[approach]]
        return at.other_arc_m - speed * ((at.ego_arc_m - ego_arc) / p.ego_speed_mps + late)

    truck_speed = draws.between("truck_speed", p.truck_speed_mps)
    truck_arc = timed("oncoming", truck_speed, draws.between("truck_offset", p.truck_offset_s))
    traffic: dict[str, tuple[Kind, str, str, float, float]] = {
        "truck": ("truck", "oncoming", "straight", truck_arc, truck_speed)
    }

    def coming(sector: str) -> tuple[Kind, str, str, float, float]:
        """Return the danger of a sector."""
        route = ROUTES[sector]
        if sector == "oncoming":
            return (
                "car",
                sector,
                route,
                truck_arc - draws.between("follow", p.follow_m),
                truck_speed,
            )
        speed = draws.between("crossing_speed", p.crossing_speed_mps)
        ego_s = (crossings[sector, route].ego_arc_m - ego_arc) / p.ego_speed_mps
        soonest, latest = p.danger_offset_s
        soonest = max(soonest, behind_truck_s(sector, speed, truck_arc, truck_speed) - ego_s)
        offset = draws.between("danger_offset", (soonest, max(soonest, latest)))
        return "car", sector, route, timed(sector, speed, offset), speed

    if danger:
        traffic["danger"] = coming(danger)
    if draws.share("late") < p.late_share:
        arm = SECTORS[int(draws.share("late_sector") * len(SECTORS))]
        speeds_mps = p.truck_speed_mps if arm == "oncoming" else p.crossing_speed_mps
        speed = draws.between("late_speed", speeds_mps)
        arc = timed(arm, speed, draws.between("late_offset", p.late_offset_s))
        traffic["late"] = ("car", arm, ROUTES[arm], arc, speed)

    spawns = [Spawn("v1", "car", "ego", "own", "straight", ego_arc, p.ego_speed_mps)]
    start_m = LOOKOUTS_M if draws.seats else p.helper_start_m
    ways = (("right", "left"), ("left", "right"), ("own", "ahead"))
    for n, (approach, exit_name) in enumerate(ways):
        arc = paths[approach, "straight"].ends_m[1]
        arc += draws.between(f"helper_start_{exit_name}", start_m)
        if exit_name == "ahead" and not draws.seats:
            arc += 4.0  # stays clear of the ego that follows it out of the junction
        speed = draws.between(f"helper_speed_{exit_name}", p.helper_speed_mps)
        spawns.append(Spawn(f"v{n + 2}", "car", "helper", approach, "straight", arc, speed))

    ids = draws.ids(("danger", "truck", "late"))

    def other(name: str, kind: Kind, *way: Any) -> Spawn:
        return Spawn(ids[name], kind, "other", *way)

    spawns += [other(name, *vehicle) for name, vehicle in traffic.items()]

    buildings = []
    for n, (east, south) in enumerate(((-1, 1), (1, 1), (-1, -1), (1, -1))):
        xs = sorted((east * draws.between(f"corner_{n}_x", p.corner_m), east * BUILDING_END_M))
        ys = sorted((south * draws.between(f"corner_{n}_y", p.corner_m), south * BUILDING_END_M))
        buildings.append(Building(f"b{n + 1}", xs[0], ys[0], xs[1], ys[1]))
    made = Layout.arranged(spawns, danger, ids["danger"], buildings)
    phantoms = tuple(other("danger", *coming(sector)) for sector in SECTORS)
    return Draft(made, phantoms, queue(draws, ids, spawns[0], SEATS_M, SEATS_MPS))


def behind_truck_s(approach: str, speed_mps: float, truck_arc_m: float, truck_mps: float) -> float:
    """Return the earliest time (s from the start) at which a crossing car can follow the truck.

    It is when the car, from the side `approach` (`left` or `right`) at `speed_mps`, would be at its
    conflict point with the ego if it just does not touch the truck, which starts at `truck_arc_m`
    (m) of its path and keeps `truck_mps`.
    """
    at = road().crossings[approach, "straight"]
    truck, car = road().paths["oncoming", "straight"], road().paths[approach, "straight"]
    where = truck.points[0, 0], at.y_m
    truck_s = (truck.project(*where)[0] - truck_arc_m) / truck_mps
    (car_length, car_width), (truck_length, truck_width) = SIZES_M["car"], SIZES_M["truck"]
    of_car_s = (car_length + truck_width) / 2 / speed_mps
    of_truck_s = (truck_length + car_width) / 2 / truck_mps
    to_conflict_s = (at.other_arc_m - car.project(*where)[0]) / speed_mps
    return truck_s + (of_car_s + of_truck_s) + SPARE_S + to_conflict_s


def cleared(xy_m: Floats, approaches: Texts, parameters: Parameters) -> Bools:
    """Return whether the ego is behind the junction by `parameters.cleared_m`.

    `xy_m`, (..., V, 2), are the centres of the V vehicles of each of any number of episodes at one
    moment, m in highway-env's frame, the ego first. `approaches`, (..., V), where their paths come
    from, is not read. The result is (...).
    """
    return np.asarray(JUNCTION_M + parameters.cleared_m <= -xy_m[..., 0, 1])


SCENARIO = Scenario(
    name=NAME,
    description=__doc__,
    actions=("SLOWER", "IDLE", "FASTER"),
    parameters=Parameters(),
    road=road,
    layout=layout,
    cleared=cleared,
    dials=WITNESSED,
    words={"task": "go straight over an intersection", "hiding": "buildings and trucks"},
    prompt="v2",
    one_sided=None,  # nobody has right of way, so that times decide and sides do not
)
