"""Compute what an ego sees of the regions,
and what it can infer about its helpers' views before it asks.
"""

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from harness.coordination.scheduling import Outlook
from harness.core.arrays import Bools, Floats
from harness.dataset.load import Scene, by_seat
from harness.world.beacons import state_by_beacon
from harness.world.perception.rays import blocked_by
from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.scene_graph import Node
from harness.world.state import VehicleState, WorldState

MOVING_MPS = 0.1  # a slower vehicle counts as standing


def outlook(scenario: Scenario, scenes: Sequence[Scene]) -> Outlook:
    """Return how much n egos see of where a danger may come from, and what helpers would add.

    Rules for whom to ask, schedules, use it. A danger is a vehicle that would meet an ego which
    keeps its speed; it may come from each of the road's R sectors, or regions. Arrays are
    `(n, ...)`; on a road with fewer regions than others, the rest counts as seen.
    """
    n, helpers = len(scenes), max((len(scene.viewers) for scene in scenes), default=1) - 1
    roads = [(seat.road(), places) for seat, places in by_seat(scenes, scenario).items()]
    most = max((len(road.sectors) for road, _ in roads), default=0)
    unseen, to_zone_s, regions = np.zeros((n, most)), np.zeros(n), np.zeros(n, dtype=int)
    added = np.full((n, helpers, most), np.nan)
    for road, places in roads:
        for i in places:
            seen, sectors = _outlook(road, scenes[i]), len(road.sectors)
            unseen[i, :sectors], to_zone_s[i], regions[i] = seen.unseen, seen.to_zone_s, sectors
            added[i, : len(seen.added)] = 0.0  # nothing, where a road has no such region
            added[i, : len(seen.added), :sectors] = seen.added
    return Outlook(unseen, added, to_zone_s, regions)


def _outlook(road: Road, scene: Scene) -> Outlook:
    """Return a scene's outlook; kept with the immutable scene."""
    if (kept := scene.notes.get("outlook")) is None:
        graph, state = scene.graphs[scene.viewers[0]], scene.state
        helpers = [state_by_beacon(state, name, state.ego.id) for name in scene.viewers[1:]]
        as_known = _as_known(state, graph.nodes, helpers)
        # What the ego sees is decided by where occluders truly are, and not by where it measures
        # them.
        reported = {state.ego.id, *graph.seen}
        in_sight = replace(state, vehicles=tuple(v for v in state.vehicles if v.id in reported))
        unseen = _unseen(road, in_sight, state.ego)
        added = [_by_region(road, unseen & ~_unseen(road, as_known, helper)) for helper in helpers]
        distance_m, speed_mps = max(graph.ego.zone_m, 0.0), graph.ego.speed_mps
        to_zone_s = (
            distance_m / speed_mps if speed_mps > MOVING_MPS else np.inf if distance_m else 0.0
        )
        regions = len(road.sectors)
        shares = _by_region(road, unseen), np.reshape(added, (-1, regions))
        kept = Outlook(*shares, np.array(to_zone_s), np.array(regions))
        scene.notes["outlook"] = kept
    return kept


def _as_known(
    state: WorldState, nodes: Sequence[Node], helpers: Sequence[VehicleState]
) -> WorldState:
    """Return the state as the ego knows it: vehicles as its sensors and its radio report them."""
    ego, by_beacon = state.ego, {helper.id: helper for helper in helpers}
    cos, sin = np.cos(ego.heading_rad), np.sin(ego.heading_rad)
    vehicles = [ego, *helpers]
    for node in nodes:
        if node.id not in by_beacon:
            x_m = ego.x_m + node.forward_m * cos + node.left_m * sin
            y_m = ego.y_m + node.forward_m * sin - node.left_m * cos
            vehicles.append(replace(state.vehicle(node.id), x_m=float(x_m), y_m=float(y_m)))
    return replace(state, vehicles=tuple(vehicles))


def _unseen(road: Road, state: WorldState, viewer: VehicleState) -> Bools:
    """Return which of the points that must be watched are hidden from a viewer."""
    points = road.watched if road.sectors else np.empty((0, 2))
    return np.array([by is not None for by in blocked_by(state, viewer, points)], dtype=bool)


def _by_region(road: Road, points: Bools) -> Floats:
    """Return the share of each region's points, (R,)."""
    ends = np.cumsum([len(sector) for sector in road.sectors.values()])[:-1]
    return np.array(
        [part.mean() for part in np.split(points, ends)] if road.sectors else [], dtype=float
    )
