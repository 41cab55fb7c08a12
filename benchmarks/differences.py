"""How often intervals of paired differences of success hold the truth, and find it.

A *study* draws layouts of known truths: in a half, a share of layouts is gained and another lost,
and in the others nothing changes. *Covered*: studies whose 95 % interval holds the truth. *Found*:
those whose interval leaves out 0. *Sign flips*: those in which a test by random signs of the
layouts that differ has p < .05; it knows nothing of variances, and is the most that is due.
*Before*: covered and found by the interval of the edition v2v-safety-1.0. Truths were listed before
any rule was tried; sizes of six are those of the suite v2v-safety-2.

    python benchmarks/differences.py [--studies 10000] [--seed 0]
"""

import argparse
import json
from dataclasses import asdict, dataclass

import numpy as np

from harness.core.arrays import Floats
from harness.core.statistics import Estimate, mean_of, paired_difference, rate_difference, wilson

SMALLEST = "--studies 20"
# with a danger and without, in the suite
SIX = ((155, 45), (42, 18), (26, 14), (62, 38), (65, 35), (66, 34))
FLIPPED = 2000  # studies, of which each has so many
FLIPS = 999
# layouts that differ on average: from here on, intervals should be about as wide as they must
MANY = 15
Half = tuple[int, float, float]  # layouts, and the shares that are gained and lost


def six(dangerous: tuple[float, float], harmless: tuple[float, float]) -> list[Half]:
    """Return the halves of six families, alike in all of them."""
    return [half for n, others in SIX for half in ((n, *dangerous), (others, *harmless))]


def one(
    n: tuple[int, int], dangerous: tuple[float, float], harmless: tuple[float, float]
) -> list[Half]:
    """Return the halves of one family."""
    return [(n[0], *dangerous), (n[1], *harmless)]


TRUTHS: dict[str, list[Half]] = {
    "six: nothing differs": six((0, 0), (0, 0)),
    "six: 1 layout in 300": six((1 / 300, 0), (1 / 300, 0)),
    "six: 1 in 200 lost": six((0, 0.005), (0, 0.005)),
    "six: 4 gained, 1 lost": six((0.06, 0.02), (0.01, 0.02)),
    "six: 4 gained": six((0.06, 0.02), (0, 0)),
    "six: 4 gained, 4 lost": six((0.06, 0.02), (0.01, 0.05)),
    "six: 12 gained, 3 lost": six((0.15, 0.03), (0.01, 0.04)),
    "six: only gains, dangerous": six((0.03, 0), (0, 0)),
    "six: only gains, both": six((0.03, 0), (0.03, 0)),
    "six: only gains, harmless": six((0, 0), (0.08, 0)),
    "six: only losses": six((0, 0.03), (0, 0.03)),
    "six: 5 gained, 5 lost": six((0.05, 0.05), (0.05, 0.05)),
    "one, 80 + 20: nothing": one((80, 20), (0, 0), (0, 0)),
    "one, 80 + 20: gains, dangerous": one((80, 20), (0.05, 0), (0, 0)),
    "one, 80 + 20: gains, harmless": one((80, 20), (0, 0), (0.06, 0)),
    "one, 80 + 20: more of these": one((80, 20), (0, 0), (0.15, 0)),
    "one, 80 + 20: 20 gained, 5 lost": one((80, 20), (0.25, 0.05), (0, 0.05)),
    "one, 80 + 20: 15 gained": one((80, 20), (0.25, 0.1), (0.1, 0.15)),
    "one, 80 + 20: 40 gained": one((80, 20), (0.4, 0), (0, 0)),
    "one, 86 + 14: gains, harmless": one((86, 14), (0, 0), (0.15, 0)),
    "one, 86 + 14: gains, both": one((86, 14), (0.2, 0), (0.12, 0)),
    "one, 120 + 80: 10 and 3": one((120, 80), (0.12, 0.02), (0.05, 0.02)),
    "one, 240 + 60: 1 in 300": one((240, 60), (1 / 300, 0), (1 / 300, 0)),
    "one, 240 + 60: gains, dangerous": one((240, 60), (0.06, 0), (0, 0)),
    "one, 240 + 60: gains, both": one((240, 60), (0.03, 0), (0.03, 0)),
    "one, 240 + 60: gains, harmless": one((240, 60), (0, 0), (0.05, 0)),
    "plain, 60: 10 gained": [(60, 0.2, 0.1)],
    "plain, 300: 1 in 300": [(300, 1 / 300, 0)],
}


@dataclass(frozen=True)
class Cell:
    """What was measured of one truth, in percent."""

    truth: str
    difference: float
    differing: float  # layouts, on average
    covered: float
    found: float
    width: float  # points, on average
    sign_flips: float | None  # None where fewer than `MANY` differ
    covered_before: float
    found_before: float


def study(rng: np.random.Generator, halves: list[Half]) -> list[Floats]:
    """Draw each half's differences: 1 gained, -1 lost, else 0."""
    shares = [(gained, lost, 1 - gained - lost) for _, gained, lost in halves]
    return [
        rng.choice([1.0, -1.0, 0.0], n, p=share)
        for (n, _, _), share in zip(halves, shares, strict=True)
    ]


def before(differences: list[Floats]) -> Estimate:
    """Return the interval of v2v-safety-1.0;
    a layout that does not differ succeeds in every second.
    """
    halves = []
    for of_half in differences:
        same = np.arange(len(of_half)) % 2 == 0
        halves.append(
            rate_difference(
                np.where(of_half == 0, same, of_half > 0).astype(float),
                np.where(of_half == 0, same, of_half < 0).astype(float),
            )
        )
    if len(halves) == 1:
        return halves[0]
    families = [mean_of(halves[n : n + 2]) for n in range(0, len(halves), 2)]
    return mean_of(families) if len(families) > 1 else families[0]


def flipped(rng: np.random.Generator, differences: list[Floats]) -> bool:
    """Return whether random signs of what differs seldom give a mean as far from 0."""
    weights = np.array([1 / len(of_half) for of_half in differences])
    differing = np.array([np.count_nonzero(of_half) for of_half in differences])
    observed = abs(sum(float(of_half.mean()) for of_half in differences))
    positive = rng.binomial(differing, 0.5, (FLIPS, len(differing)))
    means = np.abs((2 * positive - differing) @ weights)
    return bool((1 + np.sum(means >= observed - 1e-12)) / (FLIPS + 1) < 0.05)


def measure(truth: str, halves: list[Half], studies: int, seed: int) -> Cell:
    """Make so many studies of one truth."""
    rng = np.random.default_rng((seed, *truth.encode()))
    difference = float(np.mean([gained - lost for _, gained, lost in halves]))
    now, then, differing, flips = [], [], 0, []
    for n in range(studies):
        differences = study(rng, halves)
        now.append(paired_difference(differences))
        then.append(before(differences))
        differing += sum(map(np.count_nonzero, differences))
        if n < FLIPPED:
            flips.append(flipped(rng, differences))

    def covered(of: list[Estimate]) -> float:
        return 100 * float(np.mean([e.low - 1e-9 <= difference <= e.high + 1e-9 for e in of]))

    def found(of: list[Estimate]) -> float:
        return 100 * float(np.mean([e.low > 0 or e.high < 0 for e in of]))

    many = differing / studies
    return Cell(
        truth,
        100 * difference,
        many,
        covered(now),
        found(now),
        100 * float(np.mean([e.high - e.low for e in now])),
        100 * float(np.mean(flips)) if many >= MANY else None,
        covered(then),
        found(then),
    )


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--studies", type=int, default=10_000)
    arguments.add_argument("--seed", type=int, default=0)
    given = arguments.parse_args()
    print(f"{given.studies} studies a row, {min(given.studies, FLIPPED)} for sign flips; %")
    heads = ("truth", "differ", "covered", "found", "width", "sign flips", "before: cov.", "found")
    print(f"{'':<32}" + "".join(f"{head:>13}" for head in heads))
    cells = []
    for truth, halves in TRUTHS.items():
        cell = measure(truth, halves, given.studies, given.seed)
        cells.append(cell)
        figures = (
            f"{cell.difference:+.1f}",
            f"{cell.differing:.1f}",
            f"{cell.covered:.1f}",
            f"{cell.found:.1f}",
            f"{cell.width:.1f}",
            "–" if cell.sign_flips is None else f"{cell.sign_flips:.1f}",
            f"{cell.covered_before:.1f}",
            f"{cell.found_before:.1f}",
        )
        print(f"{truth:<32}" + "".join(f"{figure:>13}" for figure in figures), flush=True)
    many = [cell for cell in cells if cell.sign_flips is not None]
    told = {
        "least_covered": min(cell.covered for cell in cells),
        "most_covered_where_many_differ": max(cell.covered for cell in many),
        "most_lost_to_sign_flips": max((cell.sign_flips or 0.0) - cell.found for cell in many),
        "error_of_a_share": 100 * (wilson(0.95, given.studies)[1] - 0.95),
    }
    print(
        "\n" + ", ".join(f"{name.replace('_', ' ')}: {value:.1f}" for name, value in told.items())
    )
    print(json.dumps({"studies": given.studies, **told, "cells": list(map(asdict, cells))}))


if __name__ == "__main__":
    main()
