"""Repeats: the same evaluation several times, with other draws of its model's answers.

A repeat is a whole run with a sampling seed of its own; channel and layouts are the same. What
differs between repeats is the model's chance alone. All intervals are over episodes.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from markupsafe import Markup

from harness.backends import registry
from harness.coordination.trigger import entropy_nats
from harness.core import noise
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import Unit, amount, interval_of
from harness.core.progress import Progress
from harness.core.statistics import (
    Estimate,
    episode_interval,
    joined_clusters,
    known_mean,
    rate_interval,
    resampled,
    too_few,
    units_of,
)
from harness.core.versions import versions
from harness.evaluate.run import read_or_evaluate
from harness.evaluate.spec import Spec
from harness.report.compare.page import beside
from harness.report.document import Table
from harness.report.drawing.colours import conditions
from harness.report.findings import Kind, of_runs
from harness.runs.alike import refuse_two_of_a_name
from harness.runs.estimates import in_range
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS
from harness.runs.metric_names import ALL
from harness.runs.metric_values import by_episode
from harness.runs.metrics import METRICS
from harness.runs.records import Score
from harness.studies.figures.described import Draws, Rows
from harness.studies.study import DRAWN, Study

RESAMPLES = 4000
FLIPS, STABLE, BETWEEN = "flip_rate", "stable_rate", "between_episodes_share"
STATED, SAMPLED, DOUBT = "stated_entropy_nats", "sampled_entropy_nats", "stated_minus_sampled_nats"


def each(spec: Spec, repeats: int) -> dict[str, Spec]:
    """Return the evaluations of several repeats by folder name, each with the next sampling seed.

    A repeat is a run that differs from others only in the random sampling of the model's answers,
    which the sampling seed determines. `spec` is the first of them.
    """
    first = spec.settings.sampling_seed
    return {f"repeat-{n + 1}": spec.changed(sampling_seed=first + n) for n in range(repeats)}


def run_repeats(
    spec: Spec,
    repeats: int,
    out: Path,
    progress: Progress,
    cache_file: Path | None,
) -> "Repeats":
    """Evaluate every repeat in a folder of its own under `out`, and return their runs.

    A repeat differs from others only in the random sampling of the model's answers: `spec` is the
    first of `repeats`. Finished ones are kept. `progress` is called with the number of items just
    done in a run. `cache_file` keeps completions between runs; None for no cache.

    Raises:
        UserError: the folder holds something else, or a model is not available.
    """
    opens = cache(registry.open_backend)
    runs = [
        read_or_evaluate(of, out / name, progress, cache_file, opens)
        for name, of in each(spec, repeats).items()
    ]
    return Repeats(out, tuple(runs))


class Wavering(NamedTuple):
    """Hold a decision point at which repeats, runs that differ by chance alone, act differently.

    A decision point is a situation in which the ego must act.
    """

    scene: str  # id of the decision point
    # name of the settings of radio, asking and fusion
    condition: str
    flips: float  # share of pairs of repeats that take different actions there, 0 to 1
    # how often each action was taken, by its name
    actions: dict[str, int]


@dataclass(frozen=True)
class Repeats:
    """Hold two or more runs that differ only in the random sampling of the model's answers.

    `path` is the folder in which the runs' folders lie.
    """

    path: Path  # the folder in which the runs' folders lie
    runs: tuple[Run, ...]  # two or more

    def __post_init__(self) -> None:
        if len({(run.conditions, run.grid) for run in self.runs}) > 1:
            raise UserError(
                f"{printable(self.path)}: its runs are not of the same episodes and conditions"
            )
        refuse_two_of_a_name(self.runs)

    @property
    def k(self) -> int:
        """Return how many runs there are that differ only in the sampling of answers."""
        return len(self.runs)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Return the names of the runs' conditions: settings of radio, asking and fusion."""
        return self.runs[0].conditions

    @cached_property
    def clusters(self) -> Ints | None:
        """Return the number of each episode's cluster, (E,): two are in one if any run says so."""
        return joined_clusters([run.cluster_names for run in self.runs])

    @cached_property
    def scores(self) -> tuple[Score, ...]:
        """Return all metrics of the repeats together, with intervals over episodes.

        A score has the estimate of one metric under one condition (settings of radio, asking and
        fusion).
        """
        scores = []
        for place, condition in enumerate(self.conditions):
            for metric, estimate in self._of_condition(place):
                scores.append(Score.of(condition, metric, estimate, "episodes"))
        for metric, estimate in self._doubts():
            scores.append(Score.of(ALL, metric, estimate, "episodes"))
        return tuple(scores)

    def estimate(self, condition: str, metric: str) -> Estimate:
        """Return a metric's estimate in a condition, with its interval over episodes.

        Both are names; the condition is a set of settings of radio, asking and fusion. It is NaN
        where it is unknown.
        """
        key = (condition, metric)
        return next(s.estimate for s in self.scores if (s.condition, s.metric) == key)

    def _of_condition(self, place: int) -> Iterator[tuple[str, Estimate]]:
        """Yield the figures of the condition at a place, each with its metric."""
        _, counts, places = self._actions
        clusters = self.clusters
        units = places if clusters is None else clusters[places]
        reached = counts[place].sum(axis=(-2, -1)) > 0
        for metric, share in ((FLIPS, flips), (STABLE, stable)):
            shares = known_mean(share(counts[place]), axis=-1)
            yield metric, rate_interval(shares[reached], units[reached])
        success = self._success[:, place]
        yield SUCCESS, rate_interval(success.mean(axis=(0, 1)), clusters)
        wins = success.sum(axis=0)
        for name, of_k in (("pass^", all_of), ("any@", any_of)):
            for j in range(2, self.k + 1):
                yield f"{name}{j}", rate_interval(of_k(wins, self.k, j).mean(axis=0), clusters)
        yield BETWEEN, between_share(success.mean(axis=1).T, clusters)

    @cached_property
    def _success(self) -> Floats:
        """Whether each episode succeeded, (k, C, S, E)."""
        successes = []
        for run in self.runs:
            values = by_episode([METRICS[SUCCESS]], run.grid, run.decisions, run.episodes)
            successes.append(values[SUCCESS])
        return np.array(successes)

    @cached_property
    def _actions(self) -> tuple[list[str], Ints, Ints]:
        """Decision points (D,), how many repeats took each action there, (C, D, S, A),
        and their episodes.
        """
        labels = {scene for run in self.runs for scene in run.decisions.labels("scene") if scene}
        scenes, run = sorted(labels), self.runs[0]
        conditions, seeds, _ = run.grid.shape
        counts = np.zeros((conditions, len(scenes), seeds, len(run.actions)), dtype=np.int64)
        episodes = np.zeros(len(scenes), dtype=np.int64)
        for run in self.runs:
            scene = run.decisions.codes("scene", scenes)
            action = run.decisions.codes("action", run.actions)
            places = run.grid.places(run.decisions)
            condition, seed, episode = np.unravel_index(places, run.grid.shape)
            np.add.at(counts, (condition, scene, seed, action), 1)
            episodes[scene] = episode
        return scenes, counts, episodes

    def wavering(self, most: int) -> list[Wavering]:
        """Return up to `most` decision points at which repeats act differently, most divided first.

        A repeat is a run that differs from others by chance alone; a decision point is a situation
        in which the ego decides.
        """
        scenes, counts, _ = self._actions
        shares = np.nan_to_num(known_mean(flips(counts), axis=-1))
        n = counts.sum(axis=-1)
        pairs = (n**2 - (counts**2).sum(axis=-1)).sum(axis=-1)
        worst = np.argsort(-pairs, axis=None, kind="stable")[:most]
        points = []
        for c, d in zip(*np.unravel_index(worst, shares.shape), strict=True):
            totals = counts[c, d].sum(axis=0).tolist()
            actions = {a: n for a, n in zip(self.runs[0].actions, totals, strict=True) if n}
            points.append(Wavering(scenes[d], self.conditions[c], float(shares[c, d]), actions))
        return [point for point in points if point.flips > 0]

    def copies(self) -> Iterator[str]:
        """Yield a sentence of warning for each group of repeats whose answers are identical texts.

        A repeat is a run that differs by sampling alone. Then chance changed nothing, or one run is
        a copy of the other.
        """
        alike: dict[frozenset[tuple[str, str]], list[str]] = {}
        for run in self.runs:
            texts = frozenset((answer.id, answer.raw) for answer in run.answers)
            alike.setdefault(texts, []).append(run.path.name)
        for texts, names in alike.items():
            if texts and len(names) > 1:
                yield (
                    f"{' and '.join(names)} have the same {amount(len(texts), 'answer')}, word for "
                    "word: chance changed nothing there, or one is a copy of the other."
                )

    def _doubts(self) -> Iterator[tuple[str, Estimate]]:
        """Yield the entropy that the ego's answers state,
        and that of the actions which they rank first.
        """
        intents: dict[str, list[tuple[float, ...]]] = {}  # by scene
        for run in self.runs:
            for answer in run.answers:
                if answer.role == "ego":
                    of_scene = intents.setdefault(answer.scene, [])
                    if answer.intent:
                        of_scene.append(answer.intent)
        entropies = np.full((len(intents), 2), math.nan)  # stated, and sampled
        for n, of_scene in enumerate(intents.values()):
            if len(of_scene) > 1:
                entropies[n] = _doubt(np.array(of_scene))
        stated_nats, sampled_nats = entropies.T
        numbers = np.array([int(scene.partition("-")[0]) for scene in intents])
        episodes = units_of(numbers, self.runs[0].grid.episodes, self.clusters)
        for name, values in ((STATED, stated_nats), (SAMPLED, sampled_nats)):
            yield name, in_range(name, episode_interval(values, episodes))
        yield DOUBT, episode_interval(stated_nats - sampled_nats, episodes)


def flips(counts: Ints) -> Floats:
    """Return how often chance changes a decision: the share of pairs of repeats that differ, (...).

    A repeat is a run that differs by sampling alone. `counts` (..., A) is the number of repeats
    that took each of A actions in a decision. NaN without any pair.
    """
    n = counts.sum(axis=-1)
    pairs, same = n * (n - 1), (counts * (counts - 1)).sum(axis=-1)
    return np.where(pairs > 0, 1 - same / np.maximum(pairs, 1), np.nan)


def stable(counts: Ints) -> Floats:
    """Return 1 where all repeats took the same action, else 0, (...); NaN for fewer than two.

    A repeat is a run that differs by sampling alone. `counts` (..., A) is the number of repeats
    that took each of A actions in a decision.
    """
    n = counts.sum(axis=-1)
    return np.where(n > 1, counts.max(axis=-1) == n, np.nan)


def all_of(wins: Floats, k: int, j: int) -> Floats:
    """Return pass^j: the probability that j repeats of an episode, drawn of its k, all succeed.

    A repeat differs by chance alone, and draws are without replacement. `wins` is the number of
    successes among the k repeats of an episode, `(...)`; the result has its shape.
    """
    return np.asarray(_choose(wins, j) / math.comb(k, j))


def any_of(wins: Floats, k: int, j: int) -> Floats:
    """Return any@j: the probability that one or more of j repeats of an episode succeed.

    A repeat differs by chance alone; the j are drawn of k without replacement. It is the unbiased
    estimate of pass@k (Chen et al. 2021). `wins` is the number of successes among the k repeats of
    an episode, `(...)`; the result has its shape.
    """
    return 1 - all_of(k - wins, k, j)


def _choose(n: Floats, j: int) -> Floats:
    return np.asarray(np.vectorize(math.comb, otypes=[float])(n.astype(int), j))


def between_share(values: Floats, clusters: Ints | None = None) -> Estimate:
    """Return the share of the variance of values (E, k) that lies between episodes.

    There are E episodes with k repeats each. It is the intraclass correlation ICC(1) of Shrout and
    Fleiss (1979): below 0 where k repeats of an episode differ more than episodes do, NaN where
    nothing differs. The interval is a bootstrap over episodes, or over their `clusters`, (E,); of
    too few clusters there is none.
    """
    n, k = values.shape
    unknown = Estimate(math.nan, math.nan, math.nan, n, 0)
    if n < 2:
        return unknown
    means, within = values.mean(axis=1), values.var(axis=1) * k
    weights = resampled(noise.generator("repeats", "between"), n, RESAMPLES, clusters)
    between = k * np.maximum(weights @ means**2 - (weights @ means) ** 2 / n, 0) / (n - 1)
    inside = weights @ within / (n * (k - 1))
    total = between + (k - 1) * inside
    share = np.where(total > 1e-12, (between - inside) / np.maximum(total, 1e-12), np.nan)
    share[np.abs(share) < 1e-9] = 0.0  # else rounding shows a share below 0 where it is 0
    if np.isnan(share[0]):
        return unknown
    low, high = math.nan, math.nan
    if not too_few(clusters):
        low, high = np.nanpercentile(share[1:], (2.5, 97.5))
    return Estimate(float(share[0]), float(low), float(high), n, 0)


def _doubt(p: Floats) -> tuple[float, float]:
    """Return the mean entropy of intents (n, A), and the entropy of their likeliest actions,
    by Miller and Madow (1955), both in nats.

    The entropy of a few draws is too small on average;
    they add half of one less than the number of different actions that were drawn, over n.
    """
    n = len(p)
    shares = np.bincount(p.argmax(axis=-1), minlength=p.shape[1]) / n
    correction = (np.count_nonzero(shares) - 1) / (2 * n)
    return float(entropy_nats(p).mean()), float(entropy_nats(shares)) + correction


MARKER, FIGURES, PAGE = "repeats.json", "repeats.csv", "index.html"
# what stands in the folder before its marker: pictures, tables and the page
WRITTEN = (*(f"repeats.{kind}" for kind in ("csv", "jsonl", *DRAWN)), PAGE)
MOST_POINTS = 12  # of those at which repeats disagree
MOST_DRAWN = 5  # of j of pass^j and any@j, besides the last
NATS = Unit("nats", 2)


def repeats_study(repeats: Repeats) -> Study:
    """Return the study of repeats: its tables, figures, sentences and manifest.

    Repeats are runs that differ only in the random sampling of the model's answers.
    """
    import pandas as pd

    first, source, k = repeats.runs[0].manifest, repeats.runs[0].source, repeats.k
    variant, place = msgspec.to_builtins(first.variant), beside(repeats.path / PAGE)
    rows = [{**variant, **msgspec.to_builtins(score)} for score in repeats.scores]
    links = []
    for run in repeats.runs:
        if address := place(run):
            link = Markup('<p><a href="{}">Report of {}</a></p>').format(address, run.path.name)
            links.append(link)
    warnings = of_runs({run.path.name: run for run in repeats.runs}, Kind.VOID, Kind.CAVEAT)
    return Study(
        "repeats",
        f"{k} repeats of {first.variant} on {source}",
        headline(repeats),
        [
            f"{k} repeats × {amount(len(first.seeds), 'channel seed')} of "
            f"{amount(len(repeats.runs[0].grid.episodes), 'episode')} at temperature "
            f"{first.settings.temperature:g}. Each repeat is a whole run with its own sampling "
            "seed, and with the same episodes and channel seeds, so they differ only in the "
            "random draws of the model's answers. 95 % intervals are over episodes. All figures "
            "are in repeats.csv."
        ],
        list(_tables(repeats)),
        {"repeats": pd.DataFrame(rows)},
        {
            "sources": [{"name": first.variant.model}],
            "runs": [run.path.name for run in repeats.runs],
            "temperature": first.settings.temperature,
            "sampling_seeds": [run.manifest.settings.sampling_seed for run in repeats.runs],
            "dataset": source,
            "conditions": list(repeats.conditions),
            "versions": versions(),
        },
        {
            "repeats": str(repeats.path),
            "runs": [str(run.path) for run in repeats.runs],
            "temperature": first.settings.temperature,
            "figures": rows,
        },
        caveats=[*repeats.copies(), *(finding.sentence for finding in warnings)],
        more=Markup("\n").join(links),
        figures=lambda draws: {"repeats": _figure(draws, repeats)},
    )


def _figure(draws: Draws[Any], repeats: Repeats) -> Any:
    """Draw how often decisions stay the same, and what is left of success over several repeats."""
    drawn = [j for j in range(2, repeats.k + 1) if j <= MOST_DRAWN or j == repeats.k]
    shares = {"decisions flip": FLIPS, "same in all": STABLE, "variance between": BETWEEN}
    successes = {f"any@{j}": f"any@{j}" for j in reversed(drawn)}
    successes["succeed"] = SUCCESS
    successes |= {f"pass^{j}": f"pass^{j}" for j in drawn}
    panels = []
    for quantity, metrics in (("share, %", shares), ("episodes, %", successes)):
        estimates = {}
        for name in repeats.conditions:
            estimates[name] = [repeats.estimate(name, metric) for metric in metrics.values()]
        panels.append(Rows(quantity, list(metrics), estimates))
    return draws.intervals(panels, conditions(repeats.conditions))


def _tables(repeats: Repeats) -> Iterator[Table]:
    k, episodes = repeats.k, len(repeats.runs[0].grid.episodes)

    def cells(condition: str, *metrics: str) -> list[str]:
        return [interval_of(repeats.estimate(condition, metric)) for metric in metrics]

    rows = list[Sequence[str]]()
    for name in repeats.conditions:
        n = str(repeats.estimate(name, FLIPS).n)
        rows.append((name, *cells(name, FLIPS, STABLE), n, *cells(name, BETWEEN)))
    yield Table(
        "Decisions",
        ("condition", "decisions flip, %", "same in all, %", "n", "variance between %"),
        rows,
        "A decision flips if two repeats that both reached a decision point chose different "
        "actions there. The first column is the share of such pairs; the second is the share of "
        "the n decision points at which all repeats that reached them chose the same action. "
        "Points that only one repeat reached count in neither. Variance between episodes is the "
        "intraclass correlation of success, ICC(1): 100 % if repeats change nothing, about 0 if "
        "knowing the episode does not help to predict its repeats, a dash if all outcomes are "
        f"the same; n is {episodes} episodes.",
        terminal=range(5),
    )
    passes = [f"pass^{j}" for j in range(2, k + 1)]
    anys = [f"any@{j}" for j in range(2, k + 1)]
    heads = ("condition", "episodes succeed, %", *passes, *anys)
    yield Table(
        "Episodes",
        heads,
        [(c, *cells(c, SUCCESS, *passes, *anys)) for c in repeats.conditions],
        f"Of j repeats drawn from the {k} without replacement, pass^j: all succeed, and any@j: "
        f"one or more succeeds; in percent of n = {episodes} episodes.",
        terminal=(0, 1, k, len(heads) - 1),
    )
    rows = []
    for metric in (STATED, SAMPLED, DOUBT):
        entropy = repeats.estimate(ALL, metric)
        name = metric.removesuffix("_nats").replace("_", " ")
        rows.append((name, nats(entropy), str(entropy.n)))
    yield Table(
        "Stated and sampled entropy",
        ("entropy of the ego's own answers", "nats", "decision points"),
        rows,
        "Stated: the mean entropy of the distributions in the answers. Sampled: the entropy, "
        "over repeats, of the most probable action, with the correction of Miller and Madow. "
        f"From {k} repeats it is a rough estimate, and too small on average. Points with fewer "
        "than two answers that could be read are left out.",
    )
    if points := repeats.wavering(MOST_POINTS):
        rows = []
        for point in points:
            actions = [f"{n} × {action}" for action, n in point.actions.items()]
            flips = f"{100 * point.flips:.0f}"
            rows.append((point.scene, point.condition, flips, ", ".join(actions)))
        yield Table(
            "Where most pairs of repeats disagree",
            ("decision point", "condition", "pairs that differ, %", "actions chosen"),
            rows,
            f"Over all repeats and channel seeds. harness report {repeats.runs[0].path.name}, "
            "typed in this folder, shows the prompts and answers.",
        )


def nats(e: Estimate) -> str:
    """Return an entropy in nats with its interval as text; a dash where it is unknown."""
    return interval_of(e, NATS)


def headline(repeats: Repeats) -> list[str]:
    """Return sentences on how far chance moves results: decisions, success and entropy.

    `repeats` are runs that differ only in the random sampling of the model's answers.
    """
    return [_flip_sentence(repeats), *_variance_sentence(repeats), *_entropy_sentence(repeats)]


def _flip_sentence(repeats: Repeats) -> str:
    with_flips = [c for c in repeats.conditions if not math.isnan(repeats.estimate(c, FLIPS).value)]
    m, k = repeats.runs[0].manifest, repeats.k
    c = max(with_flips or repeats.conditions, key=lambda c: repeats.estimate(c, FLIPS).value)
    flips, once = repeats.estimate(c, FLIPS), repeats.estimate(c, SUCCESS)
    everywhere, anywhere = repeats.estimate(c, f"pass^{k}"), repeats.estimate(c, f"any@{k}")
    return (
        f"Asked again at temperature {m.settings.temperature:g}, {m.variant} decides differently "
        f"in {interval_of(flips)} % of decisions under {c} (n = {flips.n} decision points). "
        f"{interval_of(once)} % of its episodes succeed, {interval_of(everywhere)} % in all {k} "
        f"repeats and {interval_of(anywhere)} % in at least one (n = {once.n} episodes)."
    )


def _variance_sentence(repeats: Repeats) -> Iterator[str]:
    shares = {c: repeats.estimate(c, BETWEEN) for c in repeats.conditions}
    shares = {c: share for c, share in shares.items() if not math.isnan(share.value)}
    if shares:
        c = min(shares, key=lambda c: shares[c].value)
        yield (
            f"Under {c}, {interval_of(shares[c])} % of the variance of success lies between "
            f"episodes (n = {shares[c].n}); the rest is chance between repeats of one episode."
        )


def _entropy_sentence(repeats: Repeats) -> Iterator[str]:
    of_answer, of_repeats = repeats.estimate(ALL, STATED), repeats.estimate(ALL, SAMPLED)
    more = repeats.estimate(ALL, DOUBT)
    if math.isnan(more.value):
        return
    verdict = "not clearly more or less than its repeats show"
    if more.low > 0:
        verdict = "more than its repeats show"
    elif more.high < 0:
        verdict = "less than its repeats show"
    yield (
        f"The ego's answers state {nats(of_answer)} nats of entropy, {verdict}: over repeats, the "
        f"most probable action has {nats(of_repeats)} nats (difference {nats(more)}; n = {more.n} "
        "decision points)."
    )
