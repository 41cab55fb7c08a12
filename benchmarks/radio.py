"""CPU seconds of physical radios for a million links, by model.

The limit is drawing the random numbers that so many links need, and one pass over them. Shadowing
along the trip is a part of its own, since every model has the same. `first` is what a new set of
parameters costs once.

    python benchmarks/radio.py [--links 1000000] [--repeats 5]
"""

import argparse
import statistics
from collections.abc import Callable
from dataclasses import replace
from time import process_time

import numpy as np
from rows import Row, finish

from harness.extensions.radio.its_g5 import ItsG5
from harness.extensions.radio.lte_mode4 import LteMode4
from harness.extensions.radio.nr_mode2 import NrMode2
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Draws, Links, Site
from harness.radio.fading import Trips

SMALLEST = "--links 30 --repeats 1"
TABLE = "--repeats 3"
MODELS: dict[str, LteMode4 | NrMode2 | ItsG5] = {
    "lte-v2x-mode4": LteMode4(density_per_km=200.0),
    "nr-v2x-mode2": NrMode2(density_per_km=200.0),
    "its-g5": ItsG5(density_per_km=200.0),
}
AIM_S = 1.0
HELPERS, STEPS = 3, 20


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--links", type=int, default=1_000_000)
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    n = given.links // HELPERS

    links, site, trips = made_up(np.random.default_rng(0), n)
    found: dict[str, list[float]] = {}

    def spent(name: str, work: Callable[..., object], *args: object) -> None:
        start = process_time()
        work(*args)
        found.setdefault(name, []).append(process_time() - start)

    for repeat in range(given.repeats):
        generator = np.random.default_rng(repeat)
        spent("limit", lambda rng: np.sqrt(rng.random((n, HELPERS, 4))), generator)
        draws = Draws(generator.random((n, HELPERS, 2)), generator.random((n, HELPERS)), trips)
        spent("packet draws", getattr, draws, "packet")
        spent("shadowing", draws.shadow, site.xy_m, 10.0)
        for name, model in MODELS.items():
            other = replace(model, density_per_km=100.0 + repeat)
            spent(f"{name}: first", other.reception, np.array([100.0]))
            spent(f"{name}: loss", model.loss, site, np.zeros((n, HELPERS)), 800.0)
            spent(f"{name}: deliver", model.deliver, links, draws)
    medians = {name: statistics.median(values) for name, values in found.items()}
    print(f"CPU seconds for {n * HELPERS} links, median of {given.repeats}; aim {AIM_S}")
    for name, median_s in medians.items():
        print(f"  {name:<26}{median_s:8.4f}   {median_s / medians['limit']:6.1f} of the limit")
    rows = [
        Row(
            f"{n * HELPERS} links, {name}, CPU", medians[name], "s", given.repeats, medians["limit"]
        )
        for name in ("shadowing", *(f"{model}: deliver" for model in MODELS))
    ]
    finish(rows, links=n * HELPERS, repeats=given.repeats, cpu_s=medians)


def made_up(generator: np.random.Generator, n: int) -> tuple[Links, Site, Trips]:
    """Made-up links of `n` decisions near a crossing, a third each clear,
    blocked and round the corner.
    """
    shape = (n, HELPERS)
    site = Site(
        xy_m=generator.uniform(-100.0, 100.0, (n, 1 + HELPERS, 2)),
        sight=generator.choice([CLEAR, VEHICLE, BUILDING], shape),
        blocker_m=generator.choice([1.6, 3.0], shape),
        corner_m=generator.uniform(5.0, 100.0, (*shape, 2)),
    )
    links = Links(
        asked=np.ones(shape, bool),
        ready_s=generator.uniform(0.1, 0.2, shape),
        range_m=site.distance_m,
        payload_bits=generator.uniform(800.0, 2400.0, shape),
        in_radius=np.ones(shape, bool),
        rounds=np.zeros(shape, bool),
        request_bits=400.0,
        site=site,
    )
    decision = np.arange(n)
    return (
        links,
        site,
        Trips(np.zeros(n, np.int64), decision // STEPS % 500, decision % STEPS, STEPS),
    )


if __name__ == "__main__":
    main()
