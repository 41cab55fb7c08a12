"""An environment of highway-env: its name as a scenario, making it, and what of it is used.

The name is `env:` and the id that gymnasium knows; where something of the configuration is changed, also
`:config=` and the changes as JSON. So a name is enough to make the same again.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json
from harness.world.road import Lane

PREFIX, CHANGES = "env:", ":config="
KNOWN_ACTIONS = ("SLOWER", "IDLE", "FASTER")  # what reference drivers and the planner take


def named(env: str, config: Any = None) -> str:
    """The scenario's name of an environment, by its id and what its configuration changes."""
    return f"{PREFIX}{env}" + (f"{CHANGES}{canonical_json(config)}" if config else "")


def split(text: str) -> tuple[str, str | None]:
    """A name, and settings such as `decisions=5` that may stand behind the id."""
    head, config, changes = text.partition(CHANGES)
    name, _, settings = head.rpartition(":")
    return (name + config + changes, settings) if "=" in settings else (text, None)


def joined(name: str, settings: Sequence[str]) -> str:
    """A scenario's name with settings; inverse of `split` for an environment's."""
    head, config, changes = name.partition(CHANGES)
    return ":".join([head, *([",".join(settings)] if settings else [])]) + config + changes


def shown(name: str) -> str:
    """A name as messages say it."""
    return printable(name, 80)


def reset(name: str, seed: int) -> Any:
    """An environment at the start of a seed's episode. Raises UserError, in a line, if there is no such."""
    env = _made(name)
    _constants().restore()
    try:
        env.reset(seed=seed)
    except Exception as error:
        raise UserError(f"{shown(name)} cannot be reset: {raised(error)}; mind its config") from None
    meta_actions(name, env)
    return env


def _made(name: str) -> Any:
    import gymnasium
    import highway_env
    from highway_env.envs.common.abstract import AbstractEnv

    gymnasium.logger.min_level = gymnasium.logger.ERROR  # an old version is what the user asked for
    highway_env._register_highway_envs()
    env_id, _, changes = name.removeprefix(PREFIX).partition(CHANGES)
    if not re.search(r"-v\d+$", env_id):
        raise UserError(f"{shown(name)}: give its version too, as in merge-v0")
    _constants().restore()
    try:
        env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
    except ModuleNotFoundError as error:
        missing = printable(str(error).partition(". ")[0])
        raise UserError(
            f"{shown(name)}: {missing}; install the package, or put its folder on PYTHONPATH"
        ) from None
    except gymnasium.error.Error as error:
        raise UserError(f"{shown(name)}: {printable(error)}; give an id that gymnasium.make knows") from None
    except Exception as error:
        raise UserError(f"{shown(name)} cannot be made: {raised(error)}") from None
    if not isinstance(env, AbstractEnv):
        raise UserError(
            f"{shown(name)} is a {type(env).__name__}, no environment of highway-env; its class must be a "
            "subclass of highway_env's AbstractEnv"
        )
    for key, value in _changed(name, changes or "{}").items():
        if key not in env.config:
            raise unknown(f"config key of {shown(name)}", key, env.config)
        env.config[key] = _merged(env.config[key], value)
    return env


def raised(error: Exception) -> str:
    """What a user's code raised."""
    return f"{type(error).__name__}: {printable(error)}"


def _changed(name: str, changes: str) -> dict[str, Any]:
    try:
        changed = json.loads(changes)
        if not isinstance(changed, dict):
            raise ValueError(type(changed).__name__)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{shown(name)}: its config is no JSON object ({printable(error)})") from None
    return changed


def _merged(default: Any, value: Any) -> Any:
    """A changed part of a configuration; what names its own type is taken whole."""
    if isinstance(default, dict) and isinstance(value, dict) and "type" not in value:
        return {**default, **{key: _merged(default.get(key), each) for key, each in value.items()}}
    return value


def config(name: str) -> dict[str, Any]:
    """An environment's whole configuration."""
    whole: dict[str, Any] = json.loads(json.dumps(_made(name).config, default=str), parse_constant=str)
    return whole


def meta_actions(name: str, env: Any) -> Any:
    """The type of the ego's actions. Raises UserError if they are no meta-actions, or not of speed."""
    from highway_env.envs.common.action import DiscreteMetaAction, MultiAgentAction

    kind = env.action_type
    if isinstance(kind, MultiAgentAction) and kind.agents_action_types:
        kind = kind.agents_action_types[0]
    if not isinstance(kind, DiscreteMetaAction):
        raise UserError(
            f"{shown(name)} has no meta-actions but {type(kind).__name__}; config "
            '{"action": {"type": "DiscreteMetaAction"}} gives it some, where its vehicles can take them'
        )
    if missing := sorted({*KNOWN_ACTIONS}.difference(kind.actions.values())):
        raise UserError(
            f"{shown(name)} has no action {', '.join(missing)}; set `longitudinal` in its action config"
        )
    return kind


def numbered(env: Any, kind: Any, action: str) -> Any:
    """An action as the environment's `step` takes it; other controlled vehicles keep to theirs."""
    if kind is env.action_type:
        return kind.actions_indexes[action]
    idle = [each.actions_indexes["IDLE"] for each in env.action_type.agents_action_types[1:]]
    return (kind.actions_indexes[action], *idle)


def lane_of(v: Any) -> Lane:
    """The lane that a vehicle steers for, of plain types: highway-env makes numbers NumPy's."""
    begin, end, number = getattr(v, "target_lane_index", v.lane_index)
    return str(begin), str(end), int(number or 0)


@dataclass(frozen=True)
class Constants:
    """Class constants of highway-env's vehicles, such as IDM's gaps: some environments set all others'."""

    values: Mapping[tuple[type, str], Any]

    @classmethod
    def now(cls) -> "Constants":
        """As they are."""
        from highway_env.vehicle import behavior, controller, kinematics

        kinds = {
            kind for module in (behavior, controller, kinematics) for kind in vars(module).values()
            if isinstance(kind, type) and kind.__module__ == module.__name__
        }  # fmt: skip
        return cls({(kind, key): v for kind in kinds for key, v in vars(kind).items() if key.isupper()})

    def restore(self) -> None:
        """Set them so again."""
        for (kind, key), value in self.values.items():
            if vars(kind)[key] is not value:
                setattr(kind, key, value)


@lru_cache(maxsize=1)
def _constants() -> Constants:
    """As highway-env has them, if nobody has set them before the first environment is made here."""
    return Constants.now()
