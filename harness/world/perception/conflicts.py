"""Which path each known vehicle seems to follow, and where it conflicts with the ego.

The vehicles that many viewers know are laid on the road in one pass over arrays.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec import UNSET, Struct

from harness.core.arrays import Floats
from harness.world.perception.sensors import Detection
from harness.world.road import ONE_LANE_M, PathKey, Road
from harness.world.scene_graph import Arrival, Conflict, EgoArrival, Meeting, Point
from harness.world.state import SIZES_M, VehicleState, indicator

ON_PATH_M = 2.2  # farther from a path than this, an object is not on it
ALIKE = 0.05  # tolerance of costs: paths that share a lane differ by rounding only
STANDING_MPS = 0.5  # a lower speed is taken for sensor noise
ALIGNED_RAD = np.radians(40.0)  # more turned from a path than this, an object does not follow it
ALIGNED = float(np.cos(ALIGNED_RAD))


class Seat(Struct, frozen=True):
    """Hold the pose of a viewer, from which positions are converted into its frame.

    Its centre is at `x_m` and `y_m`, m to the east and south of the road's origin; `cos` and `sin`
    are of its heading, from +x (east) towards +y (south).
    """

    x_m: float  # position of its centre, m to the east of the road's origin
    y_m: float  # position of its centre, m to the south
    cos: float  # cosine of its heading
    sin: float  # sine of its heading

    def relative(self, x_m: float, y_m: float) -> Point:
        """Return a position as the viewer sees it: m forward and to the left of its centre.

        `x_m` and `y_m` are the position, m to the east and south of the road's origin. The result
        is rounded to 0.1 m.
        """
        dx, dy = x_m - self.x_m, y_m - self.y_m
        return Point(tenths(dx * self.cos + dy * self.sin), tenths(dx * self.sin - dy * self.cos))


class Place(Struct, frozen=True):
    """Describe where on the road's paths a vehicle is.

    A path's key is (approach, route): where it comes from and what it does. `near` has, for each
    path near the vehicle, the distance along it (m) and its heading there (rad). `key` is that of
    the path which the vehicle seems to follow, None if none.
    """

    # arc length, and heading there, on each path to which it is nearer than ON_PATH_M
    near: Mapping[PathKey, tuple[float, float]]
    key: PathKey | None  # the path that it seems to follow; None if none

    @property
    def arc_m(self) -> float:
        """Return how far along the path that it follows the vehicle is, m. It must follow one."""
        assert self.key is not None
        return self.near[self.key][0]


class Encounter(Struct, frozen=True):
    """Pair another vehicle with the ego, both as one viewer knows them.

    A viewer is the vehicle whose scene graph, what it knows, is made. `seat` is the viewer's pose,
    `d` the other vehicle as its sensors report it and `place` where that is on the road: it follows
    a path. `ego` is the ego, `ego_arc_m` how far along its path it is, m, and `has_lamps` whether
    the scenario's vehicles have brake lamps.
    """

    seat: Seat  # the viewer's pose
    d: Detection  # the other vehicle
    place: Place  # where the other vehicle is on the road; it follows a path
    ego: VehicleState  # the ego, as the viewer knows it
    ego_arc_m: float  # how far along its path the ego is, m
    has_lamps: bool  # whether the scenario's vehicles have brake lamps

    def arrival(self, arc_m: float, time_s: float | None) -> Arrival:
        """Return when the other vehicle comes to the point where it may meet the ego.

        `arc_m` is how far it has to go, m, and `time_s` how long at its speed, s, None at a
        standstill. The record, part of what a viewer knows, has its speed and brake lamps, too.
        """
        braking = self.d.braking if self.has_lamps else UNSET
        return Arrival(tenths(arc_m), time_s, tenths(self.d.speed_mps), braking)

    @property
    def key(self) -> PathKey:
        """Return which path the other vehicle follows, as its key (approach, route)."""
        assert self.place.key is not None
        return self.place.key

    @property
    def ego_key(self) -> PathKey:
        """Return which path the ego follows, as its key (approach, route)."""
        return self.ego.approach, self.ego.route


def tenths(value: float) -> float:
    """Round a number to one decimal, as scene graphs have it, with 0.0 in place of -0.0."""
    return round(float(value), 1) + 0.0


def places(road: Road, detections: Sequence[Detection]) -> list[Place]:
    """Return where each detected vehicle is on the road, and which path it seems to follow.

    For each of `detections` it has the paths near it, with the distance along each, and the nearest
    path that fits its heading and turn indicator; of equally good ones, the first of the road.
    """
    poses = []
    for d in detections:
        poses.append((d.x_m, d.y_m, np.nan if d.heading_rad is None else d.heading_rad))
    x, y, vehicle_heading = np.array(poses).reshape(-1, 3).T
    # (3, n, paths)
    projected = np.stack([path.project_all(x, y) for path in road.paths.values()], axis=-1)
    thing, path = np.nonzero(projected[1] <= ON_PATH_M)
    arc, lateral, heading = projected[:, thing, path]
    cos = np.cos(vehicle_heading[thing] - heading)
    keys = list(road.paths)
    near: list[dict[PathKey, tuple[float, float]]] = [{} for _ in detections]
    best: list[tuple[float, PathKey] | None] = [None] * len(detections)
    alike = ALIKE if road.form == 2 else 0.0
    columns = [column.tolist() for column in (thing, path, arc, lateral, heading, cos)]
    for n, p, arc_m, lateral_m, to_rad, turned in zip(*columns, strict=True):
        key, d = keys[p], detections[n]
        near[n][key] = arc_m, to_rad
        if d.heading_rad is None:
            turned = 0.0
        elif turned < ALIGNED:
            continue
        # Routes that part later fit equally well until then, so the indicator decides.
        forks = (key, road.paths[key].section(arc_m)) in road.forks
        unlikely = forks and indicator(key[1]) != (d.indicator or "off")
        cost = lateral_m + (1.0 - turned) * 10.0 + (1.0 if unlikely else 0.0)
        least = best[n]
        if lateral_m < ON_PATH_M and (least is None or cost < least[0] - alike):
            best[n] = cost, key
    return [Place(on, fit and fit[1]) for on, fit in zip(near, best, strict=True)]


def conflicts(road: Road, encounters: Sequence[Encounter]) -> list[list[Conflict]]:
    """Return, for each encounter, the conflicts of its vehicle with the ego's paths.

    An encounter pairs another vehicle with the ego. A conflict is where both meet: their paths
    cross or merge, or both are in one lane, which the ego is on or may change to. `road` has the
    paths.
    """
    conflicts_of: list[list[Conflict]] = [[] for _ in encounters]
    if road.form == 2:
        for n, conflict in _along(road, encounters):
            conflicts_of[n].append(conflict)
    for n, encounter in enumerate(encounters):
        # Who comes on a path of its own through a lane that both share has one place to meet, the
        # crossing.
        if all(conflict.kind == "oncoming" for conflict in conflicts_of[n]):
            meeting = _meeting(road, encounter)
            if meeting:
                conflicts_of[n] = [meeting]
    return conflicts_of


def _meeting(road: Road, encounter: Encounter) -> Conflict | None:
    """Return the conflict where another's path crosses or merges into the ego's;
    None if one is past it.
    """
    crossing = road.crossings.get(encounter.key)
    if crossing is None:
        return None
    d, ego = encounter.d, encounter.ego
    length = SIZES_M[d.kind or "car"][0]
    if (
        road.ways
        and road.paths[encounter.ego_key].project(crossing.x_m, crossing.y_m)[1] > ON_PATH_M
    ):
        return None  # it meets another of the ego's ways
    to_go = crossing.other_arc_m - encounter.place.arc_m
    ego_to_go = crossing.ego_arc_m - encounter.ego_arc_m
    if to_go < -length / 2 - ego.width_m or ego_to_go < -ego.length_m:
        return None
    kind_and_lane = (crossing.kind, "own") if road.form == 2 else ()
    return Conflict(
        d.id,
        *encounter.key,
        encounter.seat.relative(crossing.x_m, crossing.y_m),
        EgoArrival(tenths(ego_to_go), _time_s(ego_to_go, ego.speed_mps)),
        encounter.arrival(to_go, _time_s(to_go, d.speed_mps)),
        *kind_and_lane,
    )


def _time_s(to_go_m: float, speed_mps: float) -> float | None:
    """Return when a conflict is reached, negative once past; None at a standstill."""
    return tenths(to_go_m / speed_mps) if speed_mps > STANDING_MPS else None


def _along(road: Road, encounters: Sequence[Encounter]) -> Iterator[tuple[int, Conflict]]:
    """Yield the conflicts in a lane that both share or the ego may change to, at present speeds.

    Each comes after the number of its vehicle. Of two vehicles in a row only the one behind has a
    distance to go; of two that meet head-on, both have.
    """
    shared = []
    for n, encounter in enumerate(encounters):
        ways = road.beside(encounter.ego_key).items()
        shared += [(n, side, key) for side, key in ways if key in encounter.place.near]
    apart = _apart(road, [(encounters[n], key) for n, _, key in shared])
    its_arcs = [(encounter.key, encounter.place.arc_m) for encounter in encounters]
    its_heading = _at(road, its_arcs)[:, 2]
    numbers = [n for n, _, _ in shared]
    on = np.array([encounters[n].place.near[key] for n, _, key in shared]).reshape(-1, 2)
    cos = np.cos(its_heading[numbers] - on[:, 1]).tolist()
    pairs = []
    for (n, side, key), separate, turned in zip(shared, apart, cos, strict=True):
        encounter = encounters[n]
        gap = encounter.place.near[key][0] - encounter.ego_arc_m
        if (side != "own" and not separate) or abs(turned) < ALIGNED or (turned < 0 and gap < 0):
            continue
        d, ego_mps = encounter.d, encounter.ego.speed_mps
        its_mps = d.speed_mps if turned > 0 else -d.speed_mps
        kind: Meeting = "oncoming" if turned < 0 else "ahead" if gap > 0 else "behind"
        if kind == "behind" and d.speed_mps <= STANDING_MPS:
            continue  # what is parked behind the ego never meets it
        closing_mps = (ego_mps - its_mps) * (1 if gap > 0 else -1)
        share = {"ahead": 1.0, "behind": 0.0, "oncoming": ego_mps / max(closing_mps, 0.1)}[kind]
        time_s = tenths(abs(gap) / closing_mps) if closing_mps > 0.5 else None
        pairs.append((n, side, key, kind, gap, share, time_s))
    arcs = []
    for n, _, key, _, gap, share, _ in pairs:
        arcs.append((key, encounters[n].ego_arc_m + max(gap, 0.0) * share))
    points = _at(road, arcs).tolist()
    for (n, side, _, kind, gap, share, time_s), (x, y, _) in zip(pairs, points, strict=True):
        encounter = encounters[n]
        conflict = Conflict(
            encounter.d.id,
            *encounter.key,
            encounter.seat.relative(x, y),
            EgoArrival(tenths(abs(gap) * share), time_s),
            encounter.arrival(abs(gap) * (1 - share), time_s),
            kind,
            side,
        )
        yield n, conflict


def _apart(road: Road, shared: Sequence[tuple[Encounter, PathKey]]) -> list[bool]:
    """Return whether each way is in another lane than the ego's where the vehicle is."""
    positions = [(encounter.d.x_m, encounter.d.y_m) for encounter, _ in shared]
    x, y = np.array(positions).reshape(-1, 2).T
    ego_keys = [encounter.ego_key for encounter, _ in shared]
    at = _at(road, list(zip(ego_keys, road.project(ego_keys, x, y)[0].tolist(), strict=True)))
    ways = [key for _, key in shared]
    apart: list[bool] = (road.project(ways, at[:, 0], at[:, 1])[1] > ONE_LANE_M).tolist()
    return apart


def _at(road: Road, path_arcs: Sequence[tuple[PathKey, float]]) -> Floats:
    """Return x, y and heading at each of n arc lengths (m) along a path, (n, 3)."""
    poses, places = np.empty((len(path_arcs), 3)), defaultdict[PathKey, list[int]](list)
    for n, (key, _) in enumerate(path_arcs):
        places[key].append(n)
    for key, numbers in places.items():
        poses[numbers] = np.stack(
            road.paths[key].places(np.array([path_arcs[n][1] for n in numbers])), axis=-1
        )
    return poses
