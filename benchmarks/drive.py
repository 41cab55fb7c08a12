"""Live driving: where time goes, and what a second worker adds.

The parts are measured in one process with the proxy, whose answers cost next to nothing, so that
the harness's own share is the largest it can be. Of repeats the one whose time is the median
counts. The same of four agents that drive by the right-hand rule, alone on the air; their limit is
what the simulator takes.

    python benchmarks/drive.py [--episodes 32] [--seeds 5] [--repeats 3]
"""

import argparse
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any
from unittest.mock import patch

from rows import Row, finish

from harness.backends import cards
from harness.backends.driver import DriverBackend
from harness.backends.proxy import Proxy
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.dataset import freeze
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker
from harness.evaluate.live_world import LiveSource, LiveWorld
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.evaluate.table import table
from harness.evaluate.walk import walk
from harness.prompts import versions as prompts
from harness.runs.records import Episode, Latency
from harness.runs.settings import Settings
from harness.world import lockstep
from harness.world import reference as live

SMALLEST = "--episodes 1 --seeds 1 --repeats 1"
TABLE = ""
NAME = "occluded-intersection:witnesses=any,radio_share=0,limits=1,perception=1"
SWARM = "all-way-crossing:agent_share=1"
LATENCY = Latency("card", "the proxy's card", 0.145, 0.145, 0.145)
# Functions whose time makes up a part: the simulator, what is seen, and who drives. The rest is our
# own.
PARTS: dict[str, tuple[Any, str]] = {
    "frames": (lockstep, "advance"),
    "sensors": (freeze, "scene_graphs"),
    "proxy": (Proxy, "complete"),
    "rule": (DriverBackend, "complete"),
    "reference": (live, "decide"),
}


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--episodes", type=int, default=32)
    arguments.add_argument("--seeds", type=int, default=5)
    arguments.add_argument("--repeats", type=int, default=3)
    given = arguments.parse_args()
    spec = Spec(
        Agent(cards.resolve("proxy"), prompts.load("v2")),
        LiveSource(0, given.episodes, NAME),
        tuple(POINTS.values()),
        tuple(range(given.seeds)),
    )
    swarm = Spec(
        Agent(cards.resolve("right-hand"), prompts.load("v4")),
        LiveSource(0, given.episodes, SWARM),
        (POINTS["single-local"],),
        spec.seeds,
        settings=Settings(latency="paper"),
    )
    lives = given.episodes * len(spec.points) * len(spec.seeds)

    for each in (spec, swarm):
        drive(each, range(1))  # pays for imports and compiled templates
    cpu_s(replace(spec, source=LiveSource(0, 1)))
    cpu = cpu_s(spec)
    parts, frames, frames_lived = middle(spec, given.repeats)
    of_swarm, *_ = middle(swarm, given.repeats)
    of_rule = given.episodes * len(swarm.seeds)
    walls = {workers: wall_s(spec, workers, 2) for workers in (1, 2)}
    total = sum(parts.values())

    print(
        f"{lives} episodes ({given.episodes} layouts, {len(spec.points)} conditions, {given.seeds} "
        "seeds)"
    )
    print(
        f"  frames: {frames} simulated, {frames_lived} lived through: shared worlds save "
        f"{1 - frames / frames_lived:.0%}"
    )
    for part, seconds in parts.items():
        print(f"  {part:<12}{seconds:8.2f} s {seconds / total:7.1%}")
    print(f"  {lives / total:.0f} episodes a second of that CPU time")
    print(
        f"{of_rule} episodes of four agents by a rule ({given.episodes} layouts, {given.seeds} "
        "seeds)"
    )
    for part, seconds in of_swarm.items():
        print(f"  {part:<12}{seconds:8.2f} s {seconds / sum(of_swarm.values()):7.1%}")
    for workers, seconds in walls.items():
        print(f"  {workers} workers: {lives / seconds:7.1f} episodes/s")
    print(f"  one worker, CPU: {cpu:.2f} s")
    print(f"  a second worker makes it {walls[1] / walls[2]:.2f} times as fast")
    rows = [
        Row("closed loop, episodes a CPU second", lives / total, "/s", given.repeats, aim="≥ 1000"),
        Row(
            "closed loop, own share of the CPU time",
            100 * parts["own"] / total,
            "%",
            given.repeats,
            aim="≤ 20",
        ),
        Row(
            "closed loop, times as fast with 2 workers, wall", walls[1] / walls[2], "times", 2, 2.0
        ),
        Row(
            "closed loop, four agents by a rule, episodes a CPU second",
            of_rule / sum(of_swarm.values()),
            "/s",
            given.repeats,
            limit=of_rule / of_swarm["frames"],
            aim="≥ 300",
        ),
    ]
    finish(
        rows,
        episodes=lives,
        frames=frames,
        frames_lived=frames_lived,
        parts_s=parts,
        wall_s=walls,
        cpu_s=cpu,
        swarm_s=of_swarm,
    )


def drive(spec: Spec, numbers: range) -> list[Episode]:
    """Walk some episodes and lay their decisions out as a table."""
    world = LiveWorld(spec.scenario, 0, numbers, spec.points, spec.seeds, spec.ego_alone)
    asker = Asker(spec, partial(open_backend, spec.ego.card), LATENCY)
    decided = [part for step in walk(world, spec.points, asker, spec.ties) for part in step]
    table(decided, world.columns(), spec.actions)
    return world.episodes()


def middle(spec: Spec, repeats: int) -> tuple[dict[str, float], int, int]:
    """The `shares` of all episodes in the repeat whose time is the median."""
    numbers = range(spec.source.record().episodes)
    every = sorted(
        (shares(spec, numbers) for _ in range(repeats)), key=lambda each: sum(each[0].values())
    )
    return every[len(every) // 2]


def shares(spec: Spec, numbers: range) -> tuple[dict[str, float], int, int]:
    """CPU seconds of each part in one process, frames simulated,
    and frames lived through by all episodes.
    """
    spent = dict.fromkeys(PARTS, 0.0)
    simulated = 0

    def clocked(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            nonlocal simulated
            worlds = given[0] if part == "frames" else ()
            simulated -= sum(world.frame for world in worlds)
            start = process_time()
            try:
                return function(*given, **named)
            finally:
                spent[part] += process_time() - start
                simulated += sum(world.frame for world in worlds)

        return call

    with ExitStack() as stack:
        for part, (owner, name) in PARTS.items():
            stack.enter_context(patch.object(owner, name, clocked(part, getattr(owner, name))))
        start = process_time()
        episodes = drive(spec, numbers)
        total = process_time() - start
    lived_s = sum(episode.time_s or 0.0 for episode in episodes)
    lived = round(lived_s * spec.scenario.parameters.simulation_hz)
    return {**spent, "own": total - sum(spent.values())}, simulated, lived


def cpu_s(spec: Spec) -> float:
    """CPU time of a whole run in one process."""
    with tempfile.TemporaryDirectory() as folder:
        start = process_time()
        evaluate(spec, Path(folder) / "run", lambda done: None, workers=1)
        return process_time() - start


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
