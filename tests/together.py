"""Worlds of one scenario take their turns together:
the same to the last bit, for a fraction of the work.

That it is the same is proven in `sim/test_lockstep.py`.
"""

from collections.abc import Sequence

from harness.world import lockstep
from harness.world.outcome import Outcome
from harness.world.reference import finish
from harness.world.scenario import Scenario
from harness.world.world import World


def act_together(worlds: Sequence[World], actions: Sequence[str]) -> None:
    """Do what `World.act` does, each world with its action."""
    p = worlds[0].scenario.parameters
    lockstep.advance(worlds, [p.due_frame(world.step) + p.lag_frames for world in worlds])
    for world, action in zip(worlds, actions, strict=True):
        world.decide(action)
    lockstep.advance(worlds, [p.due_frame(world.step) for world in worlds])


def go_on_together(worlds: Sequence[World], action: str) -> None:
    """Take one action at once, and hold it until each world's time is over or its episode
    decided.
    """
    p = worlds[0].scenario.parameters
    for world in worlds:
        world.take(action)
    lockstep.advance(worlds, [round(p.time_limit_s * p.simulation_hz)] * len(worlds))


def drive_together(scenario: Scenario, driver: str, seeds: Sequence[int]) -> dict[int, Outcome]:
    """Drive layouts with one driver, and return how each ended by its seed."""
    worlds = [World.start(scenario, seed) for seed in seeds]
    return dict(zip(seeds, finish(worlds, [driver] * len(worlds)), strict=True))
