"""Roundabouts of one lane with four arms, as roads;
traffic goes round from an arm to that on its right.
"""

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.world.road import Lane, Path

LANE_WIDTH_M = 4.0
ARM_M = 80.0  # length of the straight before and behind the arcs
ARMS = "senw"  # south, east, north and west: the way cars go round
# as in highway-env: entries and exits in order
RING = ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx")
# of the arms, from an agent's own on, the way cars go round
NAMES = ("own", "right", "oncoming", "left")


@dataclass(frozen=True)
class Roundabout:
    """Describe a one-lane roundabout with four arms around the origin.

    `ring_m` is the radius of the middle of its lane, m, `entry_m` that of the arcs by which cars
    enter and leave, m, and `beside_m` the distance of an arm's centre line to the middle of its
    lanes, m.
    """

    ring_m: float  # radius of the middle of the ring's lane, m
    entry_m: float  # radius of the arcs by which cars enter and leave, m
    # distance of an arm's centre line to the middle of its lanes, beside the splitter island, m
    beside_m: float

    @property
    def arc_y_m(self) -> float:
        """Return how far south of the centre (m) the south arm's entry and exit arcs begin."""
        return math.sqrt((self.ring_m + self.entry_m) ** 2 - (self.beside_m + self.entry_m) ** 2)

    @property
    def touch_rad(self) -> float:
        """Return the angle on the ring (rad, from +x towards +y) where the south entry joins it."""
        return math.atan2(self.arc_y_m, self.beside_m + self.entry_m)

    def ring_rad(self, node: int) -> float:
        """Return the angle (rad, from +x towards +y) of a junction on the ring.

        `node` is its index in `RING`, which lists entries and exits in the order of traffic, from
        the south entry on. Angles decrease along the traffic.
        """
        exits = self.touch_rad if node % 2 == 0 else math.pi / 2 - self.touch_rad
        return exits - math.pi / 2 * (node // 2)

    @cache  # noqa: B019 there are few, and they are never freed
    def network(self) -> Any:
        """Build the ring and its arms, without gaps: a `highway_env.road.road.RoadNetwork`."""
        from harness.world.highway import CircularLane, LineType, RoadNetwork, StraightLane

        none, edge = LineType.NONE, LineType.CONTINUOUS
        beside, entry, arc_y, touch = self.beside_m, self.entry_m, self.arc_y_m, self.touch_rad
        streets = RoadNetwork()
        for quarters, c in enumerate(ARMS):
            turn = -math.pi / 2 * quarters
            rotate = np.array(
                [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
            ).round(12)

            def at(x: float, y: float, rotate: Floats = rotate) -> Floats:
                turned: Floats = rotate @ np.array([x, y])
                return turned

            def arc(side: int, begin: float, end: float, at: Any = at, turn: float = turn) -> Any:
                centre = at(side * (beside + entry), arc_y)
                return CircularLane(
                    centre, entry, turn + begin, turn + end, True, line_types=(edge, edge)
                )

            far = arc_y + ARM_M
            way_in = StraightLane(at(beside, far), at(beside, arc_y), line_types=(edge, edge))
            way_out = StraightLane(at(-beside, arc_y), at(-beside, far), line_types=(edge, edge))
            streets.add_lane(f"{c}er", f"{c}es", way_in)
            streets.add_lane(f"{c}es", f"{c}e", arc(1, math.pi, math.pi + touch))
            streets.add_lane(f"{c}x", f"{c}xs", arc(-1, -touch, 0.0))
            streets.add_lane(f"{c}xs", f"{c}xr", way_out)
        for n, (begin, end) in enumerate(zip(RING, RING[1:] + RING[:1], strict=True)):
            start_rad, end_rad = self.ring_rad(n), self.ring_rad(n + 1)
            lane = CircularLane(
                (0.0, 0.0), self.ring_m, start_rad, end_rad, False, line_types=(none, edge)
            )
            streets.add_lane(begin, end, lane)
        return streets

    def path(
        self, approach: str, route: str, begin: str, end: str, priority: int, home: str = ARMS[0]
    ) -> Path:
        """Build the path from arm `begin` round the ring to arm `end`: `s`, `e`, `n` or `w`.

        `approach` and `route` are its key, as an agent (a vehicle that decides) from the arm `home`
        calls it, and lanes are named from there, too. `priority` is the right of way; the higher
        one goes first.
        """
        first, last = RING.index(f"{begin}e"), RING.index(f"{end}x")
        if last <= first:  # once more past the node where the ring's list begins
            last += len(RING)
        nodes = [RING[k % len(RING)] for k in range(first, last + 1)]
        lanes: list[Lane] = [(f"{begin}er", f"{begin}es", 0), (f"{begin}es", f"{begin}e", 0)]
        lanes += [(a, b, 0) for a, b in pairwise(nodes)]
        lanes += [(f"{end}x", f"{end}xs", 0), (f"{end}xs", f"{end}xr", 0)]
        roles = [_role(lane, home) for lane in lanes]
        return Path.along(self.network(), approach, route, lanes, roles, priority)

    def mound(self, radius_m: float) -> list[tuple[float, float, float, float]]:
        """Return three boxes that together stand for a round mound on the island, to block sight.

        Each is its walls' positions west, north, east and south, m from the centre; its corners lie
        on the circle of radius `radius_m`.
        """
        boxes = []
        for degrees in (22.5, 45.0, 67.5):
            x = radius_m * math.cos(math.radians(degrees))
            y = radius_m * math.sin(math.radians(degrees))
            boxes.append((-x, -y, x, y))
        return boxes


def name_of(arm: str, home: str) -> str:
    """Return how an agent from arm `home` calls `arm`: `own`, `right`, `oncoming` or `left`.

    An agent is a vehicle that decides. Arms are given as `s`, `e`, `n` or `w`.
    """
    return NAMES[(ARMS.index(arm) - ARMS.index(home)) % len(ARMS)]


def _role(lane: Lane, home: str) -> str:
    """Name a lane as an agent from the arm `home` sees it."""
    where = name_of(lane[1][0], home)
    if lane[0] in RING and lane[1] in RING:
        return f"ring-{where}"  # before the exit of that arm, or between its exit and its entry
    return f"approach-{where}" if "e" in lane[1] else f"exit-{where}"
