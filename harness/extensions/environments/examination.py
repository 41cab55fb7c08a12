"""Check once whether an environment can be frozen,
before a dataset is built or an episode is driven.
"""

from collections.abc import Sequence

from harness.core.errors import UserError
from harness.extensions.environments.environment import (
    guarded,
    label,
    meta_actions,
    numbered,
    raised,
)
from harness.extensions.environments.world import EnvironmentWorld
from harness.world.scenario import Scenario

TRIED = ("IDLE", "FASTER", "SLOWER")
Places = list[tuple[float, ...]]  # x, y, heading and speed of each vehicle


def examine(scenario: Scenario, seed: int) -> None:
    """Raise UserError unless an environment of highway-env simulates reproducibly.

    `scenario` is one that is made of such an environment, and `seed` that of the start situation.
    The environment's own `step` takes IDLE, FASTER and SLOWER twice, and deep copies take them
    frame by frame; positions, headings and speeds of all vehicles must agree at every decision.
    """
    scenario = scenario.at(seed)
    name = label(scenario.name)
    once, again = (_stepped(scenario, seed, TRIED) for _ in range(2))
    if once != again:
        raise UserError(
            f"{name}: its traffic differs between two runs of seed {seed}; draw from "
            "env.np_random, and keep "
            "nothing between episodes"
        )
    kind: type[EnvironmentWorld] = scenario.world or EnvironmentWorld
    world = kind.begun(scenario, seed)
    for action, expected in zip(TRIED, once, strict=False):
        try:
            world = world.branch()
        except Exception as error:
            raise UserError(
                f"{name} cannot be copied: {raised(error)}; keep files, locks and the like out of "
                "its attributes"
            ) from None
        world.take(action)
        world.advance(world.frame + world.period)
        if world.outcome.ended:
            return
        if _places(world.env) != expected:
            raise UserError(
                f"{name}: frame by frame its traffic is another than by its step(); what its "
                "step() changes must come after super().step()"
            )


def _stepped(scenario: Scenario, seed: int, actions: Sequence[str]) -> list[Places]:
    world: type[EnvironmentWorld] = scenario.world or EnvironmentWorld
    env, places = world.started(scenario, seed), []
    kind = meta_actions(scenario.name, env)
    for action in actions:
        try:
            with guarded(scenario.name, env):
                *_, terminated, _, _ = env.step(numbered(env, kind, action))
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"{label(scenario.name)}: its step() fails: {raised(error)}") from None
        places.append(_places(env))
        if terminated:
            break
    return places


def _places(env: object) -> Places:
    vehicles = env.road.vehicles  # type: ignore[attr-defined]
    return [(*v.position.tolist(), float(v.heading), float(v.speed)) for v in vehicles]
