"""How often the harness's nominal 95 % intervals hold the truth, over simulated runs.

A *cell* is a kind of figure, a true rate and a number of episodes E; in each so many runs are drawn
whose truth is known, and the functions that make `summary.csv` and `harness compare` say their
intervals. *Alike* is how alike the seeds, or the answers, of one episode are: their intraclass
correlation, 1 where no seed changes anything. `<` marks less than 94 %, `>` more than 96 %; with 2
000 runs a cell of exactly 95 % is measured within 1 point of it.

`benchmarks/differences.py` has paired differences of success over halves and families.

    python benchmarks/intervals.py [--runs 2000] [--seed 0] [--twins]
"""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from time import perf_counter

import numpy as np

from harness.core.arrays import Floats
from harness.core.statistics import (
    Estimate,
    known_mean,
    mean_of,
    paired_difference,
    rate_interval,
    seed_interval,
    seed_rate_interval,
)
from harness.runs.estimates import difference, over_episodes, over_seeds
from harness.runs.headline import SUCCESS

SMALLEST = "--runs 2"
# an episode has so many answers, at least and at most
EPISODES, SEEDS, ANSWERS = (20, 60, 240), 5, (3, 9)
TWINS = (12, 24, 40)  # episodes of `harness study twins`
RATES = (0.54, 0.75, 0.9, 0.97, 0.99)
PAIRS = ((0.54, 0.54), (0.54, 0.75), (0.75, 0.9), (0.9, 0.97), (0.97, 0.99), (0.97, 0.97))
LOSSES = (0.012, 0.1, 0.5)
ALONE = 0.7  # share of episodes that succeed without a message


@dataclass(frozen=True)
class Cell:
    """What was measured: coverage and runs without an interval in percent,
    and the widths of the others.
    """

    kind: str
    row: str
    episodes: int
    covered: float
    unknown: float
    least_width: float
    mean_width: float


Drawn = Iterator[tuple[Estimate, float]]  # a run's interval, and what it should hold
Kind = Callable[[np.random.Generator, int, int], Drawn]  # from the runs and the episodes of each


def outcomes(
    rng: np.random.Generator, rate: float, alike: float, episodes: int, seeds: int
) -> Floats:
    """Successes (S, E) of layouts whose own rates are drawn from a beta distribution."""
    if alike in (0.0, 1.0):
        own = (
            np.full(episodes, rate) if alike == 0.0 else (rng.random(episodes) < rate).astype(float)
        )
    else:
        size = (1 - alike) / alike
        own = rng.beta(size * rate, size * (1 - rate), episodes)
    return (rng.random((seeds, episodes)) < own).astype(float)


def success(rate: float, alike: float, seeds: int) -> Kind:
    """A success rate over episodes."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        for _ in range(runs):
            yield over_episodes(SUCCESS, outcomes(rng, rate, alike, episodes, seeds)), rate

    return draw


def paired(
    rng: np.random.Generator,
    before: float,
    after: float,
    alike: tuple[float, float],
    seeds: int,
    episodes: int,
) -> list[Floats]:
    """Successes (E, S) of two conditions.

    In a share `alike` of episodes the layout decides, in the others each seed; nine layouts in ten
    are as hard for one condition as for the other.
    """
    hard = rng.random(episodes)
    same, decides = rng.random(episodes) < 0.9, rng.random(episodes)
    luck = rng.random((episodes, seeds))
    both = []
    for rate, share in zip((before, after), alike, strict=True):
        own = np.where(same, hard, rng.random(episodes))
        both.append(np.where((decides < share)[:, None], own[:, None], luck) < rate)
    return [each.astype(float) for each in both]


def gain(before: float, after: float, alike: tuple[float, float], seeds: int) -> Kind:
    """A paired gain in success."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        for _ in range(runs):
            a, b = paired(rng, before, after, alike, seeds, episodes)
            yield difference(SUCCESS, [(b, a)]), after - before

    return draw


def rare_change(rate: float, gained: float, seeds: int, loss: float) -> Kind:
    """A gain in so few episodes that many runs see none:
    so many are expected, whatever their number.
    """

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        share = gained / episodes
        for _ in range(runs):
            hard = rng.random((episodes, 1))
            lost = rng.random((episodes, seeds)) < loss
            a = np.repeat(hard < rate, seeds, axis=1)
            b = (hard < rate + share) & ~lost
            truth = (rate + share) * (1 - loss) - rate
            yield difference(SUCCESS, [(b.astype(float), a.astype(float))]), truth

    return draw


def answers(rate: float, alike: float) -> Kind:
    """A rate of answers, of which each episode has some."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        for _ in range(runs):
            given = outcomes(rng, rate, alike, episodes, ANSWERS[1]).T
            said = (
                np.arange(ANSWERS[1]) < rng.integers(ANSWERS[0], ANSWERS[1] + 1, episodes)[:, None]
            )
            yield rate_interval(given[said], np.nonzero(said)[0]), rate

    return draw


def twins(rate: float, alike: float, pairs: int) -> Kind:
    """The share of questions whose twin agrees, with so many of each episode:
    6 of the ego, 18 of helpers.
    """

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        of = np.repeat(np.arange(episodes), pairs)
        for _ in range(runs):
            yield rate_interval(outcomes(rng, rate, alike, episodes, pairs).T.ravel(), of), rate

    return draw


def seed_means(loss: float) -> Kind:
    """A success rate over seeds, of these very episodes:
    some hang on a message, which may be lost.
    """

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        own = np.where(np.arange(episodes) < round(ALONE * episodes), 1.0, 1.0 - loss)
        for _ in range(runs):
            values = (rng.random((SEEDS, episodes)) < own).astype(float)
            yield over_seeds(SUCCESS, values), float(own.mean())

    return draw


def own_episodes(rate: float) -> Kind:
    """A success rate over seeds of which each has episodes of its own,
    as in `harness study paper`.
    """

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        for _ in range(runs):
            values = (rng.random((SEEDS, episodes)) < rate).astype(float)
            yield seed_interval(known_mean(values, axis=1)), rate

    return draw


def seed_gains(loss: float) -> Kind:
    """The same of a gain over a condition that no seed changes."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        alone = np.arange(episodes) < round(ALONE * episodes)
        own = np.where(alone, 0.0, 1.0 - loss)
        for _ in range(runs):
            values = (rng.random((SEEDS, episodes)) < own).astype(float)
            yield seed_rate_interval(values), float(own.mean())

    return draw


def suite(families: Sequence[Kind]) -> Kind:
    """The mean over families, each with so many episodes of its own."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        for drawn in zip(*(family(rng, runs, episodes) for family in families), strict=True):
            yield (
                mean_of([estimate for estimate, _ in drawn]),
                float(np.mean([truth for _, truth in drawn])),
            )

    return draw


def suite_gain(alike: tuple[float, float], seeds: int) -> Kind:
    """A paired gain, mean over families with the rates of `PAIRS`."""

    def draw(rng: np.random.Generator, runs: int, episodes: int) -> Drawn:
        truth = float(np.mean([after - before for before, after in PAIRS]))
        for _ in range(runs):
            drawn = [paired(rng, before, after, alike, seeds, episodes) for before, after in PAIRS]
            yield paired_difference([known_mean(b - a, 1) for a, b in drawn]), truth

    return draw


def twin_kinds() -> Iterator[tuple[str, str, Kind]]:
    """What is measured of `harness study twins`."""
    for pairs in (6, 18):
        for alike in (0.1, 0.3, 0.6):
            for rate in (0.75, 0.9, 0.95):
                yield (
                    f"twins, {pairs} questions an episode, alike {alike}",
                    f"{rate:.2f}",
                    twins(rate, alike, pairs),
                )


def kinds() -> Iterator[tuple[str, str, Kind]]:
    """What is measured: its heading, its row, and how it is drawn."""
    for seeds, alike in ((1, 1.0), (SEEDS, 0.1), (SEEDS, 0.6), (SEEDS, 0.9)):
        heading = (
            f"success rate, {seeds} seeds, alike {alike}" if seeds > 1 else "success rate, one seed"
        )
        for rate in RATES:
            yield heading, f"{rate:.2f}", success(rate, alike, seeds)
    for seeds, shares in ((1, (1.0, 1.0)), (SEEDS, (1.0, 0.9)), (SEEDS, (0.6, 0.6))):
        of = f"{seeds} seeds, alike {shares[0]} and {shares[1]}" if seeds > 1 else "one seed"
        for before, after in PAIRS:
            yield (
                f"paired gain, {of}",
                f"{before:.2f} to {after:.2f}",
                gain(before, after, shares, seeds),
            )
    for seeds, loss in ((1, 0.0), (SEEDS, 0.012)):
        of = f"{seeds} seeds, loss {loss}" if seeds > 1 else "one seed"
        for gained in (1, 2, 3, 4, 6):
            heading = f"gain in few episodes, from 0.54, {of}"
            yield heading, f"{gained} expected", rare_change(0.54, gained, seeds, loss)
    for alike in (0.1, 0.3, 0.6):
        for rate in RATES:
            yield f"answer rate, alike {alike}", f"{rate:.2f}", answers(rate, alike)
    for heading, kind in (("mean over 5 seeds", seed_means), ("gain over 5 seeds", seed_gains)):
        for loss in LOSSES:
            yield heading, f"loss {loss}", kind(loss)
    for rate in RATES:
        yield "mean over 5 seeds with episodes of their own", f"{rate:.2f}", own_episodes(rate)
    rows = (("one seed", 1, 1.0), (f"{SEEDS} seeds, alike 0.6", SEEDS, 0.6))
    for row, seeds, alike in rows:
        of_rates = [success(rate, alike, seeds) for rate in RATES]
        yield "success rate, mean over families", row, suite(of_rates)
    for row, seeds, alike in rows:
        yield "paired gain, mean over families", row, suite_gain((alike, alike), seeds)


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--runs", type=int, default=2000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument(
        "--twins", action="store_true", help="those of `harness study twins` alone"
    )
    given = arguments.parse_args()
    began, found, before = perf_counter(), list[Cell](), ""
    of = TWINS if given.twins else EPISODES
    for n, (heading, row, kind) in enumerate(twin_kinds() if given.twins else kinds()):
        if heading != before:
            print(f"\n{heading:<52}" + "".join(f"{f'E = {e}':>9}" for e in of))
            before = heading
        print(f"{row:<52}", end="", flush=True)
        for episodes in of:
            rng = np.random.default_rng((given.seed, n, episodes))
            drawn = list(kind(rng, given.runs, episodes))
            covered = 100 * float(
                np.mean([e.low - 1e-9 <= truth <= e.high + 1e-9 for e, truth in drawn])
            )
            widths = np.array([e.high - e.low for e, _ in drawn])
            unknown = 100 * float(np.isnan(widths).mean())
            spread = float(np.nanmin(widths)), float(np.nanmean(widths))
            found.append(Cell(heading, row, episodes, covered, unknown, *spread))
            mark = "<" if covered < 94.0 else ">" if covered > 96.0 else " "
            print(f"{covered:>8.1f}{mark}", end="", flush=True)
        print()
    told = {
        "cells": len(found),
        "below_94": sum(cell.covered < 94.0 for cell in found),
        "above_96": sum(cell.covered > 96.0 for cell in found),
        "least": min(cell.covered for cell in found),
        "of_no_width": sum(cell.least_width <= 0.0 for cell in found),
        "seconds": round(perf_counter() - began, 1),
    }
    print(
        "\n" + ", ".join(f"{name.replace('_', ' ')}: {value:.4g}" for name, value in told.items())
    )
    print(
        json.dumps(
            {"runs": given.runs, "seed": given.seed, **told, "found": list(map(asdict, found))}
        )
    )


if __name__ == "__main__":
    main()
