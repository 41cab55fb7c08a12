"""Create an environment of highway-env from its scenario name,
and access its actions and configuration.

The name is `env:` and the id that gymnasium knows, and for a changed configuration also `:config=`
and the changes as JSON. So the name alone is enough to create the same environment again.
"""

import importlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from harness.core.depth import shallow
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json
from harness.core.strangers import strangers, watched
from harness.world.road import Lane
from harness.world.scenario import KNOWN_ACTIONS

PREFIX, CHANGES = "env:", ":config="
# environment variable: modules, with commas, that names may have imported
IMPORTS = "SWARMDRIVE_IMPORTS"
OWN_PACKAGE = "highway_env"
# what the ego of meta-actions has
OF_EGO = ("target_speeds", "target_speed", "speed_index", "route")


def named(env: str, config: Any = None) -> str:
    """Return the scenario name of an environment of highway-env, such as `env:merge-v0`.

    `env` is its gymnasium id, such as `merge-v0`, and `config` the changed keys of its
    configuration with their values, plain values of JSON, which become part of the name; None for
    none.
    """
    return f"{PREFIX}{env}" + (f"{CHANGES}{canonical_json(config)}" if config else "")


def split(text: str) -> tuple[str, str | None]:
    """Split a text such as `env:merge-v0:decisions=5` into the scenario's name and its settings.

    The settings are one text, such as `decisions=5,helpers=2`; None without any.
    """
    head, config, changes = text.partition(CHANGES)
    name, _, settings = head.rpartition(":")
    return (name + config + changes, settings) if "=" in settings else (text, None)


def joined(name: str, settings: Sequence[str]) -> str:
    """Return a scenario's name with settings added, such as `env:merge-v0:decisions=5,helpers=2`.

    `name` is that without settings, and each of `settings` one such as `decisions=5`.
    """
    head, config, changes = name.partition(CHANGES)
    return ":".join([head, *([",".join(settings)] if settings else [])]) + config + changes


def label(name: str) -> str:
    """Return the name of a scenario as error messages show it: printable, and not too long."""
    return printable(name, 80)


def allow(name: str) -> None:
    """Allow importing the Python module that an environment's name refers to, such as `my_envs`.

    It holds here and in subprocesses, by an environment variable (`IMPORTS`). Only for names that
    the user typed: a name from a file, such as a manifest, must not be given.
    """
    if module := module_of(name):
        os.environ[IMPORTS] = ",".join([*_allowed(), module])


def module_of(name: str) -> str:
    """Return the Python module that gymnasium imports for an environment, such as `my_envs`.

    `name` is its scenario name, such as `env:my_envs:MyEnv-v0`. Empty for an environment of
    highway-env itself.
    """
    return _id_and_changes(name)[0].rpartition(":")[0]


def _allowed() -> list[str]:
    """Return the modules that the variable `IMPORTS` lets environments import."""
    modules = [text.strip() for text in os.environ.get(IMPORTS, "").split(",")]
    return [module for module in modules if module]


def _id_and_changes(name: str) -> tuple[str, str]:
    env_id, _, changes = split(name)[0].removeprefix(PREFIX).partition(CHANGES)
    return env_id, changes


def _only_allowed(name: str, module: str) -> None:
    """Raise UserError if a module that a name would import is neither highway-env's nor allowed."""
    if not any(f"{module}.".startswith(f"{package}.") for package in (OWN_PACKAGE, *_allowed())):
        raise UserError(
            f"{label(name)} would import the module {printable(module, 40)}; if you trust it, "
            f"set {IMPORTS}={printable(module.partition('.')[0], 40)} in your environment"
        )


@contextmanager
def guarded(name: str, env: Any) -> Iterator[None]:
    """Enter a context for the code of an environment, in which its name imports only what it may.

    highway-env imports classes that a configuration names by their path. In this context it raises
    UserError for one of a module that is neither highway-env's nor allowed, unless the unchanged
    configuration of `env` has a path into the same module. `name` is the environment's scenario
    name.
    """
    from highway_env import utils

    def import_allowed(module: str) -> ModuleType:
        if module not in getattr(env, "own_modules", ()):
            _only_allowed(name, module)
        return importlib.import_module(module)

    # through this name every copy of `class_from_path` imports
    outer = utils.importlib
    utils.importlib = SimpleNamespace(import_module=import_allowed)
    try:
        yield
    finally:
        utils.importlib = outer


def _texts(value: Any) -> Iterator[str]:
    """Yield all texts among the values of a configuration."""
    rest = [value]
    while rest:
        value = rest.pop()
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict | list):
            rest += value.values() if isinstance(value, dict) else value


def reset(name: str, seed: int, env: Any = None) -> Any:
    """Return an environment of highway-env (an `AbstractEnv`), reset to a seed.

    `name` is its scenario name, such as `env:merge-v0`, and `env` a new environment; by default the
    one that `created` makes by that name. Raises UserError if there is none, it fails, or its ego
    (the car that decides) cannot be driven by meta-actions: SLOWER, IDLE, FASTER and changes of
    lane.
    """
    env = created(name) if env is None else env
    _constants().restore()
    try:
        with watched(label(name)), strangers(label(name)), guarded(name, env):
            env.reset(seed=seed)
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{label(name)} cannot be reset: {raised(error)}; mind its config"
        ) from None
    meta_actions(name, env)
    _only_drivable(name, env)
    return env


def _only_drivable(name: str, env: Any) -> None:
    """Raise UserError unless the ego is on the road, meta-actions drive it, and it can be hit."""
    ego = env.vehicle
    subject = f"{label(name)}: its ego"
    if not any(v is ego for v in env.road.vehicles):
        raise UserError(f"{subject} is not on the road; append self.vehicle to self.road.vehicles")
    subject += f" is a {printable(type(ego).__name__)}, which"
    advice = "make it of self.action_type.vehicle_class"
    missing = [attribute for attribute in OF_EGO if not hasattr(ego, attribute)]
    if missing:
        raise UserError(f"{subject} has no {', '.join(missing)}; {advice}")
    try:
        speeds_mps = [float(speed) for speed in ego.target_speeds]
    except (TypeError, ValueError):
        speeds_mps = []
    if not (speeds_mps and np.isfinite(speeds_mps).all()):
        speeds = printable(repr(ego.target_speeds), 40)
        raise UserError(f"{subject} has target_speeds {speeds}, no speeds; {advice}")
    if not hittable(ego):
        raise UserError(f"{subject} hits nothing; leave it collidable and solid")


def hittable(thing: Any) -> bool:
    """Return whether a `Vehicle` or `RoadObject` of highway-env can collide with others."""
    return bool(thing.collidable and thing.solid)


def created(name: str) -> Any:
    """Return the new environment of a scenario name, such as `env:merge-v0`, without a seed.

    Raises UserError if there is none, or it is not highway-env's.
    """
    import gymnasium
    import highway_env
    from highway_env.envs.common.abstract import AbstractEnv

    # no warning of an old version: the user named it
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    highway_env._register_highway_envs()
    env_id, changes = _id_and_changes(name)
    changed = _changed(name, changes or "{}")
    if module := module_of(name):
        _only_allowed(name, module)
    if not re.search(r"-v\d+$", env_id):
        raise UserError(f"{label(name)}: give its version too, as in merge-v0")
    _constants().restore()
    try:
        with watched(label(name)), strangers(label(name)):
            env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    except UserError:
        raise
    except ModuleNotFoundError as error:
        missing = printable(str(error).partition(". ")[0])
        raise UserError(
            f"{label(name)}: {missing}; install the package, or put its folder on PYTHONPATH"
        ) from None
    except gymnasium.error.Error as error:
        raise UserError(
            f"{label(name)}: {printable(error)}; give an id that gymnasium.make knows"
        ) from None
    except Exception as error:
        raise UserError(f"{label(name)} cannot be made: {raised(error)}") from None
    if not isinstance(env, AbstractEnv):
        raise UserError(
            f"{label(name)} is a {type(env).__name__}, no environment of highway-env; its class "
            "must be a subclass of highway_env's AbstractEnv"
        )
    env.own_modules = frozenset(text.rpartition(".")[0] for text in _texts(env.config))
    for key, value in changed.items():
        if key not in env.config:
            raise unknown(f"config key of {label(name)}", key, env.config)
        env.config[key] = _merged(env.config[key], value)
    return env


def raised(error: Exception) -> str:
    """Return the type and text of an error that a user's code raised, to be put into a message."""
    return f"{type(error).__name__}: {printable(error)}"


def _changed(name: str, changes: str) -> dict[str, Any]:
    try:
        changed = shallow(json.loads(changes))
        if not isinstance(changed, dict):
            raise ValueError(type(changed).__name__)
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{label(name)}: its config is no JSON object ({printable(error)})"
        ) from None
    return changed


def _merged(default: Any, value: Any) -> Any:
    """Merge a change into a part of a configuration;
    a part that names its own type replaces the default.
    """
    if isinstance(default, dict) and isinstance(value, dict) and "type" not in value:
        changed = {key: _merged(default.get(key), each) for key, each in value.items()}
        return default | changed
    return value


def config(name: str) -> dict[str, Any]:
    """Return the whole configuration of a highway-env environment, with the changes in its name.

    `name` is its scenario name, such as `env:merge-v0` or `env:merge-v0:config={...}`. Keys are
    highway-env's, and values are plain values of JSON.
    """
    text = json.dumps(created(name).config, default=str)
    whole: dict[str, Any] = json.loads(text, parse_constant=str)
    return whole


def meta_actions(name: str, env: Any) -> Any:
    """Return the action type of the ego of `env`, a `DiscreteMetaAction` of highway-env.

    `env` is highway-env's environment, and `name` its scenario name for messages. Raises UserError
    for another type, or one without SLOWER, IDLE or FASTER.
    """
    from highway_env.envs.common.action import DiscreteMetaAction, MultiAgentAction

    kind = env.action_type
    if isinstance(kind, MultiAgentAction) and kind.agents_action_types:
        kind = kind.agents_action_types[0]
    if not isinstance(kind, DiscreteMetaAction):
        raise UserError(
            f"{label(name)} has no meta-actions but {type(kind).__name__}; config "
            '{"action": {"type": "DiscreteMetaAction"}} gives it some, where its vehicles can take '
            "them"
        )
    if missing := sorted({*KNOWN_ACTIONS}.difference(kind.actions.values())):
        raise UserError(
            f"{label(name)} has no action {', '.join(missing)}; set `longitudinal` in its action "
            "config"
        )
    return kind


def numbered(env: Any, kind: Any, action: str) -> Any:
    """Return what `env.step` must be given so that the ego takes an action and others stay idle.

    That is the action's number, or a tuple of one for each agent that the environment controls.
    `env` is highway-env's environment, `kind` its ego's action type (a `DiscreteMetaAction`), and
    `action` a name such as `FASTER`.
    """
    if kind is env.action_type:
        return kind.actions_indexes[action]
    idle = [each.actions_indexes["IDLE"] for each in env.action_type.agents_action_types[1:]]
    return (kind.actions_indexes[action], *idle)


def lane_of(v: Any) -> Lane:
    """Return the index of the lane that a highway-env `Vehicle` steers for.

    It is the two nodes of its road, and the lane's number from the left, from 0. Raises UserError
    if the vehicle has none.
    """
    try:
        begin, end, number = getattr(v, "target_lane_index", v.lane_index)
    except TypeError:  # made without a road, its index is NaN
        x_m, y_m = v.position
        who = v.spawn.id if hasattr(v, "spawn") else "the ego"
        raise UserError(
            f"environment: {who}, a {type(v).__name__} at {x_m:.1f}, {y_m:.1f} m, has no lane; "
            "make every vehicle with the road, and on one of its lanes"
        ) from None
    return str(begin), str(end), int(number or 0)


@dataclass(frozen=True)
class Constants:
    """Hold the class constants of highway-env's vehicles, which some environments overwrite.

    They are kept apart so that environments in one process do not change each other's. `values` are
    by class and name of the constant.
    """

    values: Mapping[tuple[type, str], Any]  # by class and name of the constant

    @classmethod
    def now(cls) -> "Constants":
        """Return the class constants of highway-env's vehicles as they are now in this process.

        Restore them later, before the environment that they belong to goes on.
        """
        from highway_env.vehicle import behavior, controller, kinematics

        values: dict[tuple[type, str], Any] = {}
        for module in (behavior, controller, kinematics):
            classes = [each for each in vars(module).values() if isinstance(each, type)]
            for kind in classes:
                if kind.__module__ == module.__name__:
                    constants = {key: value for key, value in vars(kind).items() if key.isupper()}
                    values |= {(kind, key): value for key, value in constants.items()}
        return cls(values)

    def restore(self) -> None:
        """Set the class constants of highway-env's vehicles back to the values that are held here.

        Do so before an environment goes on, since another in this process may have overwritten
        them.
        """
        for (kind, key), value in self.values.items():
            if vars(kind)[key] is not value:
                setattr(kind, key, value)


@lru_cache(maxsize=1)
def _constants() -> Constants:
    return Constants.now()
