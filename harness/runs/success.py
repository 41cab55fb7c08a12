"""How success of episodes counts: balanced over layouts with and without a danger, or plain.

All that picks, orders or tests by success of single episodes does so here.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Generic, TypeVar

import numpy as np

from harness.core import multiplicity
from harness.core.arrays import Bools, Floats, Ints
from harness.core.power import Spread, variance
from harness.core.statistics import (
    LEVEL,
    Estimate,
    cluster_numbers,
    joined_clusters,
    known_mean,
    mean_of,
    paired_difference,
    parts_of,
    resampled,
)
from harness.runs.estimates import over_episodes
from harness.runs.grid import Grid
from harness.runs.headline import BALANCED, IN_WORDS, PAIRED, SUCCESS
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.metric_values import of_ends
from harness.runs.metrics import METRICS
from harness.runs.records import Episode, Score

Setting = TypeVar("Setting")


@dataclass(frozen=True)
class Success:
    """Define how success of E episodes is averaged: plainly, or balanced over danger and none.

    A danger is a vehicle that would meet an ego which keeps its speed; `dangerous`, (E,), says
    which episodes have one, none for a plain mean. Balanced success is the mean of two shares: of
    the successes among episodes with one, and among those without. `clusters`, (E,), has the number
    of each episode's cluster, such as the recording that its layout is cut from: intervals count
    these in place of episodes.
    """

    dangerous: Bools  # whether each episode has a danger, (E,); all false for a plain mean
    # number of the cluster of each episode, (E,); None if each is of its own
    clusters: Ints | None = None
    # names of the clusters, (E,), by which families know those that they share; empty where only
    # one family is looked at
    names: Sequence[str | None] = ()

    @classmethod
    def of(cls, episodes: Sequence[Episode], headline_metric: str) -> "Success":
        """Return how success of a run's E episodes is averaged, plainly or balanced over dangers.

        `episodes` has one record of each. `headline_metric` names plain or balanced success, the
        metric by which the run is read; the rule is balanced only if it names that, and there are
        episodes with a danger and without. A danger is a vehicle that would meet an ego which keeps
        its speed.
        """
        balanced = headline_metric == BALANCED
        dangerous = np.array([balanced and episode.danger != "none" for episode in episodes])
        names = [episode.cluster for episode in episodes]
        return cls(dangerous, cluster_numbers(names), names)

    @property
    def metric(self) -> str:
        """Return the name of the metric of success that this rule averages to, as in `summary.csv`.

        It is that of balanced success if there are episodes with a danger and without, else of
        plain success.
        """
        return BALANCED if 0 < self.dangerous.sum() < len(self.dangerous) else SUCCESS

    @property
    def words(self) -> str:
        """Return the name of the metric of success that this rule averages to, for people."""
        return IN_WORDS[self.metric]

    @property
    def plain(self) -> "Success":
        """Return the rule that averages the same episodes plainly, with a danger or not.

        A danger is a vehicle that would meet an ego which keeps its speed.
        """
        return replace(self, dangerous=np.zeros_like(self.dangerous))

    @property
    def ways(self) -> "tuple[Success, ...]":
        """Return the plain rule for the same episodes, then the balanced one if this is it.

        A balanced mean is that of success with a danger and without.
        """
        return (self.plain, self) if self.metric == BALANCED else (self,)

    def mean(self, success: Floats) -> float:
        """Return the mean of success, plain or balanced as this rule says.

        `success` is 1 or 0 (NaN where unknown), (S, E), by S seeds of the channel's random draws
        and E episodes.
        """
        return float(
            np.mean([known_mean(known_mean(success[:, part], 0), 0) for part in self.parts])
        )

    def estimate(self, success: Floats) -> Estimate:
        """Return the mean of success with its 95 % interval over episodes.

        `success` is 1 or 0 (NaN where unknown), (S, E), by S seeds of the channel's random draws
        and E episodes.
        """
        clusters = self.clusters
        estimates = []
        for part in self.parts:
            of_part = None if clusters is None else clusters[part]
            estimates.append(over_episodes(SUCCESS, success[:, part], of_part))
        if len(estimates) == 1:
            return estimates[0]
        return mean_of(estimates, together=clusters is not None)

    def difference(self, a: Floats, b: Floats, level: float = LEVEL) -> Estimate:
        """Return the difference in mean success a - b, with an interval of confidence `level`.

        `a` and `b` are the success of the same episodes, such as under two conditions, (S, E), by S
        seeds of the channel's random draws and E episodes. They are paired by episode.
        """
        return mean_difference([(self, a, b)], level)

    def p_value(self, a: Floats, b: Floats) -> float | None:
        """Return the p-value of no difference in success; None if that has no interval.

        `a` and `b` are the success of the same episodes, (S, E), by S seeds of the channel's random
        draws and E episodes.
        """
        return p_of_mean([(self, a, b)])

    def most(self, successes: Mapping[str, Floats]) -> list[str]:
        """Return the name with the highest success, then those not significantly below it.

        `successes` has by name, such as that of a condition, the success of the same episodes, (S,
        E), by S seeds of the channel's random draws and E episodes. Not below it are names whose
        paired difference from the best has a p above `LEVEL`, by Holm's method for all pairs since
        the best was picked, or that have no p.
        """
        best = max(successes, key=lambda name: self.mean(successes[name]))
        rest = [name for name in successes if name != best]
        raw_p_values = [self.p_value(successes[best], successes[name]) for name in rest]
        p_values = [1.0 if p is None else p for p in raw_p_values]
        corrected = multiplicity.holm(p_values, comb(len(successes), 2))
        close = [name for name, p in zip(rest, corrected, strict=True) if p > multiplicity.LEVEL]
        return [best, *close]

    def spread(self, a: Floats, b: Floats, counts: Ints) -> Spread:
        """Return how much the difference in success b - a varies between episodes.

        A power analysis needs it. `a` and `b` are the success of the same episodes, (S, E), by S
        seeds of the channel's random draws and E episodes. `counts` (..., E) says how often each
        episode counts in a bootstrap resample. The variance is given by group: of all episodes, or
        of those with a danger and those without.
        """
        differences, parts = known_mean(b - a, 0), self.parts
        variances = [variance(differences[part], counts[..., part]) for part in parts]
        return Spread(np.array([part.mean() for part in parts]), np.stack(variances, axis=-1))

    def resampled(self, draws: np.random.Generator, times: int) -> Ints:
        """Return how often each of E episodes counts in bootstrap resamples, (1 + times, E).

        There are `times` resamples after a first row, the sample itself. Episodes with a danger (a
        vehicle that would meet a cruising ego) and without are resampled apart, but for clusters,
        which are resampled whole. `draws` is the generator of random numbers.
        """
        if self.clusters is not None:
            return resampled(draws, len(self.dangerous), times, self.clusters)
        counts = np.empty((1 + times, len(self.dangerous)), dtype=np.int64)
        for part in self.parts:
            counts[:, part] = resampled(draws, int(part.sum()), times)
        return counts

    def weights(self, counts: Ints) -> Floats:
        """Return how much each of E episodes weighs in the mean, (..., E).

        `counts`, (..., E), says how often each counts, as in a bootstrap resample.
        """
        shares = sum(part / (len(self.parts) * part.sum()) for part in self.parts)
        return np.asarray(counts * shares)

    @property
    def parts(self) -> list[Bools]:
        """Return the masks (E,) of the groups of E episodes that are averaged first.

        It is one of all, or those with a danger and those without. The mean by this rule is the
        mean of the groups' means. A danger is a vehicle that would meet an ego which keeps its
        speed.
        """
        halves = [self.dangerous, ~self.dangerous]
        return halves if self.metric == BALANCED else [np.ones_like(self.dangerous)]


def by_condition(
    grid: Grid, episodes: Sequence[Episode], headline_metric: str = BALANCED
) -> tuple[Success, dict[str, Floats]]:
    """Return how success of a run's episodes is averaged, and their success by condition, (S, E).

    Success is 1 or 0, by S seeds of the channel's random draws and E episodes. `grid` has the run's
    conditions, seeds and episodes, and `episodes` are in its order: by condition, seed and number;
    `headline_metric` is the name of plain or of balanced success. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    values = dict(zip(grid.conditions, of_ends(METRICS[SUCCESS], grid, episodes), strict=True))
    return Success.of(episodes[: len(grid.episodes)], headline_metric), values


def is_gain(score: Score, conditions: Container[str]) -> bool:
    """Return whether a score is a gain: the difference to the condition without a radio.

    Gains are paired by episode. `conditions` are the names of those that the run scores; it is no
    gain if the score's condition, or that without a radio (`BASELINE`), is not among them. A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    has_conditions = score.condition in conditions and BASELINE in conditions
    return has_conditions and score.interval == PAIRED and score.metric in GAINS.values()


# of each family: how success counts, and both, (S, E)
Pairs = Sequence[tuple[Success, Floats, Floats]]


@dataclass(frozen=True)
class Plays(Generic[Setting]):
    """Hold the success of the same episodes under several settings, by family of scenes.

    It is what gains over a suite of scenarios are computed from. A setting is what is compared,
    such as a condition's name; a family is the scenes of one scenario. `families` has for each how
    its success is averaged, and by setting the success of its episodes, 1 or 0, (S, E), by S seeds
    of the channel's random draws and E episodes.
    """

    # for each family how its success is averaged, and by setting the success of its episodes, 1 or
    # 0, (S, E), by S channel seeds and E episodes
    families: Sequence[tuple[Success, Mapping[Setting, Floats]]]

    @property
    def plain(self) -> "Plays[Setting]":
        """Return a copy in which success is averaged plainly in every family of scenes.

        Balanced, it would be the mean of that with a danger and without. A family is the scenes of
        one scenario.
        """
        return Plays([(rule.plain, success) for rule, success in self.families])

    def pairs(self, setting: Setting, base: Setting) -> Pairs:
        """Return for each family the success of the same episodes under two settings, to compare.

        An item is how the family's success is averaged, and the success of `setting` and that of
        `base`, (S, E) each, by S seeds of the channel's random draws and E episodes. A family is
        the scenes of one scenario.
        """
        return [(rule, success[setting], success[base]) for rule, success in self.families]

    def difference(self, setting: Setting, base: Setting) -> Estimate:
        """Return the mean over families of success of `setting` minus `base`, paired by episode.

        A family is the scenes of one scenario; both settings are keys of `families`.
        """
        return mean_difference(self.pairs(setting, base))


def mean_difference(pairs: Pairs, level: float = LEVEL) -> Estimate:
    """Return the mean over families of the difference in success a - b, paired by episode.

    A family is the scenes of one scenario. `pairs` has for each how its success is averaged, and
    the success a and b of its episodes, (S, E) each, by S seeds of the channel's random draws and E
    episodes. The interval, of confidence `level`, treats all families' episodes together.
    """
    parts, masks = [], []
    for success, a, b in pairs:
        differences = known_mean(a - b, 0)
        parts += [differences[part] for part in success.parts]
        masks.append(success.parts)
    return paired_difference(parts, level, _of_parts(pairs, masks))


def _of_parts(pairs: Pairs, masks: Sequence[Sequence[Bools]]) -> list[Ints] | None:
    """Return the clusters of each family's parts, of which `masks` has the episodes."""
    clusters = clusters_of([success for success, _, _ in pairs])
    if clusters is None:
        return None
    of_parts = []
    for numbers, of_family in zip(clusters, masks, strict=True):
        of_parts += [numbers[mask] for mask in of_family]
    return of_parts


def of_families(estimates: Sequence[Estimate], rules: Sequence[Success]) -> Estimate:
    """Return the mean over families of their estimates, with an interval.

    A family is the scenes of one scenario. `rules` has for each how its success is averaged: those
    that share a cluster, such as one recording of traffic, are not independent.
    """
    return mean_of(estimates, together=shares_cluster([rule.names for rule in rules]))


def shares_cluster(families: Sequence[Sequence[str | None]]) -> bool:
    """Return whether two families have a cluster in common, by the name of each episode's."""
    parts = []
    for names in families:
        parts.append({part for name in set(names) if name is not None for part in parts_of(name)})
    return len(set[str]().union(*parts)) < sum(map(len, parts))


def clusters_of(rules: Sequence[Success]) -> list[Ints] | None:
    """Return for each family the number of each episode's cluster, (E,); None if each is its own.

    A family is the scenes of one scenario, and `rules` has for each how its success is averaged.
    Two families have a cluster in common if they name a part of it alike.
    """
    is_clustered = any(rule.clusters is not None for rule in rules)
    if not is_clustered and not shares_cluster([rule.names for rule in rules]):
        return None
    of_one, names = list[str | None](), list[str | None]()
    for family, rule in enumerate(rules):
        episodes = len(rule.dangerous)
        numbers = range(episodes) if rule.clusters is None else rule.clusters.tolist()
        of_one += [f"{family} {number}" for number in numbers]
        names += rule.names or [None] * episodes
    clusters = joined_clusters([of_one, names])
    assert clusters is not None
    ends = np.cumsum([len(rule.dangerous) for rule in rules])
    return np.split(clusters, ends[:-1])


def half_difference(pairs: Pairs, dangerous: bool) -> Estimate:
    """Return the mean over families of success a - b in episodes with a danger, or without.

    A family is the scenes of one scenario. `pairs` has for each how its success is averaged, and
    the success a and b of its episodes, (S, E) each, by S seeds of the channel's random draws and E
    episodes. `dangerous` chooses the episodes with a danger. A danger is a vehicle that would meet
    an ego which keeps its speed.
    """
    parts, masks = [], []
    for success, a, b in pairs:
        of_half = success.dangerous == dangerous
        parts.append(known_mean(a - b, 0)[of_half])
        masks.append([of_half])
    return paired_difference(parts, clusters=_of_parts(pairs, masks))


def p_of_mean(pairs: Pairs) -> float | None:
    """Return the p-value of no mean difference over families; None without an interval.

    A family is the scenes of one scenario. `pairs` has for each how its success is averaged, and
    the success a and b of its episodes, (S, E) each, by S seeds of the channel's random draws and E
    episodes.
    """
    return multiplicity.p_value(lambda level: mean_difference(pairs, level))


def alike(successes: Sequence[Success]) -> list[Success]:
    """Return rules of averaging success for several families, changed to be all of one kind.

    They are balanced if every given rule is, and else plain. A family is the scenes of one
    scenario, and has one rule.
    """
    balanced = all(success.metric == BALANCED for success in successes)
    return [success if balanced else success.plain for success in successes]
