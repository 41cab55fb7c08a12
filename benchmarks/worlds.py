"""Worlds in arrays: a frame of many, with NumPy and compiled, beside one by one, highway-env and EnvPool.

Plain means that highway-env's own `act`, `step` and `Road.step` run in the place of the simulator's. All ways
lead to the same trajectories; alone, together with NumPy and together compiled are compared to the last bit.
The compiled frame needs the extra `fast`. EnvPool is no dependency: name a Python that has it.

    python benchmarks/worlds.py [--layouts 500] [--worlds 128] [--scenarios NAME ...]
                                [--sizes 16 64 128 512] [--frozen 2] [--envpool PYTHON]
                                [--loading]
    python benchmarks/worlds.py --trees     # only what a decision point costs that is frozen, together
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from rows import Row, finish

from harness.dataset.freeze import freeze
from harness.world import lockstep, scenarios, simulator
from harness.world.scenario import Scenario
from harness.world.world import World

SMALLEST = "--scenarios blind-merge --layouts 2 --worlds 2 --sizes 1 2 --frozen 1"
TABLE = "--layouts 64"
NEEDS = "highway_env"
FIRST_SEED = 2000  # (tune)
FRAMES = 25  # before anybody meets: a fleet does not stop by itself where an episode ends
NUMPY, COMPILED = "numpy", "compiled"
FORMS = (NUMPY, COMPILED) if lockstep.compiled_fleet() else (NUMPY,)
LOADING = """
from time import process_time
from harness.world import lockstep
start = process_time()
assert lockstep.compiled_fleet()
print(process_time() - start)
"""
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
    """Print tables and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=500)
    arguments.add_argument("--worlds", type=int, default=128)
    arguments.add_argument("--scenarios", nargs="+", default=scenarios.names())
    arguments.add_argument("--sizes", type=int, nargs="+", default=[16, 64, 128, 512], help="worlds at once")
    arguments.add_argument("--envpool", help="a Python interpreter that has EnvPool")
    arguments.add_argument("--frozen", type=int, default=2, help="layouts of each scenario that are frozen")
    arguments.add_argument("--loading", action="store_true", help="also how long the compiled form loads")
    arguments.add_argument("--trees", action="store_true", help="measure only freezing, together")
    given = arguments.parse_args()
    if given.trees:
        for name in given.scenarios:
            trees = ", ".join(
                f"{form} {tree_ms(scenarios.get(name), form, given.frozen):.1f}" for form in FORMS
            )
            print(f"{name:<24}freezing, ms a decision point: {trees}")
        return
    loading = loading_s() if given.loading and COMPILED in FORMS else None
    sizes = given.sizes
    rows = {
        name: row(scenarios.get(name), given.layouts, given.worlds, sizes, given.frozen)
        for name in given.scenarios
    }
    columns = ["plain", "alone", *(f"{form}: {what}" for form in FORMS for what in ("together", "frame"))]
    print(f"{'CPU µs a frame':<24}" + "".join(f"{c:>20}" for c in columns) + "   plain / last")
    for name, r in rows.items():
        figures = [
            r["plain_us"],
            r["alone_us"],
            *(u for f in FORMS for u in (r["together_us"][f], r["frame_us"][f])),
        ]
        print(f"{name:<24}" + "".join(f"{us:20.2f}" for us in figures) + f"{figures[0] / figures[-1]:15.0f}")
    print(f"\n{'CPU µs a frame of':<24}" + "".join(f"{f'{n} {form}':>16}" for n in sizes for form in FORMS))
    for name, r in rows.items():
        print(f"{name:<24}" + "".join(f"{r['sizes_us'][f][n]:16.2f}" for n in sizes for f in FORMS))
    print(f"\n{'the same to the last bit':<24}{'frames':>8}{'differ':>8}   freezing, ms a decision point")
    for name, r in rows.items():
        trees = ", ".join(f"{form} {ms:.1f}" for form, ms in r["tree_ms"].items())
        print(f"{name:<24}{r['frames']:8}{r['differ']:8}   {trees}")
    if loading:
        print(
            "\nloading the compiled form, CPU s: compiled first {:.2f}, from numba's cache {:.2f}".format(
                *loading
            )
        )
    envpool_us = None
    if given.envpool:
        made = subprocess.run([given.envpool, "-c", ENVPOOL], capture_output=True, text=True, check=True)
        envpool_us = float(made.stdout.split()[-1])
        print(f"\nEnvPool's Intersection-v0, 64 at once on one thread: {envpool_us:.1f} µs a frame")
    at_once = f"a world's frame, {given.worlds} at once"
    figures = [
        Row(
            f"{at_once}, `{name}`, {form}, CPU",
            r["frame_us"][form],
            "µs",
            3,
            peer=f"highway-env {r['plain_us']:.0f} µs",
        )
        for name, r in rows.items()
        for form in FORMS
    ]
    figures += [
        Row(f"freezing a decision point, `{name}`, CPU", r["tree_ms"][FORMS[-1]], "ms", given.frozen)
        for name, r in rows.items()
    ]
    finish(figures, worlds=rows, loading_s=loading, envpool_us=envpool_us)


def row(scenario: Scenario, layouts: int, at_once: int, sizes: Sequence[int], trees: int) -> dict[str, Any]:
    """What a scenario's frames and trees cost in each way, and in how many worlds any two ways differ."""
    same = [frames_of(scenario, range(n, min(n + at_once, layouts))) for n in range(0, layouts, at_once)]
    alone_s, *together_s, frames, differ = np.sum(same, axis=0).tolist()
    still = [World.start(scenario, FIRST_SEED + n) for n in range(max(at_once, *sizes))]
    return {
        "plain_us": plain_us(scenario), "alone_us": alone_s * 1e6 / frames,
        "together_us": {form: s * 1e6 / frames for form, s in zip(FORMS, together_s, strict=True)},
        "frame_us": {form: step_us(scenario, form, still[:at_once]) for form in FORMS},
        "sizes_us": {form: {n: step_us(scenario, form, still[:n]) for n in sizes} for form in FORMS},
        "frames": int(frames), "differ": int(differ),
        "tree_ms": {"alone": tree_ms(scenario, NUMPY, trees, lockstep_from=10**9)}
        | {form: tree_ms(scenario, form, trees) for form in FORMS},
    }  # fmt: skip


def simulated_by(form: str) -> Any:
    """Have all frames simulated in one form."""
    return patch.object(lockstep, "COMPILED_AFTER", 0 if form == COMPILED else 10**9)


def loading_s() -> tuple[float, float]:
    """CPU seconds that a process takes to load the compiled form: with an empty cache, and from it."""
    with TemporaryDirectory() as folder:
        made = [
            subprocess.run(
                [sys.executable, "-c", LOADING], env=os.environ | {"NUMBA_CACHE_DIR": folder},
                capture_output=True, text=True, check=True,
            ) for _ in range(2)
        ]  # fmt: skip
    return float(made[0].stdout), float(made[1].stdout)


def started(scenario: Scenario, layouts: Sequence[int]) -> list[World]:
    """The start of some layouts, in each of which the ego takes an action of its own."""
    worlds = [World.start(scenario, FIRST_SEED + n) for n in layouts]
    for n, world in enumerate(worlds):
        world.take(scenario.actions[n % len(scenario.actions)])
    return worlds


def step_us(scenario: Scenario, form: str, still: Sequence[World]) -> float:
    """A frame of a world among others, all it does but record it: the least of three measurements."""

    def once() -> float:
        with simulated_by(form):
            fleet = lockstep._form()(lockstep._lanes(scenario.road), still)  # type: ignore[arg-type]
        start = process_time()
        for _ in range(FRAMES):
            fleet.step()
        return (process_time() - start) * 1e6 / FRAMES / len(still)

    return min(once() for _ in range(3))


def frames_of(scenario: Scenario, layouts: Sequence[int]) -> list[float]:
    """Seconds alone and in each form, frames, and worlds that differ: episodes with random actions."""
    rng, p = np.random.default_rng(layouts[0]), scenario.parameters
    alone = started(scenario, layouts)
    together = {form: [world.branch() for world in alone] for form in FORMS}
    spent, differ = [0.0] * (1 + len(FORMS)), 0
    for step in range(p.decisions):
        until = [p.due_frame(step + 1) - int(rng.integers(0, 9)) for _ in alone]
        start = process_time()
        for world, frame in zip(alone, until, strict=True):
            world.advance(frame)
        spent[0] += process_time() - start
        for n, (form, worlds) in enumerate(together.items()):
            with simulated_by(form):
                start = process_time()
                lockstep.advance(worlds, until)
                spent[1 + n] += process_time() - start
        for one, *others in zip(alone, *together.values(), strict=True):
            differ += any(everything(one) != everything(other) for other in others)
            if not one.outcome.ended:
                action = scenario.actions[int(rng.integers(len(scenario.actions)))]
                for world in (one, *others):
                    world.take(action)
    return [*spent, sum(world.frame for world in alone), differ]


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


def tree_ms(scenario: Scenario, form: str, trees: int, lockstep_from: int = lockstep.ALONE) -> float:
    """CPU time of a decision point that is frozen."""
    with simulated_by(form), patch.object(lockstep, "ALONE", lockstep_from):
        start = process_time()
        frozen = [freeze(scenario, FIRST_SEED + n, n) for n in range(trees)]
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
