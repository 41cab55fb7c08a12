"""How often studies of as many layouts as `harness plan` says find the difference that they were
planned for.

Outcomes are those of `benchmarks/intervals.py`, whose truth is known. A study finds a difference if
the 95 % interval that `harness compare` prints leaves out 0 on its side. *Known*: planned by how
far layouts differ in truth. *Pilots*: every study has a pilot of its own, of so many layouts, and
as many layouts as that one says, so that the figure is of planning and study together. Intervals
are Wilson's, over studies.

    python benchmarks/plan.py [--studies 1000] [--seed 0] [--power 0.8]
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from intervals import paired

from harness.core.arrays import Bools, Floats
from harness.core.power import Spread
from harness.core.statistics import wilson
from harness.runs.success import Success

SMALLEST = "--studies 2"
PILOTS = (24, 60)  # layouts
KNOWN = 200_000  # layouts that stand for the truth
DANGEROUS = 2 / 3  # of layouts, where success is balanced
HARMLESS = 0.9  # success without a danger, which does not change
Outcomes = tuple[Success, Floats, Floats]  # and the successes (S, E) of both sides
Study = Callable[[np.random.Generator, int], Outcomes]  # of so many layouts


@dataclass(frozen=True)
class Cell:
    """What was measured of one truth."""

    truth: str
    pilot: int  # layouts; 0 where the truth is known
    layouts: float  # that were planned, the median over studies
    power: float  # share of studies that found the difference
    low: float
    high: float


def plain(before: float, after: float, seeds: int, alike: float) -> Study:
    """Read by plain success."""

    def study(rng: np.random.Generator, layouts: int) -> Outcomes:
        a, b = paired(rng, before, after, (alike, alike), seeds, layouts)
        return Success(np.zeros(layouts, dtype=bool)), a.T, b.T

    return study


def balanced(before: float, after: float, seeds: int, alike: float) -> Study:
    """Read by balanced success, where only layouts with a danger differ."""

    def study(rng: np.random.Generator, layouts: int) -> Outcomes:
        dangerous: Bools = np.arange(layouts) < round(DANGEROUS * layouts)
        parts = [
            paired(rng, *rates, (alike, alike), seeds, int(part.sum()))
            for rates, part in (((before, after), dangerous), ((HARMLESS, HARMLESS), ~dangerous))
        ]
        a, b = (np.concatenate(each).T for each in zip(*parts, strict=True))
        return Success(dangerous), a, b

    return study


def truths() -> list[tuple[str, float, Study]]:
    """What is planned for: its name, its difference and how it is drawn."""
    rates = [(0.54, 0.59), (0.75, 0.8), (0.9, 0.95), (0.54, 0.64), (0.75, 0.85)]
    rows = [
        (
            f"{before:.2f} to {after:.2f}, {words}",
            after - before,
            plain(before, after, seeds, alike),
        )
        for seeds, alike, words in ((1, 1.0, "one seed"), (5, 0.6, "5 seeds"))
        for before, after in rates
    ]
    return [
        *rows,
        *(
            (
                f"balanced, {before:.2f} to {after:.2f}",
                (after - before) / 2,
                balanced(before, after, 5, 0.6),
            )
            for before, after in ((0.5, 0.6), (0.5, 0.7))
        ),
    ]


def spread_of(outcomes: Outcomes) -> Spread:
    """Return how far layouts differ in a pilot."""
    success, a, b = outcomes
    return success.spread(a, b, np.ones(len(success.dangerous), dtype=np.int64))


def measure(
    truth: str, difference: float, study: Study, pilot: int, power: float, draws: tuple[int, int]
) -> Cell:
    """Plan and make so many studies."""
    seed, studies = draws
    rng = np.random.default_rng((seed, pilot, *truth.encode()))
    known = spread_of(study(rng, KNOWN)).episodes(difference, power) if not pilot else None
    hits, planned = 0, []
    for _ in range(studies):
        layouts = int(
            known if known is not None else spread_of(study(rng, pilot)).episodes(difference, power)
        )
        success, a, b = study(rng, layouts)
        hits += success.difference(b, a).low > 0
        planned.append(layouts)
    return Cell(
        truth, pilot, float(np.median(planned)), hits / studies, *wilson(hits / studies, studies)
    )


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--studies", type=int, default=1000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--power", type=float, default=0.8)
    given = arguments.parse_args()
    print(
        f"power of {given.studies} studies, %, and their layouts (median); planned: "
        f"{given.power:.0%}"
    )
    heads = ["known", *(f"pilots of {pilot}" for pilot in PILOTS)]
    print(f"{'':<24}" + "".join(f"{head:>28}" for head in heads))
    cells = []
    for truth, difference, study in truths():
        print(f"{truth:<24}", end="", flush=True)
        for pilot in (0, *PILOTS):
            cell = measure(
                truth, difference, study, pilot, given.power, (given.seed, given.studies)
            )
            cells.append(cell)
            share = f"{100 * cell.power:.1f} [{100 * cell.low:.1f}, {100 * cell.high:.1f}]"
            print(f"{share:>20}{cell.layouts:>8.0f}", end="", flush=True)
        print()
    print(
        json.dumps(
            {"studies": given.studies, "power": given.power, "cells": list(map(asdict, cells))}
        )
    )


if __name__ == "__main__":
    main()
