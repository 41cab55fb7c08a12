"""Judge the probabilities of policies by the actions that turned out optimal.

The worth of an action is exact, from the decision tree: whether success is still possible after it.
An action is *optimal* if it is of the greatest worth; of several all are. Where nothing can succeed
any more all actions are alike, and the decision is not judged. A policy is right if its likeliest
action is optimal, and as sure as that action is probable; of equally likely actions the share that
is optimal counts.

How sure a policy should be of one action is known only where exactly one is optimal. Of several it
may take any: one that spreads its probability over them makes no mistake, and is less sure than it
is right.

Each figure is over all decisions with one optimal action, and none is a mean over episodes. Its
interval is a bootstrap (Efron and Tibshirani 1993, chapter 13) that resamples whole episodes, since
decisions of one are not independent, or whole clusters of episodes, where those of one are not. The
ends are percentiles of the resampled figures, moved by as much as these are off the figure on
average: a resample is noisier than the sample, which lifts a calibration error.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.noise import generator
from harness.core.statistics import Estimate, resampled, too_few

LEAST_P = 0.005  # least probability of the optimal actions that is counted in a likelihood
BINS = 15  # of equal mass
RISK = 0.05  # greatest share of decisions acted on whose action is not optimal
# fewest decisions of a figure: of fewer, even a calibrated policy has an error of many points
LEAST = 100
LEAST_EPISODES = 30  # fewest that these are of: other seeds often repeat the decisions of a layout
RESAMPLES = 399  # of episodes
SAME = 1e-9  # how near figures are that differ by rounding alone
AT_ONCE = 1 << 17  # how many numbers of resamples are summed at once: they stay in a core's cache


def mass(p: Floats, optimal: Bools) -> Floats:
    """Return the probability that policies give to all optimal actions together, (...).

    It is a score of probabilities: 1 is best. A policy, `p`, is the probabilities of A actions in a
    decision, (..., A), and `optimal` is the mask of actions after which success is still possible,
    (..., A). NaN where no action is optimal.
    """
    # rounding may lift it above 1
    total = np.minimum(np.sum(np.where(optimal, p, 0.0), axis=-1), 1.0)
    return np.where(np.any(optimal, axis=-1), total, np.nan)


def brier(p: Floats, optimal: Bools) -> Floats:
    """Return the Brier score (Brier 1950) of policies: how far they are from optimal, (...).

    A policy, `p`, is the probabilities of A actions in a decision, (..., A), and `optimal` is the
    mask of actions after which success is still possible, (..., A). NaN where no action is optimal.
    With the probability m of the optimal actions together it is (1 - m)² + (0 - (1 - m))²; 0 best,
    2 worst. It does not matter how m is spread over several optimal actions.
    """
    return np.asarray(2.0 * (1.0 - mass(p, optimal)) ** 2)


def likelihood_nats(p: Floats, optimal: Bools) -> Floats:
    """Return the logarithmic score of policies: -ln of the optimal actions' probability, (...).

    It is in nats, 0 is best (Good 1952). A policy, `p`, is the probabilities of A actions in a
    decision, (..., A), and `optimal` is the mask of actions after which success is still possible,
    (..., A). NaN where no action is optimal. A probability below `LEAST_P` counts as that, so that
    it is 5.3 nats at most.
    """
    return np.asarray(-np.log(np.maximum(mass(p, optimal), LEAST_P)))


def right(p: Floats, optimal: Bools) -> Floats:
    """Return 1 where the likeliest action of a policy is optimal, else 0, (...).

    A policy, `p`, is the probabilities of A actions in a decision, (..., A), and `optimal` is the
    mask of actions after which success is still possible, (..., A). For equally likely actions it
    is the share that is optimal; NaN where no action is.
    """
    likeliest = p == p.max(axis=-1, keepdims=True)
    share = np.sum(likeliest & optimal, axis=-1) / np.maximum(likeliest.sum(axis=-1), 1)
    return np.where(np.any(optimal, axis=-1) & ~np.isnan(p).any(axis=-1), share, np.nan)


@dataclass(frozen=True)
class Judged:
    """Hold how sure and how right the n decisions with exactly one optimal action are.

    An action is optimal if success is still possible after it, where it is possible at all. `sure`,
    (n,), is the probability of the likeliest action, `right`, (n,), 1 if that is the optimal one,
    else 0, and `episode`, (n,), the index of the decision's episode.
    """

    sure: Floats  # probability of each decision's likeliest action, (n,)
    # 1 if that is the optimal one, else 0, (n,); if several are equally likely, the share of these
    # that is optimal
    right: Floats
    episode: Ints  # index from 0 of each decision's episode among the run's, (n,)

    @classmethod
    def of(cls, p: Floats, optimal: Bools, episode: Ints) -> "Judged":
        """Return how sure and how right those decisions are that have exactly one optimal action.

        They are chosen from n. `p` are the decisions' policies, probabilities of A actions, (n, A),
        `optimal` is the mask of actions after which success is still possible, (n, A), and
        `episode`, (n,), the index of each decision's episode.
        """
        hits = right(p, optimal)
        is_judged = ~np.isnan(hits) & (optimal.sum(axis=-1) == 1)
        return cls(p.max(axis=-1)[is_judged], hits[is_judged], episode[is_judged])

    @classmethod
    def joined(cls, parts: Sequence["Judged"], sizes: Sequence[int]) -> "Judged":
        """Join the decisions of several parts of a run, as if they were of one.

        `sizes` are the numbers of episodes in the parts. Episodes are counted through: the first of
        a part follows the last of the part before.
        """
        starts = np.cumsum([0, *sizes[:-1]])
        episode = [part.episode + start for part, start in zip(parts, starts, strict=True)]
        sure = np.concatenate([part.sure for part in parts])
        hits = np.concatenate([part.right for part in parts])
        return cls(sure, hits, np.concatenate(episode))

    def bins(self) -> Ints:
        """Return in which bin of like confidence each of n decisions is, its number from 0, (n,).

        There are `BINS` bins of about as many decisions each, as a reliability diagram shows them;
        `calibration_error` uses the same.
        """
        levels, level = np.unique(-self.sure, return_inverse=True)
        return np.asarray(_bins(np.bincount(level, minlength=len(levels))[None])[0][level])


Figure = Callable[[Floats, Floats, Floats], Floats]


def decisions(count: Floats, hits: Floats, sure: Floats) -> Floats:
    """Return the number of decisions in each of R bootstrap resamples, (R,).

    It is a figure of the same form as `calibration_error` and `coverage`, so all arguments are (R,
    L), by resample and by L levels of how sure decisions are: `count` is how many decisions there
    are; `hits`, how many of these are right, and `sure`, the sum of their confidence, are not used.
    """
    return np.asarray(count.sum(axis=1))


def calibration_error(count: Floats, hits: Floats, sure: Floats) -> Floats:
    """Return the expected calibration error of the likeliest action (Naeini and others 2015), (R,).

    There is one for each of R bootstrap resamples: how far the share of right decisions is from the
    mean probability of their likeliest action, the mean over `BINS` bins of equal mass (Nguyen and
    O'Connor 2015); equally sure decisions share a bin. It is above 0 even for calibrated policies,
    the more the fewer decisions there are.

    Args:
        count: number of decisions at each of L levels of confidence, descending, (R, L).
        hits: how many of these are right, (R, L).
        sure: the sum of their confidence, (R, L).
    """
    place = _bins(count) + BINS * np.arange(len(count))[:, None]
    gaps = np.bincount(place.ravel(), weights=(hits - sure).ravel(), minlength=BINS * len(count))
    return np.asarray(np.abs(gaps).reshape(-1, BINS).sum(axis=1) / count.sum(axis=1))


def coverage(count: Floats, hits: Floats, sure: Floats) -> Floats:
    """Return the greatest share of decisions, the surest first, with an error of `RISK`, (R,).

    There is one for each of R bootstrap resamples. It is selective classification (El-Yaniv and
    Wiener 2010) with a threshold that is chosen on the same decisions; equally sure ones are taken
    together.

    Args:
        count: number of decisions at each of L levels of confidence, descending, (R, L).
        hits: how many of these are right, (R, L).
        sure: not used.
    """
    acted, correct = count.cumsum(axis=1), hits.cumsum(axis=1)
    within = acted - correct <= RISK * acted + 1e-9
    return np.asarray(np.where(within, acted, 0.0).max(axis=1) / acted[:, -1])


def estimate(judged: Judged, figure: Figure, episodes: int) -> Estimate:
    """Return a figure of calibration, such as `coverage`, with its bootstrap interval.

    `judged` has how sure and how right decisions are. `figure` is `decisions`, `calibration_error`
    or `coverage`; `episodes` is the number of all episodes. A figure other than the number of
    decisions is unknown with fewer than `LEAST` of these or from fewer than `LEAST_EPISODES`
    episodes.
    """
    return estimates(judged, [figure], episodes)[0]


def estimates(
    judged: Judged,
    figures: Sequence[Figure],
    episodes: int,
    older: bool = False,
    clusters: Ints | None = None,
) -> list[Estimate]:
    """Return several figures of calibration, with intervals from the same bootstrap resamples.

    `judged` has how sure and how right decisions are. `figures` are among `decisions`,
    `calibration_error` and `coverage`; `episodes` is the number of all episodes. With `older` they
    are computed as in the oldest runs (version 1 of `harness.core.versions.FIGURES`): any number of
    episodes is enough, and a figure whose resamples are all alike has an interval of no width.
    `clusters`, (E,), are resampled in place of episodes, if these have some.
    """
    known_figures = [figure for figure in figures if _is_known(figure, judged, older)]
    values = []
    for sums in _sums(judged, episodes, clusters) if known_figures else ():
        values.append([figure(*sums) for figure in known_figures])
    results = iter(
        _estimate(parts, judged, episodes, older, clusters) for parts in zip(*values, strict=True)
    )
    return [next(results) if figure in known_figures else _unknown(episodes) for figure in figures]


def difference(
    a: Judged, b: Judged, figure: Figure, episodes: int, clusters: Ints | None = None
) -> tuple[float, float, Estimate]:
    """Return a figure of calibration, such as `coverage`, of runs A and B, and B - A.

    The difference has an interval. `a` and `b` have how sure and how right the runs' decisions are.
    They are paired by episode: episodes in which either has no decision are left out. All are NaN
    if one is left with fewer than `LEAST` decisions or `LEAST_EPISODES` episodes. `episodes` is the
    number of all episodes, (E,) `clusters` are resampled in their place if they have some.
    """
    both = np.intersect1d(a.episode, b.episode)
    a, b = (_of(side, np.isin(side.episode, both)) for side in (a, b))
    if not (_is_known(figure, a) and _is_known(figure, b)):
        return math.nan, math.nan, _unknown(episodes)
    of_a = np.concatenate([figure(*sums) for sums in _sums(a, episodes, clusters)])
    of_b = np.concatenate([figure(*sums) for sums in _sums(b, episodes, clusters)])
    change = _estimate([of_b - of_a], a, episodes, clusters=clusters)
    return float(of_a[0]), float(of_b[0]), change


def _of(judged: Judged, which: Bools) -> Judged:
    return Judged(judged.sure[which], judged.right[which], judged.episode[which])


def _unknown(episodes: int) -> Estimate:
    return Estimate(math.nan, math.nan, math.nan, 0, episodes)


def _is_known(figure: Figure, judged: Judged, older: bool = False) -> bool:
    if figure is decisions:
        return len(judged.sure) > 0
    least_episodes = 1 if older else LEAST_EPISODES
    return len(judged.sure) >= LEAST and len(np.unique(judged.episode)) >= least_episodes


def _estimate(
    values: Sequence[Floats],
    judged: Judged,
    episodes: int,
    older: bool = False,
    clusters: Ints | None = None,
) -> Estimate:
    """Return a figure, the first of its values, with the interval of the others, its resamples.

    Where all are alike, what is not seen in n episodes is in at most 3 / n of others (95 %: Hanley
    and Lippman-Hand 1983). There is no interval of too few clusters.
    """
    n = len(np.unique(judged.episode))
    value, *others = np.concatenate(values).tolist()
    if too_few(clusters):
        return Estimate(value, math.nan, math.nan, n, episodes - n)
    low, high = value + np.percentile(others, (2.5, 97.5)) - np.mean(others)
    if high - low < SAME and not older:
        units = n if clusters is None else len(np.unique(clusters[judged.episode]))
        low, high = value - 3 / units, value + 3 / units
    return Estimate(value, float(low), float(high), n, episodes - n)


def _sums(
    judged: Judged, episodes: int, clusters: Ints | None
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield what a `Figure` is of, in parts of some resamples;
    the first is of the decisions as they are.
    """
    order = np.argsort(-judged.sure, kind="stable")
    sure, hits, episode = judged.sure[order], judged.right[order], judged.episode[order]
    starts = np.flatnonzero(np.diff(sure, prepend=np.inf))
    weights = resampled(generator("reliability", episodes), episodes, RESAMPLES, clusters)
    # resamples that have any decision
    weights = weights[weights[:, np.unique(episode)].any(axis=1)]
    at_once = max(1, AT_ONCE // len(sure))
    parts = np.split(weights.astype(float), range(at_once, len(weights), at_once))

    def by_level(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values, starts, axis=1))

    for part in parts:
        count = part[:, episode]
        yield by_level(count), by_level(count * hits), by_level(count * sure)


def _bins(count: Floats | Ints) -> Ints:
    """Return the bin of each level (R, L):
    the one of equal mass that the middle of the level is in.
    """
    upto = count.cumsum(axis=1)
    place = BINS * (upto - count / 2) / upto[:, -1:]
    return np.asarray(np.minimum(place.astype(np.int64), BINS - 1))
