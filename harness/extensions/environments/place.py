"""Where an environment takes place: its parameters, its road, and the ego's goal.

Most environments have one road. Where it differs from seed to seed, or the goal does, each layout
has a place of its own.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, ClassVar, cast

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.extensions.environments import environment
from harness.extensions.environments.environment import label, lane_of, raised, reset
from harness.extensions.environments.goal import Goal, at_place, declared
from harness.extensions.environments.routes import Routes, routes
from harness.extensions.environments.window import LEAST_M, is_within, middle, within
from harness.world.parameters import Parameters as Common
from harness.world.road import ONE_LANE_M, Crossing, Lane, Path, PathKey, Road, crossings, lanes_of
from harness.world.scenario import LAYOUTS_KEPT, Scenario

CAREFUL_FIRST = ("SLOWER", "IDLE", "FASTER", "LANE_LEFT", "LANE_RIGHT")
MOST_HZ = 1000
# decision periods after the last decision: to the goal by cruising, to the time limit
AFTER, LIMIT = 2, 5
REACH_M = 500.0  # paths are built up to this distance from the middle of an episode
# watched parts of the ego's ways, behind its start and beyond its goal
BEHIND_M, BEYOND_M = 30.0, 40.0
BEFORE_M = (5.0, 45.0)  # watched part of a path that meets the ego's, before that point
HALFWAY = 0.4  # share of the way to the goal at which the origin lies, the middle of pictures
PROBES = 1, 2  # seeds whose roads are compared with seed 0's
Make = Callable[..., Any]  # takes a scenario's name, and returns a new environment


@dataclass(frozen=True)
class Parameters(Common):
    """Hold the parameters of an environment of highway-env as a scenario.

    Raises UserError if `decisions` (of an episode) or `helpers` (the vehicles that the ego can ask)
    is not from 1 to 9. `braking_mps2` and `acceleration_mps2` are the hardest that the ego can do,
    m/s^2, as far as the harness assumes.
    """

    additions: ClassVar[tuple[tuple[str, Any], ...]] = (("goal", ""), ("window_m", 0.0))
    braking_mps2: float = 20.0  # hardest braking, m/s^2; highway-env's own controller has no limit
    acceleration_mps2: float = 20.0  # hardest acceleration, m/s^2
    # number of helpers, the vehicles that the ego can ask: others that the environment lets agents
    # control first, then those nearest to the ego
    helpers: int = 3
    # the ego's goal (`Goal`), such as `120m`; empty for the one that the environment declares
    goal: str = ""
    # distance from the middle of an episode, m, beyond which nothing is there for the harness; 0
    # for none
    window_m: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.goal:
            Goal.of(self.goal)
        if self.window_m and not LEAST_M <= self.window_m <= REACH_M:
            raise UserError(
                f"scenario: window_m is {self.window_m:g}; it must be 0 for none, or from "
                f"{LEAST_M:g} to {REACH_M:g}"
            )
        for name in ("decisions", "helpers"):
            if not 0 < getattr(self, name) <= 9:
                raise UserError(
                    f"scenario: {name} is {getattr(self, name)}; it must be from 1 to 9"
                )

    @property
    def goal_s(self) -> float:
        """Return the seconds of the ego's decisions and two periods more.

        A goal that is `speed` is this time, times the first target speed, away from its start.
        """
        return (self.decisions + AFTER) * self.decision_period_s


@dataclass(frozen=True)
class Place:
    """Hold what is the same for every seed of an environment of highway-env, or for one layout.

    `routes` are the paths through its road network, and `road` has these with the ego's goal.
    `ends` has where each lane, by highway-env's index of it, begins and ends: x, y, x, y in m of
    highway-env's own frame. `actions` are the names of what the ego can do, such as `SLOWER`;
    `kind` is the name of the environment's class. `goal` is the ego's, which the environment
    declared as `declaration`.
    """

    routes: Routes  # the paths of its network
    # where each of the network's lanes begins and ends: x, y, x, y in m
    ends: Mapping[Lane, tuple[float, ...]]
    road: Road  # these paths and the ego's goal, as the harness describes them
    actions: tuple[str, ...]  # the ego's meta-actions, such as `SLOWER`
    parameters: Parameters  # the scenario's parameters, as they are by default
    kind: str  # name of the environment's class
    goal: Goal  # the ego's goal
    declaration: str | tuple[float, float]  # the goal that the environment declared
    window_m: float  # distance from the middle beyond which nothing is there, m; 0 for none

    def has(self, thing: Any) -> bool:
        """Return whether a `Vehicle` of highway-env is within the window, and on a lane there."""
        is_near = is_within(thing.position, self.road.origin_m, self.window_m)
        return is_near and (not self.window_m or lane_of(thing) in self.ends)

    def differs(self, env: Any) -> str | None:
        """Return what is another in an environment that is reset to a seed; None if nothing is.

        `env` is an `AbstractEnv`. The answer is a word for messages, such as `road`.
        """
        ego, network = env.vehicle, env.road.network
        if self.window_m:
            network = within(network, self.road.origin_m, self.window_m)
        if ends_of(network) != self.ends:
            return "road"
        if not {*self.routes.keys(lane_of(ego), ego.route)}.intersection(self.road.ways):
            return "ego's path"
        return None if declared("", env) == self.declaration else "goal"


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


@dataclass(frozen=True)
class RoadOf:
    """Return, when called, the road of an environment, or of one layout of it.

    `make` makes it by its scenario name `name` (`EnvironmentWorld.environment`). `seed` is that
    of the layout, or 0 where all have one road; `goal` and `window_m` are the parameters, and
    `cruise_s` the time to a goal that is `speed`.
    """

    make: Make  # makes the environment by its name
    name: str  # the scenario's name, such as `env:merge-v0`
    seed: int  # the layout seed whose road it is
    goal: str  # the parameter `goal`
    window_m: float  # the parameter `window_m`, m
    # time of the decisions and two periods, s; None for that of the default parameters, by which
    # the middle of an episode without a window lies
    cruise_s: float | None

    @classmethod
    def of(cls, scenario: Scenario) -> "RoadOf":
        """Return the road of a scenario whose world is an `EnvironmentWorld`."""
        p, world = cast("Parameters", scenario.parameters), cast("Any", scenario.world)
        seed = scenario.layout_seed or 0
        cruise_s = p.goal_s if p.window_m else None
        return cls(world.environment, scenario.name, seed, p.goal, p.window_m, cruise_s)

    @cached_property
    def place(self) -> Place:
        return place(self.make, self.name, self.seed, self.goal, self.window_m, self.cruise_s)

    @cached_property
    def differs(self) -> bool:
        """Return whether layouts differ in their roads, or in the goal that is declared.

        An environment says so by `several_roads`. Of one that does not, three layouts are compared;
        those of highway-env itself have one road.
        """
        roads, goals, streets = differences(self.make, self.name)
        if roads or (goals and not self.goal):
            return True
        others = PROBES if streets else ()
        return any(self.place.differs(start(self.make, self.name, seed)) for seed in others)

    def __call__(self) -> Road:
        return self.place.road


@lru_cache(maxsize=1)  # parameters and place are found from one
def start(make: Make, name: str, seed: int) -> Any:
    """Return an environment that is reset to a seed; a shared one, which must not be stepped.

    `make` makes it by its scenario name, `name`. Raises UserError if there is no such environment,
    or it lacks something needed.
    """
    return reset(name, seed, make(name))


@lru_cache(maxsize=16)
def differences(make: Make, name: str) -> tuple[bool, bool, bool]:
    """Return whether roads, declared goals, and the streets where egos start differ by seed.

    `make` makes the environment by its scenario name, `name`.
    """
    env = start(make, name, 0)
    several: bool | None = getattr(env, "several_roads", None)
    if several is not None or type(env).__module__.startswith(f"{environment.OWN_PACKAGE}."):
        return bool(several), False, False
    envs = [env, *(start(make, name, seed) for seed in PROBES)]
    roads = [ends_of(each.road.network) for each in envs]
    goals = [declared(label(name), each) for each in envs]
    streets = [lane_of(each.vehicle)[:2] for each in envs]
    return _differ(roads), _differ(goals), _differ(streets)


def _differ(parts: Sequence[object]) -> bool:
    return any(part != parts[0] for part in parts)


@lru_cache(maxsize=16)
def usual(make: Make, name: str) -> tuple[Parameters, tuple[str, ...]]:
    """Return an environment's default parameters and the ego's actions, the most careful first.

    `make` makes it by its scenario name, `name`. Raises UserError if its frequencies of frames and
    decisions do not fit.
    """
    env = start(make, name, 0)
    available = environment.meta_actions(name, env).actions.values()
    actions = tuple(action for action in CAREFUL_FIRST if action in available)
    return _parameters(name, env, len(available)), actions


@lru_cache(maxsize=LAYOUTS_KEPT)
def place(
    make: Make, name: str, seed: int, goal: str, window_m: float, cruise_s: float | None
) -> Place:
    """Return where the episode of a seed takes place: paths, road, actions, parameters, goal.

    `make` makes an environment by its scenario name, `name`, such as `env:merge-v0`. `goal` and
    `window_m` are the parameters, and `cruise_s` the time to a goal that is `speed`. Raises
    UserError if there is no such environment, or it has no such goal.
    """
    p, actions = usual(make, name)
    env = start(make, name, seed)
    ego, network, lane = env.vehicle, env.road.network, lane_of(env.vehicle)
    declaration = declared(label(name), env)
    aim, speed_mps = _aim(name, goal or declaration, ego), first_target_mps(ego)
    cruise_s = cruise_s or p.goal_s
    ahead_m = aim.ahead_m(cruise_s, speed_mps)

    if window_m:
        origin = middle(network, ego, HALFWAY * ahead_m)
        if not is_within(ego.position, origin, window_m):
            raise _too_near(name, window_m, ahead_m)
        network = within(network, origin, window_m)
        near = routes(name, network, lane[:2], origin, window_m)
        key = near.keys(lane, ego.route)[0]
    else:
        whole = routes(name, network, lane[:2])
        key = whole.keys(lane, ego.route)[0]
        way = whole.paths[key]
        origin = way.at(way.project(*ego.position)[0] + HALFWAY * ahead_m)[:2]
        near = routes(name, network, lane[:2], origin, REACH_M)
    ways = next((ways for ways in near.ways.values() if key in ways), (key,))
    begin_m = near.paths[key].project(*(ego.position - origin))[0]
    if not isinstance(goal or declaration, str):
        aim = at_place(label(name), near.paths[key], begin_m, *(np.array(declaration) - origin))
    goal_m = begin_m + aim.ahead_m(cruise_s, speed_mps)
    watched_m = begin_m - BEHIND_M, goal_m + BEYOND_M
    if window_m:
        way = near.paths[key]
        is_cut = np.hypot(*way.points[-1]) > window_m - 1.0  # by the window: the road goes on
        if aim.is_place and is_cut and goal_m > way.arc_m[-1]:
            raise _too_near(name, window_m, goal_m - begin_m)
        watched_m = max(watched_m[0], 0.0), min(watched_m[1], float(way.arc_m[-1]))
    meetings: dict[PathKey, Crossing] = {}
    for way_key in (*ways, key):
        for other, at in crossings(near.paths, way_key).items():
            if begin_m < at.ego_arc_m < goal_m + BEYOND_M:
                meetings[other] = at
    zone_m = min((goal_m, *(at.ego_arc_m for at in meetings.values())))
    facts: dict[str, str | float] = {"kind": type(env).__name__, "ego": "/".join(key)}
    if aim.kind != "speed":
        facts["goal"] = aim.text
    road = Road(
        facts=facts,
        paths=near.paths,
        ego=key,
        crossings=meetings,
        zone_m=near.paths[key].at(zone_m)[:2],
        sectors=_sectors(near.paths, ways, meetings, watched_m),
        network=lambda: network,
        ways=ways,
        origin_m=origin,
        goal_m=partial(_goal_m, aim, speed_mps, begin_m) if aim.is_place else None,
        waits=aim.kind == "stay",
    )
    return Place(
        near, ends_of(network), road, actions, p, type(env).__name__, aim, declaration, window_m
    )


def _aim(name: str, goal: str | tuple[float, float], ego: Any) -> Goal:
    """Return the goal of a text; of a place, which is about so far away as it is by air."""
    if isinstance(goal, str):
        return Goal.of(goal, label(name))
    return Goal("place", float(np.hypot(*(np.array(goal) - ego.position))))


def _too_near(name: str, window_m: float, ahead_m: float) -> UserError:
    """Return the error for a window beyond which the ego's start or goal lies."""
    least_m = math.ceil(max(HALFWAY, 1 - HALFWAY) * ahead_m) + 1
    return UserError(
        f"{label(name)}: window_m is {window_m:g}, and the ego's way to its goal is {ahead_m:.0f} "
        f"m; set window_m={least_m}, or a nearer goal"
    )


def _goal_m(aim: Goal, speed_mps: float, begin_m: float, parameters: Parameters) -> float:
    return begin_m + aim.ahead_m(parameters.goal_s, speed_mps)


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
        window_m=_window_m(name, env),
    )


def _window_m(name: str, env: Any) -> float:
    """Return the window that an environment has by its attribute `window_m`, m; 0 for none."""
    try:
        return float(getattr(env, "window_m", 0.0))
    except (TypeError, ValueError) as error:
        raise UserError(f"{label(name)}: its window_m is no number: {raised(error)}") from None


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
