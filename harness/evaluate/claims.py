"""Collect what helpers claim about themselves at decision points,
and what the ego can check it against.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import shapely

from harness.coordination.claims import Claims, Maps
from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.world.beacons import state_by_beacon
from harness.world.road import Road
from harness.world.scenario import LAYOUTS_KEPT, Scenario

NEGLIGIBLE_M = 0.01  # how far a simplified line of the map may be off


def claims(scenario: Scenario, scenes: Sequence[Scene]) -> Claims:
    """Return the positions and speeds that helpers' broadcasts claim, to check them.

    What the ego can check them by is returned, too. Arrays are `(n, ...)` for n scenes, with NaN
    where a scene has fewer helpers than another. `scenario` is that of the scenes. Rules that fuse
    messages and rate trust, and attacks, use them.
    """
    p = scenario.parameters
    by_scene = [scenario.at(scene.state.episode_seed) for scene in scenes]
    n, helpers = len(scenes), max((len(scene.viewers) for scene in scenes), default=1) - 1
    xy_m = np.full((n, 1 + helpers, 2), np.nan)
    speed_mps, sensed_m = np.full((2, n, helpers), np.nan)
    for i, scene in enumerate(scenes):
        places, speeds, sensed = _claims(by_scene[i].road(), scene)
        xy_m[i, : len(places)], speed_mps[i, : len(speeds)], sensed_m[i, : len(sensed)] = (
            places,
            speeds,
            sensed,
        )
    time_s = np.array([scene.state.time_s for scene in scenes])
    error_m = np.full(n, 0.0 if p.perfect_knowledge else p.beacon_noise_m)
    return Claims(xy_m, speed_mps, time_s, error_m, sensed_m, _maps(scenario, by_scene))


def _maps(scenario: Scenario, by_scene: Sequence[Scenario]) -> Callable[[Floats], Floats]:
    """Return the map, or those of the roads of n decisions, whose scenarios are `by_scene`."""
    if scenario.layouts is None:
        return _map(scenario)
    numbers = {each: number for number, each in enumerate(dict.fromkeys(by_scene))}
    road = np.array([numbers[each] for each in by_scene], dtype=int)
    return Maps([_map(each) for each in numbers], road)


def _claims(road: Road, scene: Scene) -> tuple[Floats, Floats, Floats]:
    """Return places (1+H, 2), speeds (H,) and sensed distances (H,);
    kept with the immutable scene.
    """
    if (notes := scene.notes.get("claims")) is None:
        state, (ego, *names) = scene.state, scene.viewers
        helpers = [state_by_beacon(state, name, ego) for name in names]
        nodes = {node.id: node for node in scene.graphs[ego].nodes}
        cos, sin = math.cos(state.ego.heading_rad), math.sin(state.ego.heading_rad)
        zone_x, zone_y = road.zone_m

        def sensed(name: str) -> float:
            if (node := nodes.get(name)) is None:
                return math.nan
            x = state.ego.x_m + node.forward_m * cos + node.left_m * sin
            y = state.ego.y_m + node.forward_m * sin - node.left_m * cos
            return math.hypot(x - zone_x, y - zone_y)

        notes = (
            np.array([(v.x_m, v.y_m) for v in (state.ego, *helpers)]) - road.zone_m,
            np.array([helper.speed_mps for helper in helpers]),
            np.array([sensed(name) for name in names]),
        )
        scene.notes["claims"] = notes
    return notes


@lru_cache(maxsize=LAYOUTS_KEPT)
def _map(scenario: Scenario) -> Callable[[Floats], Floats]:
    """Return the function from places (..., 2) to metres to the nearest path.

    Places are relative to the centroid of the conflict zone.
    An absent vehicle, at NaN, is infinitely far.
    """
    road = scenario.road()
    paths = shapely.MultiLineString([path.points - road.zone_m for path in road.paths.values()])
    lines = (shapely.get_coordinates(line) for line in paths.simplify(NEGLIGIBLE_M).geoms)
    segments = [np.stack([line[:-1], line[1:]], axis=1) for line in lines]
    tree = shapely.STRtree(shapely.linestrings(np.concatenate(segments)))

    def from_road_m(xy_m: Floats) -> Floats:
        metres, there = np.full(xy_m.shape[:-1], np.inf), ~np.isnan(xy_m).any(axis=-1)
        places = shapely.points(xy_m[there])
        _, metres[there] = tree.query_nearest(places, return_distance=True, all_matches=False)
        return metres

    return from_road_m
