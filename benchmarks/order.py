"""How a board's order hangs on what each family weighs: random weights, and each family left out.

    python benchmarks/order.py [--only TEXT] [--layouts N] [--out reports/order]
                               [--page benchmarks/measured/benchmark.md]

It evaluates each of `ENTRIES` on the suite under `6g`, draws weights of the families from the flat
Dirichlet distribution, and writes the tables of the page between its marks. What is finished is
read and not made again; a stopped one goes on with the same command.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from families import Families, Row
from pages import markdown, options, write_tables

from harness.core.arrays import Floats
from harness.core.figures import interval_of
from harness.runs.metric_names import BASELINE
from harness.runs.success import by_condition

SMALLEST = "--only constant --layouts 1"
DRAWS = 1_000
CONDITION = "6g"  # a board ranks by it
POINTS = ("--condition", BASELINE, "--condition", CONDITION, "--latency", "paper")
RULES = ("proxy", "local-view", "open-loop", "constant", "uniform")
ENTRIES = (Row("swarm-tiny-six-v2", "v4", "readout"), *(Row(name, "v4", "json") for name in RULES))


def main() -> None:
    """Make what is missing, and write the page's tables."""
    given = options(__doc__, "order").parse_args()
    found = dict[str, Families]()
    for row in (entry.asked(given.layouts) for entry in ENTRIES):
        if given.only in row.name:
            row.evaluate(given.out / row.name, *POINTS)
        if runs := Families.read(given.out / row.name):
            found[row.model] = runs
    ordered = sorted(found, key=lambda name: -success(found[name]).mean())
    entries = {name: found[name] for name in ordered}
    text = "\n\n".join((by_family(entries), *by_weights(entries)))
    print(text)
    if given.page:
        write_tables(given.page, text)


def success(runs: Families) -> Floats:
    """Return balanced success of each family, in the order of their names, (F,)."""
    families = (by_condition(run.grid, run.episodes) for _, run in sorted(runs.runs.items()))
    return np.array([how.mean(of[CONDITION]) for how, of in families])


def by_family(entries: Mapping[str, Families]) -> str:
    """A table of success by family."""
    names = sorted(next(iter(entries.values())).runs)
    rows = [
        (name, *(f"{100 * value:.1f}" for value in (*success(runs), success(runs).mean())))
        for name, runs in entries.items()
    ]
    return markdown((f"{CONDITION}, balanced success %", *names, "mean"), rows)


def by_weights(entries: Mapping[str, Families]) -> Iterator[str]:
    """Yield in how many draws the order stays, and what tells neighbours apart."""
    scores = np.array([success(runs) for runs in entries.values()])
    weights = np.random.default_rng(0).dirichlet(np.ones(scores.shape[1]), DRAWS)
    ahead = np.diff(weights @ scores.T, axis=1) < 0
    yield f"The order stays in {int(ahead.all(axis=1).sum())} of {DRAWS} draws."
    rows = [
        (
            f"{' over '.join(pair)}",
            str(int(often)),
            difference(entries, pair),
            *least(entries, *pair),
        )
        for pair, often in zip(pairwise(entries), ahead.sum(axis=0), strict=True)
    ]
    heads = (
        "neighbours",
        f"ahead, of {DRAWS}",
        "difference, points",
        "least without a family",
        "which",
    )
    yield markdown(heads, rows)


def difference(entries: Mapping[str, Families], pair: Sequence[str], without: str = "") -> str:
    """Return by how much the first is above the second, paired by layout,
    perhaps without one family.
    """
    upper, lower = (
        Families({family: run for family, run in entries[name].runs.items() if family != without})
        for name in pair
    )
    return interval_of(upper.over(lower, CONDITION), sign="+")


def least(entries: Mapping[str, Families], upper: str, lower: str) -> tuple[str, str]:
    """Return the difference without the family that carries most of it, and which that is."""
    names = sorted(entries[upper].runs)
    without = names[int(np.argmax(success(entries[upper]) - success(entries[lower])))]
    return difference(entries, (upper, lower), without), f"`{without}`"


if __name__ == "__main__":
    main()
