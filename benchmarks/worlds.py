"""Worlds in arrays: a frame of many worlds at once, beside one by one, plain highway-env and EnvPool's port.

Plain means that highway-env's own `act`, `step` and `Road.step` run in the place of the simulator's. All ways
lead to the same trajectories; alone and together are compared to the last bit. EnvPool is no dependency: name
a Python that has it.

    python benchmarks/worlds.py [--layouts 500] [--worlds 128] [--envpool PYTHON]
    python benchmarks/worlds.py --trees     # only what a decision point costs that is frozen, together
"""

import argparse
import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import process_time
from unittest.mock import patch

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from harness.dataset.freeze import freeze
from harness.world import lockstep, scenarios, simulator
from harness.world.scenario import Scenario
from harness.world.world import World

FIRST_SEED = 2000  # (tune)
FRAMES = 25  # before anybody meets: a fleet does not stop by itself where an episode ends
TREES = 2  # layouts of each scenario that are frozen
ENVPOOL = """
import time, numpy as np, envpool
env = envpool.make("Intersection-v0", env_type="gymnasium", num_envs=64, num_threads=1)
rng = np.random.default_rng(0)
env.reset()
actions = [rng.integers(0, 3, 64).astype(np.int32) for _ in range(60)]
for action in actions[:10]: env.step(action)
start = time.process_time()
for action in actions: env.step(action)
print((time.process_time() - start) / (60 * 64 * 15) * 1e6)  # 15 frames a step
"""


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=500)
    arguments.add_argument("--worlds", type=int, default=128)
    arguments.add_argument("--envpool", help="a Python interpreter that has EnvPool")
    arguments.add_argument("--trees", action="store_true", help="measure only freezing, together")
    given = arguments.parse_args()
    if given.trees:
        for name in scenarios.names():
            print(f"{name:<24}freezing, together: {tree_ms(scenarios.get(name)):.1f} ms a decision point")
        return
    rows = {name: row(scenarios.get(name), given.layouts, given.worlds) for name in scenarios.names()}
    print(f"{'CPU µs a frame':<24}{'plain':>8}{'alone':>8}{'together':>10}{'frame':>8}{'plain /':>9}")
    for name, r in rows.items():
        print(f"{name:<24}{r['plain_us']:8.0f}{r['alone_us']:8.0f}{r['together_us']:10.1f}{r['frame_us']:8.1f}"
              f"{r['plain_us'] / r['frame_us']:9.0f}")  # fmt: skip
    print(f"\n{'the same to the last bit':<24}{'frames':>8}{'differ':>8}   freezing, ms a decision point")
    for name, r in rows.items():
        print(f"{name:<24}{r['frames']:8}{r['differ']:8}   alone {r['tree_alone_ms']:.1f}, "
              f"together {r['tree_ms']:.1f}")  # fmt: skip
    envpool_us = None
    if given.envpool:
        made = subprocess.run([given.envpool, "-c", ENVPOOL], capture_output=True, text=True, check=True)
        envpool_us = float(made.stdout.split()[-1])
        print(f"\nEnvPool's Intersection-v0, 64 at once on one thread: {envpool_us:.1f} µs a frame")
    print(json.dumps({"rows": rows, "envpool_us": envpool_us}))


def row(scenario: Scenario, layouts: int, at_once: int) -> dict[str, float]:
    """What a scenario's frames and trees cost in each way, and in how many frames any two ways differ."""
    same = [frames_of(scenario, range(n, min(n + at_once, layouts))) for n in range(0, layouts, at_once)]
    alone_s, together_s, frames, differ = np.sum(same, axis=0).tolist()
    still = [World.start(scenario, FIRST_SEED + n) for n in range(at_once)]
    fleet = lockstep.Fleet(lockstep._lanes(scenario.road), still)  # type: ignore[arg-type]
    return {
        "plain_us": plain_us(scenario), "alone_us": alone_s * 1e6 / frames,
        "together_us": together_s * 1e6 / frames, "frame_us": step_us(fleet, at_once),
        "frames": int(frames), "differ": int(differ),
        "tree_ms": tree_ms(scenario), "tree_alone_ms": tree_ms(scenario, lockstep_from=10**9),
    }  # fmt: skip


def started(scenario: Scenario, layouts: Sequence[int]) -> list[World]:
    """The start of some layouts, in each of which the ego takes an action of its own."""
    worlds = [World.start(scenario, FIRST_SEED + n) for n in layouts]
    for n, world in enumerate(worlds):
        world.take(scenario.actions[n % len(scenario.actions)])
    return worlds


def step_us(fleet: lockstep.Fleet, worlds: int) -> float:
    """A frame of a world among many: movement, collisions and whether the episode is over."""
    start = process_time()
    for _ in range(FRAMES):
        fleet.step()
    return (process_time() - start) * 1e6 / FRAMES / worlds


def frames_of(scenario: Scenario, layouts: Sequence[int]) -> tuple[float, float, int, int]:
    """Seconds alone and together, frames, and worlds that differ, of whole episodes with random actions."""
    rng, p = np.random.default_rng(layouts[0]), scenario.parameters
    alone = started(scenario, layouts)
    together = [world.branch() for world in alone]
    spent, differ = [0.0, 0.0], 0
    for step in range(p.decisions):
        until = [p.due_frame(step + 1) - int(rng.integers(0, 9)) for _ in alone]
        start = process_time()
        for world, frame in zip(alone, until, strict=True):
            world.advance(frame)
        middle = process_time()
        lockstep.advance(together, until)
        spent[0] += middle - start
        spent[1] += process_time() - middle
        for one, other in zip(alone, together, strict=True):
            differ += everything(one) != everything(other)
            if not one.outcome.ended:
                action = scenario.actions[int(rng.integers(len(scenario.actions)))]
                one.take(action)
                other.take(action)
    return *spent, sum(world.frame for world in alone), differ  # type: ignore[return-value]


def everything(world: World) -> tuple[object, ...]:
    """What there is of a world, to the last bit."""
    poses = [(*v.position.tolist(), v.heading, v.speed, v.crashed, v.route) for v in world.vehicles]
    return world.frame, world.outcome, world.hard_brakings, world.beacons, poses


def plain_us(scenario: Scenario) -> float:
    """CPU time of a frame as highway-env simulates it."""
    worlds = started(scenario, range(4))
    with highway_envs_own():
        start = process_time()
        for world in worlds:
            world.advance(scenario.parameters.simulation_hz * 3)
        return (process_time() - start) * 1e6 / sum(world.frame for world in worlds)


def tree_ms(scenario: Scenario, lockstep_from: int = lockstep.ALONE) -> float:
    """CPU time of a decision point that is frozen."""
    with patch.object(lockstep, "ALONE", lockstep_from):
        start = process_time()
        frozen = [freeze(scenario, FIRST_SEED + n, n) for n in range(TREES)]
        points = sum(len(level) for _, scenes in frozen for level in scenes)
        return (process_time() - start) * 1e3 / points


@contextmanager
def highway_envs_own() -> Iterator[None]:
    """Frames as highway-env simulates them."""
    mine = simulator._OnRoute, simulator._Road
    with ExitStack() as stack:
        stack.enter_context(patch.object(mine[1], "step", Road.step))
        stack.enter_context(patch.object(mine[0], "step", Vehicle.step))
        stack.enter_context(patch.object(simulator.Traffic, "act", ControlledVehicle.act))
        stack.enter_context(patch.object(simulator.Ego, "act", MDPVehicle.act))
        stack.enter_context(patch.object(mine[0], "act", ControlledVehicle.act))
        yield


if __name__ == "__main__":
    main()
