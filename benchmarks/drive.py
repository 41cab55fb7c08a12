"""Live driving: what a frame costs beside plain highway-env, where time goes, and what a second worker adds.

Frames are plain where highway-env's own `act`, `step` and `Road.step` run in the place of the simulator's;
the trajectories are the same. The parts are measured in one process with the proxy, whose answers cost next
to nothing, so that the harness's own share is the largest it can be.

    python benchmarks/drive.py [--episodes 32] [--seeds 5] [--repeats 5]
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter, process_time
from typing import Any
from unittest.mock import patch

from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from harness.backends import cards
from harness.backends.proxy import Proxy
from harness.coordination.operating_point import POINTS
from harness.dataset import freeze
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker
from harness.evaluate.live_world import LiveSource, LiveWorld
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.evaluate.walk import table, walk
from harness.prompts import versions as prompts
from harness.runs.records import Episode, Latency
from harness.world import reference as live
from harness.world import simulator
from harness.world.scenarios.occluded_intersection import SCENARIO
from harness.world.world import World

LATENCY = Latency("card", "the proxy's card", 0.145, 0.145, 0.145)
# Functions whose time makes up a part: frames, what is seen, and who drives. The rest is the harness's own.
PARTS: dict[str, tuple[Any, str]] = {
    "highway-env": (World, "_step"),
    "sensors": (freeze, "scene_graph"),
    "proxy": (Proxy, "complete"),
    "reference": (live, "decide"),
}


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--episodes", type=int, default=32)
    arguments.add_argument("--seeds", type=int, default=5)
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    spec = Spec(
        Agent(cards.resolve("proxy"), prompts.load("v2")), LiveSource(0, given.episodes),
        tuple(POINTS.values()), tuple(range(given.seeds)),
    )  # fmt: skip
    lives = given.episodes * len(spec.points) * len(spec.seeds)

    drive(spec, range(1))  # pays for imports and compiled templates
    # By turns, and the least of each: what else the machine does only ever adds.
    turns = [(frame_us(), frame_us(plain=True)) for _ in range(given.repeats)]
    cheap_us, plain_us = map(min, zip(*turns, strict=True))
    parts, frames, frames_lived = shares(spec, range(given.episodes))
    walls = {workers: wall_s(spec, workers, 2) for workers in (1, 2)}
    total = sum(parts.values())

    print(f"a frame of six vehicles, CPU: {cheap_us:.0f} µs; plain highway-env {plain_us:.0f} µs, "
          f"{plain_us / cheap_us:.1f} times as much")  # fmt: skip
    print(f"{lives} episodes ({given.episodes} layouts, {len(spec.points)} conditions, {given.seeds} seeds)")
    print(f"  frames: {frames} simulated, {frames_lived} lived through: shared worlds save "
          f"{1 - frames / frames_lived:.0%}")  # fmt: skip
    for part, seconds in parts.items():
        print(f"  {part:<12}{seconds:8.2f} s {seconds / total:7.1%}")
    # What the own share would be had frames stayed as dear as highway-env's.
    plain_total = total + parts["highway-env"] * (plain_us / cheap_us - 1)
    print(f"  own time of the time with plain frames {parts['own'] / plain_total:.1%}")
    for workers, seconds in walls.items():
        print(f"  {workers} workers: {lives / seconds:7.1f} episodes/s")
    print(f"  a second worker makes it {walls[1] / walls[2]:.2f} times as fast")
    print(json.dumps({
        "episodes": lives, "frame_us": cheap_us, "plain_frame_us": plain_us, "frames": frames,
        "frames_lived": frames_lived, "parts_s": parts, "wall_s": walls,
    }))  # fmt: skip


def frame_us(plain: bool = False) -> float:
    """CPU time of a frame, over ten seconds of four layouts with a braking ego."""
    worlds = [World.start(SCENARIO, seed) for seed in (0, 1, 6, 10)]
    with highway_envs_own() if plain else ExitStack():
        start = process_time()
        for world in worlds:
            world.take("SLOWER")
            world.advance(SCENARIO.parameters.simulation_hz * 10)
        return (process_time() - start) * 1e6 / sum(world.frame for world in worlds)


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


def drive(spec: Spec, numbers: range) -> list[Episode]:
    """Walk some episodes and lay their decisions out as a table."""
    world = LiveWorld(SCENARIO, 0, numbers, spec.points, spec.seeds, spec.ego_alone)
    asker = Asker(spec, Proxy, LATENCY)
    decided = [part for step in walk(world, spec.points, asker) for part in step]
    table(decided, world.columns(), spec.actions)
    return world.episodes()


def shares(spec: Spec, numbers: range) -> tuple[dict[str, float], int, int]:
    """Seconds of each part in one process, frames simulated, and frames lived through by all episodes."""
    spent = dict.fromkeys(PARTS, 0.0)
    calls = dict.fromkeys(PARTS, 0)

    def clocked(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            start = perf_counter()
            try:
                return function(*given, **named)
            finally:
                spent[part] += perf_counter() - start
                calls[part] += 1

        return call

    with ExitStack() as stack:
        for part, (owner, name) in PARTS.items():
            stack.enter_context(patch.object(owner, name, clocked(part, getattr(owner, name))))
        start = perf_counter()
        episodes = drive(spec, numbers)
        total = perf_counter() - start
    lived_s = sum(episode.time_s or 0.0 for episode in episodes)
    lived = round(lived_s * SCENARIO.parameters.simulation_hz)
    return {**spent, "own": total - sum(spent.values())}, calls["highway-env"], lived


def wall_s(spec: Spec, workers: int, repeats: int) -> float:
    """Wall time of a whole run, its folder written: the least of some."""

    def once() -> float:
        with tempfile.TemporaryDirectory() as folder:
            start = perf_counter()
            evaluate(spec, Path(folder) / "run", lambda done: None, workers=workers)
            return perf_counter() - start

    return min(once() for _ in range(repeats))


if __name__ == "__main__":
    main()
