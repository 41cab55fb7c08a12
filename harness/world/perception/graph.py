"""The ego-centric scene graph: what one vehicle knows, as nodes, conflicts and sectors.

Relative positions are in the viewer's frame: metres forward and to the left, headings in degrees
counter-clockwise from the viewer's. Lane roles, sectors and conflicts are named from the *ego's* seat
for every viewer, since helpers judge what the ego should do; a helper knows the ego's position and speeds
from the last beacon that it heard, not from its sensors.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from harness.core.arrays import Bools
from harness.world.beacons import estimated, last_heard
from harness.world.perception.conflicts import Known, Seat, conflicts, places, tenths
from harness.world.perception.rays import Look, Surfaces, hidden, rays_on_vehicles, surfaces
from harness.world.perception.sensors import LEAST_RAYS, Detection, detections
from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.state import VehicleState, WorldState

OCCLUDED_BELOW = 0.5  # share of a sector in sight below which the sector counts as occluded
AT_ONCE = 32  # the rays of more viewers do not fit into the processor's cache

Graph = dict[str, Any]


def scene_graph(
    scenario: Scenario, state: WorldState, viewer_id: str, left_out: Collection[str] = ()
) -> Graph:
    """Return the scene graph of one vehicle's sensors; ids in `left_out` are treated as undetected."""
    [graph] = scene_graphs(scenario, [(state, viewer_id)], left_out)
    return graph


def scene_graphs(
    scenario: Scenario, looks: Sequence[tuple[WorldState, str]], left_out: Collection[str] = ()
) -> list[Graph]:
    """Return the scene graphs of some states, each as the vehicle with an id sees it."""
    return [
        graph for begin in range(0, len(looks), AT_ONCE)
        for graph in _seen(
            scenario, [(s, s.vehicle(viewer)) for s, viewer in looks[begin : begin + AT_ONCE]], left_out
        )
    ]  # fmt: skip


def blinded(graph: Mapping[str, Any]) -> Graph:
    """Return the graph of a viewer without sensors, who knows only itself and the ego's beacon."""
    unseen = {"seen_share": 0.0, "occluded": True, "by": []}
    sectors = [{**sector, **unseen} for sector in graph["sectors"]]
    return {**graph, "nodes": [], "conflicts": [], "sectors": sectors}


def truth_graph(scenario: Scenario, state: WorldState) -> Graph:
    """Return the ego's graph with everything in view and no noise, which only `full-view` may read."""
    [graph] = truth_graphs(scenario, [state])
    return graph


def truth_graphs(scenario: Scenario, states: Sequence[WorldState]) -> list[Graph]:
    """Return the `truth_graph` of each state."""
    exact = [list(map(_exact, state.vehicles[1:])) for state in states]
    return _graphs(scenario, [(state, state.ego) for state in states], exact, [[] for _ in states])


def _exact(v: VehicleState) -> Detection:
    return Detection(
        v.id, ("truth",), v.kind, v.indicator, v.x_m, v.y_m, v.heading_rad, v.speed_mps, None, v.braking
    )


def _seen(scenario: Scenario, looks: Sequence[Look], left_out: Collection[str]) -> list[Graph]:
    around = surfaces(looks)
    hit = around.by_viewer(rays_on_vehicles(around)) >= LEAST_RAYS
    others = [[v for v in state.vehicles if v.id != viewer.id] for state, viewer in looks]
    in_sight = list(zip(*(numbers.tolist() for numbers in np.nonzero(hit)), strict=True))
    found = detections([(*looks[n], others[n][place]) for n, place in in_sight], scenario.parameters.light)
    detected: list[list[Detection]] = [[] for _ in looks]
    reported = np.zeros_like(hit)
    for (n, place), d in zip(in_sight, found, strict=True):
        if d and d.id not in left_out:
            detected[n].append(d)
            reported[n, place] = True
    # An undetected vehicle must not reveal itself by what it hides.
    solid = ~around.vehicle | reported[around.viewer, around.place]
    return _graphs(scenario, looks, detected, _sectors(scenario.road(), around, solid))


def _graphs(
    scenario: Scenario, looks: Sequence[Look], detected: Sequence[Sequence[Detection]],
    sectors: Sequence[list[Graph]],
) -> list[Graph]:  # fmt: skip
    """Return the graph of each viewer, of what it detected and of its sectors."""
    if not looks:
        return []
    road = scenario.road()
    beacons = [last_heard(state, state.ego.id, viewer.id) for state, viewer in looks]
    egos = [estimated(s.ego, b, s.time_s) for (s, _), b in zip(looks, beacons, strict=True)]
    viewers = [viewer for _, viewer in looks]
    ego_arcs, own_arcs = (_arcs(road, vehicles) for vehicles in (egos, viewers))
    x, y, heading = np.array([(v.x_m, v.y_m, v.heading_rad) for v in viewers]).T
    zone_m = np.hypot(x - road.zone_m[0], y - road.zone_m[1]).tolist()
    places_m = zip(x.tolist(), y.tolist(), np.cos(heading).tolist(), np.sin(heading).tolist(), strict=True)
    seats = [Seat(*place) for place in places_m]
    # The viewer itself may be in the ego's way, too.
    listed = [
        [*found, *([] if road.form == 1 or viewer.id == state.ego.id else [_exact(viewer)])]
        for (state, viewer), found in zip(looks, detected, strict=True)
    ]
    things = [(n, d) for n, found in enumerate(listed) for d in found]
    where = places(road, [d for _, d in things])
    of = [k for k, (n, d) in enumerate(things) if where[k].key and d.id != egos[n].id]
    known = [Known(seats[n], d, where[k], egos[n], ego_arcs[n]) for k in of for n, d in [things[k]]]
    met: list[list[Graph]] = [[] for _ in looks]
    for k, some in zip(of, conflicts(road, known), strict=True):
        n, d = things[k]
        met[n] += [{**c, "other": {**c["other"], **_lamps(scenario, d)}} for c in some]
    nodes: list[list[Graph]] = [[] for _ in looks]
    headings = np.array([np.nan if d.heading_rad is None else d.heading_rad for _, d in things])
    aside = (np.degrees(heading[[n for n, _ in things]] - headings) + 180) % 360 - 180
    for (n, d), place, aside_deg in zip(things, where, aside.tolist(), strict=True):
        if d.id != viewers[n].id:
            lane = road.paths[place.key].lane_role(place.arc_m) if place.key else "off-lane"
            nodes[n].append({**_node(seats[n], d, lane, aside_deg), **_lamps(scenario, d)})
    return [
        {
            "viewer": viewer.id,
            "role": "ego" if viewer.part == "ego" else "helper",
            "step": state.step,
            "self": {
                "speed_mps": tenths(viewer.speed_mps),
                "lane": road.paths[viewer.approach, viewer.route].lane_role(own_arcs[n]),
                "zone_m": tenths(zone_m[n]),
                **({} if road.form == 1 else {"type": viewer.kind}),
            },
            "ego": {
                "id": ego.id,
                "speed_mps": tenths(ego.speed_mps),
                "target_speed_mps": beacon.target_speed_mps if beacon else state.target_speed_mps,
                "age_s": round(state.time_s - beacon.time_s, 2) if beacon else 0.0,
                "zone_m": tenths(road.zone_arc_m - ego_arcs[n]),
                **seats[n].relative(ego.x_m, ego.y_m),
                **({"route": ego.route} if road.ways else {}),
            },
            "nodes": nodes[n],
            "conflicts": met[n],
            "sectors": sectors[n],
        }
        for n, ((state, viewer), ego, beacon) in enumerate(zip(looks, egos, beacons, strict=True))
    ]


def _arcs(road: Road, vehicles: Sequence[VehicleState]) -> list[float]:
    """Return the arc length of each vehicle on its own path."""
    x, y = np.array([(v.x_m, v.y_m) for v in vehicles]).reshape(-1, 2).T
    paths = np.array([road.number[v.approach, v.route] for v in vehicles], dtype=int)
    arcs: list[float] = road.project(paths, x, y)[0].tolist()
    return arcs


def _lamps(scenario: Scenario, d: Detection) -> Graph:
    return {"braking": d.braking} if scenario.brake_lamps else {}


def _node(seat: Seat, d: Detection, lane: str, aside_deg: float) -> Graph:
    return {
        "id": d.id,
        "type": d.kind or "vehicle",
        **seat.relative(d.x_m, d.y_m),
        "heading_deg": None if d.heading_rad is None else round(aside_deg),
        "speed_mps": tenths(d.speed_mps),
        "range_rate_mps": None if d.range_rate_mps is None else tenths(d.range_rate_mps),
        "lane": lane,
        "indicator": d.indicator,
        "sensors": list(d.sensors),
    }


def _sectors(road: Road, around: Surfaces, solid: Bools) -> list[list[Graph]]:
    """Return the share of each sector's points in each viewer's sight, and which known objects hide the rest.

    Known are the surfaces that are `solid`, (n,).
    """
    if not road.sectors:
        return [[] for _ in around.ids]
    met = hidden(around, road.watched, solid)
    ends = np.cumsum([len(points) for points in road.sectors.values()])
    sectors: list[list[Graph]] = [[] for _ in around.ids]
    of_surface = around.place.tolist()
    for sector, blockers in zip(road.sectors, np.split(met, ends[:-1], axis=1), strict=True):
        in_sight = (blockers < 0).sum(axis=1).tolist()
        for n, (row, count) in enumerate(zip(blockers.tolist(), in_sight, strict=True)):
            seen = count / len(row)
            hiding = sorted({around.ids[n][of_surface[b]] for b in {*row} if b >= 0})
            sectors[n].append({
                "sector": sector, "seen_share": round(seen, 2), "occluded": seen < OCCLUDED_BELOW,
                "by": hiding,
            })  # fmt: skip
    return sectors
