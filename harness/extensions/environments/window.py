"""Cut a road network of highway-env to the part that matters: what is within a window.

So the cost of an episode grows with what is near it, and not with the map.
"""

import math
from typing import Any

import numpy as np

from harness.extensions.environments.environment import lane_of
from harness.world.road import lanes_of

LEAST_M = 20.0  # the smallest window
NEAR_M = 10.0  # a lane farther from a vehicle than this is not its own, if there is a nearer one
SLACK_M = 5.0  # a lane that is no straight line may be longer than it says, by this at most
Point = tuple[float, float]


def middle(network: Any, ego: Any, ahead_m: float) -> Point:
    """Return the point that is `ahead_m` m ahead of the ego on the lanes that it will take.

    `network` is highway-env's `RoadNetwork`, and the point x and y in m of its frame; the end of
    the last lane, where the road is shorter.
    """
    index, plan = lane_of(ego), list(ego.route or ())
    lane = network.get_lane(index)
    at_m = lane.local_coordinates(ego.position)[0] + ahead_m
    for _ in range(len(network.lanes_list())):  # a ring has no end
        if at_m <= lane.length or index[1] not in network.graph:
            break
        at_m -= lane.length
        index = network.next_lane(index, plan, lane.position(lane.length, 0.0))
        lane = network.get_lane(index)
    x_m, y_m = lane.position(min(at_m, lane.length), 0.0)
    return float(x_m), float(y_m)


def within(network: Any, origin_m: Point, window_m: float) -> Any:
    """Return the part of a `RoadNetwork` of highway-env that lies within a window, as another.

    It has the roads, with all of their lanes, of which a lane comes nearer to `origin_m`, x and y
    in m, than `window_m`.
    """
    from highway_env.road.road import RoadNetwork

    near = RoadNetwork()
    for begin, following in network.graph.items():
        for end, lanes in following.items():
            if any(_comes_near(lane, origin_m, window_m) for lane in lanes):
                near.graph.setdefault(begin, {})[end] = lanes
    return near


def _comes_near(lane: Any, origin_m: Point, window_m: float) -> bool:
    away_m = float(np.hypot(*(lane.position(0.0, 0.0) - origin_m)))
    if away_m > window_m + lane.length + SLACK_M:
        return False
    along_m = np.linspace(0.0, lane.length, math.ceil(lane.length) + 1)
    points = np.array([lane.position(at_m, 0.0) for at_m in along_m])
    return bool(np.hypot(*(points - origin_m).T).min() < window_m)


def is_within(position: Any, origin_m: Point, window_m: float) -> bool:
    """Return whether a position, x and y in m, is within a window; all are, if that is 0."""
    return not window_m or math.dist(position, origin_m) < window_m


def quicken(network: Any) -> None:
    """Let vehicles look for their lane among those that come near them.

    highway-env's own `RoadNetwork` looks through all lanes of the map, for each vehicle in each
    frame. The answer is the same where no lane's length is shorter than the lane.
    """
    lanes = list(lanes_of(network).items())
    centres_m = np.array([lane.position(lane.length / 2, 0.0) for _, lane in lanes])
    reaches_m = np.array([lane.length / 2 + SLACK_M + NEAR_M for _, lane in lanes])
    of_all = network.get_closest_lane_index

    def closest(position: Any, heading: float | None = None) -> Any:
        near = np.flatnonzero(np.hypot(*(centres_m - position).T) < reaches_m).tolist()
        distances = [lanes[n][1].distance_with_heading(position, heading) for n in near]
        least = min(distances, default=np.inf)
        if least > NEAR_M:
            return of_all(position, heading)
        return lanes[near[distances.index(least)]][0]

    network.get_closest_lane_index = closest
