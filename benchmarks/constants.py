"""How many tune layouts of each scenario an ego clears that always takes one action.

    python benchmarks/constants.py [--layouts 240] [--scenarios NAME ...]

It drives so many layouts of each, as they are drawn and judged under either version of the limits,
in some minutes. It prints what each action clears; without options it writes
`harness/world/constants.csv`, from which the driver `constant` takes its action.
"""

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from harness.core.arrays import Bools
from harness.core.seeds import FIRST, seeds_text
from harness.core.statistics import mean_of, rate_interval
from harness.world import reference, scenarios
from harness.world.drivers import CONSTANTS, PRIVILEGED
from harness.world.scenario import Scenario
from harness.world.world import World

SMALLEST = "--layouts 1 --scenarios blind-merge"
LAYOUTS, ALL = 240, sorted(scenarios._files())
# How layouts are drawn that are judged by each version, as far as a scenario has these settings.
VERSIONS = {
    1: {"limits": "1", "witnesses": "any", "radio_share": "0", "perception": "1"},
    2: {"limits": "2", "witnesses": "each", "radio_share": "0.25", "perception": "2"},
}
HEADS = (
    "scenario",
    "limits",
    "action",
    "cleared",
    "layouts",
    "harmless_cleared",
    "harmless",
    "first_seed",
)


def cleared(scenario: Scenario, layouts: int) -> tuple[Bools, dict[str, Bools]]:
    """Return which of the first tune layouts have a danger,
    and in which each action succeeds, (layouts,).
    """
    drivers, p = [*scenario.actions, PRIVILEGED], scenario.parameters
    dangerous: list[bool] = []
    success: dict[str, list[bool]] = {action: [] for action in scenario.actions}
    for first in range(FIRST["tune"], FIRST["tune"] + layouts, reference.TOGETHER):
        seeds = range(first, min(first + reference.TOGETHER, FIRST["tune"] + layouts))
        worlds = [World.start(scenario, seed) for seed in seeds for _ in drivers]
        dangers = [world.layout.danger for world in worlds[:: len(drivers)]]
        ended = iter(reference.finish(worlds, drivers * len(seeds)))
        for danger in dangers:
            *constant, full_view = [next(ended) for _ in drivers]
            dangerous.append(danger is not None)
            for action, outcome in zip(scenario.actions, constant, strict=True):
                success[action].append(outcome.judged(full_view, danger, p).success)
    return np.array(dangerous), {action: np.array(of) for action, of in success.items()}


def scenario_of(name: str, limits: int) -> Scenario:
    """Return a scenario whose layouts are drawn and judged by a version of the limits."""
    dials = scenarios.get(name).dials
    settings = ",".join(
        f"{dial}={value}" for dial, value in VERSIONS[limits].items() if dial in dials
    )
    return scenarios.get(f"{name}:{settings}")


def write(file: Path, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write the table of a driver."""
    with file.open("w", encoding="utf-8", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(heads)
        table.writerows(rows)


def measured(name: str, limits: int, layouts: int) -> Iterator[tuple[object, ...]]:
    """Print what each action clears in percent, and yield the rows of the table."""
    dangerous, success = cleared(scenario_of(name, limits), layouts)
    for action, of in success.items():
        halves = [rate_interval(of[half].astype(float)) for half in (dangerous, ~dangerous)]
        rates = (rate_interval(of.astype(float)), mean_of(halves), *halves)
        shown = (f"{100 * e.value:5.1f} [{100 * e.low:4.1f}, {100 * e.high:5.1f}]" for e in rates)
        print(f"{name:22} {limits}  {action:11}", *shown, sep="  ")
        counts = of.sum(), layouts, of[~dangerous].sum(), (~dangerous).sum()
        yield name, limits, action, *map(int, counts), FIRST["tune"]


def main() -> None:
    """Measure, print and write."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=LAYOUTS)
    arguments.add_argument("--scenarios", nargs="+", default=ALL)
    given = arguments.parse_args()
    layouts = given.layouts
    print(
        f"success % [95 % interval] of {layouts} layouts each, {seeds_text(FIRST['tune'], layouts)}"
    )
    print(f"{'scenario':22} limits  action   of all, balanced over dangerous and harmless, of each")
    names = [(limits, name) for limits in VERSIONS for name in given.scenarios]
    rows = [row for limits, name in names for row in measured(name, limits, layouts)]
    if (layouts, given.scenarios) == (LAYOUTS, ALL):
        write(CONSTANTS, HEADS, rows)


if __name__ == "__main__":
    main()
