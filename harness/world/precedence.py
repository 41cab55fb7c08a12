"""Rules of the road between vehicles that keep them: who goes first where two paths meet.

`right-hand` is Article 18.4 of the Convention on Road Traffic (Vienna 1968): where nothing is
signed, one gives way to who comes from the right. `first-come` lets go first who would be there
first, and of two who come within `TIE_S` the one with the lower id. Under both, who can no longer
stop goes first.

Where two roads merge, nobody comes from the right, and under `right-hand` the one with right of way
goes first; of two who come head-on, the one who is sooner in the middle; of two who stand, the one
with the lower id: four who wait for each other would wait for ever.

Whoever bears the id of an ego or of a helper is expected to keep the rule. That is too much where
some of them decide nothing (`agent_share` below 1).
"""

from collections.abc import Callable, Mapping

import numpy as np
from msgspec.structs import replace

from harness.world.road import Road
from harness.world.scenario import Scenario
from harness.world.scene_graph import Conflict, EgoArrival, SceneGraph
from harness.world.state import SIZES_M

# ids of the ego and of whom it asks (`harness.world.scenario.Draws.ids`)
KEEPING = ("v1", "v2", "v3", "v4")
# arrivals nearer to each other in time are at once, for each knows the other's with an error
TIE_S = 0.2
GAP_S = 0.5  # who gives way leaves the other so long, since it may be slower than it seems
STANDS_MPS = 0.5  # who is slower stands
HEAD_ON = -0.9  # cosine between headings below which two come head-on
CLEAR_M = (
    sum(SIZES_M["car"]) + 1.0
) / 2  # from the conflict point to the middle of a car that stops before it


def _from_the_right(road: Road, graph: SceneGraph, conflict: Conflict) -> bool:
    ego_path, other_path = road.paths[road.ego], road.paths[conflict.sector, conflict.route]
    at = road.crossings[conflict.sector, conflict.route]
    if at.kind == "merging" and ego_path.priority != other_path.priority:
        return ego_path.priority > other_path.priority
    if max(graph.ego.speed_mps, conflict.other.speed_mps) < STANDS_MPS:
        return _lower(graph, conflict)
    turn = _turn_rad(road, conflict)
    if np.cos(turn) < HEAD_ON:
        return _sooner(road, graph, conflict)
    return bool(np.sin(turn) > 0)  # y is to the south: who comes from the left heads to the right


def _turn_rad(road: Road, conflict: Conflict) -> float:
    """Return from which heading to which the ego's path and the other's meet."""
    ego_path, other_path = road.paths[road.ego], road.paths[conflict.sector, conflict.route]
    at = road.crossings[conflict.sector, conflict.route]
    return other_path.project(at.x_m, at.y_m)[2] - ego_path.project(at.x_m, at.y_m)[2]


def _sooner(road: Road, graph: SceneGraph, conflict: Conflict) -> bool:
    """Return whether the ego is at the conflict sooner than the other."""
    own_s = np.inf if conflict.ego.time_s is None else conflict.ego.time_s
    other_s = np.inf if conflict.other.time_s is None else conflict.other.time_s
    # they meet in the middle, wherever each has to wait
    if np.cos(_turn_rad(road, conflict)) < HEAD_ON:
        path = road.paths[conflict.sector, conflict.route]
        at = road.crossings[conflict.sector, conflict.route]
        ahead_m = path.project(*road.zone_m)[0] - at.other_arc_m + conflict.other.arc_m
        own_s = graph.ego.zone_m / max(graph.ego.speed_mps, STANDS_MPS)
        other_s = ahead_m / max(conflict.other.speed_mps, STANDS_MPS)
    if own_s == other_s or abs(own_s - other_s) < TIE_S:
        return _lower(graph, conflict)
    return own_s < other_s


def _lower(graph: SceneGraph, conflict: Conflict) -> bool:
    return int(graph.ego.id[1:]) < int(conflict.vehicle[1:])


# Whether the ego goes before the other vehicle of a conflict.
RULES: Mapping[str, Callable[[Road, SceneGraph, Conflict], bool]] = {
    "right-hand": _from_the_right,
    "first-come": _sooner,
}


def under(rule: str, scenario: Scenario, graph: SceneGraph) -> SceneGraph:
    """Return the ego's scene graph, changed as if others obeyed a right-of-way rule.

    `rule` is a key of `RULES`: `right-hand` or `first-come`; `graph` is the ego's scene graph in
    `scenario`. Conflicts with vehicles that must give way are dropped. Beside the conflict with a
    vehicle that goes first stand two like it, in which it comes faster and later, so that a planner
    leaves it room. Vehicles that keep no rule stay as they are.
    """
    p, road = scenario.parameters, scenario.road()
    top_mps, conflicts = p.target_speeds_mps[-1], list[Conflict]()
    for conflict in graph.conflicts:
        other = conflict.other
        if not conflict.meets or conflict.vehicle not in KEEPING:
            conflicts.append(conflict)
            continue
        stuck = _passes(conflict.ego, graph.ego.speed_mps, p.braking_mps2)
        late = _passes(other, other.speed_mps, p.braking_mps2)
        if stuck and late:  # too late for a rule
            conflicts.append(conflict)
        elif late or not (stuck or RULES[rule](road, graph, conflict)):
            faster = replace(other, speed_mps=max(top_mps, other.speed_mps))
            later = replace(other, arc_m=other.arc_m + GAP_S * other.speed_mps)
            conflicts += [replace(conflict, other=arrival) for arrival in (other, faster, later)]
    return replace(graph, conflicts=tuple(conflicts))


def _passes(arrival: EgoArrival, speed_mps: float, braking_mps2: float) -> bool:
    """Return whether a vehicle can no longer stop before a conflict."""
    return arrival.arc_m - CLEAR_M < speed_mps**2 / (2 * braking_mps2)
