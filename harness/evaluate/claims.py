"""What helpers say of themselves at decision points, and what the ego's map and sensors say of it."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import shapely

from harness.coordination.claims import Claims
from harness.core.arrays import Floats
from harness.dataset.load import Scene
from harness.world.beacons import known
from harness.world.road import Road
from harness.world.scenario import Scenario

NEGLIGIBLE_M = 0.01  # by which the map's lines may be off


def claims(scenario: Scenario, moments: Sequence[Scene]) -> Claims:
    """The claims of each moment, (n, ...)."""
    road, p = scenario.road(), scenario.parameters
    n, helpers = len(moments), max((len(scene.viewers) for scene in moments), default=1) - 1
    xy_m = np.full((n, 1 + helpers, 2), np.nan)
    speed_mps, sensed_m = np.full((2, n, helpers), np.nan)
    for i, scene in enumerate(moments):
        here, speed, sensed = _claims(road, scene)
        xy_m[i, : len(here)], speed_mps[i, : len(speed)], sensed_m[i, : len(sensed)] = here, speed, sensed
    time_s = np.array([scene.state.time_s for scene in moments])
    error_m = np.full(n, 0.0 if p.perfect_knowledge else p.beacon_noise_m)
    return Claims(xy_m, speed_mps, time_s, error_m, sensed_m, _map(scenario))


def _claims(road: Road, scene: Scene) -> tuple[Floats, Floats, Floats]:
    """Places (1+H, 2), speeds (H,) and sensed distances (H,); kept with the scene, which never changes."""
    if (kept := scene.notes.get("claims")) is None:
        state, (ego, *names) = scene.state, scene.viewers
        helpers = [known(state, name, ego) for name in names]
        nodes = {node["id"]: node for node in scene.record["graphs"][ego]["nodes"]}
        cos, sin = math.cos(state.ego.heading_rad), math.sin(state.ego.heading_rad)
        zone_x, zone_y = road.zone_m

        def sensed(name: str) -> float:
            if (seen := nodes.get(name)) is None:
                return math.nan
            x = state.ego.x_m + seen["forward_m"] * cos + seen["left_m"] * sin
            y = state.ego.y_m + seen["forward_m"] * sin - seen["left_m"] * cos
            return math.hypot(x - zone_x, y - zone_y)

        kept = (
            np.array([(v.x_m, v.y_m) for v in (state.ego, *helpers)]) - road.zone_m,
            np.array([helper.speed_mps for helper in helpers]),
            np.array([sensed(name) for name in names]),
        )
        scene.notes["claims"] = kept
    return kept


@lru_cache(maxsize=16)
def _map(scenario: Scenario) -> Callable[[Floats], Floats]:
    """Metres from places (..., 2), from the centroid of the conflict zone, to the nearest path."""
    road = scenario.road()
    paths = shapely.MultiLineString([path.points - road.zone_m for path in road.paths.values()])
    paths = paths.simplify(NEGLIGIBLE_M)

    def from_road_m(xy_m: Floats) -> Floats:
        with np.errstate(invalid="ignore"):  # who is not there is nowhere
            return np.asarray(shapely.distance(shapely.points(xy_m), paths))

    return from_road_m
