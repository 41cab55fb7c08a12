"""The ego-centric scene graph: what one vehicle knows, as nodes, conflicts and sectors.

Relative positions are in the viewer's frame: metres forward and to the left, headings in degrees
counter-clockwise from the viewer's. Lane roles, sectors and conflicts are named from the *ego's* seat
whoever looks, for helpers judge what the ego should do; a helper knows the ego's position and speed from
the request, not from its sensors.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.world.perception.rays import blocked_by, sweep
from harness.world.perception.sensors import Detection, detect
from harness.world.road import SECTORS, Path, conflict_zone, crossings, paths
from harness.world.state import SIZES_M, VehicleState, WorldState

OCCLUDED_BELOW = 0.5  # share of a sector's approach in sight below which the sector counts as occluded
SECTOR_REACH_M = (8.0, 50.0)  # stretch of the approach lane, from the conflict point, that is looked at
ON_PATH_M = 2.2  # farther from a path than this, an object is not on it

Graph = dict[str, Any]


def scene_graph(state: WorldState, viewer_id: str) -> Graph:
    """What the sensors of one vehicle know."""
    viewer = state.vehicle(viewer_id)
    detections = detect(state, viewer, sweep(state, viewer))
    # What no sensor reports must not show by what it hides.
    reported = {viewer.id, *(d.id for d in detections)}
    known = replace(state, vehicles=tuple(v for v in state.vehicles if v.id in reported))
    return _graph(state, viewer, detections, _sectors(known, viewer))


def truth_graph(state: WorldState) -> Graph:
    """The ego's graph with everything in view and no noise: what only `full-view` may read."""
    exact = [
        Detection(
            v.id, ("truth",), v.kind, "left" if v.route == "left" else "off",
            v.x_m, v.y_m, v.heading_rad, v.speed_mps, None,
        )
        for v in state.vehicles[1:]
    ]  # fmt: skip
    return _graph(state, state.ego, exact, [])


def _graph(
    state: WorldState, viewer: VehicleState, detections: list[Detection], sectors: list[Graph]
) -> Graph:
    ego = state.ego
    ego_arc = paths()["own", "straight"].project(ego.x_m, ego.y_m)[0]
    nodes, conflicts = [], []
    for d in detections:
        path = _path_of(d)
        arc = path.project(d.x_m, d.y_m)[0] if path else None
        nodes.append(_node(viewer, d, path.lane_role(arc) if path and arc is not None else "off-lane"))
        if path and arc is not None and d.id != ego.id:
            conflict = _conflict(viewer, d, path, arc, ego, ego_arc)
            conflicts += [conflict] if conflict else []
    zone = conflict_zone()
    return {
        "viewer": viewer.id,
        "role": "ego" if viewer.part == "ego" else "helper",
        "step": state.step,
        "self": {
            "speed_mps": _tenths(viewer.speed_mps),
            "lane": paths()[viewer.approach, viewer.route].lane_role(
                paths()[viewer.approach, viewer.route].project(viewer.x_m, viewer.y_m)[0]
            ),
            "zone_m": _tenths(np.hypot(viewer.x_m - zone[0], viewer.y_m - zone[1])),
        },
        "ego": {
            "id": ego.id,
            "speed_mps": _tenths(ego.speed_mps),
            "target_speed_mps": state.target_speed_mps,
            "zone_m": _tenths(paths()["own", "straight"].project(*zone)[0] - ego_arc),
            **_relative(viewer, ego.x_m, ego.y_m),
        },
        "nodes": nodes,
        "conflicts": conflicts,
        "sectors": sectors,
    }


def _relative(viewer: VehicleState, x_m: float, y_m: float) -> dict[str, float]:
    dx, dy = x_m - viewer.x_m, y_m - viewer.y_m
    cos, sin = np.cos(viewer.heading_rad), np.sin(viewer.heading_rad)
    return {"forward_m": _tenths(dx * cos + dy * sin), "left_m": _tenths(dx * sin - dy * cos)}


def _tenths(value: float) -> float:
    """The value to one decimal; adding zero turns -0.0, which means nothing to a reader, into 0.0."""
    return round(float(value), 1) + 0.0


def _node(viewer: VehicleState, d: Detection, lane: str) -> Graph:
    heading = None
    if d.heading_rad is not None:
        turned = np.degrees(viewer.heading_rad - d.heading_rad)
        heading = round(float((turned + 180) % 360 - 180))
    return {
        "id": d.id,
        "type": d.kind or "vehicle",
        **_relative(viewer, d.x_m, d.y_m),
        "heading_deg": heading,
        "speed_mps": _tenths(d.speed_mps),
        "range_rate_mps": None if d.range_rate_mps is None else _tenths(d.range_rate_mps),
        "lane": lane,
        "indicator": d.indicator,
        "sensors": list(d.sensors),
    }


def _path_of(d: Detection) -> Path | None:
    """The path an object is taken to follow: the nearest that fits its heading; left if it shows left."""
    best, least = None, ON_PATH_M
    for (_, route), path in paths().items():
        arc, lateral, heading = path.project(d.x_m, d.y_m)
        turned = 0.0 if d.heading_rad is None else float(np.cos(d.heading_rad - heading))
        if d.heading_rad is not None and turned < np.cos(np.radians(40.0)):
            continue
        # On the shared approach lane both routes fit alike: a turn shows by the indicator, or under way.
        before = arc < path.junction_m[0]
        unlikely = before and (route == "left") != (d.indicator == "left")
        cost = lateral + (1.0 - turned) * 10.0 + (1.0 if unlikely else 0.0)
        if lateral < ON_PATH_M and (best is None or cost < least):
            best, least = path, cost
    return best


def _conflict(
    viewer: VehicleState, d: Detection, path: Path, arc: float, ego: VehicleState, ego_arc: float
) -> Graph | None:
    crossing = crossings().get((path.approach, path.route))
    if crossing is None:
        return None
    length = SIZES_M[d.kind or "car"][0]
    to_go, ego_to_go = crossing.other_arc_m - arc, crossing.ego_arc_m - ego_arc
    if to_go < -length / 2 - ego.width_m or ego_to_go < -ego.length_m:
        return None
    return {
        "with": d.id,
        "sector": path.approach,
        "route": path.route,
        "point": _relative(viewer, crossing.x_m, crossing.y_m),
        "ego": _arrival(ego_to_go, ego.speed_mps),
        "other": {**_arrival(to_go, d.speed_mps), "speed_mps": _tenths(d.speed_mps)},
    }


def _arrival(to_go_m: float, speed_mps: float) -> dict[str, float | None]:
    """Arc length left (m, negative once past), and the seconds it takes (None at a standstill)."""
    return {
        "arc_m": _tenths(to_go_m),
        "time_s": _tenths(to_go_m / speed_mps) if speed_mps > 0.5 else None,
    }


def _sectors(state: WorldState, viewer: VehicleState) -> list[Graph]:
    """How much of each sector's approach lane is in sight, and which known thing hides the rest."""
    points = _looked_at()
    found = blocked_by(state, viewer, points.reshape(-1, 2))
    sectors = []
    for n, sector in enumerate(SECTORS):
        blockers = found[n * points.shape[1] : (n + 1) * points.shape[1]]
        seen = sum(b is None for b in blockers) / len(blockers)
        hiding = sorted({b for b in blockers if b is not None})
        sectors.append(
            {"sector": sector, "seen_share": round(seen, 2), "occluded": seen < OCCLUDED_BELOW, "by": hiding}
        )
    return sectors


@lru_cache(maxsize=1)
def _looked_at() -> Floats:
    """(sectors, 15, 2) m, points of each sector's approach lane. Shared: not to be written to."""
    approaches = [paths()[sector, "straight"] for sector in SECTORS]
    back_m = np.linspace(*SECTOR_REACH_M, 15)
    return np.array([[p.at(p.junction_m[0] + 11.0 - back)[:2] for back in back_m] for p in approaches])
