"""How many answers fewer are enough where each layout's difficulty is taken off its success.

A tree knows, before any model is asked, what the drivers `local-view` and `cruise` and a draw of even
actions achieve in its layout. Success is regressed on these three over the layouts that were answered, and
the mean is corrected by how far theirs are from those of a pool of layouts that were not (a control
variate: Glynn and Szechtman 2002). *Ratio*: how many times as many answers the plain mean needs for the
same variance, with a pool without end, and its 95 % interval over layouts; a dash where nothing is left to
vary. *Coverage*: how often Student's interval of a study of few answered layouts, drawn from those of the
run, and a pool holds the run's mean, *plain* without the correction. *Width*: that of its interval, of the
plain one's.

    python benchmarks/difficulty.py [--models proxy constant swarm-tiny] [--layouts 120]
"""

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pages
from scipy.stats import t as student

from harness.core.arrays import Floats
from harness.core.figures import Unit
from harness.core.figures import known as number
from harness.core.statistics import known_mean
from harness.dataset.load import find, load
from harness.runs.folder import read
from harness.runs.success import by_condition

SMALLEST = "--models constant --layouts 12 --studies 2"
DATASET = "occluded-intersection-v2"
ANSWERED, POOL = 60, 4  # layouts of a study, and how many times as many more are in its pool
RESAMPLES = 300
RATIO = Unit(decimals=2)


@dataclass(frozen=True)
class Cell:
    """What was measured of one figure."""

    figure: str
    n: int  # layouts
    ratio: float
    low: float
    high: float
    coverage: float
    plain_coverage: float
    width: float  # of the corrected interval, as a share of the plain one's


def difficulty(layouts: int) -> Floats:
    """What trees know of layouts, (E, 3)."""
    forest = load(find(DATASET), layouts).forest
    drivers = [forest.driver_success(name).astype(float) for name in ("local-view", "cruise")]
    return np.column_stack([*drivers, forest.uniform_success()])


def fit(values: Floats, known: Floats) -> tuple[Floats, float]:
    """Slopes of values (E,) on what is known, (E, 3), and the variance of what is left."""
    centred = known - known.mean(axis=0)
    slopes, _, rank, _ = np.linalg.lstsq(centred, values - values.mean(), rcond=None)
    left = values - values.mean() - centred @ slopes
    return slopes, float(left @ left) / max(len(values) - 1 - int(rank), 1)


def ratio(values: Floats, known: Floats) -> float:
    """The variance of values over that of what is left of them; NaN where nothing is left."""
    left = fit(values, known)[1]
    return float(values.var(ddof=1)) / left if left > 1e-12 else np.nan


def study(rng: np.random.Generator, values: Floats, known: Floats) -> tuple[bool, bool, float]:
    """Whether the corrected interval and the plain one hold the mean, and the share of their widths."""
    answered = rng.integers(len(values), size=ANSWERED)
    pool = np.concatenate([answered, rng.integers(len(values), size=POOL * ANSWERED)])
    y, x, every = values[answered], known[answered], known[pool]
    slopes, left = fit(y, x)
    corrected = y.mean() + (every.mean(axis=0) - x.mean(axis=0)) @ slopes
    error = np.sqrt(left / ANSWERED + (every @ slopes).var(ddof=1) / len(every))
    half = student.ppf(0.975, ANSWERED - 4) * error
    plain = student.ppf(0.975, ANSWERED - 1) * np.sqrt(y.var(ddof=1) / ANSWERED)
    truth = values.mean()
    return abs(corrected - truth) <= half, abs(y.mean() - truth) <= plain, half / plain if plain else np.nan


def figures(model: str, layouts: int, folder: Path) -> dict[str, Floats]:
    """Success by layout, (E,), of each condition, and each gain over alone."""
    run = folder / model
    pages.harness(
        "eval", "--model", model, "--dataset", DATASET, "--limit", str(layouts), "--quiet",
        "--condition", "single-local", "--condition", "6g", "--out", str(run),
    )  # fmt: skip
    done = read(run)
    values = {name: known_mean(each, 0) for name, each in by_condition(done.grid, done.episodes)[1].items()}
    return {
        f"{model}, alone": values["single-local"], f"{model}, 6g": values["6g"],
        f"{model}, gain": values["6g"] - values["single-local"],
    }  # fmt: skip


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--models", nargs="+", default=["proxy", "constant", "swarm-tiny"])
    arguments.add_argument("--layouts", type=int, default=120)
    arguments.add_argument("--studies", type=int, default=1000)
    given = arguments.parse_args()
    known, cells = difficulty(given.layouts), list[Cell]()
    print(f"{DATASET}, {given.layouts} layouts; studies of {ANSWERED}, a pool of {POOL} times as many more")
    print(f"{'':<24}{'ratio':>22}{'coverage':>10}{'plain':>8}{'width':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for model in given.models:
            for figure, values in figures(model, given.layouts, Path(folder)).items():
                if values.std() == 0:
                    print(f"{figure:<24}{'alike in all layouts':>22}")
                    continue
                rng = np.random.default_rng(list(figure.encode()))
                drawn = (rng.integers(len(values), size=len(values)) for _ in range(RESAMPLES))
                ratios = [ratio(values[some], known[some]) for some in drawn]
                low, high = np.percentile(ratios, (2.5, 97.5))
                studies = [study(rng, values, known) for _ in range(given.studies)]
                held, plain, width = zip(*studies, strict=True)
                cell = Cell(
                    figure, len(values), ratio(values, known), float(low), float(high), float(np.mean(held)),
                    float(np.mean(plain)), float(np.nanmean(width)),
                )  # fmt: skip
                cells.append(cell)
                print(
                    f"{figure:<24}{RATIO.interval(cell.ratio, cell.low, cell.high):>22}"
                    f"{100 * cell.coverage:>9.1f} {100 * cell.plain_coverage:>7.1f} {cell.width:>7.2f}",
                    flush=True,
                )
    rows = [{k: number(v) if isinstance(v, float) else v for k, v in asdict(c).items()} for c in cells]
    print(json.dumps({"layouts": given.layouts, "studies": given.studies, "cells": rows}))


if __name__ == "__main__":
    main()
