"""Where an environment takes place: its parameters, its road, and the ego's goal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.extensions.environments import environment
from harness.extensions.environments.environment import lane_of, reset
from harness.extensions.environments.routes import Routes, routes
from harness.world.parameters import Parameters as Common
from harness.world.road import ONE_LANE_M, Crossing, Lane, Path, PathKey, Road, crossings, lanes_of

CAREFUL_FIRST = ("SLOWER", "IDLE", "FASTER", "LANE_LEFT", "LANE_RIGHT")
MOST_HZ = 1000
# decision periods after the last decision: to the goal by cruising, to the time limit
AFTER, LIMIT = 2, 5
REACH_M = 500.0  # paths are built up to this distance from the middle of an episode
# watched parts of the ego's ways, behind its start and beyond its goal
BEHIND_M, BEYOND_M = 30.0, 40.0
BEFORE_M = (5.0, 45.0)  # watched part of a path that meets the ego's, before that point
HALFWAY = 0.4  # share of the way to the goal at which the origin lies, the middle of pictures


@dataclass(frozen=True)
class Parameters(Common):
    """Hold the parameters of an environment of highway-env as a scenario.

    Raises UserError if `decisions` (of an episode) or `helpers` (the vehicles that the ego can ask)
    is not from 1 to 9. `braking_mps2` and `acceleration_mps2` are the hardest that the ego can do,
    m/s^2, as far as the harness assumes.
    """

    braking_mps2: float = 20.0  # hardest braking, m/s^2; highway-env's own controller has no limit
    acceleration_mps2: float = 20.0  # hardest acceleration, m/s^2
    # number of helpers, the vehicles that the ego can ask: others that the environment lets agents
    # control first, then those nearest to the ego
    helpers: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("decisions", "helpers"):
            if not 0 < getattr(self, name) <= 9:
                raise UserError(
                    f"scenario: {name} is {getattr(self, name)}; it must be from 1 to 9"
                )

    @property
    def goal_s(self) -> float:
        """Return the seconds that the ego needs to its goal if it keeps its first target speed.

        So the goal is this time, times that speed, away from its start.
        """
        return (self.decisions + AFTER) * self.decision_period_s


@dataclass(frozen=True)
class Place:
    """Hold what is the same for every seed of an environment of highway-env.

    `routes` are the paths through its road network, and `road` has these with the ego's goal.
    `ends` has where each lane, by highway-env's index of it, begins and ends: x, y, x, y in m of
    highway-env's own frame. `actions` are the names of what the ego can do, such as `SLOWER`;
    `kind` is the name of the environment's class.
    """

    routes: Routes  # the paths of its network
    # where each of the network's lanes begins and ends: x, y, x, y in m
    ends: Mapping[Lane, tuple[float, ...]]
    road: Road  # these paths and the ego's goal, as the harness describes them
    actions: tuple[str, ...]  # the ego's meta-actions, such as `SLOWER`
    parameters: Parameters  # the scenario's parameters
    kind: str  # name of the environment's class


def first_target_mps(ego: Any) -> float:
    """Return the speed, m/s, that an ego aims for at first; the highest it can, if that is 0.

    `ego` is a vehicle of highway-env that is driven by meta-actions (`MDPVehicle`).
    """
    return float(ego.target_speed) or float(max(ego.target_speeds))


def ends_of(network: Any) -> dict[Lane, tuple[float, ...]]:
    """Return where each lane of a highway-env `RoadNetwork` begins and ends: x, y, x, y in m.

    The key is the lane's index: the two nodes of its road, and its number from the left, from 0.
    Coordinates are those of highway-env's own frame.
    """
    ends = {}
    for index, lane in lanes_of(network).items():
        points = np.round([lane.position(0, 0), lane.position(lane.length, 0)], 3)
        ends[index] = tuple(points.ravel().tolist())
    return ends


@lru_cache(maxsize=16)
def place(name: str) -> Place:
    """Return what is the same for every seed of an environment: paths, road, actions, parameters.

    It is found by resetting it to seed 0. `name` is its scenario name, such as `env:merge-v0`.
    Raises UserError if there is no such environment, or its frequencies of frames and decisions do
    not fit.
    """
    env = reset(name, 0)
    ego, network = env.vehicle, env.road.network
    available = environment.meta_actions(name, env).actions.values()
    p, lane = _parameters(name, env, len(available)), lane_of(ego)
    goal = partial(_goal_m, first_target_mps(ego))

    whole = routes(name, network, lane[:2])
    key = whole.keys(lane, ego.route)[0]
    way = whole.paths[key]
    origin = way.at(way.project(*ego.position)[0] + HALFWAY * goal(0.0, p))[:2]
    near = routes(name, network, lane[:2], origin, REACH_M)
    ways = next((ways for ways in near.ways.values() if key in ways), (key,))
    begin_m = near.paths[key].project(*(ego.position - origin))[0]
    goal_m = goal(begin_m, p)
    meetings: dict[PathKey, Crossing] = {}
    for way_key in (*ways, key):
        for other, at in crossings(near.paths, way_key).items():
            if begin_m < at.ego_arc_m < goal_m + BEYOND_M:
                meetings[other] = at
    zone_m = min((goal_m, *(at.ego_arc_m for at in meetings.values())))
    road = Road(
        facts={"kind": type(env).__name__, "ego": "/".join(key)},
        paths=near.paths,
        ego=key,
        crossings=meetings,
        zone_m=near.paths[key].at(zone_m)[:2],
        sectors=_sectors(near.paths, ways, meetings, (begin_m - BEHIND_M, goal_m + BEYOND_M)),
        network=lambda: network,
        ways=ways,
        origin_m=origin,
        goal_m=partial(goal, begin_m),
    )
    actions = tuple(action for action in CAREFUL_FIRST if action in available)
    return Place(near, ends_of(network), road, actions, p, type(env).__name__)


def _goal_m(speed_mps: float, begin_m: float, parameters: Parameters) -> float:
    return begin_m + parameters.goal_s * speed_mps


def _parameters(name: str, env: Any, actions: int) -> Parameters:
    hz, decisions_hz = (env.config[f"{kind}_frequency"] for kind in ("simulation", "policy"))
    for kind, value in (("simulation", hz), ("policy", decisions_hz)):
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not 0 < value <= MOST_HZ
        ):
            raise UserError(
                f"{environment.label(name)}: {kind}_frequency is {printable(repr(value))}; set a "
                f"number above 0, at most {MOST_HZ}, in its config"
            )
    if hz % decisions_hz:
        raise UserError(
            f"{environment.label(name)}: simulation_frequency {hz:g} is no multiple of "
            f"policy_frequency {decisions_hz:g}; set one in its config"
        )
    period_s = 1 / decisions_hz
    # A tree has about a hundred decision points: three actions lead to 2.4 new ones each, five to
    # 3.4.
    decisions = 6 if actions == 3 else 4
    return Parameters(
        target_speeds_mps=tuple(float(speed) for speed in env.vehicle.target_speeds),
        decisions=decisions,
        decision_period_s=period_s,
        decision_lag_s=min(Common.decision_lag_s, period_s / 2),
        simulation_hz=int(hz),
        time_limit_s=(decisions + LIMIT) * period_s,
        delay_allowance_s=period_s,
        beacon_hz=min(Common.beacon_hz, hz),
    )


def _sectors(
    paths: Mapping[PathKey, Path],
    ways: Sequence[PathKey],
    meetings: Mapping[PathKey, Any],
    watched_m: tuple[float, float],
) -> dict[str, Floats]:
    """Return the points that must be seen: of the ego's ways, and of paths before they meet it."""
    sectors: dict[str, Floats] = {}
    for key in ways:
        points = paths[key].points_at(np.linspace(*watched_m, 15))
        before = np.concatenate([*sectors.values(), np.full((1, 2), np.inf)])
        apart_m = np.hypot(*(points[:, None] - before).T).min(axis=0)
        # of a way that parts later only what is its own
        if (own_points := points[apart_m > ONE_LANE_M]).size:
            sectors[key[1]] = own_points
    for key, at in meetings.items():
        if key[0] not in sectors:
            sectors[key[0]] = paths[key].points_at(at.other_arc_m - np.linspace(*BEFORE_M, 9))
    return sectors
