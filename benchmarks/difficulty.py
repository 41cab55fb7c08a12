"""How many answers fewer are enough where each layout's difficulty is taken off its success.

A tree knows, before any model is asked, what the drivers `local-view` and `cruise` and a draw of
even actions achieve in its layout. `harness/core/covariate.py` corrects success by how far theirs
in the answered layouts are from those of a pool of layouts. *Ratio*: how many times as many answers
the plain figure needs for an interval as narrow, if the pool has no end, and its 95 % interval over
layouts; a dash where nothing is left to vary. *Strata*: the same where layouts are counted by kind
instead: whether each driver succeeds, and whether even actions do so more often than in the median
layout. *Width*: of the corrected interval of the most answered layouts, as a share of the plain
one's. *Coverage*: how often the interval of a study of so many answered layouts, drawn from those
of the run, and a pool of five times as many holds the run's figure, in percent; beside it the plain
interval's.

    python benchmarks/difficulty.py [--models proxy swarm-tiny] [--layouts 120]
                                    [--answered 20 30 40 60]
"""

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pages

from harness.core import covariate
from harness.core.arrays import Floats, Ints
from harness.core.figures import Unit, as_mapping, interval_of, number_or_none
from harness.core.statistics import Estimate, resampled, resampled_estimate
from harness.dataset.load import find, load
from harness.runs.difficulty import REFERENCES, Pool
from harness.runs.folder import read
from harness.runs.headline import IN_WORDS
from harness.runs.success import Success, by_condition

SMALLEST = "--models constant --layouts 12 --studies 2 --answered 12"
DATASET = "occluded-intersection-v2"
POOL = 5  # times as many layouts as are answered
ENDLESS = 1000  # times as many: as good as a pool without end
LEAST = covariate.LEAST
MOST = 100  # a greater ratio says that the references explain all
RESAMPLES = 300
RATIO = Unit(decimals=2)


@dataclass(frozen=True)
class Figure:
    """Success of a run, or its gain over another."""

    name: str
    success: Success  # how it counts
    values: Floats  # success, (S, E)
    base: Floats | None  # that over which it is a gain
    known: Floats  # what trees know of the layouts, (E, K)

    def estimates(self, some: Ints, pool: Ints) -> tuple[Estimate, Estimate | None]:
        """Return it in some layouts, plain and corrected by those of a pool,
        of which they are the first.
        """
        of, values = Success(self.success.dangerous[some]), self.values[:, some]
        all_of = Pool(self.known[pool], self.success.dangerous[pool], np.arange(len(some)))
        if self.base is None:
            return of.estimate(values), all_of.estimate(of, values)
        base = self.base[:, some]
        return of.difference(values, base), all_of.difference(of, values, base)

    @property
    def by_kind(self) -> "Figure":
        """The same, knowing of each layout only which of eight kinds it is of."""
        easy = self.known[:, 2] > np.median(self.known[:, 2])
        of_drivers = self.known[:, :2] == 1
        return replace(self, known=np.eye(8)[of_drivers @ [4, 2] + easy])

    def ratio(self, some: Ints) -> float:
        """Return how many times as many answers it needs plain;
        NaN where nothing is left to vary.
        """
        plain, better = self.estimates(some, np.tile(some, ENDLESS))
        ratio = covariate.worth(plain, better) if better else 1.0
        return ratio if ratio < MOST else np.nan


@dataclass(frozen=True)
class Coverage:
    """How often intervals of so many answered layouts held the truth."""

    answered: int
    corrected: float
    plain: float
    width: float | None  # of the corrected interval, as a share of the plain one's: the median


@dataclass(frozen=True)
class Cell:
    """What was measured of one figure."""

    figure: str
    ratio: Mapping[str, float | int | None]  # with its interval; n: layouts
    strata: float | None
    coverage: list[Coverage]


def measure(figure: Figure, answered: int, studies: int, rng: np.random.Generator) -> Coverage:
    """Make so many studies; those of fewer layouts than the harness corrects are corrected, too."""
    covariate.LEAST = min(LEAST, answered)
    layouts = len(figure.known)
    truth = figure.estimates(np.arange(layouts), np.arange(layouts))[0].value
    held, widths = np.zeros(2), []
    for _ in range(studies):
        pool = rng.integers(layouts, size=POOL * answered)
        plain, better = figure.estimates(pool[:answered], pool)
        better = better or plain
        held += [e.low - 1e-9 <= truth <= e.high + 1e-9 for e in (better, plain)]
        widths.append((better.high - better.low) / (plain.high - plain.low))
    corrected, plain_held = (held / studies).tolist()
    return Coverage(answered, corrected, plain_held, number_or_none(float(np.median(widths))))


def figures(model: str, layouts: int, folder: Path) -> Iterator[Figure]:
    """Run a model; yield success of each condition and its gain over alone, plain and balanced."""
    pages.harness(
        "eval",
        "--model",
        model,
        "--dataset",
        DATASET,
        "--limit",
        str(layouts),
        "--quiet",
        "--condition",
        "single-local",
        "--condition",
        "6g",
        "--out",
        str(folder / model),
    )
    done = read(folder / model)
    references = load(find(DATASET), layouts).reference_success()
    in_trees = np.column_stack([references[name] for name in REFERENCES])
    balanced, values = by_condition(done.grid, done.episodes)
    alone, helped = values["single-local"], values["6g"]
    for how in (balanced.plain, balanced):
        for name, of, base in (
            ("alone", alone, None),
            ("6g", helped, None),
            ("gain", helped, alone),
        ):
            yield Figure(f"{model}, {IN_WORDS[how.metric]}, {name}", how, of, base, in_trees)


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--models", nargs="+", default=["proxy", "swarm-tiny"])
    arguments.add_argument("--layouts", type=int, default=120)
    arguments.add_argument("--answered", nargs="+", type=int, default=[20, 30, 40, 60])
    arguments.add_argument("--studies", type=int, default=1000)
    given = arguments.parse_args()
    cells = list[Cell]()
    print(
        f"{DATASET}, {given.layouts} layouts; {given.studies} studies, a pool {POOL} times as large"
    )
    heads = "".join(f"{f'of {answered}':>8}{'plain':>7}" for answered in given.answered)
    print(f"{'':<36}{'ratio':>20}{'strata':>8}{'width':>7}{heads}")
    with tempfile.TemporaryDirectory() as folder:
        for model in given.models:
            for figure in figures(model, given.layouts, Path(folder)):
                rng = np.random.default_rng(list(figure.name.encode()))
                covariate.LEAST = LEAST
                drawn = resampled(rng, given.layouts, RESAMPLES)
                ratios = np.array(
                    [figure.ratio(np.repeat(np.arange(given.layouts), n)) for n in drawn]
                )
                ratio = resampled_estimate(ratios, given.layouts)
                strata = figure.by_kind.ratio(np.arange(given.layouts))
                coverage = [measure(figure, n, given.studies, rng) for n in given.answered]
                cells.append(Cell(figure.name, as_mapping(ratio), number_or_none(strata), coverage))
                held = "".join(f"{100 * c.corrected:>8.1f}{100 * c.plain:>7.1f}" for c in coverage)
                ratios_shown = f"{interval_of(ratio, RATIO):>20}{RATIO.number(strata):>8}"
                width = RATIO.number(coverage[-1].width)
                print(f"{figure.name:<36}{ratios_shown}{width:>7}{held}", flush=True)
    print(json.dumps({"studies": given.studies, "cells": [asdict(cell) for cell in cells]}))


if __name__ == "__main__":
    main()
