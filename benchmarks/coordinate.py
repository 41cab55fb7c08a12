"""CPU seconds of `coordinate` for 100 000 decisions, by operating point.

The limit is drawing the random numbers that such decisions need, with NumPy.

    python benchmarks/coordinate.py [--decisions 100000] [--repeats 5]
"""

import argparse
import statistics
from time import process_time

import numpy as np
from rows import Row, finish

from harness.coordination.coordinate import coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS
from harness.radio.channel import Draws

SMALLEST = "--decisions 100 --repeats 1"
TABLE = ""
AIM_S = 1.0
HELPERS, ACTIONS = 3, 3


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--decisions", type=int, default=100_000)
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    n = given.decisions

    intents = decisions(np.random.default_rng(0), n)
    found: dict[str, list[float]] = {name: [] for name in ("limit", *POINTS)}
    for repeat in range(given.repeats):
        generator = np.random.default_rng(repeat)
        start = process_time()
        draws = Draws(generator.random((n, HELPERS, 2)), generator.random((n, HELPERS)))
        found["limit"].append(process_time() - start)
        for name, point in POINTS.items():
            start = process_time()
            coordinate(point, intents, draws)
            found[name].append(process_time() - start)
    medians = {name: statistics.median(values) for name, values in found.items()}
    print(
        f"CPU seconds for {n} decisions of {HELPERS} helpers, median of {given.repeats}; aim "
        f"{AIM_S}"
    )
    for name, median_s in medians.items():
        print(f"  {name:<14}{median_s:8.4f}   {median_s / medians['limit']:6.1f} of the limit")
    limit, *points = [(name, 1000 * s) for name, s in medians.items()]
    rows = [
        Row(f"`coordinate` of {n} decisions, `{name}`, CPU", ms, "ms", given.repeats, limit[1])
        for name, ms in points
    ]
    finish(rows, decisions=n, repeats=given.repeats, cpu_s=medians)


def decisions(generator: np.random.Generator, n: int) -> Intents:
    """Made-up intents, distances and sizes of `n` decisions.

    One answer in twenty fails; half of the egos are unsure enough to ask.
    """
    own = generator.dirichlet(np.ones(ACTIONS), n)
    own[generator.random(n) < 0.05] = np.nan
    return Intents(
        own=own,
        helpers=generator.dirichlet(np.ones(ACTIONS), (n, HELPERS)),
        valid=generator.random((n, HELPERS)) < 0.95,
        distance_m=generator.uniform(0.0, 80.0, (n, 1 + HELPERS)),
        range_m=generator.uniform(5.0, 120.0, (n, HELPERS)),
        payload_bits=generator.uniform(800.0, 2400.0, (n, HELPERS)),
        inference_s=generator.uniform(0.1, 0.15, (n, 1 + HELPERS)),
    )


if __name__ == "__main__":
    main()
