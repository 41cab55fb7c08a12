"""CPU milliseconds of a camera's frame,
and whether one of the shipped scenes shows who is not reported.

The limit is filling the frame: each of its pixels is written once, from a table of colours.

    python benchmarks/camera.py [--scenes 200] [--whole]

`--whole` takes every decision point on the reference drivers' courses (some minutes);
else so many of each dataset, drawn.
"""

import argparse
import statistics
from time import process_time
from typing import Any

import numpy as np
from rows import Row, finish

from harness.dataset.load import Dataset, Scene, find, load
from harness.dataset.suites import named
from harness.world.perception.camera import SIZE_PX, frame
from harness.world.perception.sensors import detect

SMALLEST = "--scenes 1"
TABLE = "--scenes 40"
AIM_MS = 10.0


def main() -> None:
    """Print a line a dataset, and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--scenes", type=int, default=200)
    arguments.add_argument("--whole", action="store_true")
    given = arguments.parse_args()
    suite = named("suite:v2v-safety")
    assert suite
    limit_ms, rows = limit(), list[dict[str, Any]]()
    print(f"{'dataset':<28}{'ms a frame':>11}{'/ limit':>9}{'frames':>9}{'leaks':>7}")
    for name in suite.datasets:
        dataset = load(find(name))
        took, leaks = measured(dataset, drawn(dataset, None if given.whole else given.scenes))
        median = statistics.median(took)
        rows.append(
            {"dataset": name, "ms": median, "limit_ms": limit_ms, "n": len(took), "leaks": leaks}
        )
        print(f"{name:<28}{median:>11.1f}{median / limit_ms:>9.1f}{len(took):>9}{leaks:>7}")
    slowest = max(rows, key=lambda row: row["ms"])
    what = f"a camera's frame, the slowest of {len(rows)} datasets"
    aim = f"≤ {AIM_MS:g}"
    finish(
        [Row(what, slowest["ms"], "ms", slowest["n"], limit_ms, aim=aim)],
        aim_ms=AIM_MS,
        frames=rows,
    )


def drawn(dataset: Dataset, most: int | None) -> list[Scene]:
    """Decision points on the reference drivers' courses."""
    ids = list(dataset.courses())
    if most is not None:
        ids = [
            ids[n] for n in sorted(np.random.default_rng(0).permutation(len(ids))[:most].tolist())
        ]
    return list(dataset.scenes(ids))


def measured(dataset: Dataset, scenes: list[Scene]) -> tuple[list[float], int]:
    """CPU milliseconds of each frame, and how many vehicles own pixels that no sensor reports."""
    # the map of the ground is made once
    frame(dataset.scenario, scenes[0].state, scenes[0].viewers[0])
    took, leaks = [], 0
    for scene in scenes:
        state = scene.state
        for viewer in scene.viewers:
            begun_s = process_time()
            made = frame(dataset.scenario, state, viewer)
            took.append(1000 * (process_time() - begun_s))
            eye = state.vehicle(viewer)
            reported = detect(state, eye, dataset.scenario.parameters)
            allowed = {d.id for d in reported} | {b.id for b in state.buildings}
            leaks += len(made.boxes().keys() - allowed)
    return took, leaks


def limit(repeats: int = 50) -> float:
    """CPU milliseconds to write a frame's pixels from a table."""
    table = np.random.default_rng(0).integers(0, 256, (1000, 3), dtype=np.uint8)
    which = np.random.default_rng(1).integers(0, 1000, SIZE_PX[::-1])
    begun_s = process_time()
    for _ in range(repeats):
        table[which]
    return 1000 * (process_time() - begun_s) / repeats


if __name__ == "__main__":
    main()
