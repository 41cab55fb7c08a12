"""Make the scene graphs of viewers from the state of the world and what their sensors detect."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from msgspec import UNSET

from harness.core.arrays import Bools
from harness.world.beacons import estimated, last_heard
from harness.world.perception.conflicts import Encounter, Seat, conflicts, places, tenths
from harness.world.perception.rays import Look, Surfaces, hidden, surfaces
from harness.world.perception.sensors import Detection, among, reports
from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.scene_graph import (
    BY_BEACON,
    Conflict,
    Ego,
    Node,
    Role,
    SceneGraph,
    Sector,
    Viewer,
)
from harness.world.state import Part, VehicleState, WorldState

OCCLUDED_BELOW = 0.5  # share of a sector in sight below which the sector counts as occluded
ROLES: dict[Part, Role] = {"ego": "ego", "helper": "helper", "other": "helper"}
AT_ONCE = 32  # the rays of more viewers do not fit into the processor's cache


def scene_graph(
    scenario: Scenario, state: WorldState, viewer_id: str, left_out: Collection[str] = ()
) -> SceneGraph:
    """Return the scene graph of one vehicle's sensors;
    ids in `left_out` are treated as undetected.
    """
    [graph] = scene_graphs(scenario, [(state, viewer_id)], left_out)
    return graph


def scene_graphs(
    scenario: Scenario, looks: Sequence[tuple[WorldState, str]], left_out: Collection[str] = ()
) -> list[SceneGraph]:
    """Return the scene graphs of some states, each as the vehicle with an id sees it."""
    return [
        graph
        for begin in range(0, len(looks), AT_ONCE)
        for graph in _perceived(
            scenario,
            [(s, s.vehicle(viewer)) for s, viewer in looks[begin : begin + AT_ONCE]],
            left_out,
        )
    ]


def truth_graph(scenario: Scenario, state: WorldState) -> SceneGraph:
    """Return the ego's graph with everything in view and no noise,
    which only `full-view` may read.
    """
    [graph] = truth_graphs(scenario, [state])
    return graph


def truth_graphs(scenario: Scenario, states: Sequence[WorldState]) -> list[SceneGraph]:
    """Return the `truth_graph` of each state."""
    exact = [list(map(_exact, state.vehicles[1:])) for state in states]
    return listed_graphs(
        scenario, [(state, state.ego) for state in states], exact, [[] for _ in states]
    )


def _exact(v: VehicleState) -> Detection:
    return Detection(
        v.id,
        ("truth",),
        v.kind,
        v.indicator,
        v.x_m,
        v.y_m,
        v.heading_rad,
        v.speed_mps,
        None,
        v.braking,
    )


def _perceived(
    scenario: Scenario, looks: Sequence[Look], left_out: Collection[str]
) -> list[SceneGraph]:
    around = surfaces(looks)
    reported = reports(looks, around, scenario.parameters)
    detected: list[list[Detection]] = [[] for _ in looks]
    listed = {place: d for place, d in reported.items() if d.id not in left_out}
    for (n, _), d in listed.items():
        detected[n].append(d)
    for (state, viewer), seen in zip(looks, detected, strict=True):
        seen += _announced(scenario, state, viewer, {*left_out, viewer.id, *(d.id for d in seen)})
    # An undetected vehicle must not reveal itself by what it hides.
    solid = ~around.vehicle | among(around, listed)
    return listed_graphs(scenario, looks, detected, _sectors(scenario.road(), around, solid))


def _announced(
    scenario: Scenario, state: WorldState, viewer: VehicleState, known: Collection[str]
) -> Iterator[Detection]:
    """Yield who else sends beacons, by the last one that the viewer has;
    nobody without a radio has any.

    Helpers are among them if they have goals of their own,
    since only then they may be in the ego's way.
    """
    for v in state.vehicles:
        sends = v.radio or (scenario.seats is not None and v.part == "helper")
        if sends and v.id not in known and viewer.part != "other":
            beacon = last_heard(state, v.id, viewer.id)
            if beacon or scenario.parameters.perfect_knowledge:
                at = estimated(v, beacon, state.time_s)
                place = at.x_m, at.y_m, at.heading_rad, at.speed_mps
                yield Detection(v.id, BY_BEACON, v.kind, None, *place, None)


def listed_graphs(
    scenario: Scenario,
    looks: Sequence[Look],
    detected: Sequence[Sequence[Detection]],
    sectors: Sequence[Sequence[Sector]],
) -> list[SceneGraph]:
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
    places_m = zip(
        x.tolist(), y.tolist(), np.cos(heading).tolist(), np.sin(heading).tolist(), strict=True
    )
    seats = [Seat(*place) for place in places_m]
    # The viewer itself may be in the ego's way, too.
    listed = [
        [*seen, *([] if road.form == 1 or viewer.id == state.ego.id else [_exact(viewer)])]
        for (state, viewer), seen in zip(looks, detected, strict=True)
    ]
    things = [(n, d) for n, seen in enumerate(listed) for d in seen]
    where = places(road, [d for _, d in things])
    kept = [k for k, (n, d) in enumerate(things) if where[k].key and d.id != egos[n].id]
    known = [
        Encounter(seats[n], d, where[k], egos[n], ego_arcs[n], scenario.brake_lamps)
        for k in kept
        for n, d in [things[k]]
    ]
    met: list[list[Conflict]] = [[] for _ in looks]
    for k, some in zip(kept, conflicts(road, known), strict=True):
        met[things[k][0]] += some
    nodes: list[list[Node]] = [[] for _ in looks]
    headings = np.array([np.nan if d.heading_rad is None else d.heading_rad for _, d in things])
    aside = (np.degrees(heading[[n for n, _ in things]] - headings) + 180) % 360 - 180
    for (n, d), place, aside_deg in zip(things, where, aside.tolist(), strict=True):
        if d.id != viewers[n].id:
            lane = road.paths[place.key].lane_role(place.arc_m) if place.key else "off-lane"
            at = seats[n].relative(d.x_m, d.y_m)
            nodes[n].append(
                Node(
                    d.id,
                    d.kind or "vehicle",
                    at.forward_m,
                    at.left_m,
                    None if d.heading_rad is None else round(aside_deg),
                    tenths(d.speed_mps),
                    None if d.range_rate_mps is None else tenths(d.range_rate_mps),
                    lane,
                    d.indicator,
                    d.sensors,
                    d.braking if scenario.brake_lamps else UNSET,
                )
            )
    graphs = []
    for n, ((state, viewer), ego, beacon) in enumerate(zip(looks, egos, beacons, strict=True)):
        at = seats[n].relative(ego.x_m, ego.y_m)
        stated = beacon.target_speed_mps if beacon else None
        itself = Viewer(
            tenths(viewer.speed_mps),
            road.paths[viewer.approach, viewer.route].lane_role(own_arcs[n]),
            tenths(zone_m[n]),
            UNSET if road.form == 1 else viewer.kind,
        )
        known_ego = Ego(
            ego.id,
            tenths(ego.speed_mps),
            state.target_speed_mps if stated is None else stated,
            round(state.time_s - beacon.time_s, 2) if beacon else 0.0,
            tenths(road.zone_arc_m - ego_arcs[n]),
            at.forward_m,
            at.left_m,
            ego.route if road.ways else UNSET,
        )
        knows = tuple(nodes[n]), tuple(met[n]), tuple(sectors[n])
        graphs.append(
            SceneGraph(viewer.id, ROLES[viewer.part], state.step, itself, known_ego, *knows)
        )
    return graphs


def _arcs(road: Road, vehicles: Sequence[VehicleState]) -> list[float]:
    """Return the arc length of each vehicle on its own path."""
    x, y = np.array([(v.x_m, v.y_m) for v in vehicles]).reshape(-1, 2).T
    arcs: list[float] = road.project([(v.approach, v.route) for v in vehicles], x, y)[0].tolist()
    return arcs


def _sectors(road: Road, around: Surfaces, solid: Bools) -> list[list[Sector]]:
    """Return the share of each sector's points in each viewer's sight,
    and which known objects hide the rest.

    Known are the surfaces that are `solid`, (n,).
    """
    if not road.sectors:
        return [[] for _ in around.ids]
    met = hidden(around, road.watched, solid)
    ends = np.cumsum([len(points) for points in road.sectors.values()])
    sectors: list[list[Sector]] = [[] for _ in around.ids]
    of_surface = around.place.tolist()
    for sector, blockers in zip(road.sectors, np.split(met, ends[:-1], axis=1), strict=True):
        in_sight = (blockers < 0).sum(axis=1).tolist()
        for n, (row, count) in enumerate(zip(blockers.tolist(), in_sight, strict=True)):
            seen = count / len(row)
            hiding = sorted({around.ids[n][of_surface[b]] for b in {*row} if b >= 0})
            sectors[n].append(Sector(sector, round(seen, 2), seen < OCCLUDED_BELOW, tuple(hiding)))
    return sectors
