"""Whether the paper's ledger holds on any seeds, and whether its intervals cover.

    python benchmarks/ledger.py [--sets 10] [--coverage 100]

Prints the ledger's counts on consecutive sets of five seeds at the paper's own sizes, each by
`harness study paper --seeds`, and how often intervals over five other seeds hold the mean of all of
them.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from io import StringIO

import numpy as np
import pandas as pd

from harness.core.arrays import Floats
from harness.extensions.paper.calibrated import Calibrated
from harness.extensions.paper.ledger import tally
from harness.extensions.paper.panels import panels
from harness.studies.play import over_own_episodes

SMALLEST = "--sets 1 --coverage 1"
SEEDS = 5  # of a set
# Of the sweeps; other grid points have another's success, or lie between two of these.
POINTS = {"size": (1, 2, 4, 8), "loss": (0.1, 0.4), "tau": (0.5, 0.8)}


def main() -> None:
    """Print both tables, and all as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--sets", type=int, default=10)
    arguments.add_argument(
        "--coverage", type=int, default=100, help="sets of five seeds for the intervals"
    )
    given = arguments.parse_args()
    held = [of_set(SEEDS * n) for n in range(given.sets)]
    covered = coverage(given.coverage)
    print(json.dumps({"sets": held, "coverage": covered}))


def of_set(first: int) -> dict[str, object]:
    """The ledger's counts on five seeds, by the command."""
    seeds = f"{first}:{first + SEEDS}"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "harness", "study", "paper", "--seeds", seeds, "--json"]
        said = subprocess.run(
            [*command, "--out", folder], check=True, capture_output=True, text=True
        ).stdout
    ledger = pd.read_json(StringIO(said), orient="records")
    counts = tally(ledger)
    off = {
        verdict: ", ".join(dict.fromkeys(ledger[ledger.verdict == verdict].id))
        for verdict in ("unclear", "misses")
    }
    print(
        f"seeds {seeds:<8}{counts['within']} of {counts['total']} within"
        + "".join(f"; {verdict} {rows}" for verdict, rows in off.items() if rows),
        flush=True,
    )
    return {"seeds": seeds, **counts, "rows": off}


def coverage(sets: int) -> list[dict[str, object]]:
    """How often the interval of five seeds has the mean of all seeds,
    which is as good as the truth.
    """
    found: list[dict[str, object]] = []
    heads = (
        f"{head:>10}"
        for head in ("value", "episodes", "success %", "covers %", "± ours", "± plain")
    )
    print(f"{'panel':<8}{''.join(heads)}")
    for panel in panels():
        source = Calibrated(panel.episodes)
        for setting in panel.settings:
            if setting.value not in POINTS.get(panel.name, ()):
                continue
            walks = (
                next(source.walked([setting], range(first, first + SEEDS)))
                for first in range(1000, 1000 + SEEDS * sets, SEEDS)
            )
            measured = _covered([part.ends["success_rate"] for [part] in walks])
            print(
                f"{panel.name:<8}{setting.value:>10}{panel.episodes:>10}"
                + "".join(f"{number:>10.2f}" for number in measured.values()),
                flush=True,
            )
            found.append({"panel": panel.name, "value": setting.value, **measured})
    return found


def _covered(sets: Sequence[Floats]) -> dict[str, float]:
    """Of sets of seeds' episodes (S, E); half widths in points, `plain` that of plain draws."""
    truth = float(np.mean(sets))
    intervals = [over_own_episodes("success_rate", each) for each in sets]
    plain = 2.776 * np.sqrt(truth * (1 - truth) / sets[0].size)  # t(4)
    return {
        "success": 100 * truth,
        "covers": 100 * float(np.mean([e.low <= truth <= e.high for e in intervals])),
        "half": 50 * float(np.mean([e.high - e.low for e in intervals])),
        "plain": 100 * float(plain),
    }


if __name__ == "__main__":
    main()
