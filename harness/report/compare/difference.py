"""What changed from one run to another: metrics, episodes, answers and settings."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import printable
from harness.core.multiplicity import holm, p_of_bootstrap, p_value
from harness.core.statistics import LEVEL, Estimate, known_mean
from harness.prompts.difference import PromptChange, change, of_swarm
from harness.report.compare.pair import Pair, Side
from harness.runs import percentiles, reliability
from harness.runs.leading import lead_of
from harness.runs.metrics import (
    ADJUSTED,
    METRICS,
    ONE_OPTIMAL,
    SUCCESS,
    difference,
    entry,
    known_in,
)
from harness.runs.records import Answer
from harness.runs.sources import prompt_of
from harness.runs.success import Success

# in the order of the list: what B gave away comes first, then what A did
LOST_BY = ("B", "A", None)


@dataclass(frozen=True)
class DecisionFlip:
    """A decision point at which the runs act otherwise."""

    scene: str  # its id
    episode: int  # its episode's number
    seeds: tuple[int, ...]  # in which they do
    a: str  # action of A
    b: str  # action of B
    # the run whose action alone gave success away; None where neither, both or unknown
    lost_by: str | None


@dataclass(frozen=True)
class Difference:
    """One metric in one condition, in its own unit (shares from 0 to 1)."""

    metric: str  # its name
    # mean of A over the episodes and seeds in which both know it; of a latency percentile, itself
    a: float
    b: float  # mean of B over the same
    # B - A, paired by episode and seed, with a 95 % interval over episodes; of a percentile a
    # bootstrap's
    change: Estimate
    p_value: float | None = None  # of no difference, by that interval; None where there is none
    # by Holm's method (Holm 1979) for the primary metrics in all conditions; None where exploratory
    p_corrected: float | None = None

    @property
    def primary(self) -> bool:
        """Whether the metric is one of those that answer for the comparison."""
        return entry(self.metric).primary


@dataclass(frozen=True)
class Flip:
    """An episode that succeeds in one run and not in the other."""

    episode: int  # its number
    seeds: tuple[int, ...]  # in which it does
    a: str  # how it ends in A: `success`, or how it fails
    b: str  # how it ends in B


@dataclass(frozen=True)
class InCondition:
    """What changed in one condition."""

    condition: str  # its name
    differences: tuple[Difference, ...]  # metrics that both runs know
    gained: tuple[Flip, ...]  # episodes from failure to success
    lost: tuple[Flip, ...]  # episodes from success to failure
    decisions: int  # how many both runs have
    flips: tuple[DecisionFlip, ...]  # those whose action is another; what B's gave away first


@dataclass(frozen=True)
class AnswersFlipped:
    """Answers to the same requests that were read with another verdict."""

    role: str  # of who answered: `ego`, `helper` or `merge`
    a: str  # verdict in A: `strict`, `recovered` or `failed`
    b: str  # verdict in B
    requests: tuple[str, ...]  # their ids; first where B gave success away, then where A did


@dataclass(frozen=True)
class AnswerChanged:
    """Two answers to the same question that say, or were read as, something else."""

    request: str  # its id
    role: str  # of who answered, as in `AnswersFlipped`
    a: str  # text of A's answer
    b: str  # text of B's
    verdicts: tuple[str, str]  # how A's and B's were read


@dataclass(frozen=True)
class AnswersHeld:
    """The answers of both runs to the same questions, held against each other.

    The same question is the same messages and the same picture. Under another prompt no question is
    the same, and a fusion call is another question as soon as one message in it is another.
    """

    same: int  # how many questions were the same
    other: int  # how many were not, so that their answers are not compared
    changed: tuple[AnswerChanged, ...]  # in the order of `AnswersFlipped.requests`

    @property
    def verdicts(self) -> int:
        """How many answers to the same question were read with another verdict."""
        return sum(before != after for before, after in (each.verdicts for each in self.changed))


@dataclass(frozen=True)
class Comparison:
    """B against A."""

    pair: Pair  # the two runs
    # that differ: name, A's value, B's, or None
    settings: tuple[tuple[str, str | None, str | None], ...]
    conditions: tuple[InCondition, ...]  # what changed in each
    answers: tuple[AnswersFlipped, ...]  # which answers changed their verdict
    answers_in_both: dict[str, int]  # answers by role that both runs have
    held: AnswersHeld  # which answers to the same questions changed, in their text too
    # what differs; None where nothing; a sentence why it is not known
    prompts: PromptChange | str | None


def compare(pair: Pair) -> Comparison:
    """Hold B against A."""
    a, b = ({answer.id: answer for answer in side.run.answers} for side in (pair.a, pair.b))
    both = [request for request in a if request in b]
    conditions = [_in_condition(pair, name) for name in pair.conditions]
    lost = {
        f.scene: LOST_BY.index(f.lost_by) for c in reversed(conditions) for f in reversed(c.flips)
    }
    both.sort(key=lambda request: lost.get(a[request].scene, len(LOST_BY)))
    flipped: dict[tuple[str, str, str], list[str]] = {}
    for request in both:
        before, after = a[request].verdict, b[request].verdict
        if before != after:
            flipped.setdefault((a[request].role, before, after), []).append(request)
    return Comparison(
        pair=pair,
        settings=tuple(_settings(pair)),
        conditions=_corrected(conditions),
        answers=tuple(AnswersFlipped(*how, tuple(ids)) for how, ids in sorted(flipped.items())),
        answers_in_both=dict(Counter(a[request].role for request in both)),
        held=_held([(a[request], b[request]) for request in both]),
        prompts=_prompts(pair),
    )


def _held(answers: Sequence[tuple[Answer, Answer]]) -> AnswersHeld:
    """Hold answers of both runs against each other where they answer the same question."""
    same = [(a, b) for a, b in answers if _question(a) == _question(b)]
    changed = tuple(
        AnswerChanged(a.id, a.role, a.raw, b.raw, (a.verdict, b.verdict))
        for a, b in same
        if (a.raw, a.verdict) != (b.raw, b.verdict)
    )
    return AnswersHeld(len(same), len(answers) - len(same), changed)


def _question(answer: Answer) -> tuple[str, str | None]:
    return answer.prompt_sha256, answer.image_sha256 or None


def _prompts(pair: Pair) -> PromptChange | str | None:
    """Return what differs between the egos' prompts, and between the first helpers'."""
    a, b = (
        [side.run.manifest.agent(place)["prompt"] for place in (0, 1)] for side in (pair.a, pair.b)
    )
    if [prompt["sha256"] for prompt in a] == [prompt["sha256"] for prompt in b]:
        return None
    here = []
    sides = (("A", pair.a, a), ("B", pair.b, b))
    for name, side, prompt in ((name, side, each) for name, side, of in sides for each in of):
        version = prompt_of(side.run, prompt)
        if version is None:
            return (
                f"what differs between the prompts is not known: {name}'s "
                f"{printable(prompt['version'], 40)} "
                f"with sha256 {printable(prompt['sha256'], 13)} is not here"
            )
        here.append(version)
    return change(of_swarm(*here[:2]), of_swarm(*here[2:]))


def _corrected(conditions: Sequence[InCondition]) -> tuple[InCondition, ...]:
    """Correct the p-values of the primary metrics,
    as they count among each other in all conditions.
    """
    p_values = [
        p for c in conditions for d in c.differences if d.primary and (p := d.p_value) is not None
    ]
    corrected = iter(holm(p_values))

    def with_p(d: Difference) -> Difference:
        return replace(d, p_corrected=next(corrected)) if d.primary and d.p_value is not None else d

    return tuple(replace(c, differences=tuple(map(with_p, c.differences))) for c in conditions)


def _settings(pair: Pair) -> Iterator[tuple[str, str | None, str | None]]:
    a, b = pair.a.settings, pair.b.settings
    left_out = tuple(
        f"condition.{name}."
        for side in (pair.a, pair.b)
        for name in side.run.conditions
        if name not in pair.conditions
    )
    for name in {**a, **b}:
        # A description changes nothing, and the sample behind a time is no setting.
        if a.get(name) != b.get(name) and not name.startswith(
            ("model.description", "latency.sample.", *left_out)
        ):
            yield name, a.get(name), b.get(name)


def _in_condition(pair: Pair, condition: str) -> InCondition:
    shared = {name: pair.values(pair.a, name, condition) for name in pair.a.values}
    differences = [_difference(pair, name, condition) for name in known_in(shared)]
    names = {metric.percentile: metric.name for metric in METRICS.values()}
    before, after = (pair.latencies(side, condition) for side in (pair.a, pair.b))
    differences += [
        Difference(
            names[percent], a, b, change, p_of_bootstrap(change.value, change.low, change.high)
        )
        for percent, a, b, change in percentiles.differences(before, after, len(pair.episodes))
    ]
    judged_a, judged_b = (pair.judged(side, condition) for side in (pair.a, pair.b))
    for metric in METRICS.values():
        if metric.name == ONE_OPTIMAL:  # it says what others are of, and is no figure of a policy
            first, second = float(len(judged_a.sure)), float(len(judged_b.sure))
            n = len(pair.episodes) if first or second else 0
            count = Estimate(second - first, math.nan, math.nan, n, 0)
            differences.append(Difference(metric.name, first, second, count, None))
        elif metric.pooled:
            first, second, change = reliability.difference(
                judged_a, judged_b, metric.pooled, len(pair.episodes)
            )
            p = p_of_bootstrap(change.value, change.low, change.high)
            differences.append(Difference(metric.name, first, second, change, p))
    a, b = (pair.values(side, SUCCESS, condition) for side in (pair.a, pair.b))
    differences += _adjusted(pair, condition, a.T, b.T)
    decisions, flipped = _decision_flips(pair, condition)
    return InCondition(
        condition=condition,
        differences=tuple(d for d in differences if d.change.n),
        gained=tuple(_flips(pair, condition, (a == 0) & (b == 1))),
        lost=tuple(_flips(pair, condition, (a == 1) & (b == 0))),
        decisions=decisions,
        flips=flipped,
    )


def _difference(pair: Pair, metric: str, condition: str) -> Difference:
    def values(name: str) -> tuple[Floats, Floats]:
        a, b = (pair.values(side, name, condition) for side in (pair.a, pair.b))
        unknown = np.isnan(a) | np.isnan(b)
        return np.where(unknown, np.nan, a), np.where(unknown, np.nan, b)

    halves = {name: values(name) for name in entry(metric).halves or (metric,)}
    before, after = (
        float(np.mean([known_mean(known_mean(half[side], 1), 0) for half in halves.values()]))
        for side in (0, 1)
    )

    def change(level: float) -> Estimate:
        return difference(metric, [(b, a) for a, b in halves.values()], level)

    return Difference(metric, before, after, change(LEVEL), p_value(change))


def _adjusted(pair: Pair, condition: str, a: Floats, b: Floats) -> Iterator[Difference]:
    """Yield the differences of success, (S, E) each, corrected by the layouts' difficulty."""
    pool = pair.pool
    if pool is None:
        return
    ends = [pair.a.ends[condition, pair.seeds[0], episode] for episode in pair.episodes]
    success = Success.of(ends, lead_of(pair.a.run, pair.b.run))
    for by in success.ways:

        def change(level: float, by: Success = by) -> Estimate:
            return pool.difference(by, b, a, level) or by.difference(b, a, level)

        if corrected := pool.difference(by, b, a):
            before, after = (pool.estimate(by, side) or by.estimate(side) for side in (a, b))
            name = ADJUSTED[by.metric]
            yield Difference(name, before.value, after.value, corrected, p_value(change))


def _flips(pair: Pair, condition: str, which: Bools) -> Iterator[Flip]:
    """Yield those (E, S) that flip, one an episode and way of ending."""
    for episode, row in zip(pair.episodes, which, strict=True):
        seeds: dict[tuple[str, str], list[int]] = {}
        for seed in np.array(pair.seeds)[row].tolist():
            a, b = (side.ends[condition, seed, episode] for side in (pair.a, pair.b))
            how = ("success" if a.success else a.failure, "success" if b.success else b.failure)
            seeds.setdefault(how, []).append(seed)
        yield from (Flip(episode, tuple(in_seeds), *how) for how, in_seeds in sorted(seeds.items()))


def _decision_flips(pair: Pair, condition: str) -> tuple[int, tuple[DecisionFlip, ...]]:
    """Count the decisions of both runs in a condition;
    list the flips by `LOST_BY`, then by most seeds.
    """
    names = sorted({*pair.a.run.decisions.scenes, *pair.b.run.decisions.scenes})
    (keys_a, rows_a), (keys_b, rows_b) = (
        _keys(pair, side, condition, names) for side in (pair.a, pair.b)
    )
    _, of_a, of_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
    rows_a, rows_b = rows_a[of_a], rows_b[of_b]
    a, b = pair.a.run.decisions, pair.b.run.decisions
    acted_a, acted_b = (
        np.array(side.run.actions)[side.run.decisions.codes("action", side.run.actions)[rows]]
        for side, rows in ((pair.a, rows_a), (pair.b, rows_b))
    )
    lost_a, lost_b = a.flags("regret")[rows_a], b.flags("regret")[rows_b]
    lost_by = np.where(lost_a == lost_b, 2, np.where(lost_b, 0, 1))
    scene, episode = a.codes("scene", names)[rows_a], a.whole("episode")[rows_a]
    seed = a.whole("seed")[rows_a]
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
    """Return a number for each decision in a condition, the same in both runs,
    and the decision's row.
    """
    run = side.run
    d = run.decisions
    rows = np.flatnonzero(d.codes("condition", run.conditions) == run.conditions.index(condition))
    rows = rows[np.isin(d.whole("episode")[rows], pair.episodes)]
    scene, episode, seed = (
        d.codes("scene", names)[rows],
        d.whole("episode")[rows],
        d.whole("seed")[rows],
    )
    place = np.searchsorted(pair.episodes, episode) * len(pair.seeds) + np.searchsorted(
        pair.seeds, seed
    )
    return scene * (len(pair.episodes) * len(pair.seeds)) + place, rows
