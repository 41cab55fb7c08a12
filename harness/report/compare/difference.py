"""What changed from one run to another: metrics, episodes, answers and settings."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import printable
from harness.core.multiplicity import holm, p_of_bootstrap, p_value
from harness.core.statistics import LEVEL, Estimate, known_mean, too_few
from harness.prompts.difference import PromptChange, change, of_swarm
from harness.report.compare.pair import OPENED, Pair, Side
from harness.runs import percentiles, reliability
from harness.runs.estimates import difference
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS
from harness.runs.metric_names import ADJUSTED, ONE_OPTIMAL
from harness.runs.metric_values import known_in
from harness.runs.metrics import METRICS, entry
from harness.runs.records import Answer
from harness.runs.sources import prompt_of
from harness.runs.success import Success

# in the order of the list: what B gave away comes first, then what A did
LOST_BY = ("B", "A", None)


@dataclass(frozen=True)
class DecisionFlip:
    """Hold a scene in which runs A and B take different actions, with the seeds where they do.

    `scene` is the id of the scene, one decision point, and `episode` the number of its episode.
    `seeds` are those of the channel's random numbers, and `a` and `b` names of actions. `lost_by`
    is the run whose action alone made success impossible; None for neither, both or unknown.
    """

    scene: str  # the scene's id
    episode: int  # the number of the scene's episode
    seeds: tuple[int, ...]  # channel seeds with which they do
    a: str  # action that A takes
    b: str  # action that B takes
    # the run, `A` or `B`, whose action alone made success impossible; None where neither, both or
    # unknown
    lost_by: str | None


@dataclass(frozen=True)
class Difference:
    """Hold how one metric differs in one condition, in the metric's unit (shares 0 to 1).

    `a` and `b` are its means in runs A and B, `change` is B - A with its 95 % interval. The
    p-values are of no difference: `p_value` as computed, `p_corrected` corrected for multiple
    testing, which only primary metrics (those that a comparison is judged by) are; None where there
    is none. A condition is a named set of settings of the radio, of asking helpers and of fusing
    their messages.
    """

    metric: str  # the metric's name
    # mean of A over the episodes and seeds in which both know it; of a latency percentile, itself
    a: float
    b: float  # mean of B over the same
    # B - A, paired by episode and seed, with a 95 % interval over episodes; of a percentile a
    # bootstrap's
    change: Estimate
    p_value: float | None = None  # of no difference, by that interval; None where there is none
    # by Holm's method (Holm 1979) for the primary metrics in all conditions; None where exploratory
    p_corrected: float | None = None
    # whether `change` has no ends because its units, two or more, all changed by its value
    is_alike: bool = False

    @property
    def primary(self) -> bool:
        """Return whether comparisons are judged by this metric, with a corrected p-value."""
        return entry(self.metric).primary


@dataclass(frozen=True)
class Flip:
    """Hold an episode that succeeds in one run and fails in the other, and in which seeds.

    `episode` is its number, `seeds` are channel seeds. `a` and `b` are its outcomes in the two
    runs: `success`, or the kind of failure.
    """

    episode: int  # the episode's number
    seeds: tuple[int, ...]  # channel seeds with which it does
    a: str  # how it ends in A: `success`, or how it fails
    b: str  # how it ends in B


@dataclass(frozen=True)
class InCondition:
    """Hold what differs between runs A and B in one condition: metrics, episodes and decisions.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. `gained` are episodes that fail in A and succeed in B, `lost` the reverse; `decisions`
    counts those in both runs, and `flips` are those of them with another action.
    """

    condition: str  # the condition's name
    differences: tuple[Difference, ...]  # one for each metric that both runs know
    gained: tuple[Flip, ...]  # episodes that fail in A and succeed in B
    lost: tuple[Flip, ...]  # episodes that succeed in A and fail in B
    decisions: int  # how many decisions both runs have
    # decisions in which both take another action; first those by which B alone gave success away
    flips: tuple[DecisionFlip, ...]


@dataclass(frozen=True)
class AnswersFlipped:
    """Hold the ids of requests whose answers changed from parse verdict `a` to verdict `b`.

    A verdict is how run A's and run B's answer could be read: `strict` (as it is), `recovered`
    (after repairs) or `failed`. `role` is that of the answers: `ego`, `helper` or `merge` (the ego
    after it heard messages); `requests` are the ids.
    """

    role: str  # of who answered: `ego`, `helper` or `merge`
    a: str  # verdict in A: `strict`, `recovered` or `failed`
    b: str  # verdict in B
    # ids of the requests whose answers these are; first those where B gave success away, then where
    # A did
    requests: tuple[str, ...]


@dataclass(frozen=True)
class AnswerChanged:
    """Hold two answers to the same prompt and picture that differ in text or parse verdict.

    `request` is the request's id, `role` who was asked (`ego`, `helper`, or `merge`: the ego after
    it heard messages), and `a` and `b` are the texts of run A's and run B's answer. `verdicts` says
    how each was read: `strict`, `recovered` or `failed`.
    """

    request: str  # the request's id
    role: str  # of who answered: `ego`, `helper` or `merge`
    a: str  # text of A's answer
    b: str  # text of B's answer
    verdicts: tuple[str, str]  # how A's and B's were read: `strict`, `recovered` or `failed`


@dataclass(frozen=True)
class AnswersHeld:
    """Hold the comparison of both runs' answers to the same questions.

    A question is the same if its chat messages and picture are: `same` counts these, `other` the
    rest. Under another prompt none is the same. `changed` has the pairs of answers that differ; of
    the rest, `other_leaning` counts those whose likeliest action or verdict does.
    """

    same: int  # how many questions were the same
    other: int  # how many were not, so that their texts are not compared
    other_leaning: int  # how many of these have another likeliest action, or another verdict
    # answers that differ; first where B gave success away, then where A did
    changed: tuple[AnswerChanged, ...]

    @property
    def verdicts(self) -> int:
        """Return how many answers to the same question are parsed with another outcome in B.

        The outcome is `strict`, `recovered` (after repairs) or `failed`.
        """
        return sum(len(set(answer.verdicts)) > 1 for answer in self.changed)


@dataclass(frozen=True)
class Comparison:
    """Hold everything that differs between run A and run B, as `compare` finds it.

    `pair` are the runs, and `conditions` has what differs in each condition, a named set of
    settings of the radio, of asking helpers and of fusing their messages. `settings` has the name
    of each that differs, with A's value and B's. `answers` has the answers that changed their parse
    verdict (how they could be read), of the `answers_in_both` by role, and `held` those to the same
    question that changed at all. `prompts` is what differs between the prompts: None for nothing, a
    sentence if it is not known.
    """

    pair: Pair  # the two runs
    # those that differ: name, A's value and B's, None where it has none
    settings: tuple[tuple[str, str | None, str | None], ...]
    conditions: tuple[InCondition, ...]  # what changed in each condition that both have
    answers: tuple[AnswersFlipped, ...]  # which answers changed their verdict
    answers_in_both: dict[str, int]  # answers by role that both runs have
    held: AnswersHeld  # which answers to the same questions changed, in their text too
    # what differs in prompts; None where nothing; a sentence why it is not known
    prompts: PromptChange | str | None


def compare(pair: Pair) -> Comparison:
    """Return all that differs from run A to run B: settings, prompts, metrics and episodes.

    Answers are compared, too. `pair` has both runs, on the same scenes. The result is what the
    command `harness compare` shows.
    """
    conditions = [_in_condition(pair, name) for name in pair.conditions]
    answers = _answers_of_both(pair, conditions)
    return Comparison(
        pair=pair,
        settings=tuple(_settings(pair)),
        conditions=_corrected(conditions),
        answers=_answers_flipped(answers),
        answers_in_both=dict(Counter(before.role for before, _ in answers)),
        held=_held(answers),
        prompts=_prompts(pair),
    )


def _answers_of_both(pair: Pair, conditions: Sequence[InCondition]) -> list[tuple[Answer, Answer]]:
    """Return the answers of both runs to each request that they share.

    First come those of scenes where B gave success away, then those where A did.
    """
    rank: dict[str, int] = {}  # by scene: of its first flip
    for condition in conditions:
        for flip in condition.flips:
            rank.setdefault(flip.scene, LOST_BY.index(flip.lost_by))
    after = {answer.id: answer for answer in pair.b.run.answers}
    answers = [(answer, after[answer.id]) for answer in pair.a.run.answers if answer.id in after]
    return sorted(answers, key=lambda both: rank.get(both[0].scene, len(LOST_BY)))


def _answers_flipped(answers: Sequence[tuple[Answer, Answer]]) -> tuple[AnswersFlipped, ...]:
    """Return the answers whose verdict changed, by role and both verdicts."""
    requests: dict[tuple[str, str, str], list[str]] = {}
    for a, b in answers:
        if a.verdict != b.verdict:
            requests.setdefault((a.role, a.verdict, b.verdict), []).append(a.id)
    return tuple(AnswersFlipped(*key, tuple(ids)) for key, ids in sorted(requests.items()))


def _held(answers: Sequence[tuple[Answer, Answer]]) -> AnswersHeld:
    """Hold answers of both runs against each other where they answer the same question."""
    same = [(a, b) for a, b in answers if _question(a) == _question(b)]
    others = [(a, b) for a, b in answers if _question(a) != _question(b)]
    changed = tuple(
        AnswerChanged(a.id, a.role, a.raw, b.raw, (a.verdict, b.verdict))
        for a, b in same
        if (a.raw, a.verdict) != (b.raw, b.verdict)
    )
    leaning = sum((a.likeliest, a.verdict) != (b.likeliest, b.verdict) for a, b in others)
    return AnswersHeld(len(same), len(others), leaning, changed)


def _question(answer: Answer) -> tuple[str, str | None]:
    return answer.prompt_sha256, answer.image_sha256 or None


def _prompts(pair: Pair) -> PromptChange | str | None:
    """Return what differs between the egos' prompts, and between the first helpers'."""
    stated_a, stated_b = pair.a.prompts, pair.b.prompts
    if [prompt["sha256"] for prompt in stated_a] == [prompt["sha256"] for prompt in stated_b]:
        return None
    swarms = []
    for name, side in (("A", pair.a), ("B", pair.b)):
        prompts = []
        for prompt_record in side.prompts:
            prompt = prompt_of(side.run, prompt_record)
            if prompt is None:
                return (
                    f"what differs between the prompts is not known: {name}'s "
                    f"{printable(prompt_record['version'], 40)} "
                    f"with sha256 {printable(prompt_record['sha256'], 13)} is not here"
                )
            prompts.append(prompt)
        swarms.append(of_swarm(*prompts))
    return change(*swarms)


def _corrected(conditions: Sequence[InCondition]) -> tuple[InCondition, ...]:
    """Correct the p-values of the primary metrics together, over all conditions."""
    p_values = []
    for condition in conditions:
        primary = [each for each in condition.differences if each.primary]
        p_values += [each.p_value for each in primary if each.p_value is not None]
    corrected = iter(holm(p_values))
    result = []
    for condition in conditions:
        differences = []
        for each in condition.differences:
            if each.primary and each.p_value is not None:
                each = replace(each, p_corrected=next(corrected))
            differences.append(each)
        result.append(replace(condition, differences=tuple(differences)))
    return tuple(result)


def _settings(pair: Pair) -> Iterator[tuple[str, str | None, str | None]]:
    """Yield each setting that differs, with its value in A and in B; None where it has none."""
    a, b = pair.a.settings, pair.b.settings
    # A description changes nothing, and the sample behind a time is no setting.
    prefixes = ["model.description", "latency.sample."]
    for side in (pair.a, pair.b):
        alone = [name for name in side.run.conditions if name not in pair.conditions]
        prefixes += [f"condition.{name}." for name in alone]
    opened = tuple(f"{kind}." for kind in OPENED)
    for name in {**a, **b}:
        in_one = name.startswith(opened) and (name not in a or name not in b)
        if a.get(name) != b.get(name) and not in_one and not name.startswith(tuple(prefixes)):
            yield name, a.get(name), b.get(name)


def _in_condition(pair: Pair, condition: str) -> InCondition:
    shared = {name: pair.values(pair.a, name, condition) for name in pair.a.values}
    differences = [_difference(pair, name, condition) for name in known_in(shared)]
    differences += _percentiles(pair, condition)
    differences += _pooled(pair, condition)
    a, b = pair.values(pair.a, SUCCESS, condition), pair.values(pair.b, SUCCESS, condition)
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


def _percentiles(pair: Pair, condition: str) -> Iterator[Difference]:
    """Yield the differences of the percentiles of latency."""
    names = {metric.percentile: metric.name for metric in METRICS.values()}
    before, after = pair.latencies(pair.a, condition), pair.latencies(pair.b, condition)
    differences = percentiles.differences(before, after, len(pair.episodes), pair.clusters)
    for percent, a, b, estimate in differences:
        p = p_of_bootstrap(estimate.value, estimate.low, estimate.high)
        is_alike = p is None and estimate.n > 1 and not too_few(pair.clusters)
        yield Difference(names[percent], a, b, estimate, p, is_alike=is_alike)


def _pooled(pair: Pair, condition: str) -> Iterator[Difference]:
    """Yield the differences of metrics that are of all decisions together, and their number."""
    episodes = len(pair.episodes)
    judged_a, judged_b = pair.judged(pair.a, condition), pair.judged(pair.b, condition)
    for metric in METRICS.values():
        if metric.name == ONE_OPTIMAL:  # it says what others are of, and is no figure of a policy
            a, b = float(len(judged_a.sure)), float(len(judged_b.sure))
            count = Estimate(b - a, math.nan, math.nan, episodes if a or b else 0, 0)
            yield Difference(metric.name, a, b, count, None)
        elif metric.pooled:
            a, b, estimate = reliability.difference(
                judged_a, judged_b, metric.pooled, episodes, pair.clusters
            )
            p = p_of_bootstrap(estimate.value, estimate.low, estimate.high)
            yield Difference(metric.name, a, b, estimate, p)


def _difference(pair: Pair, metric: str, condition: str) -> Difference:
    """Return the difference of a metric, over the episodes and seeds in which both know it.

    Of a mean of halves, each half is paired on its own.
    """
    halves = list[tuple[Floats, Floats]]()  # values of A and of B, (E, S)
    means_a, means_b = list[Floats](), list[Floats]()
    for name in entry(metric).halves or (metric,):
        a, b = pair.values(pair.a, name, condition), pair.values(pair.b, name, condition)
        unknown = np.isnan(a) | np.isnan(b)
        a, b = np.where(unknown, np.nan, a), np.where(unknown, np.nan, b)
        halves.append((a, b))
        means_a.append(known_mean(known_mean(a, 1), 0))
        means_b.append(known_mean(known_mean(b, 1), 0))

    def change(level: float) -> Estimate:
        return difference(metric, [(b, a) for a, b in halves], level, pair.clusters)

    before, after = float(np.mean(means_a)), float(np.mean(means_b))
    p = p_value(change)
    is_alike = p is None and _is_alike(pair, metric, halves)
    return Difference(metric, before, after, change(LEVEL), p, is_alike=is_alike)


def _is_alike(pair: Pair, metric: str, halves: Sequence[tuple[Floats, Floats]]) -> bool:
    """Return whether two or more units changed by one value, which Student's interval lacks."""
    if entry(metric).interval == "rate":
        return False  # whose interval adds units that differ: it lacks ends for too few units alone
    ((a, b),) = halves
    changes = known_mean(b - a, 1)
    units = np.arange(len(changes)) if pair.clusters is None else pair.clusters
    return len(np.unique(units[~np.isnan(changes)])) > 1


def _adjusted(pair: Pair, condition: str, a: Floats, b: Floats) -> Iterator[Difference]:
    """Yield the differences of success, (S, E) each, corrected by the layouts' difficulty."""
    pool = pair.pool
    if pool is None:
        return
    success = pair.success_rule(condition)
    for by in success.ways:

        def change(level: float, by: Success = by) -> Estimate:
            return pool.difference(by, b, a, level) or by.difference(b, a, level)

        if corrected := pool.difference(by, b, a):
            before = pool.estimate(by, a) or by.estimate(a)
            after = pool.estimate(by, b) or by.estimate(b)
            name = ADJUSTED[by.metric]
            yield Difference(name, before.value, after.value, corrected, p_value(change))


def _flips(pair: Pair, condition: str, which: Bools) -> Iterator[Flip]:
    """Yield those (E, S) that flip, one an episode and way of ending."""
    for episode, row in zip(pair.episodes, which, strict=True):
        seeds_of: dict[tuple[str, str], list[int]] = {}  # by the endings in A and B
        for seed in np.array(pair.seeds)[row].tolist():
            a, b = pair.a.ends[condition, seed, episode], pair.b.ends[condition, seed, episode]
            endings = ("success" if a.success else a.failure, "success" if b.success else b.failure)
            seeds_of.setdefault(endings, []).append(seed)
        for endings, seeds in sorted(seeds_of.items()):
            yield Flip(episode, tuple(seeds), *endings)


def _decision_flips(pair: Pair, condition: str) -> tuple[int, tuple[DecisionFlip, ...]]:
    """Count the decisions of both runs in a condition;
    list the flips by `LOST_BY`, then by most seeds.
    """
    names = sorted({*pair.a.run.decisions.scenes, *pair.b.run.decisions.scenes})
    keys_a, rows_a = _keys(pair, pair.a, condition, names)
    keys_b, rows_b = _keys(pair, pair.b, condition, names)
    _, of_a, of_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
    rows_a, rows_b = rows_a[of_a], rows_b[of_b]
    a, b = pair.a.run.decisions, pair.b.run.decisions
    action_a, action_b = _actions(pair.a.run, rows_a), _actions(pair.b.run, rows_b)
    lost_a, lost_b = a.flags("regret")[rows_a], b.flags("regret")[rows_b]
    lost_by = np.where(lost_a == lost_b, 2, np.where(lost_b, 0, 1))
    scene, episode = a.codes("scene", names)[rows_a], a.whole("episode")[rows_a]
    seed = a.whole("seed")[rows_a]
    # By places in `LOST_BY` and in `names`, actions of A and B, and episode.
    seeds_of: dict[tuple[int, int, str, str, int], list[int]] = {}
    for n in np.flatnonzero(action_a != action_b).tolist():
        key = int(lost_by[n]), int(scene[n]), str(action_a[n]), str(action_b[n]), int(episode[n])
        seeds_of.setdefault(key, []).append(int(seed[n]))

    def order(key: tuple[int, int, str, str, int]) -> tuple[Any, ...]:
        return key[0], -len(seeds_of[key]), key

    flips = []
    for key in sorted(seeds_of, key=order):
        by, place, before, after, number = key
        seeds = tuple(seeds_of[key])
        flips.append(DecisionFlip(names[place], number, seeds, before, after, LOST_BY[by]))
    return len(of_a), tuple(flips)


def _actions(run: Run, rows: Ints) -> NDArray[np.str_]:
    """Return the names of the actions of some rows of decisions, (n,)."""
    return np.array(run.actions)[run.decisions.codes("action", run.actions)[rows]]


def _keys(pair: Pair, side: Side, condition: str, names: Sequence[str]) -> tuple[Ints, Ints]:
    """Return a number for each decision in a condition, the same in both runs,
    and the decision's row.
    """
    run, decisions = side.run, side.run.decisions
    conditions = decisions.codes("condition", run.conditions)
    rows = np.flatnonzero(conditions == run.conditions.index(condition))
    rows = rows[np.isin(decisions.whole("episode")[rows], pair.episodes)]
    scene = decisions.codes("scene", names)[rows]
    episode = np.searchsorted(pair.episodes, decisions.whole("episode")[rows])
    seed = np.searchsorted(pair.seeds, decisions.whole("seed")[rows])
    seeds, episodes = len(pair.seeds), len(pair.episodes)
    return (scene * episodes + episode) * seeds + seed, rows
