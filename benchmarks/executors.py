"""Processes and a Ray cluster: what handing out a chunk costs, and what a second worker adds.

Chunks wait for a second, so that what else the machine does changes little, or do nothing. Ray is a
cluster of two nodes of a core each, all here.

    python benchmarks/executors.py [--chunks 20] [--seconds 1] [--empty 500] [--repeats 5]
                                   [--only TEXT]
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from time import perf_counter, sleep

from rows import Row, finish

from harness.core.parallel import Ray, Workers, spread

SMALLEST = "--chunks 2 --seconds 0.01 --empty 2 --repeats 1 --only processes"
TABLE = "--chunks 8 --repeats 1"
EXECUTORS: dict[str, Workers] = {"2 processes": 2, "Ray, 2 nodes": Ray()}


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--chunks", type=int, default=20)
    arguments.add_argument("--seconds", type=float, default=1.0)
    arguments.add_argument("--empty", type=int, default=500)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--only", default="", help="only executors whose name has this text")
    given = arguments.parse_args()
    alone = least_s(nap, [given.seconds] * given.chunks, 1, 1)
    found: dict[str, dict[str, float]] = {}
    with ExitStack() as stack:
        for name, workers in EXECUTORS.items():
            if given.only not in name:
                continue
            if isinstance(workers, Ray):
                stack.enter_context(cluster())
            spread(nap, [0.0] * 4, workers, lambda done: None)  # pays for starts and imports
            took = least_s(nap, [given.seconds] * given.chunks, workers, given.repeats)
            empty = least_s(nap, [0.0] * given.empty, workers, given.repeats)
            found[name] = {"speed_up": alone / took, "empty_ms": 1000 * empty / given.empty}
    own = given.seconds * given.chunks
    print(f"{given.chunks} chunks of {given.seconds:g} s, the least of {given.repeats}")
    print(f"  1 process     {alone:6.2f} s, {own:g} s of them the chunks'")
    for name, of in found.items():
        took, empty = alone / of["speed_up"], of["empty_ms"]
        print(
            f"  {name:<14}{took:6.2f} s, {of['speed_up']:.2f} times as fast; an empty chunk "
            f"{empty:.2f} ms"
        )
    rows = [
        Row(f"{name}, times as fast as one process", of["speed_up"], "times", given.repeats, 2.0)
        for name, of in found.items()
    ]
    rows += [
        Row(f"{name}, an empty chunk", of["empty_ms"], "ms", given.repeats)
        for name, of in found.items()
    ]
    finish(rows, chunks=given.chunks, seconds=given.seconds, alone_s=alone, executors=found)


def nap(seconds: float) -> float:
    """Wait, and give back how long."""
    sleep(seconds)
    return seconds


def least_s(
    work: Callable[[float], float], chunks: list[float], workers: Workers, repeats: int
) -> float:
    """Wall time of all chunks: the least of some."""

    def once() -> float:
        start = perf_counter()
        spread(work, chunks, workers, lambda done: None, repeatable=False)
        return perf_counter() - start

    return min(once() for _ in range(repeats))


@contextmanager
def cluster() -> Iterator[None]:
    """Two nodes on this machine, which `Ray()` finds."""
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", PYTHONPATH=os.pathsep.join(sys.path))
    import ray
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 << 20}
    made = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    made.add_node(**node)
    os.environ["RAY_ADDRESS"] = made.address
    try:
        yield
    finally:
        ray.shutdown()
        made.shutdown()


if __name__ == "__main__":
    main()
