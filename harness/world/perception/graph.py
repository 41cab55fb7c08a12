"""The ego-centric scene graph: what one vehicle knows, as nodes, conflicts and sectors.

Relative positions are in the viewer's frame: metres forward and to the left, headings in degrees
counter-clockwise from the viewer's. Lane roles, sectors and conflicts are named from the *ego's* seat
for every viewer, since helpers judge what the ego should do; a helper knows the ego's position and speeds
from the last beacon that it heard, not from its sensors.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from harness.world.beacons import known, last_heard
from harness.world.perception.rays import blocked_by, sweep
from harness.world.perception.sensors import Detection, detect
from harness.world.road import Path, Road
from harness.world.scenario import Scenario
from harness.world.state import SIZES_M, VehicleState, WorldState, indicator

OCCLUDED_BELOW = 0.5  # share of a sector in sight below which the sector counts as occluded
ON_PATH_M = 2.2  # farther from a path than this, an object is not on it
ALIKE = 0.05  # tolerance of costs: paths that share a lane differ by rounding only
STANDING_MPS = 0.5  # a lower speed is taken for sensor noise
ALIGNED_RAD = np.radians(40.0)  # more turned from a path than this, an object does not follow it

Graph = dict[str, Any]


def scene_graph(
    scenario: Scenario, state: WorldState, viewer_id: str, left_out: Collection[str] = ()
) -> Graph:
    """Return the scene graph of one vehicle's sensors; ids in `left_out` are treated as undetected."""
    road, viewer = scenario.road(), state.vehicle(viewer_id)
    detected = detect(state, viewer, sweep(state, viewer), scenario.parameters.light)
    detections = [d for d in detected if d.id not in left_out]
    # An undetected vehicle must not reveal itself by what it hides.
    reported = {viewer.id, *(d.id for d in detections)}
    known = replace(state, vehicles=tuple(v for v in state.vehicles if v.id in reported))
    return _graph(scenario, state, viewer, detections, _sectors(road, known, viewer))


def blinded(graph: Mapping[str, Any]) -> Graph:
    """Return the graph of a viewer without sensors, who knows only itself and the ego's beacon."""
    unseen = {"seen_share": 0.0, "occluded": True, "by": []}
    sectors = [{**sector, **unseen} for sector in graph["sectors"]]
    return {**graph, "nodes": [], "conflicts": [], "sectors": sectors}


def truth_graph(scenario: Scenario, state: WorldState) -> Graph:
    """Return the ego's graph with everything in view and no noise, which only `full-view` may read."""
    exact = list(map(_exact, state.vehicles[1:]))
    return _graph(scenario, state, state.ego, exact, [])


def _exact(v: VehicleState) -> Detection:
    return Detection(
        v.id, ("truth",), v.kind, v.indicator, v.x_m, v.y_m, v.heading_rad, v.speed_mps, None, v.braking
    )


def _graph(
    scenario: Scenario, state: WorldState, viewer: VehicleState, detections: list[Detection],
    sectors: list[Graph],
) -> Graph:  # fmt: skip
    road = scenario.road()
    ego, zone = known(state, state.ego.id, viewer.id), road.zone_m
    beacon = last_heard(state, ego.id, viewer.id)
    ego_arc = road.paths[ego.approach, ego.route].project(ego.x_m, ego.y_m)[0]
    own = road.paths[viewer.approach, viewer.route]
    itself = {} if road.form == 1 else {"type": viewer.kind}
    nodes, conflicts = [], list[Graph]()

    def lamps(d: Detection) -> Graph:
        return {"braking": d.braking} if scenario.brake_lamps else {}

    # The viewer itself may be in the ego's way, too.
    for d in [*detections, *([] if road.form == 1 or viewer.id == ego.id else [_exact(viewer)])]:
        path = _path_of(road, d)
        arc = path.project(d.x_m, d.y_m)[0] if path else None
        if d.id != viewer.id:
            lane = path.lane_role(arc) if path and arc is not None else "off-lane"
            nodes.append({**_node(viewer, d, lane), **lamps(d)})
        if path and arc is not None and d.id != ego.id:
            met = list(_along(road, viewer, d, path, arc, ego, ego_arc)) if road.form == 2 else []
            if not met and (meeting := _meeting(road, viewer, d, path, arc, ego, ego_arc)):
                met = [meeting]
            conflicts += [{**c, "other": {**c["other"], **lamps(d)}} for c in met]
    return {
        "viewer": viewer.id,
        "role": "ego" if viewer.part == "ego" else "helper",
        "step": state.step,
        "self": {
            "speed_mps": _tenths(viewer.speed_mps),
            "lane": own.lane_role(own.project(viewer.x_m, viewer.y_m)[0]),
            "zone_m": _tenths(np.hypot(viewer.x_m - zone[0], viewer.y_m - zone[1])),
            **itself,
        },
        "ego": {
            "id": ego.id,
            "speed_mps": _tenths(ego.speed_mps),
            "target_speed_mps": beacon.target_speed_mps if beacon else state.target_speed_mps,
            "age_s": round(state.time_s - beacon.time_s, 2) if beacon else 0.0,
            "zone_m": _tenths(road.zone_arc_m - ego_arc),
            **_relative(viewer, ego.x_m, ego.y_m),
            **({"route": ego.route} if road.ways else {}),
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
    """Round to one decimal; adding zero turns -0.0, which means nothing to a reader, into 0.0."""
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


def _path_of(road: Road, d: Detection) -> Path | None:
    """Return the path that an object seems to follow: the nearest that fits its heading and indicator.

    Of equally good paths, the road's first one is taken.
    """
    best, least = None, ON_PATH_M
    alike = ALIKE if road.form == 2 else 0.0
    for path in road.paths.values():
        arc, lateral, heading = path.project(d.x_m, d.y_m)
        turned = 0.0 if d.heading_rad is None else float(np.cos(d.heading_rad - heading))
        if d.heading_rad is not None and turned < np.cos(ALIGNED_RAD):
            continue
        # Routes that part later fit equally well until then, so the indicator decides.
        forks = ((path.approach, path.route), path.section(arc)) in road.forks
        unlikely = forks and indicator(path.route) != (d.indicator or "off")
        cost = lateral + (1.0 - turned) * 10.0 + (1.0 if unlikely else 0.0)
        if lateral < ON_PATH_M and (best is None or cost < least - alike):
            best, least = path, cost
    return best


def _meeting(
    road: Road, viewer: VehicleState, d: Detection, path: Path, arc: float, ego: VehicleState, ego_arc: float
) -> Graph | None:
    """Return the conflict where another's path crosses or merges into the ego's; None if one is past it."""
    crossing = road.crossings.get((path.approach, path.route))
    if crossing is None:
        return None
    length = SIZES_M[d.kind or "car"][0]
    if road.ways and road.paths[ego.approach, ego.route].project(crossing.x_m, crossing.y_m)[1] > ON_PATH_M:
        return None  # it meets another of the ego's ways
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
        **({"kind": crossing.kind, "lane": "own"} if road.form == 2 else {}),
    }


def _along(
    road: Road, viewer: VehicleState, d: Detection, path: Path, arc: float, ego: VehicleState, ego_arc: float
) -> Iterator[Graph]:
    """Yield the conflicts in a lane that both share or the ego may change to, at present speeds.

    Of two vehicles in a row only the one behind has a distance to go; of two that meet head-on, both have.
    """
    its_heading, own = path.at(arc)[2], (ego.approach, ego.route)
    for side, key in road.beside(own, road.paths[own].project(d.x_m, d.y_m)[0]).items():
        way = road.paths[key]
        at, lateral, heading = way.project(d.x_m, d.y_m)
        turned, gap = float(np.cos(its_heading - heading)), at - ego_arc
        if lateral > ON_PATH_M or abs(turned) < np.cos(ALIGNED_RAD) or (turned < 0 and gap < 0):
            continue
        ego_mps, its_mps = ego.speed_mps, d.speed_mps * np.sign(turned)
        kind = "oncoming" if turned < 0 else "ahead" if gap > 0 else "behind"
        if kind == "behind" and d.speed_mps <= STANDING_MPS:
            continue  # what is parked behind the ego never meets it
        closing_mps = (ego_mps - its_mps) * (1 if gap > 0 else -1)
        share = {"ahead": 1.0, "behind": 0.0, "oncoming": ego_mps / max(closing_mps, 0.1)}[kind]
        time_s = _tenths(abs(gap) / closing_mps) if closing_mps > 0.5 else None
        x, y, _ = way.at(ego_arc + max(gap, 0.0) * share)
        yield {
            "with": d.id,
            "sector": path.approach,
            "route": path.route,
            "point": _relative(viewer, x, y),
            "ego": {"arc_m": _tenths(abs(gap) * share), "time_s": time_s},
            "other": {
                "arc_m": _tenths(abs(gap) * (1 - share)), "time_s": time_s, "speed_mps": _tenths(d.speed_mps)
            },
            "kind": kind,
            "lane": side,
        }  # fmt: skip


def _arrival(to_go_m: float, speed_mps: float) -> dict[str, float | None]:
    """Return the remaining arc length (m, negative once past) and time (s, None at a standstill)."""
    return {
        "arc_m": _tenths(to_go_m),
        "time_s": _tenths(to_go_m / speed_mps) if speed_mps > STANDING_MPS else None,
    }


def _sectors(road: Road, state: WorldState, viewer: VehicleState) -> list[Graph]:
    """Return the share of each sector's points that is in sight, and which known objects hide the rest."""
    found = iter(blocked_by(state, viewer, road.watched))
    sectors = []
    for sector, points in road.sectors.items():
        blockers = list(islice(found, len(points)))
        seen = sum(b is None for b in blockers) / len(blockers)
        hiding = sorted({b for b in blockers if b is not None})
        sectors.append(
            {"sector": sector, "seen_share": round(seen, 2), "occluded": seen < OCCLUDED_BELOW, "by": hiding}
        )
    return sectors
