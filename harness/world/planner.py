"""The reference planner of `local-view` and `full-view`, which looks ahead along the ego's ways.

It knows only the scene graph. It plays every sequence of meta-actions over the next decisions, then
FASTER, against the conflicts of the graph at constant speed, and takes the first action of the
sequence that passes the conflict zone soonest without meeting anyone. A vehicle that is seen to
brake is assumed to brake until it stands. The planner does not guess what it cannot see, so
occlusion has a cost. Where the goal is to wait, the best sequence is the one that comes least far.

Under `limits` 1 it plays only changes to ways that lie beside its own now, so that a driver who
overtakes never comes back in what it plays. Under 2 it plays the way back, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import compress, product

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.world.parameters import Parameters
from harness.world.road import Path, PathKey, Road
from harness.world.scenario import Scenario
from harness.world.scene_graph import Arrival, Ego, SceneGraph
from harness.world.state import SIZES_M

SPEED = {"FASTER": 1, "SLOWER": -1}  # levels by which an action changes the target speed
SIDE = {"LANE_LEFT": -1, "LANE_RIGHT": 1}  # ways to the right by which an action changes lane
# Among equal sequences the calmest is taken, compared decision by decision.
CALM = {"IDLE": 0, "FASTER": 1, "SLOWER": 2, "LANE_RIGHT": 3, "LANE_LEFT": 4}
HORIZON = 4  # decisions that are played through; later ones are assumed to be FASTER
LOOK_AHEAD_S = 9.0  # conflicts are looked for this far into the future
MARGIN_M = 0.5  # added to every outline, for noise and for errors of the motion model
# time constant of the ego's speed controller (highway-env's TAU_ACC), and of its steering
RESPONSE_S = 0.6
EMERGENCY_MPS2 = 6.0  # assumed deceleration of a vehicle that is seen to brake
LATERAL_MPS2 = 7.0  # lateral acceleration that dry tyres hold in a bend
AWAY_S = 0.5  # cost of ending beside the ego's own way
STEP_S = 0.1
LANE_M = 4.0  # distance between two ways
Point = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Sequences:
    """Hold n sequences of meta-actions that the planner tries, with what each does to the ego.

    A way is one of the ego's paths that lie side by side, as lanes do. A step is `STEP_S` seconds.
    """

    first: Sequence[str]  # name of each one's first action, (n,)
    # number of steps in the scenario's list of target speeds by which each decision changes the
    # target speed, (n, decisions)
    levels: Ints
    ends: Ints  # final way, counted to the right from the present one, (n,)
    # rank of each among all of them, 0 for the calmest, by which one of equals is chosen, (n,)
    calm: Ints
    # distance to the right of the way that the ego is on now, after each step, m, (n, steps); None
    # if it stays on it
    right_m: Floats | None
    shift: Ints  # index of each one's lateral motion among the distinct ones, (n,)


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Hold the ego's predicted motions, each shared by all action sequences that lead to it.

    A step is `STEP_S` seconds. A way is one of the ego's paths that lie side by side, as lanes do.
    """

    travelled_m: Floats  # distance along the ego's way after each step, m, (motions, steps)
    # distance to the right of the way that the ego is on now, after each step, m, (motions, steps);
    # None if it stays on it
    right_m: Floats | None
    motion: Ints  # index of the motion to which each of n sequences of actions leads, (n,)

    @cached_property
    def speed_mps(self) -> Floats:
        return np.asarray(
            np.diff(self.travelled_m, axis=1, prepend=self.travelled_m[:, :1]) / STEP_S
        )

    @cached_property
    def fastest_mps(self) -> float:
        return float(self.speed_mps.max())


# Speed, its target, decisions left, ways on either side, and how many ways to the right the ego's
# own one is.
Start = tuple[float, float, int, tuple[int, int], int]


def plan(scenario: Scenario, graph: SceneGraph) -> str:
    """Return the meta-action, such as `SLOWER`, that the reference planner takes for the ego.

    `graph` is the ego's scene graph, all that the planner knows; `scenario` has the road and the
    actions.
    """
    [action] = plans(scenario, [graph])
    return action


def plans(scenario: Scenario, graphs: Sequence[SceneGraph]) -> list[str]:
    """Return the meta-action, such as `SLOWER`, that the reference planner takes for each ego.

    Each of `graphs` is an ego's scene graph, all that the planner knows of its scene; all are of
    `scenario`.
    """
    p, road = scenario.parameters, scenario.road()
    places = [(_way(road, graph.ego), road.zone_arc_m - graph.ego.zone_m) for graph in graphs]
    beside = [road.beside(way, at_m) for way, at_m in places]
    starts: list[Start] = []
    for graph, ways, (way, _) in zip(graphs, beside, places, strict=True):
        sides = int("left" in ways), int("right" in ways)
        home = road.ways.index(road.ego) - road.ways.index(way) if road.ways else 0
        ego, left = graph.ego, p.decisions - graph.step
        starts.append((ego.speed_mps, ego.target_speed_mps, left, sides, home))
    rollouts = _rollouts(scenario.actions, starts, p)
    actions = []
    for graph, (_, at_m), ways, start in zip(graphs, places, beside, starts, strict=True):
        sequences = _sequences(scenario.actions, *start[2:], p)
        actions.append(_chosen(scenario, graph, at_m, ways["own"], sequences, rollouts[start]))
    return actions


def _chosen(
    scenario: Scenario,
    graph: SceneGraph,
    at_m: float,
    way: PathKey,
    sequences: Sequences,
    tried: Rollouts,
) -> str:
    """Return the first action of the best sequence, for an ego at an arc length of its own way."""
    p, road = scenario.parameters, scenario.road()
    # The goal lies well behind the conflict points, so that a late burst of speed counts too.
    to_go = graph.ego.zone_m + 15.0 if road.goal_m is None else road.goal_m(p) - at_m
    short = tried.travelled_m < to_go
    under_way = True if road.goal_m is None else short
    gap = np.full(len(tried.travelled_m), np.inf)
    for motion in predicted(road, graph, tried.travelled_m.shape[1]):
        gap = np.minimum(gap, least_gap(tried, motion, under_way))
    gap = np.where(_too_fast(road.paths[way], at_m, tried, under_way), np.minimum(gap, 0.0), gap)
    arrival_s = short.sum(axis=1) * STEP_S - 1e-3 * tried.travelled_m[:, -1]
    if road.waits:
        arrival_s = tried.travelled_m[:, -1]
    cost = arrival_s[tried.motion]
    if road.ways:
        cost += AWAY_S * (road.ways.index(way) + sequences.ends != road.ways.index(road.ego))
    gap = gap[tried.motion]
    score = np.where(gap > 0, -cost, -1e3 + np.minimum(gap, 0.0))
    best = np.flatnonzero(score >= score.max() - 1e-9)
    return sequences.first[int(best[sequences.calm[best].argmin()])]


def _too_fast(way: Path, at_m: float, tried: Rollouts, under_way: Bools | bool) -> Bools:
    """Return whether each motion takes a bend faster than tyres hold, (motions,)."""
    # most ways are straight; the look-up costs
    if tried.fastest_mps**2 * way.sharpest <= LATERAL_MPS2:
        return np.zeros(len(tried.travelled_m), dtype=np.bool_)
    places = np.searchsorted(way.arc_m, at_m + tried.travelled_m).clip(0, len(way.arc_m) - 1)
    return np.asarray(
        ((tried.speed_mps**2 * way.bends[places] > LATERAL_MPS2) & under_way).any(axis=1)
    )


def _way(road: Road, ego: Ego) -> PathKey:
    return road.ego[0], ego.route or road.ego[1]


@lru_cache(maxsize=64)
def _sequences(
    actions: tuple[str, ...], left: int, sides: tuple[int, int], home: int, parameters: Parameters
) -> Sequences:
    """Return every sequence that `left` decisions and the ways on either side allow;
    a shared value.

    Under `limits` 2 a sequence that ends beside the ego's own way, `home` ways to the right of the
    present one, may also come back by a decision after `HORIZON`: an overtaking takes longer.
    """
    returns = parameters.limits > 1 and any(sides)
    played = [action for action in actions if action in CALM]
    if not returns:  # nor does it leave its way to a side without another
        played = [action for action in played if action not in SIDE or sides[SIDE[action] > 0]]
    back = {SIDE[action]: action for action in played if action in SIDE}
    later = ("FASTER",) * (left - HORIZON if returns else 0)
    sequences = []
    for first in product(played, repeat=min(HORIZON, left)):
        way = home - sum(SIDE.get(action, 0) for action in first)
        sequences.append(first + later)
        for n in range(len(later) if way in back else 0):
            sequences.append((*first, *later[:n], back[way], *later[n + 1 :]))
    ends = np.cumsum(_changes(sequences, SIDE), axis=1)
    stays = (ends.min(axis=1) >= -sides[0]) & (ends.max(axis=1) <= sides[1])
    sequences, ends = list(compress(sequences, stays)), ends[stays]
    order = sorted(range(len(sequences)), key=lambda n: [CALM[a] for a in sequences[n]])
    return Sequences(
        [sequence[0] for sequence in sequences],
        levels(sequences),
        ends[:, -1],
        np.argsort(order),
        _right_m(ends, parameters) if any(sides) else None,
        np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1),
    )


def levels(sequences: Sequence[tuple[str, ...]]) -> Ints:
    """Return by how many steps of target speed each decision changes the ego's, (n, decisions).

    `sequences` are n sequences of meta-actions, equally long. A step leads to the next of the
    scenario's target speeds: FASTER is 1, SLOWER -1, and all else 0.
    """
    return _changes(sequences, SPEED)


def _changes(sequences: Sequence[tuple[str, ...]], change_by: Mapping[str, int]) -> Ints:
    """Return the change of each decision of sequences, (n, decisions);
    an action that is not in `change_by` changes nothing.
    """
    rows = []
    for actions in sequences:
        rows.append([change_by.get(action, 0) for action in actions])
    return np.array(rows)


def _rollouts(
    actions: tuple[str, ...], starts: Sequence[Start], parameters: Parameters
) -> dict[Start, Rollouts]:
    """Return the motions of the ego from each start under the sequences that it allows."""
    alike: dict[tuple[int, tuple[int, int], int], list[Start]] = {}
    for start in dict.fromkeys(starts):
        alike.setdefault(start[2:], []).append(start)
    rollouts = {}
    for (left, sides, home), some in alike.items():
        sequences = _sequences(actions, left, sides, home, parameters)
        speeds, targets = np.array([start[:2] for start in some]).T
        distances_m = travelled_m(sequences.levels, speeds, targets, left, parameters)
        for start, travelled in zip(some, distances_m, strict=True):
            _, place = np.unique(travelled[:, -1], return_inverse=True)
            both = place * len(place) + sequences.shift
            _, first, motion = np.unique(both, return_index=True, return_inverse=True)
            # others come as far in the end
            if not np.array_equal(travelled[first][motion], travelled):
                first = motion = np.arange(len(travelled))
            right_m = None if sequences.right_m is None else sequences.right_m[first]
            rollouts[start] = Rollouts(travelled[first], right_m, motion)
    return rollouts


def travelled_m(
    moves: Ints, speeds_mps: Floats, targets_mps: Floats, left: int, parameters: Parameters
) -> Floats:
    """Return how far the ego travels, m, after each step of `STEP_S` seconds, by its actions.

    The result is (starts, sequences, steps), for each start with each sequence of actions. Speeds
    are those of highway-env's `MDPVehicle`: FASTER and SLOWER move one level from the level nearest
    to the present speed, and IDLE keeps the target.

    Args:
        moves: changes of level, an index in the scenario's target speeds, (sequences, decisions).
        speeds_mps: the ego's speed at each start, m/s, (starts,).
        targets_mps: its target speed at each start, m/s, (starts,).
        left: how many decisions remain; those that `moves` does not have are FASTER.
        parameters: the scenario's, with the target speeds and the limits of acceleration.
    """
    levels, shape = np.array(parameters.target_speeds_mps), (len(speeds_mps), len(moves))
    steps, every = round(LOOK_AHEAD_S / STEP_S), round(parameters.decision_period_s / STEP_S)
    speed, target = (np.broadcast_to(each[:, None], shape) for each in (speeds_mps, targets_mps))
    travelled = np.empty((steps, *shape))
    distance = np.zeros(shape)
    spacing = (levels[-1] - levels[0]) / (len(levels) - 1)
    for k in range(steps):
        n = k // every
        if k % every == 0 and n < left:
            move = moves[:, n] if n < moves.shape[1] else np.ones(len(moves), dtype=int)
            nearest = np.round((speed - levels[0]) / spacing).clip(0, len(levels) - 1).astype(int)
            level = np.clip(nearest + move, 0, len(levels) - 1)
            target = np.where(move == 0, target, levels[level])
        change = np.maximum((target - speed) / RESPONSE_S, -parameters.braking_mps2)
        change = np.minimum(change, parameters.acceleration_mps2)
        distance = distance + speed * STEP_S
        speed = np.maximum(speed + change * STEP_S, 0.0)
        travelled[k] = distance
    return np.ascontiguousarray(np.moveaxis(travelled, 0, -1))


def _right_m(ends: Ints, parameters: Parameters) -> Floats:
    """Return the ego's distance to the right, (n, steps),
    from its way after each decision, (n, k).
    """
    steps, every = round(LOOK_AHEAD_S / STEP_S), round(parameters.decision_period_s / STEP_S)
    right = np.empty((len(ends), steps))
    now = np.zeros(len(ends))
    for k in range(steps):
        decision = min(k // every, ends.shape[1] - 1)
        now = now + (ends[:, decision] * LANE_M - now) * STEP_S / RESPONSE_S
        right[:, k] = now
    return right


@dataclass(frozen=True)
class Motion:
    """Describe the predicted motion of another vehicle, and the ego's path that it may meet.

    A position on a path is its distance along it from the beginning, m. A step is `STEP_S` seconds.
    """

    way: Path  # the ego's path
    begin_m: float  # the ego's present position on it, m
    path: Path  # the other's path
    arc_m: Floats  # the other's position on its path after each step, m, (steps,)
    size_m: tuple[float, float]  # the other's length and width, m


def predicted(road: Road, graph: SceneGraph, steps: int) -> list[Motion]:
    """Predict the motions of vehicles that the ego could meet, for `steps` steps of `STEP_S` s.

    They are those with a conflict, a place where both may meet, in `graph`, the ego's scene graph;
    `road` has the paths. They keep path and speed, unless they queue behind another one or are seen
    to brake.
    """
    time_s = np.arange(1, steps + 1, dtype=np.float64) * STEP_S
    key = _way(road, graph.ego)
    way = road.paths[key]
    type_of: dict[str, str] = {node.id: node.type for node in graph.nodes}
    type_of[graph.viewer] = graph.itself.type or "car"
    motions, queue = [], dict[str, Motion]()
    # the first in a queue first
    for conflict in sorted(graph.conflicts, key=lambda c: -c.ego.arc_m):
        kind, ego, other = conflict.kind, conflict.ego, conflict.other
        size_m = SIZES_M.get(type_of.get(conflict.vehicle, ""), SIZES_M["car"])
        distance_m = _travelled_m(other, time_s)
        if conflict.meets:
            path_key = conflict.sector, conflict.route
            crossing = road.crossings[path_key]
            begin_m = crossing.ego_arc_m - ego.arc_m
            arc_m = crossing.other_arc_m - other.arc_m + distance_m
            motions.append(Motion(way, begin_m, road.paths[path_key], arc_m, size_m))
            continue
        begin_m, lane = road.zone_arc_m - graph.ego.zone_m, conflict.lane or "own"
        if kind == "behind" and lane == "own":
            continue  # it keeps its distance by itself
        arc_m = begin_m + ego.arc_m - other.arc_m + distance_m
        if kind == "oncoming":
            arc_m = begin_m + ego.arc_m + other.arc_m - distance_m
        elif before := queue.get(lane):
            bumper_m = before.arc_m - (before.size_m[0] + size_m[0]) / 2 - 2.0
            arc_m = np.minimum(arc_m, bumper_m)
        motion = Motion(way, begin_m, road.paths[road.beside(key)[lane]], arc_m, size_m)
        motions.append(motion)
        if kind == "ahead":
            queue[lane] = motion
    return motions


def _travelled_m(other: Arrival, time_s: Floats) -> Floats:
    """Return the distance that a vehicle travels at its speed,
    or while it brakes until it stands.
    """
    if not other.braking:
        return np.asarray(other.speed_mps * time_s)
    until_s = np.minimum(time_s, other.speed_mps / EMERGENCY_MPS2)
    return np.asarray(other.speed_mps * until_s - EMERGENCY_MPS2 / 2 * until_s**2)


def least_gap(
    tried: Rollouts, motion: Motion, under_way: Bools | bool = True, within_m: float = 0.0
) -> Floats:
    """Return the smallest gap (m) to another vehicle for each of the ego's motions, (motions,).

    A value below 0 is a collision.

    Args:
        tried: the ego's predicted motions.
        motion: the other vehicle's.
        under_way: which steps of each motion count, such as those before the goal,
            (motions, steps); True for all.
        within_m: a gap wider than this may be given as inf, which is faster.
    """
    (ego_discs, ego_reach), (discs, reach) = cover(*SIZES_M["car"]), cover(*motion.size_m)
    (x, y), off_m = _middles(tried, motion.way, motion.begin_m)
    its_x, its_y, _ = motion.path.places(motion.arc_m)
    near_m = ego_discs.max() + discs.max() + ego_reach + reach + MARGIN_M + off_m + within_m
    sequence, step = np.nonzero(((x - its_x) ** 2 + (y - its_y) ** 2 < near_m**2) & under_way)
    squared = np.full(len(x), np.inf)
    if len(step):
        right_m = None if tried.right_m is None else tried.right_m[sequence, step]
        arc_m = motion.begin_m + tried.travelled_m[sequence, step]
        x, y = _discs(motion.way, arc_m, ego_discs, right_m)
        its_x, its_y = (part[:, None, step] for part in _discs(motion.path, motion.arc_m, discs))
        np.minimum.at(squared, sequence, ((x - its_x) ** 2 + (y - its_y) ** 2).min(axis=(0, 1)))
    return np.asarray(np.sqrt(squared) - reach - ego_reach - MARGIN_M)


@lru_cache(maxsize=8)  # the ego meets others on few ways
def _middles(tried: Rollouts, way: Path, begin_m: float) -> tuple[Point, float]:
    """Return about where the ego is along a way, (motions, steps), and how far off that may be, m.

    Shared: do not write to it.
    """
    spacing_m, off_m = float(way.arc_m[1]), way.uneven_m
    point = (
        np.rint((begin_m + tried.travelled_m) / spacing_m).astype(int).clip(0, len(way.arc_m) - 1)
    )
    x, y = way.columns[0][point], way.columns[1][point]
    if tried.right_m is None:
        return (x, y), spacing_m + off_m
    heading = way.headings_rad[point]
    x, y = x - np.sin(heading) * tried.right_m, y + np.cos(heading) * tried.right_m
    turned_rad = way.kink_rad * (1 + off_m / spacing_m)
    return (x, y), spacing_m + off_m + turned_rad * float(np.abs(tried.right_m).max())


@lru_cache(maxsize=64)
def cover(length_m: float, width_m: float) -> tuple[Floats, float]:
    """Return equal discs that cover a vehicle of length `length_m` and width `width_m`, m.

    The first result are their centres, offsets along the vehicle's axis from its middle, (discs,)
    m, in a shared array that must not be written to; the second is their radius, m.
    """
    count = max(3, round(length_m / width_m))
    places = (np.arange(count) - (count - 1) / 2) * length_m / count
    return places, float(np.hypot(length_m / count / 2, width_m / 2))


def _discs(path: Path, arc_m: Floats, away_m: Floats, right_m: Floats | None = None) -> Point:
    """Return x and y (discs, ...) of a vehicle's discs at arc lengths (...) of a path,
    or to its right.
    """
    x, y, heading = path.places(arc_m)
    cos, sin = np.cos(heading), np.sin(heading)
    if right_m is not None:
        x, y = x - sin * right_m, y + cos * right_m
    return x + np.multiply.outer(away_m, cos), y + np.multiply.outer(away_m, sin)
