"""How success of episodes counts: balanced over layouts with and without a danger, or plain.

All that picks, orders or tests by success of single episodes does so here.
"""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import comb
from typing import Generic, TypeVar

import numpy as np

from harness.core import multiplicity
from harness.core.arrays import Bools, Floats, Ints
from harness.core.power import Spread, variance
from harness.core.sequences import any_time, any_time_difference
from harness.core.statistics import (
    LEVEL,
    Estimate,
    known_mean,
    mean_of,
    paired_difference,
    resampled,
)
from harness.runs.leading import ANY_TIME, BALANCED, IN_WORDS, PAIRED, SUCCESS
from harness.runs.metrics import BASELINE, GAINS, METRICS, Grid, of_ends, over_episodes
from harness.runs.records import Episode, Score

Setting = TypeVar("Setting")


@dataclass(frozen=True)
class Success:
    """How success of episodes E counts."""

    dangerous: Bools  # which of them have a danger, (E,)

    @classmethod
    def of(cls, episodes: Sequence[Episode], lead: str) -> "Success":
        """Return that of some episodes, one row of each, in runs that are read by `lead`."""
        return cls(
            np.array([lead == BALANCED and episode.danger != "none" for episode in episodes])
        )

    @property
    def metric(self) -> str:
        """What leads."""
        return BALANCED if 0 < self.dangerous.sum() < len(self.dangerous) else SUCCESS

    @property
    def words(self) -> str:
        """The same for people."""
        return IN_WORDS[self.metric]

    @property
    def plain(self) -> "Success":
        """The same episodes, read by plain success."""
        return Success(np.zeros_like(self.dangerous))

    @property
    def ways(self) -> "tuple[Success, ...]":
        """Plain success, and balanced success where that leads."""
        return (self.plain, self) if self.metric == BALANCED else (self,)

    def mean(self, success: Floats) -> float:
        """Return the mean of success, (S, E)."""
        return float(
            np.mean([known_mean(known_mean(success[:, part], 0), 0) for part in self.parts])
        )

    def estimate(self, success: Floats) -> Estimate:
        """Return the same with its interval over episodes."""
        return self._mean(lambda part: over_episodes(SUCCESS, success[:, part]))

    def difference(self, a: Floats, b: Floats, level: float = LEVEL) -> Estimate:
        """Return success a - b, both (S, E), paired by episode."""
        return mean_difference([(self, a, b)], level)

    def any_time(self, success: Floats) -> Estimate:
        """Return mean success, (S, E), with an interval over episodes that holds at every look."""
        return any_time([known_mean(success, 0)[part] for part in self.parts])

    def any_time_difference(self, a: Floats, b: Floats) -> Estimate:
        """Return success a - b, both (S, E), paired by episode,
        with an interval that holds at every look.
        """
        return any_time_difference([known_mean(a - b, 0)[part] for part in self.parts])

    def p_value(self, a: Floats, b: Floats) -> float | None:
        """Return the p-value of no such difference; None without an interval."""
        return p_of_mean([(self, a, b)])

    def most(self, successes: Mapping[str, Floats]) -> list[str]:
        """Return the name with the most success, (S, E) each,
        and then those that cannot be told from it.

        These are the names whose difference from it, paired by episode, has a p above `LEVEL`, by
        Holm's method for all pairs, since the first was picked for being the best; or that have no
        p.
        """
        best = max(successes, key=lambda name: self.mean(successes[name]))
        rest = [name for name in successes if name != best]
        found = [self.p_value(successes[best], successes[name]) for name in rest]
        p_values = [1.0 if p is None else p for p in found]
        corrected = multiplicity.holm(p_values, comb(len(successes), 2))
        close = [name for name, p in zip(rest, corrected, strict=True) if p > multiplicity.LEVEL]
        return [best, *close]

    def spread(self, a: Floats, b: Floats, counts: Ints) -> Spread:
        """Return how much success b - a, both (S, E), varies where episodes count so often,
        (..., E).
        """
        differences, parts = known_mean(b - a, 0), self.parts
        variances = [variance(differences[part], counts[..., part]) for part in parts]
        return Spread(np.array([part.mean() for part in parts]), np.stack(variances, axis=-1))

    def resampled(self, draws: np.random.Generator, times: int) -> Ints:
        """Return how often each episode counts, as in `statistics.resampled`,
        (1 + times, E), by halves.
        """
        counts = np.empty((1 + times, len(self.dangerous)), dtype=np.int64)
        for part in self.parts:
            counts[:, part] = resampled(draws, int(part.sum()), times)
        return counts

    def weights(self, counts: Ints) -> Floats:
        """Return the weight of each episode in the mean where they count so often, (..., E)."""
        shares = sum(part / (len(self.parts) * part.sum()) for part in self.parts)
        return np.asarray(counts * shares)

    @property
    def parts(self) -> list[Bools]:
        """Which episodes are averaged first, (E,) each; the mean is of these means."""
        halves = [self.dangerous, ~self.dangerous]
        return halves if self.metric == BALANCED else [np.ones_like(self.dangerous)]

    def _mean(self, estimate: Callable[[Bools], Estimate]) -> Estimate:
        parts = self.parts
        estimates = [estimate(part) for part in parts]
        return mean_of(estimates) if len(estimates) > 1 else estimates[0]


def by_condition(
    grid: Grid, episodes: Sequence[Episode], lead: str = BALANCED
) -> tuple[Success, dict[str, Floats]]:
    """Return how success of a run's episodes counts, and success (S, E) by condition;
    in the grid's order.
    """
    values = dict(zip(grid.conditions, of_ends(METRICS[SUCCESS], grid, episodes), strict=True))
    return Success.of(episodes[: len(grid.episodes)], lead), values


def any_time_scores(grid: Grid, episodes: Sequence[Episode]) -> Iterator[Score]:
    """Yield the scores of success, and of gains in it, whose intervals hold at every look."""
    success, values = by_condition(grid, episodes)
    for by in success.ways:
        for name, of_condition in values.items():
            yield Score.of(name, by.metric, by.any_time(of_condition), ANY_TIME)
            if BASELINE in values and name != BASELINE:
                gain = by.any_time_difference(of_condition, values[BASELINE])
                yield Score.of(name, GAINS[by.metric], gain, ANY_TIME)


def is_gain(score: Score, conditions: Container[str]) -> bool:
    """Return whether a row is a gain over `BASELINE` that can be computed: a file may state any."""
    known = score.condition in conditions and BASELINE in conditions
    return known and score.interval == PAIRED and score.metric in GAINS.values()


# of each family: how success counts, and both, (S, E)
Pairs = Sequence[tuple[Success, Floats, Floats]]


@dataclass(frozen=True)
class Plays(Generic[Setting]):
    """Success of the same episodes under several settings, in one family of scenes or more."""

    # of each family: how success counts, and success by setting, (S, E)
    families: Sequence[tuple[Success, Mapping[Setting, Floats]]]

    @property
    def plain(self) -> "Plays[Setting]":
        """The same, read by plain success."""
        return Plays([(rule.plain, success) for rule, success in self.families])

    def pairs(self, setting: Setting, base: Setting) -> Pairs:
        """Return success under a setting and under the one that it is held against, by family."""
        return [(rule, success[setting], success[base]) for rule, success in self.families]

    def difference(self, setting: Setting, base: Setting) -> Estimate:
        """Return the mean over families of the difference in success, paired by episode."""
        return mean_difference(self.pairs(setting, base))


def mean_difference(pairs: Pairs, level: float = LEVEL) -> Estimate:
    """Return the mean over families of success a - b, both (S, E), paired by episode."""
    parts = []
    for success, a, b in pairs:
        differences = known_mean(a - b, 0)
        parts += [differences[part] for part in success.parts]
    return paired_difference(parts, level)


def half_difference(pairs: Pairs, dangerous: bool) -> Estimate:
    """Return the same where there is a danger, or where there is none."""
    parts = [known_mean(a - b, 0)[success.dangerous == dangerous] for success, a, b in pairs]
    return paired_difference(parts)


def p_of_mean(pairs: Pairs) -> float | None:
    """Return the p-value of no such difference; None without an interval."""
    return multiplicity.p_value(lambda level: mean_difference(pairs, level))


def alike(successes: Sequence[Success]) -> list[Success]:
    """Return what is averaged over families: balanced only where it is in all of them."""
    balanced = all(success.metric == BALANCED for success in successes)
    return [success if balanced else success.plain for success in successes]
