"""How many tune layouts of each scenario an ego clears that always takes one action.

`python benchmarks/constants.py` drives 240 layouts of each in some minutes, prints what each action
clears, and writes `harness/world/constants.csv`, from which the driver `constant` takes its action.
"""

import csv
import sys

import numpy as np

from harness.core.seeds import FIRST, stated
from harness.core.statistics import rate_interval
from harness.world import reference, scenarios
from harness.world.drivers import CONSTANTS, PRIVILEGED
from harness.world.world import World

LAYOUTS = 240


def cleared(name: str, layouts: int) -> dict[str, list[bool]]:
    """Whether each constant action succeeds in each of the first tune layouts, by action."""
    scenario = scenarios.get(name)
    drivers = [*scenario.actions, PRIVILEGED]
    found: dict[str, list[bool]] = {action: [] for action in scenario.actions}
    for first in range(FIRST["tune"], FIRST["tune"] + layouts, reference.TOGETHER):
        seeds = range(first, min(first + reference.TOGETHER, FIRST["tune"] + layouts))
        worlds = [World.start(scenario, seed) for seed in seeds for _ in drivers]
        ended = iter(reference.finish(worlds, drivers * len(seeds)))
        for _ in seeds:
            *constant, full_view = [next(ended) for _ in drivers]
            for action, outcome in zip(scenario.actions, constant, strict=True):
                found[action].append(outcome.judged(full_view, scenario.parameters).success)
    return found


def main() -> None:
    """Measure, print and write."""
    layouts = int(sys.argv[1]) if len(sys.argv) > 1 else LAYOUTS
    rows = []
    print(f"success % [95 % interval] of {layouts} layouts each, {stated(FIRST['tune'], layouts)}")
    for name in sorted(scenarios.names()):
        for action, success in cleared(name, layouts).items():
            rate = rate_interval(np.array(success, dtype=float))
            print(
                f"{name:24}{action:14}{100 * rate.value:5.1f} [{100 * rate.low:.1f}, {100 * rate.high:.1f}]"
            )
            rows.append((name, action, sum(success), layouts, FIRST["tune"]))
    if layouts == LAYOUTS:
        with CONSTANTS.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(("scenario", "action", "cleared", "layouts", "first_seed"))
            table.writerows(rows)


if __name__ == "__main__":
    main()
