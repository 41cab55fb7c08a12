"""Make the scene graphs of viewers from the state of the world and what their sensors detect."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from msgspec import UNSET, structs

from harness.core.arrays import Bools
from harness.world.beacons import estimated, last_heard
from harness.world.perception.conflicts import Encounter, Seat, conflicts, places, tenths
from harness.world.perception.rays import Look, Surfaces, hidden, surfaces
from harness.world.perception.sensors import Detection, among, reported, reports
from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.scene_graph import (
    BY_BEACON,
    AgedNode,
    Conflict,
    Ego,
    Node,
    Point,
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
    """Return what one vehicle knows of a state by its sensors and by the beacons that it heard.

    `viewer_id` is its id, and `state` a moment of an episode of `scenario`. Vehicles whose ids are
    in `left_out` are treated as undetected: they are not listed, and nothing is said to be hidden
    by them.
    """
    [graph] = scene_graphs(scenario, [(state, viewer_id)], left_out)
    return graph


def scene_graphs(
    scenario: Scenario, looks: Sequence[tuple[WorldState, str]], left_out: Collection[str] = ()
) -> list[SceneGraph]:
    """Return the scene graph of each look: a state, and the id of the vehicle that looks in it.

    A scene graph is what that vehicle knows by its sensors and by the beacons that it heard. All
    states are of `scenario`. Vehicles whose ids are in `left_out` are treated as undetected. For
    several looks it is faster than one call of `scene_graph` each.
    """
    graphs: list[SceneGraph] = []
    for viewers in _at_once(looks):
        graphs += _perceived(scenario, viewers, left_out)
    return graphs


def sectors_in_sight(
    scenario: Scenario, looks: Sequence[tuple[WorldState, str]]
) -> list[list[Sector]]:
    """Return how much of each sector each look has in sight: what `scene_graphs` has of them.

    A sector is a direction that danger can come from. A look is a state of `scenario` and the id of
    the vehicle that looks in it.
    """
    sectors: list[list[Sector]] = []
    for viewers in _at_once(looks):
        around = surfaces(viewers)
        solid = ~around.vehicle | reported(viewers, around, scenario.parameters)
        sectors += _sectors(scenario.road(), around, solid)
    return sectors


def _at_once(looks: Sequence[tuple[WorldState, str]]) -> Iterator[list[Look]]:
    """Yield the viewers of all looks, as many at a time as are fastest."""
    for begin in range(0, len(looks), AT_ONCE):
        some = looks[begin : begin + AT_ONCE]
        yield [(state, state.vehicle(viewer_id)) for state, viewer_id in some]


def truth_graph(scenario: Scenario, state: WorldState) -> SceneGraph:
    """Return the ego's scene graph of a state with every vehicle in view, no noise, and no sectors.

    A scene graph is what one vehicle knows of a scene, and a sector a direction that danger can
    come from; `state` is a moment of an episode of `scenario`. Only the reference driver
    `full-view`, which sees everything, may read this one.
    """
    [graph] = truth_graphs(scenario, [state])
    return graph


def truth_graphs(scenario: Scenario, states: Sequence[WorldState]) -> list[SceneGraph]:
    """Return, for each state, the ego's scene graph with every vehicle in view and no noise.

    A scene graph is what one vehicle knows of a scene; all `states` are of `scenario`. Only driver
    `full-view` may read these.
    """
    looks: list[Look] = []
    exact: list[list[Detection]] = []
    no_sectors: list[list[Sector]] = []
    for state in states:
        looks.append((state, state.ego))
        exact.append([_exact(vehicle) for vehicle in state.vehicles[1:]])
        no_sectors.append([])
    return listed_graphs(scenario, looks, exact, no_sectors)


def _exact(v: VehicleState) -> Detection:
    """Return a vehicle as it truly is."""
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
    """Return the scene graph of each viewer, as its sensors and the beacons that it has tell it."""
    around = surfaces(looks)
    sensed_by_all = reports(looks, around, scenario.parameters)
    listed = {place: d for place, d in sensed_by_all.items() if d.id not in left_out}
    detected: list[list[Detection]] = [[] for _ in looks]
    for (n, _), d in listed.items():
        detected[n].append(d)
    for (state, viewer), sensed in zip(looks, detected, strict=True):
        known_ids = {viewer.id, *left_out, *[d.id for d in sensed]}
        sensed += _announced(scenario, state, viewer, known_ids)
    # An undetected vehicle must not reveal itself by what it hides.
    solid = ~around.vehicle | among(around, listed)
    sectors = _sectors(scenario.road(), around, solid)
    return listed_graphs(scenario, looks, detected, sectors)


def _announced(
    scenario: Scenario, state: WorldState, viewer: VehicleState, known_ids: Collection[str]
) -> Iterator[Detection]:
    """Yield who else sends beacons, by the last one that the viewer has;
    nobody without a radio has any.

    Helpers are among them if they have goals of their own,
    since only then they may be in the ego's way.
    """
    for v in state.vehicles:
        sends = v.radio or (scenario.seats is not None and v.part == "helper")
        if not sends or v.id in known_ids or viewer.part == "other":
            continue
        beacon = last_heard(state, v.id, viewer.id)
        if beacon or scenario.parameters.perfect_knowledge:
            at = estimated(v, beacon, state.time_s)
            pose = at.x_m, at.y_m, at.heading_rad, at.speed_mps
            yield Detection(v.id, BY_BEACON, v.kind, None, *pose, None)


def listed_graphs(
    scenario: Scenario,
    looks: Sequence[Look],
    detected: Sequence[Sequence[Detection]],
    sectors: Sequence[Sequence[Sector]],
) -> list[SceneGraph]:
    """Return the scene graph of each viewer, given what it detected and how it sees each sector.

    A scene graph is what one vehicle knows of a scene, and a sector a direction that danger can
    come from. A look is a state of `scenario` and the vehicle that looks in it, the viewer.
    `detected` and `sectors` have, for each look in the same order, the vehicles that it knows of,
    and how much of each sector it sees. Conflicts with the ego's path are computed here.
    """
    if not looks:
        return []
    road = scenario.road()
    viewers = [viewer for _, viewer in looks]
    beacons = [last_heard(state, state.ego.id, viewer.id) for state, viewer in looks]
    egos = [estimated(s.ego, b, s.time_s) for (s, _), b in zip(looks, beacons, strict=True)]
    ego_arcs, viewer_arcs = _arcs(road, egos), _arcs(road, viewers)
    x, y, heading = np.array([(v.x_m, v.y_m, v.heading_rad) for v in viewers]).T
    zone_m = np.hypot(x - road.zone_m[0], y - road.zone_m[1]).tolist()
    frames = np.stack([x, y, np.cos(heading), np.sin(heading)], axis=-1).tolist()
    seats = [Seat(*frame) for frame in frames]
    things: list[tuple[int, Detection]] = []  # number of a viewer, and what it knows
    for n, ((state, viewer), some) in enumerate(zip(looks, detected, strict=True)):
        things += [(n, d) for d in some]
        # The viewer itself may be in the ego's way, too.
        if road.form != 1 and viewer.id != state.ego.id:
            things.append((n, _exact(viewer)))
    where = places(road, [d for _, d in things])
    owners: list[int] = []
    encounters: list[Encounter] = []
    for (n, d), place in zip(things, where, strict=True):
        if place.key and d.id != egos[n].id:
            owners.append(n)
            encounters.append(
                Encounter(seats[n], d, place, egos[n], ego_arcs[n], scenario.brake_lamps)
            )
    conflicts_of: list[list[Conflict]] = [[] for _ in looks]
    for n, some_conflicts in zip(owners, conflicts(road, encounters), strict=True):
        conflicts_of[n] += some_conflicts
    nodes: list[list[Node]] = [[] for _ in looks]
    headings = np.array([np.nan if d.heading_rad is None else d.heading_rad for _, d in things])
    turned_deg = (np.degrees(heading[[n for n, _ in things]] - headings) + 180) % 360 - 180
    for (n, d), place, heading_deg in zip(things, where, turned_deg.tolist(), strict=True):
        if d.id != viewers[n].id:
            lane = road.paths[place.key].lane_role(place.arc_m) if place.key else "off-lane"
            at = seats[n].relative(d.x_m, d.y_m)
            nodes[n].append(_node(d, at, heading_deg, lane, scenario.brake_lamps))
    graphs = []
    for n, ((state, viewer), ego, beacon) in enumerate(zip(looks, egos, beacons, strict=True)):
        at = seats[n].relative(ego.x_m, ego.y_m)
        target_mps = beacon.target_speed_mps if beacon else None
        itself = Viewer(
            tenths(viewer.speed_mps),
            road.paths[viewer.approach, viewer.route].lane_role(viewer_arcs[n]),
            tenths(zone_m[n]),
            UNSET if road.form == 1 else viewer.kind,
        )
        known_ego = Ego(
            ego.id,
            tenths(ego.speed_mps),
            state.target_speed_mps if target_mps is None else target_mps,
            round(state.time_s - beacon.time_s, 2) if beacon else 0.0,
            tenths(road.zone_arc_m - ego_arcs[n]),
            at.forward_m,
            at.left_m,
            ego.route if road.ways else UNSET,
        )
        knowledge = tuple(nodes[n]), tuple(conflicts_of[n]), tuple(sectors[n])
        graphs.append(
            SceneGraph(viewer.id, ROLES[viewer.part], state.step, itself, known_ego, *knowledge)
        )
    return graphs


def _node(d: Detection, at: Point, heading_deg: float, lane: str, brake_lamps: bool) -> Node:
    """Return a known vehicle as a node, at a place of the viewer's frame and in a lane."""
    node = Node(
        d.id,
        d.kind or "vehicle",
        at.forward_m,
        at.left_m,
        None if d.heading_rad is None else round(heading_deg),
        tenths(d.speed_mps),
        None if d.range_rate_mps is None else tenths(d.range_rate_mps),
        lane,
        d.indicator,
        d.sensors,
        d.braking if brake_lamps else UNSET,
    )
    return node if d.age_s is None else AgedNode(**structs.asdict(node), age_s=round(d.age_s, 2))


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
            share = count / len(row)
            hiding = {around.ids[n][of_surface[blocker]] for blocker in {*row} if blocker >= 0}
            sectors[n].append(
                Sector(sector, round(share, 2), share < OCCLUDED_BELOW, tuple(sorted(hiding)))
            )
    return sectors
