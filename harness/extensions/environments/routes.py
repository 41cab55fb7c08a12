"""Derive the paths of any road network of highway-env: every route through it, on every lane.

A road is named by its two nodes. A route is a chain of consecutive roads, from one without a
predecessor to one without a successor. A path keeps to one lane as long as there is one.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np

from harness.core.errors import UserError, printable
from harness.world.road import Lane, Path, PathKey

Street = tuple[str, str]  # the two nodes of a road
Route = tuple[Street, ...]
# a lane that begins farther from another's end does not continue it; lanes are 4 m wide
GAP_M = 6.0
TURN_RAD = math.radians(60.0)  # nor does a lane that is turned by more than this
MOST_ROUTES = 200
TURNS = ("straight", "right", "back", "left")  # in quarters of a turn to the right


@dataclass(frozen=True)
class Routes:
    """Hold all paths through a road network of highway-env: the lines that vehicles can follow.

    A road joins two nodes of the `network` and has one or more lanes. A route is the roads that a
    path takes, one after another; it has several parallel paths where its roads have several lanes
    (`ways`, from left to right). The key of a path is the node where it begins, and a name that
    says where it goes and, of parallel ones, on which lane.
    """

    network: Any  # highway-env's `RoadNetwork`
    paths: dict[PathKey, Path]  # every path by its key
    ways: dict[Route, tuple[PathKey, ...]]  # the paths of each route from left to right

    def ahead(self, lane: Lane, plan: Sequence[Lane] | None) -> Route:
        """Return the roads that a vehicle will take, from its present one on, as two nodes each.

        `lane` is where it is: the two nodes of its road, and a number from the left, from 0. At
        each node it follows highway-env's rule for the next lane. `plan` has the lanes that
        highway-env planned for the vehicle, as such triples, or is None.
        """
        streets, plan = [lane[:2]], list(plan or ())
        while lane[1] in self.network.graph:
            end = self.network.get_lane(lane)
            try:
                follows = self.network.next_lane(lane, plan, end.position(end.length, 0.0))
            except KeyError:  # its plan leads out of what is there of the network
                break
            if follows[:2] in streets:
                break
            lane = follows
            streets.append(lane[:2])
        return tuple(streets)

    def keys(self, lane: Lane, plan: Sequence[Lane] | None) -> list[PathKey]:
        """Return the keys of the paths that contain a vehicle's `lane`, the best match first.

        A path is a line through the road network; its key is the node where it begins, and a name.
        `lane` is the two nodes of a road and a number from the left, from 0. The best match shares
        most roads with those that the vehicle will take. `plan` has the lanes that highway-env
        planned for it, or is None.
        """
        ahead = self.ahead(lane, plan)
        on_lane = [key for key, path in self.paths.items() if lane in path.lanes]
        return sorted(on_lane, key=lambda key: -_together(ahead, self.paths[key].lanes))


def _together(ahead: Route, lanes: Sequence[Lane]) -> int:
    streets = [lane[:2] for lane in lanes]
    rest = streets[streets.index(ahead[0]) :]
    return sum(a == b for a, b in zip(ahead, rest, strict=False))


def routes(
    name: str,
    network: Any,
    begin: Street,
    origin_m: tuple[float, float] = (0.0, 0.0),
    reach_m: float = math.inf,
) -> Routes:
    """Build every path that vehicles can follow through a road network of highway-env.

    Args:
        name: the environment's name, for the error's text.
        network: highway-env's `RoadNetwork`.
        begin: the road, as its two nodes, at which a route begins that goes round in a ring.
        origin_m: the point, x and y in m of highway-env's frame, that becomes the origin of the
            paths' coordinates.
        reach_m: distance from there, in m, beyond which paths are cut off.

    Raises UserError if there are more than `MOST_ROUTES` routes.
    """
    every = list(_routes(name, network, begin))
    labels = _labels(network, every)
    paths: dict[PathKey, Path] = {}
    ways = {}
    for route, label in zip(every, labels, strict=True):
        approach, lanes_of = route[0][0], _variants(network, route)
        keys = []
        for n, lanes in enumerate(lanes_of):
            key = approach, label if len(lanes_of) == 1 else f"{label} lane {n + 1}"
            roles = [_role(network, lane) for lane in lanes]
            priority = int(getattr(network.get_lane(lanes[0]), "priority", 0))
            paths[key] = Path.along(network, *key, lanes, roles, priority, origin_m, reach_m)
            keys.append(key)
        ways[route] = tuple(keys)
    for lanes in _left_over(network, {lane for path in paths.values() for lane in path.lanes}):
        key = lanes[0][0], f"to {lanes[-1][1]} lane {lanes[0][2] + 1}"
        roles = [_role(network, lane) for lane in lanes]
        paths[key] = Path.along(network, *key, lanes, roles, 0, origin_m, reach_m)
    return Routes(network, paths, ways)


def _left_over(network: Any, covered: set[Lane]) -> Iterator[list[Lane]]:
    """Yield chains of lanes that no route takes, such as the inner lane of a roundabout."""
    lanes: list[Lane] = []
    for street in _streets(network):
        lanes += [(*street, number) for number in range(len(_lanes(network, street)))]
    for lane in lanes:
        chain: list[Lane] = []
        while lane not in covered:
            covered.add(lane)
            chain.append(lane)
            if lane[1] in network.graph:
                end = network.get_lane(lane)
                following = network.next_lane(lane, None, end.position(end.length, 0.0))
                if _apart_m(end, network.get_lane(following)) <= GAP_M:
                    lane = following
        if chain:
            yield chain


def _streets(network: Any) -> list[Street]:
    return [(begin, end) for begin, nodes in network.graph.items() for end in nodes]


def _routes(name: str, network: Any, begin: Street) -> Iterator[Route]:
    """Yield every route of a network; one on a ring begins at the street `begin`, if it is on it.

    Raises UserError, with the environment's `name`, if there are more than MOST_ROUTES.
    """
    streets = _streets(network)
    after: dict[Street, list[Street]] = {}
    for street in streets:
        joining = [(street[1], end) for end in network.graph.get(street[1], ())]
        after[street] = [other for other in joining if _goes_on(network, street, other)]
    led_to = {street for following in after.values() for street in following}
    complete: list[Route] = []
    rings: list[Route] = []

    def extend(route: Route) -> None:
        if len(complete) + len(rings) > MOST_ROUTES:
            raise UserError(
                f"{printable(name)}: its road has more than {MOST_ROUTES} routes; set window_m, "
                "or give it fewer junctions"
            )
        following = [street for street in after[route[-1]] if street not in route]
        for street in following:
            extend((*route, street))
        if not following:
            (rings if after[route[-1]] else complete).append(route)

    for street in streets:
        if street not in led_to:
            extend((street,))
    for street in (begin, *streets):  # a ring has no beginning
        if not any(street in route for route in complete):
            extend((street,))
            complete += rings[:1]
        rings.clear()
    yield from complete


def _goes_on(network: Any, street: Street, following: Street) -> bool:
    """Return whether some lane of the second road continues one of the first."""
    for lane, other in product(_lanes(network, street), _lanes(network, following)):
        turn_rad = lane.heading_at(lane.length) - other.heading_at(0.0)
        if _apart_m(lane, other) <= GAP_M and math.cos(turn_rad) > math.cos(TURN_RAD):
            return True
    return False


def _lanes(network: Any, street: Street) -> Sequence[Any]:
    lanes: Sequence[Any] = network.graph[street[0]][street[1]]
    return lanes


def _apart_m(lane: Any, following: Any) -> float:
    return float(np.hypot(*(lane.position(lane.length, 0.0) - following.position(0.0, 0.0))))


def _variants(network: Any, route: Route) -> list[list[Lane]]:
    """Return the lanes of a route's paths, from left to right:
    one path for each lane of its widest road.
    """
    widest = max(range(len(route)), key=lambda n: len(_lanes(network, route[n])))
    variants = []
    for number in range(len(_lanes(network, route[widest]))):
        lanes = [(*route[widest], number)]
        for street in route[widest + 1 :]:
            lanes.append((*street, _beside(network, lanes[-1], street, True)))
        for street in reversed(route[:widest]):
            lanes.insert(0, (*street, _beside(network, lanes[0], street, False)))
        joined = [_apart_m(network.get_lane(a), network.get_lane(b)) for a, b in pairwise(lanes)]
        if max(joined, default=0.0) <= GAP_M and lanes not in variants:
            variants.append(lanes)
    return variants


def _beside(network: Any, lane: Lane, street: Street, after: bool) -> int:
    """Return the lane of the next or previous road that joins a lane:
    by number, or else the nearest.
    """
    here, lanes = network.get_lane(lane), _lanes(network, street)
    if len(lanes) == len(_lanes(network, lane[:2])):
        return lane[2]
    gaps_m = [_apart_m(here, other) if after else _apart_m(other, here) for other in lanes]
    return int(np.argmin(gaps_m))


def _labels(network: Any, every: Sequence[Route]) -> list[str]:
    """Name routes by their turn if that is unique among those of one beginning,
    or else by their end.
    """
    begins = [route[0][0] for route in every]
    turns = [_turn(network, route) for route in every]
    ends = [f"to {route[-1][1]}" for route in every]
    routes_from = Counter(begins)
    by_turn = Counter(zip(begins, turns, strict=True))
    by_end = Counter(zip(begins, ends, strict=True))
    ambiguous = {begin for (begin, _), count in by_turn.items() if count > 1}
    labels = []
    for route, begin, turn, end in zip(every, begins, turns, ends, strict=True):
        if routes_from[begin] > 1 and begin not in ambiguous:
            labels.append(turn)
        elif by_end[begin, end] == 1:
            labels.append(end)
        else:
            nodes = [node for _, node in route[:-1]]
            labels.append(f"{end} by {' '.join(nodes)}")
    return labels


def _turn(network: Any, route: Route) -> str:
    first, last = _lanes(network, route[0])[0], _lanes(network, route[-1])[0]
    quarters = (last.heading_at(last.length) - first.heading_at(0.0)) / (math.pi / 2)
    return TURNS[round(quarters) % 4]


def _role(network: Any, lane: Lane) -> str:
    several = len(_lanes(network, lane[:2])) > 1
    return f"{lane[0]}-{lane[1]}" + (f" lane {lane[2] + 1}" if several else "")
