"""The best fixed sequence of actions in tune layouts: what an ego clears that looks at nothing.

    python benchmarks/open_loop.py [--layouts 100] [--scenarios NAME ...]

It builds the trees of so many layouts of each scenario in half an hour, and searches all sequences.
One is left as soon as the layouts that it can still clear are no more than the best so far clears.
It prints what is found; without options it writes `harness/world/open_loop.csv`, from which the
driver `open-loop` takes its actions.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from constants import scenario_of, write

from harness.core.arrays import Floats, Ints
from harness.core.seeds import FIRST, seeds_text
from harness.dataset.build import build
from harness.dataset.forest import Forest
from harness.dataset.load import load
from harness.world.drivers import OPEN_LOOPS

SMALLEST = "--layouts 1 --scenarios parking-exit"
LAYOUTS = 100
# Scenarios, and the version of the limits by which their layouts are drawn and judged: those of the
# suite v2v-safety-2, and the paper's scenario by the first version.
SEARCHED = (
    ("occluded-intersection", 1),
    ("occluded-intersection", 2),
    ("hard-brake-ahead", 2),
    ("do-not-pass", 2),
    ("roundabout-entry", 2),
    ("parking-exit", 2),
    ("blind-merge", 2),
)
HEADS = (
    "scenario",
    "limits",
    "actions",
    "cleared",
    "layouts",
    "harmless_cleared",
    "harmless",
    "first_seed",
)


def weights(dangerous: Floats, limits: int = 2) -> Floats:
    """Return what each layout weighs in success, (E,), which is balanced where `limits` is 2."""
    if limits == 1:
        return np.full(len(dangerous), 1 / len(dangerous))
    halves = [dangerous > 0, dangerous == 0]
    shares = [half / half.sum() for half in halves if half.any()]
    return np.asarray(np.sum(shares, axis=0) / len(shares))


def best(forest: Forest, layouts: Floats) -> tuple[str, ...]:
    """Return the sequence that clears most; of equals the one that comes first."""
    everything = np.arange(len(forest.root))
    found: tuple[float, tuple[str, ...]] = (-1.0, ())

    def search(at: Ints, cleared: Floats, actions: tuple[str, ...]) -> None:
        nonlocal found
        going = at >= 0
        if not going.any():
            if cleared @ layouts > found[0] + 1e-12:
                found = float(cleared @ layouts), actions
            return
        for place, action in enumerate(forest.actions):
            then, done = at.copy(), cleared.copy()
            edge = forest.edge[at[going], place]
            then[going] = forest.child[at[going], place]
            done[going] = forest.succeeds(edge, everything[going]) & (then[going] < 0)
            possible = np.where(then >= 0, forest.value[then], done > 0)
            if possible @ layouts > found[0] + 1e-12:
                search(then, done, (*actions, action))

    search(forest.root.copy(), np.zeros(len(forest.root)), ())
    return found[1]


def measured(name: str, limits: int, layouts: int) -> tuple[object, ...]:
    """Print the best sequence of a scenario and return its row."""
    scenario = scenario_of(name, limits)
    with tempfile.TemporaryDirectory() as folder:
        build(scenario, Path(folder, "tune"), layouts, FIRST["tune"], 1, lambda done: None)
        data = load(Path(folder, "tune"))
        forest, dangerous = data.forest, data.dangerous
    actions = best(forest, weights(dangerous.astype(float), limits))
    success = forest.sequence_success(actions)
    counts = success.sum(), layouts, success[~dangerous].sum(), (~dangerous).sum()
    print(f"{name:22} {limits} {' '.join(actions):40}", *map(int, counts), flush=True)
    return name, limits, " ".join(actions), *map(int, counts), FIRST["tune"]


def main() -> None:
    """Search, print and write."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--layouts", type=int, default=LAYOUTS)
    arguments.add_argument("--scenarios", nargs="+", default=[name for name, _ in SEARCHED])
    given = arguments.parse_args()
    print(
        f"{seeds_text(FIRST['tune'], given.layouts)}; cleared, layouts, cleared without a danger, "
        "of these"
    )
    searched = [each for each in SEARCHED if each[0] in given.scenarios]
    rows = [measured(name, limits, given.layouts) for name, limits in searched]
    if (given.layouts, searched) == (LAYOUTS, list(SEARCHED)):
        write(OPEN_LOOPS, HEADS, rows)


if __name__ == "__main__":
    main()
