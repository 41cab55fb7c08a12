"""Decisions that flip: the same decision point, condition, episode and seed, and another action."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Ints
from harness.report.compare.pair import Pair, Side

LOST_BY = ("B", "A", None)  # in the order of the list: what B gave away comes first, then what A did


@dataclass(frozen=True)
class DecisionFlip:
    """A decision point at which the runs act otherwise."""

    scene: str  # its id
    episode: int  # its episode's number
    seeds: tuple[int, ...]  # in which they do
    a: str  # action of A
    b: str  # action of B
    # the run whose action alone gave success away; None where neither, both or nobody knows
    lost_by: str | None


def flips(pair: Pair, condition: str) -> tuple[int, tuple[DecisionFlip, ...]]:
    """Count the decisions of both runs in a condition; list the flips by `LOST_BY`, then by most seeds."""
    names = sorted({*pair.a.run.decisions.scenes, *pair.b.run.decisions.scenes})
    (keys_a, rows_a), (keys_b, rows_b) = (_keys(pair, side, condition, names) for side in (pair.a, pair.b))
    _, of_a, of_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
    rows_a, rows_b = rows_a[of_a], rows_b[of_b]
    a, b = pair.a.run.decisions, pair.b.run.decisions
    acted_a, acted_b = (
        np.array(side.run.actions)[side.run.decisions.codes("action", side.run.actions)[rows]]
        for side, rows in ((pair.a, rows_a), (pair.b, rows_b))
    )
    lost_a, lost_b = a.flags("regret")[rows_a], b.flags("regret")[rows_b]
    lost_by = np.where(lost_a == lost_b, 2, np.where(lost_b, 0, 1))
    scene, episode, seed = (
        a.codes("scene", names)[rows_a],
        a.whole("episode")[rows_a],
        a.whole("seed")[rows_a],
    )
    seeds: dict[tuple[int, int, str, str, int], list[int]] = {}
    for n in np.flatnonzero(acted_a != acted_b).tolist():
        how = int(lost_by[n]), int(scene[n]), str(acted_a[n]), str(acted_b[n]), int(episode[n])
        seeds.setdefault(how, []).append(int(seed[n]))
    ordered = sorted(seeds.items(), key=lambda item: (item[0][0], -len(item[1]), item[0]))
    return len(of_a), tuple(
        DecisionFlip(names[place], number, tuple(in_seeds), before, after, LOST_BY[by])
        for (by, place, before, after, number), in_seeds in ordered
    )


def _keys(pair: Pair, side: Side, condition: str, names: Sequence[str]) -> tuple[Ints, Ints]:
    """Return a number for each decision in a condition, the same in both runs, and the decision's row."""
    run = side.run
    d = run.decisions
    rows = np.flatnonzero(d.codes("condition", run.conditions) == run.conditions.index(condition))
    rows = rows[np.isin(d.whole("episode")[rows], pair.episodes)]
    scene, episode, seed = d.codes("scene", names)[rows], d.whole("episode")[rows], d.whole("seed")[rows]
    place = np.searchsorted(pair.episodes, episode) * len(pair.seeds) + np.searchsorted(pair.seeds, seed)
    return scene * (len(pair.episodes) * len(pair.seeds)) + place, rows
