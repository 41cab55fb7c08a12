"""Merge the objects that helpers share into the ego's scene graph,
as a receiver of CPMs or SDSMs does.

A helper's message says where it is, with the errors of a beacon, and lists what its sensors report
in its own frame, with the regions that it has in sight (ETSI TS 103 324: originating vehicle,
perceived objects, perception regions). Ids are the sender's own and do not say who is meant:
reports of two senders are of one object if places and speeds agree as far as their errors go (the
gate of a chi-squared test, as in tracking). The most precise report of an object stands. All see at
the same moment, so nothing is extrapolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, degrees, hypot, radians, sin
from typing import NamedTuple

import numpy as np
from msgspec import UNSET, structs

from harness.core import noise
from harness.core.arrays import Floats
from harness.world.parameters import Parameters
from harness.world.perception.conflicts import Seat, tenths
from harness.world.perception.graph import listed_graphs
from harness.world.perception.sensors import (
    BEARING_NOISE_RAD,
    LIDAR_NOISE_M,
    RADAR_NOISE_M,
    SPEED_NOISE_MPS,
    Detection,
)
from harness.world.scenario import Scenario
from harness.world.scene_graph import BY_BEACON, Node, SceneGraph, Sector
from harness.world.state import VehicleState, WorldState

# What a chi-squared value with three degrees of freedom (place and speed) exceeds once in 100 000.
GATE = 25.90
NOBODY, STANDS_M = "v99", 30.0  # id of a vehicle that does not exist, and how far ahead it stands
ROUNDED_M = 0.1 / 12**0.5  # standard deviation of the rounding of a graph's places


class Heard(NamedTuple):
    """Hold what the ego sees by itself, and the scene graphs that it got from helpers.

    A scene graph is what one vehicle knows of a state.
    """

    state: WorldState  # the state in which the ego is
    own: SceneGraph  # the ego's scene graph
    helpers: Sequence[SceneGraph]  # the scene graphs of the helpers that were heard
    # the state in which these helpers are; None for the ego's, as it is unless messages of another
    # scene are put in their place
    source: WorldState | None = None


@dataclass(frozen=True)
class Report:
    """Describe one object as one sender reports it, with the covariance of its errors.

    The sender is the ego itself or a helper.
    """

    detection: Detection  # the object, in the frame of the road
    node: Node | None  # the object in the ego's own scene graph; None for one out of a message
    place_m2: Floats  # covariance of its position to the east and to the south, m2, (2, 2)
    speed_m2ps2: float  # variance of its speed, m2/s2

    @property
    def spread_m2(self) -> float:
        """Return the sum of the position's variances along both axes, m²: less is more precise."""
        return float(np.trace(self.place_m2))


class Told(NamedTuple):
    """Hold what the ego sees by itself, and what senders report to it.

    A report is of one object, and in the frame of the road.
    """

    state: WorldState  # the state in which the ego is
    own: SceneGraph  # the ego's scene graph: what it knows of the state by itself
    senders: Sequence[Sequence[Report]]  # what each sender reports, of itself and of others
    sectors: Sequence[Sequence[Sector]]  # how much of each direction of danger each sender sees


def merged(scenario: Scenario, cases: Sequence[Heard]) -> list[SceneGraph]:
    """Return the ego's scene graph of each case, with the objects that helpers' messages report.

    A scene graph is what one vehicle knows of a scene of `scenario`, and each of `cases` has the
    ego's own and those of the helpers heard. Reports of several senders are taken for one object if
    positions and speeds agree (chi-squared test), and the most precise of them is kept. Of each
    direction of danger as much counts as seen as whoever sees most of it does.
    """
    of_road: list[Told] = []
    for case in cases:
        senders: list[list[Report]] = []
        for graph in case.helpers:
            sender = state_in_message(scenario.parameters, case.source or case.state, graph.viewer)
            of_sender = [itself(scenario.parameters, sender)]
            of_sender += [_reported(scenario.parameters, sender, node) for node in graph.sensed]
            senders.append(of_sender)
        sectors = [graph.sectors for graph in case.helpers]
        of_road.append(Told(case.state, case.own, senders, sectors))
    return with_reports(scenario, of_road)


def with_reports(scenario: Scenario, cases: Sequence[Told]) -> list[SceneGraph]:
    """Return the ego's scene graph of each case, with the objects that senders report.

    It is for what senders report in the road's frame, and at times of their own; `merged` is for
    what helpers see now. Reports are joined as there.
    """
    own_ids: list[list[str]] = []  # whose report in the ego's own graph stands
    added: list[list[Detection]] = []  # what messages report
    for case in cases:
        reports = _reports(scenario.parameters, case)
        own_ids.append([report.node.id for report in reports if report.node])
        added.append([report.detection for report in reports if report.node is None])
    looks = [(case.state, case.state.ego) for case in cases]
    graphs = listed_graphs(scenario, looks, added, [() for _ in cases])
    merged_graphs: list[SceneGraph] = []
    for case, ids, graph in zip(cases, own_ids, graphs, strict=True):
        nodes = [node for node in case.own.nodes if node.id in ids]
        conflicts = [conflict for conflict in case.own.conflicts if conflict.vehicle in ids]
        merged_graphs.append(
            structs.replace(
                case.own,
                nodes=(*nodes, *graph.nodes),
                conflicts=(*conflicts, *graph.conflicts),
                sectors=_seen_together(case),
            )
        )
    return merged_graphs


def _reports(p: Parameters, case: Told) -> list[Report]:
    """Return one report of each object but the ego, the most precise."""
    ego = case.state.ego
    ego_reports = [_reported(p, ego, node, exact=True) for node in case.own.nodes]
    accepted = [itself(p, ego, exact=True)]
    for reports in (ego_reports, *case.senders):
        accepted = _joined(accepted, reports)
    return accepted[1:]


def state_in_message(p: Parameters, state: WorldState, sender: str) -> VehicleState:
    """Return a helper's state as its message gives it, with the errors of a beacon.

    `sender` is the helper's id in `state`, and `p` has the scenario's sizes of these errors. Under
    perfect knowledge it is the true state.
    """
    vehicle = state.vehicle(sender)
    if p.perfect_knowledge:
        return vehicle
    key = ("shared", state.episode_seed, state.step, sender)
    x, y, turn, speed = noise.generator(*key).standard_normal(4).tolist()
    return structs.replace(
        vehicle,
        x_m=vehicle.x_m + p.beacon_noise_m * x,
        y_m=vehicle.y_m + p.beacon_noise_m * y,
        heading_rad=vehicle.heading_rad + p.beacon_noise_rad * turn,
        speed_mps=max(vehicle.speed_mps + p.beacon_noise_mps * speed, 0.0),
    )


def invented(scenario: Scenario, state: WorldState, viewer: str) -> Node:
    """Return a car that does not exist, on collision course with the ego: an attacker's lie.

    It is on the first path of the scenario's road that crosses the ego's, as far from there as the
    ego is in `state`, and as fast; without such a path it stands `STANDS_M` ahead of the ego.
    `viewer` is the id of the helper that makes it up, in whose frame (m forward and to the left) it
    is given.
    """
    road, sender, ego = scenario.road(), state.vehicle(viewer), state.ego
    path = road.paths[ego.approach, ego.route]
    ego_m = path.project(ego.x_m, ego.y_m)[0]
    arc_m, speed_mps = ego_m + STANDS_M, 0.0
    if road.crossings:
        key, crossing = next(iter(road.crossings.items()))
        path = road.paths[key]
        arc_m = crossing.other_arc_m - (crossing.ego_arc_m - ego_m)
        speed_mps = ego.speed_mps
    x, y, heading = (float(column[0]) for column in path.places(np.array([arc_m])))
    seat = Seat(sender.x_m, sender.y_m, cos(sender.heading_rad), sin(sender.heading_rad))
    at = seat.relative(x, y)
    heading_deg = (degrees(sender.heading_rad - heading) + 180) % 360 - 180
    return Node(
        NOBODY,
        "car",
        at.forward_m,
        at.left_m,
        round(heading_deg),
        tenths(speed_mps),
        None,
        path.lane_role(arc_m),
        "off",
        ("lidar", "radar"),
    )


def _joined(accepted: Sequence[Report], reports: Sequence[Report]) -> list[Report]:
    """Return the accepted reports with those of one more sender;
    of two reports of an object the better one.

    Nearest pairs are joined first, and no report twice.
    The first accepted report, the ego, always stands.
    """
    distances = _distances(accepted, reports)
    joined, new = list(accepted), dict(enumerate(reports))
    taken: set[int] = set()
    rows, columns = np.nonzero(distances <= GATE)
    near = distances[rows, columns].tolist()
    pairs = zip(near, rows.tolist(), columns.tolist(), strict=True)
    for _, row, column in sorted(pairs):
        if row not in taken and column in new:
            taken.add(row)
            report = new.pop(column)
            if row and report.spread_m2 < accepted[row].spread_m2:
                joined[row] = report
    return [*joined, *new.values()]


def _distances(accepted: Sequence[Report], reports: Sequence[Report]) -> Floats:
    """Return the squared Mahalanobis distance of each pair of reports, (accepted, reports)."""
    place, speed, place_m2, speed_m2ps2 = _columns(accepted)
    other_place, other_speed, other_place_m2, other_speed_m2ps2 = _columns(reports)
    away = place[:, None] - other_place[None]
    covariance = place_m2[:, None] + other_place_m2[None]
    scaled = np.linalg.solve(covariance, away[..., None])[..., 0]
    of_place = np.einsum("...i,...i", away, scaled)
    variance = speed_m2ps2[:, None] + other_speed_m2ps2
    of_speed = (speed[:, None] - other_speed) ** 2 / variance
    return np.asarray(of_place + of_speed)


def _columns(reports: Sequence[Report]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return reports' places (n, 2), speeds (n,), covariances of the places (n, 2, 2)
    and variances of the speeds (n,).
    """
    n = len(reports)
    places_m = np.array([(r.detection.x_m, r.detection.y_m) for r in reports])
    speeds_mps = np.array([r.detection.speed_mps for r in reports])
    places_m2 = np.array([r.place_m2 for r in reports])
    speeds_m2ps2 = np.array([r.speed_m2ps2 for r in reports])
    return places_m.reshape(n, 2), speeds_mps, places_m2.reshape(n, 2, 2), speeds_m2ps2


def itself(p: Parameters, v: VehicleState, exact: bool = False) -> Report:
    """Return what a vehicle's message says of the vehicle itself.

    With `exact` it is what the vehicle knows of itself. `p` has the sizes of a beacon's errors.
    """
    detection = Detection(
        v.id,
        (f"v2v:{v.id}",),
        v.kind,
        v.indicator,
        v.x_m,
        v.y_m,
        v.heading_rad,
        v.speed_mps,
        None,
        v.braking,
    )
    place_m, speed_mps = ROUNDED_M, 0.1  # standard deviations
    if not (exact or p.perfect_knowledge):
        place_m = hypot(place_m, p.beacon_noise_m)
        speed_mps = hypot(speed_mps, p.beacon_noise_mps)
    return Report(detection, None, np.eye(2) * place_m**2, speed_mps**2)


def _reported(p: Parameters, sender: VehicleState, node: Node, exact: bool = False) -> Report:
    """Return a node of a sender's list, as its message reports it."""
    sent = report(p, sender, detection_of(sender, node), exact)
    return replace(sent, node=node) if exact else sent


def detection_of(sender: VehicleState, node: Node) -> Detection:
    """Return a node of a sender's list, in the frame of the road, where headings are clockwise."""
    c, s = cos(sender.heading_rad), sin(sender.heading_rad)
    dx, dy = node.forward_m * c + node.left_m * s, node.forward_m * s - node.left_m * c
    return Detection(
        node.id,
        node.sensors,
        None if node.type == "vehicle" else node.type,
        node.indicator,
        sender.x_m + dx,
        sender.y_m + dy,
        None if node.heading_deg is None else sender.heading_rad - radians(node.heading_deg),
        node.speed_mps,
        None,
        None if node.braking is UNSET else node.braking,
    )


def report(p: Parameters, sender: VehicleState, seen: Detection, exact: bool = False) -> Report:
    """Return what a sender's message reports of an object that its sensors have `seen`.

    It has the covariance of the sensors' errors and of the sender's own pose, whose errors are a
    beacon's, as `p` has them. With `exact` the sender knows its pose: it is the ego itself.
    """
    dx, dy = seen.x_m - sender.x_m, seen.y_m - sender.y_m
    away_m = max(hypot(dx, dy), 0.1)
    # Standard deviations along the line of sight, across it, and of the speed.
    along_m, across_m = RADAR_NOISE_M, BEARING_NOISE_RAD * away_m
    speed_mps = SPEED_NOISE_MPS["radar" in seen.sensors]
    if "lidar" in seen.sensors:
        along_m = across_m = LIDAR_NOISE_M
    if seen.sensors == BY_BEACON:
        along_m = across_m = p.beacon_noise_m
        speed_mps = p.beacon_noise_mps
    sender_m, sender_rad = p.beacon_noise_m, p.beacon_noise_rad
    if exact or p.perfect_knowledge:
        sender_m = sender_rad = 0.0
    along_m = hypot(along_m, ROUNDED_M, sender_m)
    across_m = hypot(across_m, ROUNDED_M, sender_m, sender_rad * away_m)
    turn = np.array([[dx, -dy], [dy, dx]]) / away_m
    place_m2 = turn @ np.diag([along_m**2, across_m**2]) @ turn.T
    detection = structs.replace(seen, sensors=(f"v2v:{sender.id}",), range_rate_mps=None)
    return Report(detection, None, place_m2, speed_mps**2)


def _seen_together(case: Told) -> tuple[Sector, ...]:
    """Return each sector as the viewer with the most of it in sight sees it,
    a lower bound of the union. Senders on another road see no sector that only theirs has.
    """
    sectors = {sector.sector: sector for sector in case.own.sectors}
    for of_sender in case.sectors:
        for sector in of_sender:
            here = sectors.get(sector.sector)
            if here is not None and sector.seen_share > here.seen_share:
                sectors[sector.sector] = sector
    return tuple(sectors.values())
