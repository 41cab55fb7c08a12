"""Worlds in arrays: a frame of many together, beside one by one, highway-env and EnvPool.

Plain means that highway-env's own `act` and `step` drive the same vehicles. All ways lead to the
same trajectories; alone and together are compared to the last bit. EnvPool is no dependency: name a
Python that has it.

    python benchmarks/worlds.py [--layouts 500] [--worlds 128] [--scenarios NAME ...]
                                [--sizes 16 64 128 512] [--frozen 8] [--envpool PYTHON]
    python benchmarks/worlds.py --trees
        # only what a decision point costs that is frozen, together
    python benchmarks/worlds.py --joint 4 --scenarios all-way-crossing narrow-passage --frozen 10
        # only how many states two agents can bring about together, with so many decisions each
"""

import argparse
import gzip
import subprocess
from collections.abc import Sequence
from itertools import product
from time import process_time
from typing import Any

import msgspec
import numpy as np
from rows import Row, finish

from harness.dataset.freeze import freeze
from harness.dataset.schema import scene_id
from harness.world import lockstep, scenarios
from harness.world.scenario import Scenario
from harness.world.world import World

SMALLEST = "--scenarios blind-merge --layouts 2 --worlds 2 --sizes 1 2 --frozen 1"
TABLE = "--layouts 16"
NEEDS = "highway_env"
FIRST_SEED = 2000  # (tune)
FRAMES = 25  # before anybody meets: a fleet does not stop by itself where an episode ends
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
    arguments.add_argument(
        "--sizes", type=int, nargs="+", default=[16, 64, 128, 512], help="worlds at once"
    )
    arguments.add_argument("--envpool", help="a Python interpreter that has EnvPool")
    arguments.add_argument(
        "--frozen", type=int, default=8, help="layouts of each scenario that are frozen"
    )
    arguments.add_argument("--trees", action="store_true", help="measure only freezing, together")
    arguments.add_argument(
        "--joint", type=int, help="measure only joint trees, of so many decisions"
    )
    given = arguments.parse_args()
    if given.joint:
        for name in given.scenarios:
            print(
                f"{name}: "
                f"{joint_tree(scenarios.get(f'{name}:agent_share=1'), given.frozen, given.joint)}"
            )
        return
    if given.trees:
        for name in given.scenarios:
            ms = tree_ms(scenarios.get(name), given.frozen, given.frozen)
            print(f"{name:<24}freezing, ms a decision point: {ms:.1f}")
        return
    sizes = given.sizes
    rows = {
        name: row(scenarios.get(name), given.layouts, given.worlds, sizes, given.frozen)
        for name in given.scenarios
    }
    columns = ["plain", "alone", "together", "frame"]
    print(f"{'CPU µs a frame':<24}" + "".join(f"{c:>12}" for c in columns) + "   plain / frame")
    for name, r in rows.items():
        us = [r[f"{column}_us"] for column in columns]
        print(f"{name:<24}" + "".join(f"{each:12.2f}" for each in us) + f"{us[0] / us[-1]:15.0f}")
    print(f"\n{'CPU µs a frame of':<24}" + "".join(f"{n:>12}" for n in sizes))
    for name, r in rows.items():
        print(f"{name:<24}" + "".join(f"{r['sizes_us'][n]:12.2f}" for n in sizes))
    print(
        f"\n{'the same to the last bit':<24}{'frames':>8}{'differ':>8}   freezing, ms a decision "
        "point"
    )
    for name, r in rows.items():
        trees = f"{r['tree_ms']:.1f}, one layout at a time {r['tree_alone_ms']:.1f}"
        print(f"{name:<24}{r['frames']:8}{r['differ']:8}   {trees}")
    envpool_us = None
    if given.envpool:
        made = subprocess.run(
            [given.envpool, "-c", ENVPOOL], capture_output=True, text=True, check=True
        )
        envpool_us = float(made.stdout.split()[-1])
        print(f"\nEnvPool's Intersection-v0, 64 at once on one thread: {envpool_us:.1f} µs a frame")
    at_once = f"a world's frame, {given.worlds} at once"
    figures = [
        Row(
            f"{at_once}, `{name}`, CPU",
            r["frame_us"],
            "µs",
            3,
            peer=f"highway-env {r['plain_us']:.0f} µs",
        )
        for name, r in rows.items()
    ]
    figures += [
        Row(f"freezing a decision point, `{name}`, CPU", r["tree_ms"], "ms", given.frozen)
        for name, r in rows.items()
    ]
    finish(figures, worlds=rows, envpool_us=envpool_us)


def row(
    scenario: Scenario, layouts: int, at_once: int, sizes: Sequence[int], trees: int
) -> dict[str, Any]:
    """What a scenario's frames and trees cost in each way,
    and in how many worlds two ways differ.
    """
    same = [
        frames_of(scenario, range(n, min(n + at_once, layouts))) for n in range(0, layouts, at_once)
    ]
    alone_s, together_s, frames, differ = np.sum(same, axis=0).tolist()
    still = [World.start(scenario, FIRST_SEED + n) for n in range(max(at_once, *sizes))]
    return {
        "plain_us": plain_us(scenario),
        "alone_us": alone_s * 1e6 / frames,
        "together_us": together_s * 1e6 / frames,
        "frame_us": step_us(still[:at_once]),
        "sizes_us": {n: step_us(still[:n]) for n in sizes},
        "frames": int(frames),
        "differ": int(differ),
        "tree_ms": tree_ms(scenario, trees, trees),
        "tree_alone_ms": tree_ms(scenario, trees, 1),
    }


def started(scenario: Scenario, layouts: Sequence[int]) -> list[World]:
    """The start of some layouts, in each of which the ego takes an action of its own."""
    worlds = [World.start(scenario, FIRST_SEED + n) for n in layouts]
    for n, world in enumerate(worlds):
        world.take(scenario.actions[n % len(scenario.actions)])
    return worlds


def step_us(still: Sequence[World]) -> float:
    """A frame of a world among others, all it does but record it:
    the least of three measurements.
    """

    def once() -> float:
        fleet = lockstep.Fleet(still)
        start = process_time()
        for _ in range(FRAMES):
            fleet.step()
        return (process_time() - start) * 1e6 / FRAMES / len(still)

    return min(once() for _ in range(3))


def frames_of(scenario: Scenario, layouts: Sequence[int]) -> list[float]:
    """Seconds alone and together, frames, and worlds that differ: episodes with random actions."""
    rng, p = np.random.default_rng(layouts[0]), scenario.parameters
    alone = started(scenario, layouts)
    together = [world.branch() for world in alone]
    spent, differ = [0.0, 0.0], 0
    for step in range(p.decisions):
        until = [p.due_frame(step + 1) - int(rng.integers(0, 9)) for _ in alone]
        start = process_time()
        for world, frame in zip(alone, until, strict=True):
            world.advance(frame)
        spent[0] += process_time() - start
        start = process_time()
        lockstep.advance(together, until)
        spent[1] += process_time() - start
        for one, other in zip(alone, together, strict=True):
            differ += everything(one) != everything(other)
            if not one.outcome.ended:
                action = scenario.actions[int(rng.integers(len(scenario.actions)))]
                one.take(action)
                other.take(action)
    return [*spent, sum(world.frame for world in alone), differ]


def everything(world: World) -> tuple[object, ...]:
    """What there is of a world, to the last bit."""
    poses = [(*v.position.tolist(), v.heading, v.speed, v.crashed, v.route) for v in world.vehicles]
    return world.frame, world.outcome, world.journey.hard_brakings, world.beacons, poses


def plain_us(scenario: Scenario) -> float:
    """CPU time of a frame as highway-env simulates it."""
    worlds, hz = started(scenario, range(4)), scenario.parameters.simulation_hz
    start = process_time()
    for world in worlds:
        for frame in range(hz * 3):
            world.road.time_s = frame / hz
            world.road.act()
            world.road.step(1 / hz)
    return (process_time() - start) * 1e6 / (len(worlds) * hz * 3)


def tree_ms(scenario: Scenario, trees: int, at_once: int) -> float:
    """CPU time of a decision point that is frozen, with so many layouts at once."""
    start, points = process_time(), 0
    for n in range(0, trees, at_once):
        frozen = freeze(scenario, {k: FIRST_SEED + k for k in range(n, min(n + at_once, trees))})
        points += sum(len(level) for tree in frozen for level in tree.scenes)
    return (process_time() - start) * 1e3 / points


def joint_tree(scenario: Scenario, layouts: int, decisions: int) -> str:
    """States after each decision of two agents, zipped bytes of the edges, and CPU time, a layout.

    Layouts are the first that have two agents.
    """
    worlds = (World.start(scenario, seed) for seed in range(FIRST_SEED, FIRST_SEED + 100 * layouts))
    level = [world for world in worlds if len(world.journeys) == 2][:layouts]
    if not level:
        return "no layout has two agents"
    p, n, start = scenario.parameters, len(level), process_time()
    # of each edge, the number of the state that it leads to
    states, edges = [1.0], list[list[int]]()
    for step in range(decisions):
        lockstep.advance(level, [p.due_frame(step) + p.lag_frames] * len(level))
        parts = [part for world in level for part in joint_parts(world)]
        lockstep.advance(parts, [p.due_frame(step + 1)] * len(parts))
        following: dict[str, World] = {}
        ids = [scene_id(0, part.state()) for part in parts]
        for name, part in zip(ids, parts, strict=True):
            following.setdefault(name, part)
        number = {name: n for n, name in enumerate(following)}
        edges.append([number[name] for name in ids])
        level = [part for part in following.values() if not part.ended]
        states.append(len(level) / n)
    spent_s, size = process_time() - start, len(gzip.compress(msgspec.json.encode(edges)))
    return f"{n} layouts, states {states}, {size / n:.0f} B, {spent_s / n:.2f} CPU s"


def joint_parts(world: World) -> list[World]:
    """A world for each choice of the targets of all agents that are under way."""
    free = [
        [
            (agent, action)
            for action in {world.target_after(a, agent): a for a in world.actions}.values()
        ]
        for agent, journey in world.journeys.items()
        if not journey.outcome.ended
    ]
    parts = []
    for choice in product(*free):
        part = world.branch()
        for agent, action in choice:
            part.take(action, agent)
        part.step += 1
        parts.append(part)
    return parts


if __name__ == "__main__":
    main()
