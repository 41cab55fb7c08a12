"""How often runs that may stop at every look hold the truth, and after how many layouts they stop.

Outcomes are those of `benchmarks/intervals.py` and `benchmarks/plan.py`, whose truth is known. A
run has so many layouts at most, and is looked at as with `harness eval --until-width` and
`--until-decided`. *Every look*: runs whose interval holds the truth at all looks. *Stop*: at the
look where it stops. *Fixed*: at all looks, by the interval for a number of layouts fixed before.
*Layouts*: the median after which runs stop. *Planned*: what the same width, or a power of 80 %,
needs without looking.

    python benchmarks/interim_looks.py [--runs 1000] [--layouts 1000] [--seed 0] [--only TEXT]
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from intervals import outcomes
from plan import KNOWN, Outcomes, Study, balanced, plain, spread_of

from harness.core.arrays import Bools
from harness.core.statistics import Estimate, wilson
from harness.extensions.early_stop.rule import RULE, any_time_mean, interim_looks
from harness.runs.success import Success

SMALLEST = "--runs 2 --layouts 40"
WIDTH = 0.12  # of an interval that is narrow enough
DANGEROUS = 2 / 3  # of layouts, where success is balanced
Interval = Callable[[Outcomes], Estimate]


@dataclass(frozen=True)
class Cell:
    """What was measured of one truth: shares of runs, each with Wilson's interval."""

    truth: str
    every_look: tuple[float, float, float]
    stop: tuple[float, float, float]
    fixed: tuple[float, float, float]
    layouts: float  # the median; the most there are where half of the runs do not stop
    stopped: float  # share of runs that stop before that
    planned: float  # layouts of a study with the same aim that does not look


@dataclass(frozen=True)
class Case:
    """What is looked at."""

    truth: str  # its name
    value: float  # it
    study: Study
    any_time: Interval
    fixed: Interval
    planned: Callable[[Outcomes], float]  # layouts, by a study of very many
    decided: bool  # whether it stops when 0 is left out, and not when it is narrow


def rate(truth: str, rates: tuple[float, ...], seeds: int, alike: float) -> Case:
    """A success rate; of two it is the mean, with a danger and without."""

    def study(rng: np.random.Generator, layouts: int) -> Outcomes:
        dangerous: Bools = (
            np.arange(layouts) % 3 > 0 if len(rates) > 1 else np.zeros(layouts, dtype=bool)
        )
        success = np.empty((seeds, layouts))
        parts = (dangerous, ~dangerous) if len(rates) > 1 else (~dangerous,)
        for part, of_part in zip(parts, rates, strict=True):
            success[:, part] = outcomes(rng, of_part, alike, int(part.sum()), seeds)
        return Success(dangerous), success, success

    def planned(many: Outcomes) -> float:
        success, values, _ = many
        spread = success.spread(
            np.zeros_like(values), values, np.ones(values.shape[1], dtype=np.int64)
        )
        variance = float(np.sum(spread.variances / spread.shares)) / len(spread.shares) ** 2
        return (2 * 1.96 / WIDTH) ** 2 * variance

    return Case(
        truth,
        float(np.mean(rates)),
        study,
        lambda o: any_time_mean(o[0], o[1]),
        lambda o: o[0].estimate(o[1]),
        planned,
        decided=False,
    )


def gain(truth: str, value: float, study: Study) -> Case:
    """A paired gain, or none."""

    def planned(many: Outcomes) -> float:
        return float(spread_of(many).episodes(value, 0.8)) if value else np.nan

    return Case(
        truth,
        value,
        study,
        lambda o: RULE.difference(o[0], o[2], o[1]),
        lambda o: o[0].difference(o[2], o[1]),
        planned,
        decided=True,
    )


def cases() -> list[Case]:
    return [
        *(rate(f"success {p:.2f}, one seed", (p,), 1, 1.0) for p in (0.54, 0.75, 0.9, 0.97)),
        *(rate(f"success {p:.2f}, 5 seeds", (p,), 5, 0.6) for p in (0.75, 0.9)),
        rate("balanced, .60 and .90", (0.6, 0.9), 5, 0.6),
        *(
            gain(f"gain {a:.2f} to {b:.2f}, one seed", b - a, plain(a, b, 1, 1.0))
            for a, b in ((0.75, 0.75), (0.75, 0.8), (0.75, 0.85), (0.54, 0.74))
        ),
        *(
            gain(f"gain {a:.2f} to {b:.2f}, 5 seeds", b - a, plain(a, b, 5, 0.6))
            for a, b in ((0.75, 0.85),)
        ),
        gain("balanced gain, .50 to .70", 0.1, mixed(balanced(0.5, 0.7, 5, 0.6))),
    ]


def mixed(study: Study) -> Study:
    """Draw layouts with a danger among the others, and not before them."""

    def shuffled(rng: np.random.Generator, layouts: int) -> Outcomes:
        success, a, b = study(rng, layouts)
        order = rng.permutation(layouts)
        return Success(success.dangerous[order]), a[:, order], b[:, order]

    return shuffled


def measure(case: Case, layouts: int, runs: int, seed: int) -> Cell:
    """Make so many runs and look at each."""
    rng = np.random.default_rng((seed, *case.truth.encode()))
    planned = case.planned(case.study(rng, KNOWN))
    every, stop, fixed, after = 0, 0, 0, []
    planned_looks = interim_looks(layouts)
    for _ in range(runs):
        success, a, b = case.study(rng, layouts)
        prefixes = [(Success(success.dangerous[:n]), a[:, :n], b[:, :n]) for n in planned_looks]
        spans = [case.any_time(prefix) for prefix in prefixes]
        holds = [_holds(span, case.value) for span in spans]
        ends = [n for n, span in enumerate(spans) if _enough(case, span)]
        last = ends[0] if ends else len(spans) - 1
        every += all(holds)
        stop += holds[last]
        fixed += all(_holds(case.fixed(prefix), case.value) for prefix in prefixes)
        after.append(planned_looks[last])
    share_every, share_stop, share_fixed = (
        (k / runs, *wilson(k / runs, runs)) for k in (every, stop, fixed)
    )
    stopped = float(np.mean(np.array(after) < layouts))
    return Cell(
        case.truth, share_every, share_stop, share_fixed, float(np.median(after)), stopped, planned
    )


def _holds(span: Estimate, value: float) -> bool:
    return bool(np.isnan(span.low) or span.low - 1e-9 <= value <= span.high + 1e-9)


def _enough(case: Case, span: Estimate) -> bool:
    return (
        bool(span.low > 0 or span.high < 0) if case.decided else bool(span.high - span.low <= WIDTH)
    )


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--runs", type=int, default=1000)
    arguments.add_argument("--layouts", type=int, default=1000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--only", default="", help="only truths whose name holds this text")
    given = arguments.parse_args()
    looks = len(interim_looks(given.layouts))
    print(
        f"{given.runs} runs of {given.layouts} layouts at most, {looks} looks; "
        f"they stop at a width of {100 * WIDTH:g} points, gains where they are decided"
    )
    heads = ("every look", "stop", "fixed", "layouts", "stopped", "planned")
    print(
        f"{'':<28}"
        + "".join(f"{head:>20}" for head in heads[:3])
        + "".join(f"{head:>9}" for head in heads[3:])
    )
    cells = []
    for case in (case for case in cases() if given.only in case.truth):
        cell = measure(case, given.layouts, given.runs, given.seed)
        cells.append(cell)
        shares = (cell.every_look, cell.stop, cell.fixed)
        shown = [f"{100 * p:.1f} [{100 * low:.1f}, {100 * high:.1f}]" for p, low, high in shares]
        print(
            f"{cell.truth:<28}"
            + "".join(f"{text:>20}" for text in shown)
            + f"{cell.layouts:>9.0f}{100 * cell.stopped:>8.0f}%{cell.planned:>9.0f}",
            flush=True,
        )
    print(
        json.dumps(
            {"runs": given.runs, "layouts": given.layouts, "cells": list(map(asdict, cells))}
        )
    )


if __name__ == "__main__":
    main()
