"""Scenario `one-way-crossing`: two one-way streets cross, and nothing hides anything.

The ego goes north. In every other episode a car from the west meets it; a helper has just passed.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from harness.extend import Ground, Layout, Parameters, Path, Road, Scenario, Spawn, crossings

REACH_M, HALF_M = 100.0, 2.0


def way(name, start, end, priority):
    points = np.linspace(start, end, 801)
    arc = np.linspace(0.0, 2 * REACH_M, 801)
    return Path(
        name,
        "straight",
        points,
        arc,
        (),
        (f"street-{name}",),
        ((name, f"{name}-end", 0),),
        priority,
    )


@cache
def road():
    ego, west = ("south", "straight"), ("west", "straight")
    paths = {
        ego: way("south", (0.0, REACH_M), (0.0, -REACH_M), priority=0),
        west: way("west", (-REACH_M, 0.0), (REACH_M, 0.0), priority=1),
    }
    return Road(
        facts={"kind": "crossing of one-way streets", "lane_width_m": 2 * HALF_M},
        paths=paths,
        ego=ego,
        crossings=crossings(paths, ego),
        zone_m=(0.0, 0.0),
        sectors={"west": np.array([(-back, 0.0) for back in np.linspace(5.0, 40.0, 8)])},
        network=network,
        ground=ground,
    )


@cache
def network():
    from highway_env.road.lane import StraightLane
    from highway_env.road.road import RoadNetwork

    streets = RoadNetwork()
    for path in road().paths.values():
        (start, end, _) = path.lanes[0]
        streets.add_lane(
            start, end, StraightLane(path.points[0], path.points[-1], width=2 * HALF_M)
        )
    return streets


def ground(far_m):
    plus = np.array([(HALF_M, far_m), (HALF_M, HALF_M), (far_m, HALF_M), (far_m, -HALF_M)])
    streets = [np.array([(-x, -y), (x, y)]) for x, y in ((HALF_M, far_m), (far_m, HALF_M))]
    return Ground((np.vstack([plus, -plus]),), (), (), tuple(streets))


def layout(seed, parameters):
    to_go_m = 45.0 + seed % 7
    spawns = [
        Spawn("v1", "car", "ego", "south", "straight", REACH_M - to_go_m, 14.0),
        Spawn("v2", "car", "helper", "west", "straight", REACH_M + 12.0, 6.0),
    ]
    if danger := seed % 2:
        spawns.append(
            Spawn("v3", "car", "other", "west", "straight", REACH_M - to_go_m * 10 / 14, 10.0)
        )
    return Layout(tuple(spawns), (), "west" if danger else None, "v3" if danger else None)


def cleared(xy_m, approaches, parameters):
    return xy_m[..., 0, 1] < -10.0


SCENARIO = Scenario(
    name="one-way-crossing",
    description=__doc__,
    actions=("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER"),
    parameters=Parameters(decisions=4, time_limit_s=9.0),
    road=road,
    layout=layout,
    cleared=cleared,
    words={"task": "cross a one-way street"},
    prompt="v2",
)
# Its layouts are cut from recordings, two from each.
RECORDED = replace(
    SCENARIO, name="one-way-recorded", cluster=lambda seed: f"recording {(seed + 1) // 2}"
)
