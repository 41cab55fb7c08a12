"""Any environment of highway-env as a scenario: `env:merge-v0`, `env:my_package:MyEnv-v0`.

Vehicles, traffic and ends are the environment's; docs/environments.md says what it must offer. Its id and
what its configuration changes are the scenario's name, so that a name is enough to make it again.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json
from harness.world.road import Path, PathKey, Road, crossings, ground
from harness.world.routes import Routes, routes
from harness.world.scenario import Layout, Scenario
from harness.world.scenario import Parameters as Common

PREFIX = "env:"
CAREFUL_FIRST = ("SLOWER", "IDLE", "FASTER", "LANE_LEFT", "LANE_RIGHT")
REACH_M = 500.0  # from the middle of an episode: as far as paths are drawn
BEHIND_M, BEYOND_M = 30.0, 40.0  # watched of the ego's ways, behind its start and beyond its goal
BEFORE_M = (5.0, 45.0)  # watched of a path that meets the ego's, before that point
HALFWAY = 0.4  # of the way to the goal lies the origin, the middle of pictures
AFTER, LIMIT = 2, 5  # decision periods after the last decision, from which the goal and the time limit follow


@dataclass(frozen=True)
class Parameters(Common):
    """The dials of an environment.

    Attributes:
        helpers: how many vehicles help: other controlled ones first, then those nearest to the ego.
    """

    braking_mps2: float = 20.0  # highway-env's own controller has no limits
    acceleration_mps2: float = 20.0
    helpers: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in (("decisions", 9), ("helpers", 9)):
            if not 0 < getattr(self, name) <= most:
                raise UserError(
                    f"scenario: {name} is {getattr(self, name)}; it must be above 0, at most {most}"
                )

    @property
    def goal_s(self) -> float:
        """The ego's goal is as far away as it would come in this time at its first target speed."""
        return (self.decisions + AFTER) * self.decision_period_s


DIALS = ("decisions", "helpers", "time_limit_s", "delay_allowance_s")


def named(env: str, config: Mapping[str, Any] | None = None) -> str:
    """The scenario's name of an environment: its id and what its configuration changes."""
    return f"{PREFIX}{env}" + (f":config={canonical_json(config)}" if config else "")


def split(text: str) -> tuple[str, str | None]:
    """A name, and settings such as `decisions=5` that may stand between id and configuration."""
    head, config, changes = text.partition(":config=")
    name, _, settings = head.rpartition(":")
    return (name + config + changes, settings) if "=" in settings else (text, None)


def joined(name: str, settings: Sequence[str]) -> str:
    """A name with settings."""
    head, config, changes = name.partition(":config=")
    return ":".join([head, *([",".join(settings)] if settings else [])]) + config + changes


@lru_cache(maxsize=16)
def scenario(name: str) -> Scenario:
    """An environment as a scenario. Raises UserError if it is none, or lacks something, in a line."""
    env = reset(name, 0)
    ego, shown = env.vehicle, printable(name, 80)
    actions = tuple(a for a in CAREFUL_FIRST if a in _meta_actions(env, shown).actions.values())
    if missing := {"SLOWER", "IDLE", "FASTER"}.difference(actions):
        raise UserError(
            f"{shown} has no action {', '.join(sorted(missing))}; set `longitudinal` in its action config"
        )
    hz, decisions_hz = (env.config[f"{kind}_frequency"] for kind in ("simulation", "policy"))
    if hz % decisions_hz:
        raise UserError(
            f"{shown}: simulation_frequency {hz:g} is no multiple of policy_frequency {decisions_hz:g}; "
            "set one in its config"
        )
    return Scenario(
        name=name,
        description=f"Scenario {name}: {type(env).__name__} with the traffic that it brings along.\n",
        actions=actions,
        parameters=_parameters(env),
        road=partial(road, name),
        layout=_layout,
        cleared=_arrived,
        words={
            "task": f"follow your road, {_prepared(name).road.ego[1].partition(' lane ')[0]}, and keep up speed",
            "hiding": "other vehicles",
        },
        brake_lamps=True,
        start=_start,
    )


def _parameters(env: Any) -> Parameters:
    hz, period_s = env.config["simulation_frequency"], 1 / env.config["policy_frequency"]
    # A tree has some hundred decision points: three actions lead to 2.4 new ones, five to 3.4.
    decisions = 6 if len(_meta_actions(env, "").actions) == 3 else 4
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


def _layout(seed: int, parameters: Any) -> Layout:
    """Nobody knows what an environment's seeds hold: no vehicle of it counts as the danger."""
    return Layout((), (), None, None)


def _arrived(vehicles: Sequence[Any], parameters: Any) -> bool:
    return bool(vehicles[0].to_go_m <= 0)


def _start(scenario: Scenario, seed: int) -> Any:
    from harness.world.environment_world import EnvironmentWorld

    return EnvironmentWorld.begun(scenario, seed)


def config(name: str) -> dict[str, Any]:
    """An environment's whole configuration."""
    whole: dict[str, Any] = json.loads(json.dumps(reset(name, 0).config, default=str))
    return whole


def reset(name: str, seed: int) -> Any:
    """An environment at the start of a seed's episode. Raises UserError if that cannot be had."""
    import gymnasium
    import highway_env
    from highway_env.envs.common.abstract import AbstractEnv

    gymnasium.logger.min_level = gymnasium.logger.ERROR  # an old version is what the user asked for
    if "highway-v0" not in gymnasium.registry:
        highway_env._register_highway_envs()
    shown = printable(name, 80)
    env_id, _, changes = name.removeprefix(PREFIX).partition(":config=")
    if not re.search(r"-v\d+$", env_id):
        raise UserError(f"{shown}: give its version too, as in merge-v0")
    _constants().restore()
    try:
        env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    except ModuleNotFoundError as error:
        raise UserError(
            f"{shown}: {printable(str(error).partition('. ')[0])}; install the package, or put its folder on "
            "PYTHONPATH"
        ) from None
    except gymnasium.error.Error as error:
        raise UserError(f"{shown}: {printable(error)}; give an id that gymnasium.make knows") from None
    except Exception as error:  # whatever a user's environment raises when it is made
        raise UserError(f"{shown} cannot be made: {type(error).__name__}: {printable(error)}") from None
    if not isinstance(env, AbstractEnv):
        raise UserError(
            f"{shown} is a {type(env).__name__}, no environment of highway-env; its class must be "
            "a subclass of highway_env's AbstractEnv"
        )
    try:
        changed = json.loads(changes or "{}")
        if not isinstance(changed, dict):
            raise ValueError("no object")
    except ValueError as error:
        raise UserError(f"{shown}: its config is no JSON object ({printable(error)})") from None
    for key, value in changed.items():
        if key not in env.config:
            raise unknown(f"config key of {shown}", key, env.config)
        env.config[key] = _merged(env.config[key], value)
    _constants().restore()
    try:
        env.reset(seed=seed)
    except Exception as error:
        raise UserError(
            f"{shown} cannot be reset: {type(error).__name__}: {printable(error)}; mind its config"
        ) from None
    _meta_actions(env, shown)
    return env


def _merged(default: Any, value: Any) -> Any:
    """A changed part of a configuration; what names its own type is taken whole."""
    if isinstance(default, dict) and isinstance(value, dict) and "type" not in value:
        return {**default, **{key: _merged(default.get(key), each) for key, each in value.items()}}
    return value


def _meta_actions(env: Any, shown: str) -> Any:
    """The ego's meta-actions. Raises UserError if it has none."""
    from highway_env.envs.common.action import DiscreteMetaAction, MultiAgentAction

    kind = env.action_type
    if isinstance(kind, MultiAgentAction) and kind.agents_action_types:
        kind = kind.agents_action_types[0]
    if not isinstance(kind, DiscreteMetaAction):
        raise UserError(
            f"{shown} has no meta-actions but {type(kind).__name__}; "
            'config {"action": {"type": "DiscreteMetaAction"}} gives it some, where its vehicles can take them'
        )
    return kind


ego_actions = _meta_actions


@dataclass(frozen=True)
class Constants:
    """highway-env's class constants, such as IDM's gaps, which some environments set for all others."""

    values: Mapping[tuple[type, str], Any]

    @classmethod
    def now(cls) -> "Constants":
        """As they are."""
        from highway_env.vehicle import behavior, controller, kinematics

        kinds = {
            kind for module in (behavior, controller, kinematics) for kind in vars(module).values()
            if isinstance(kind, type) and kind.__module__ == module.__name__
        }  # fmt: skip
        return cls({
            (kind, name): value for kind in kinds for name, value in vars(kind).items()
            if name.isupper() and not callable(value)
        })  # fmt: skip

    def restore(self) -> None:
        """Set them so again."""
        for (kind, name), value in self.values.items():
            if vars(kind)[name] is not value:
                setattr(kind, name, value)


@lru_cache(maxsize=1)
def _constants() -> Constants:
    """As highway-env has them, if nobody set them before the first environment was made here."""
    return Constants.now()


@dataclass(frozen=True)
class Prepared:
    """What is the same for every seed of an environment.

    Attributes:
        routes: the paths of its road.
        ways: those of the ego, from left to right.
        road: as the harness knows it.
        outline: where its lanes begin and end.
    """

    routes: Routes
    ways: tuple[PathKey, ...]
    road: Road
    outline: Mapping[Any, Any]


def road(name: str) -> Road:
    """An environment's road."""
    return _prepared(name).road


@lru_cache(maxsize=16)
def _prepared(name: str) -> Prepared:
    env = reset(name, 0)
    ego, network = env.vehicle, env.road.network
    lane = lane_of(ego.target_lane_index)
    rough = routes(printable(name, 80), network, lane[:2], (0.0, 0.0), math.inf)
    key = rough.keys(lane, ego.route)[0]
    p, speed_mps = _parameters(env), first_target_mps(ego)
    way = rough.paths[key]
    here_m = way.project(*ego.position)[0]
    origin_m = way.at(here_m + HALFWAY * p.goal_s * speed_mps)[:2]
    found = routes(printable(name, 80), network, lane[:2], origin_m, REACH_M)
    ways = (
        next(ways for ways in found.ways.values() if key in ways)
        if key in {k for ways in found.ways.values() for k in ways}
        else (key,)
    )
    begin_m = found.paths[key].project(*(ego.position - origin_m))[0]
    goal_m = begin_m + p.goal_s * speed_mps
    meetings = {
        other: at for way in (key, *ways) for other, at in crossings(found.paths, way).items()
        if begin_m < at.ego_arc_m < goal_m + BEYOND_M
    }  # fmt: skip
    zone = min((at for at in meetings.values()), key=lambda at: at.ego_arc_m, default=None)
    built = Road(
        facts={"kind": type(env).__name__, "ego": "/".join(key), "goal_m": round(goal_m - begin_m, 1)},
        paths=found.paths,
        ego=key,
        crossings=meetings,
        zone_m=(zone.x_m, zone.y_m) if zone and zone.ego_arc_m < goal_m else found.paths[key].at(goal_m)[:2],
        sectors=_sectors(found, ways, meetings, begin_m - BEHIND_M, goal_m + BEYOND_M),
        network=lambda: network,
        ground=partial(ground, network, origin_m=origin_m),
        ways=ways,
        goal_m=lambda p: begin_m + float(p.goal_s) * speed_mps,
        origin_m=origin_m,
    )
    return Prepared(found, ways, built, outline_of(network))


prepared = _prepared


def _sectors(
    found: Routes, ways: Sequence[PathKey], meetings: Mapping[PathKey, Any], begin_m: float, end_m: float
) -> dict[str, Floats]:
    """What must be seen: of each of the ego's ways, and of those that meet it before they do."""
    sectors: dict[str, Floats] = {}
    for key in ways:
        points = _points(found.paths[key], np.linspace(begin_m, end_m, 15))
        before = np.concatenate([*sectors.values(), np.full((1, 2), np.inf)])
        apart_m = np.hypot(*(points[:, None] - before).T).min(axis=0)
        if (
            own := points[apart_m > 1.0]
        ).size:  # of a way that parts later what is not in its neighbour's lane
            sectors[key[1]] = own
    for key, at in meetings.items():
        if key[0] not in sectors:
            sectors[key[0]] = _points(found.paths[key], at.other_arc_m - np.linspace(*BEFORE_M, 9))
    return sectors


def _points(path: Path, arcs_m: Floats) -> Floats:
    return np.array([path.at(arc_m)[:2] for arc_m in arcs_m])


def first_target_mps(ego: Any) -> float:
    """The speed that the ego aims at, or where it is to stand, the highest that it may aim at."""
    return float(ego.target_speed) or float(max(ego.target_speeds))


def lane_of(index: Sequence[Any]) -> tuple[str, str, int]:
    """A lane's name, of plain types: highway-env makes numbers NumPy's."""
    return str(index[0]), str(index[1]), int(index[2] or 0)


def outline_of(network: Any) -> dict[Any, Any]:
    """Where lanes begin and end, to the millimetre."""
    return {
        (a, b, n): tuple(np.round([lane.position(0, 0), lane.position(lane.length, 0)], 3).ravel().tolist())
        for a, nodes in network.graph.items() for b, lanes in nodes.items() for n, lane in enumerate(lanes)
    }  # fmt: skip


Digest = list[tuple[float, ...]]


def examine(scenario: Scenario, seed: int) -> None:
    """Raise UserError unless equal seeds give equal traffic, copies go on as one, and frames as its `step`.

    Some decisions are taken by the environment's own `step`, twice, and frame by frame, by a copy too.
    """
    shown = printable(scenario.name, 80)
    kinds = ("IDLE", "FASTER", "SLOWER")
    own = [_driven(scenario, seed, kinds) for _ in range(2)]
    if own[0] != own[1]:
        raise UserError(
            f"{shown}: its traffic differs between two runs of seed {seed}; "
            "draw from env.np_random, and keep nothing between episodes"
        )
    framed = scenario.start(scenario, seed) if scenario.start else None
    assert framed is not None
    try:
        framed.branch()
    except Exception as error:
        raise UserError(
            f"{shown} cannot be copied: {type(error).__name__}: {printable(error)}; "
            "keep files, locks and the like out of its attributes"
        ) from None
    for action, expected in zip(kinds, own[0], strict=False):
        framed.take(action)
        framed.advance(framed.frame + framed.period)
        if framed.outcome.ended:
            return
        if _digest(framed.env) != expected:
            raise UserError(
                f"{shown}: frame by frame its traffic is another than by its step(); "
                "let it act in `_simulate`'s frames, or after super().step()"
            )
        framed = framed.branch()


def _driven(scenario: Scenario, seed: int, actions: Sequence[str]) -> list[Digest]:
    env = reset(scenario.name, seed)
    found = []
    for action in actions:
        try:
            *_, terminated, truncated, _ = env.step(index_of(env, action))
        except Exception as error:
            raise UserError(
                f"{printable(scenario.name, 80)}: its step() fails: {type(error).__name__}: {printable(error)}"
            ) from None
        found.append(_digest(env))
        if terminated or truncated:
            break
    return found


def index_of(env: Any, action: str) -> Any:
    """An action as the environment's `step` takes it; other controlled vehicles keep to theirs."""
    kind = ego_actions(env, "")
    if kind is env.action_type:
        return kind.actions_indexes[action]
    idle = [each.actions_indexes["IDLE"] for each in env.action_type.agents_action_types[1:]]
    return (kind.actions_indexes[action], *idle)


def _digest(env: Any) -> Digest:
    return [(*v.position.tolist(), float(v.heading), float(v.speed)) for v in env.road.vehicles]
