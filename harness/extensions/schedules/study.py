"""`harness study schedule compare`: schedules on stored answers,
between asking nobody and the oracle.

All schedules decide the same episodes with the same draws, so what they differ in is whom they ask,
and when. A schedule's settings are its threshold and how many helpers it asks at most. Which
setting is best is chosen on tune layouts, where a run on such is given, and reported on others.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import NEVER, ORACLE, PAPER
from harness.core import noise
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import DASH, interval_of, some_of
from harness.core.progress import Progress
from harness.core.statistics import Estimate, resampled_estimate
from harness.core.versions import versions
from harness.extensions.schedules.choices import COSTS, Choices, choices, refuse_idle
from harness.extensions.schedules.learning import layouts
from harness.report.document import Table
from harness.report.drawing.colours import COLOURS, INK, MARKERS
from harness.runs.alike import different, setup
from harness.runs.headline import BALANCED
from harness.runs.success import Success
from harness.studies.figures.described import Draws, Line, Steps
from harness.studies.replayed_run import ReplayedRun, counted
from harness.studies.study import Study, corrected, p_cell, refuse_other
from harness.studies.sweep import point_of

if TYPE_CHECKING:
    import pandas as pd

RESAMPLES = 2000
# of decision points that ask nobody, at the thresholds that are tried
SHARES = np.arange(0.0, 1.0, 0.1)
ALWAYS, RANDOM = "always", "random"
# Those that stand first in tables and figures, in this order.
FIRST = (PAPER, NEVER, ALWAYS, "margin", "risk", "deadline", "coverage", RANDOM)


@dataclass(frozen=True)
class Candidate:
    """Describe one setting of a schedule: its threshold and how many helpers it asks at most.

    A schedule is a rule for whom the ego asks. It says what asking each helper is worth in a
    decision, in its own unit, such as nats of doubt; those worth more than the threshold are asked.
    """

    schedule: str  # its name
    # what asking must be worth more than, in the schedule's own unit; None for a schedule without
    threshold: float | None
    most: int  # most helpers asked in a decision

    def at(self, point: OperatingPoint) -> OperatingPoint:
        """Return a copy of an operating point that asks by this schedule, threshold and limit.

        An operating point is the settings of radio, asking and fusion; a schedule is the rule for
        whom to ask.
        """
        if self.schedule == PAPER and self.threshold is not None:
            changed = point.changed(schedule=PAPER, threshold=None, tau_nats=self.threshold)
        else:
            changed = point.changed(schedule=self.schedule, threshold=self.threshold)
        return changed.changed(max_helpers=self.most)

    def __str__(self) -> str:
        return f"{self.most}" if self.threshold is None else f"{self.most}, {self.threshold:g}"


@dataclass(frozen=True)
class Play:
    """Hold how episodes go, and what they cost, under one setting of a schedule.

    A schedule is a rule for whom the ego asks. There are S channel seeds, E episodes and C costs,
    in the order of `COSTS`: messages, air time (ms), latency (ms), decisions and energy (J).
    """

    candidate: Candidate  # the schedule and its setting
    success: Floats  # which episodes succeed, 1 or 0, (S, E)
    costs: Floats  # costs of each episode, in the order of `COSTS`, (S, E, C)
    success_rule: Success  # how success is averaged, such as balanced by danger

    @property
    def rate(self) -> float:
        """Return the mean success of all episodes, 0 to 1, averaged as `success_rule` says.

        That is plainly, or balanced over episodes with a danger and without.
        """
        return self.success_rule.mean(self.success)

    def of(self, cost: str) -> Floats:
        """Return one of the costs of each episode, (S, E), for S channel seeds and E episodes.

        `cost` is its name in `COSTS`, such as `messages` or `latency_ms`; it is summed over the
        episode's decisions.
        """
        return np.asarray(self.costs[..., COSTS.index(cost)])

    @property
    def messages(self) -> Floats:
        """Return the number of messages in each of E episodes under S channel seeds, (S, E)."""
        return self.of("messages")

    @property
    def means(self) -> dict[str, float]:
        """Return mean costs by name, such as `messages`, `airtime_ms`, `latency_ms` and `energy_j`.

        They are per episode, but latency is per decision.
        """
        of_episode = self.costs.sum(axis=(0, 1)) / self.success.size
        means = dict(zip(COSTS, of_episode.tolist(), strict=True))
        decisions = means.pop("decisions")
        return {**means, "latency_ms": means["latency_ms"] / decisions}


def plays(
    choices: Choices, point: OperatingPoint, candidates: Sequence[Candidate], success_rule: Success
) -> list[Play]:
    """Play settings of one schedule, which differ in threshold or limit; return their outcomes.

    A schedule is a rule for whom to ask. `choices` has what follows from asking each set of
    helpers, and `point` is the other settings of radio, asking and fusion; `success_rule` says how
    success is averaged over episodes. What asking is worth is computed once for all settings.
    """
    worths = choices.worths(candidates[0].at(point))
    rules = [choices.scheduled(candidate.at(point), worths) for candidate in candidates]
    pairs = zip(candidates, rules, strict=True)
    return [Play(candidate, *choices.played(rule), success_rule) for candidate, rule in pairs]


def candidates(choices: Choices, point: OperatingPoint, schedule: str) -> list[Candidate]:
    """Return the settings of a schedule to try: thresholds, each with every limit of helpers.

    A schedule is a rule for whom to ask, here given by its name; `choices` has what follows from
    asking each set of helpers, and `point` is the other settings of radio, asking and fusion. The
    thresholds are deciles of what asking is worth there, the schedule's own, and 0.
    """
    most = range(1, point.ask.max_helpers + 1)
    usual = point.changed(schedule=schedule, threshold=None)
    if schedule != PAPER and SCHEDULES[schedule].threshold is None:
        return [Candidate(schedule, None, m) for m in most]
    best = np.concatenate([np.fmax.reduce(worth, axis=-1) for worth in choices.worths(usual)])
    best = best[~np.isnan(best)]  # where somebody may be asked
    tenths = np.quantile(best, SHARES).tolist() if len(best) else []
    tried = {0.0, usual.ask.above, *(float(f"{value:.3g}") for value in tenths if value > 0)}
    return [Candidate(schedule, threshold, m) for threshold in sorted(tried) for m in most]


@dataclass(frozen=True)
class Chosen:
    """Compare a schedule, at its chosen setting, with the paper's and with the best possible one.

    A schedule is a rule for whom the ego asks. The paper's asks if the ego is in doubt, by the
    entropy of its answer; the oracle, which bounds all, knows how each episode ends. Success is a
    share of episodes, 0 to 1; a budget is how much of a cost an episode may take. Every estimate
    has an interval over episodes.
    """

    play: Play  # the setting, with success and costs of every episode
    success: Estimate  # mean success by the success rule
    plain: Estimate  # mean success over all episodes alike
    over_paper: Estimate  # success less that of the paper's schedule
    # p-value of no such difference, by Holm's method for all schedules of the run; None without an
    # interval, and for the paper's own and the oracle
    p: float | None
    over_random: Estimate  # success less that of `random` with as many messages
    closed: Estimate  # share of the gap between the paper's schedule and the oracle that it closes
    messages: Estimate  # its messages as a share of the paper's
    # success averaged over budgets from no message to those of `always`, at the settings of `front`
    area: Estimate
    # the same over joules, from those of asking nobody; NaN where they are unknown
    area_j: Estimate


@dataclass(frozen=True)
class Compared:
    """Hold all schedules that were compared on one run, with the outcome of every setting.

    A schedule is a rule for whom the ego asks. All played the same episodes with the same draws of
    the channel, so that differences are paired.
    """

    name: str  # the run's model, prompt and answer mode
    # settings of radio, asking and fusion; each play has a schedule of its own in it
    point: OperatingPoint
    names: tuple[str, ...]  # names of the schedules that are compared
    plays: Mapping[str, Sequence[Play]]  # of every candidate, by schedule
    # the same on tune layouts, start situations on which settings are chosen; empty without
    tune: Mapping[str, Sequence[Play]]
    oracle: Play  # the bound: of an ego that knows how each episode ends
    budget: float  # share of the paper's messages within which settings are chosen

    @property
    def paper(self) -> Play:
        """Return the outcome of the paper's schedule with its threshold and limit as they are set.

        They are those of the run's operating point (settings of radio, asking and fusion). The
        paper's schedule, a rule for whom to ask, asks where the entropy of the ego's intent (its
        probabilities of actions) is above a threshold.
        """
        return _at(self.plays[PAPER], self._untuned(PAPER))

    @property
    def everybody(self) -> Play:
        """Return the outcome of always asking all helpers that the operating point allows.

        The operating point is the settings of radio, asking and fusion.
        """
        return _at(self.plays[ALWAYS], self._untuned(ALWAYS))

    def _untuned(self, schedule: str) -> Candidate:
        """Return a schedule at its own threshold, with all the helpers that the point allows."""
        threshold = self.point.ask.tau_nats if schedule == PAPER else SCHEDULES[schedule].threshold
        return Candidate(schedule, threshold, self.point.ask.max_helpers)

    @property
    def success_rule(self) -> Success:
        """Return how success is averaged over episodes, such as balanced by danger.

        That is the mean over episodes with a danger (a vehicle that the ego would meet) and
        without.
        """
        return self.oracle.success_rule

    @cached_property
    def counts(self) -> Ints:
        """Return how often each episode counts in each bootstrap resample, (1 + RESAMPLES, E).

        All intervals of the comparison use the same resamples. There are E episodes; the first row
        has them as played, once each.
        """
        return self.success_rule.resampled(noise.generator("schedule", "episodes"), RESAMPLES)

    def chosen(self, schedule: str) -> Play:
        """Return a schedule's outcome at the setting chosen for it.

        `schedule` is its name, that of a rule for whom to ask. The setting is the one with the most
        success on tune layouts (start situations for choosing) within the budget of messages; of
        equal ones the cheapest, and the cheapest of all if none is within it. Without tune layouts
        it is the default setting.
        """
        if not self.tune:
            return _at(self.plays[schedule], self._untuned(schedule))
        budget = self.budget * _at(self.tune[PAPER], self._untuned(PAPER)).messages.mean()
        cheapest = min(self.tune[schedule], key=lambda play: play.messages.mean())
        within = [play for play in self.tune[schedule] if play.messages.mean() <= budget] or [
            cheapest
        ]
        best = max(within, key=lambda play: (round(play.rate, 9), -play.messages.mean()))
        return _at(self.plays[schedule], best.candidate)

    @property
    def energy(self) -> bool:
        """Return whether the energy of decisions is known, in joules, so that tables show it."""
        return bool(np.isfinite(self.oracle.means["energy_j"]))

    def front(self, schedule: str, cost: str = "messages") -> list[Play]:
        """Return the outcomes of the settings to use as a cost's budget grows, the cheapest first.

        `schedule` is the name of the rule for whom to ask, and `cost` one of `COSTS`. A setting is
        in it if no cheaper one succeeds more on tune layouts (start situations for choosing);
        without them, on these layouts, which flatters it. The first asks nobody.
        """

        def order(ranked: tuple[Play, float]) -> tuple[float, float]:
            play, rank = ranked
            return float(play.of(cost).mean()), -rank

        taken, best = list[Play](), -np.inf
        for play, rank in sorted(self._ranked(schedule), key=order):
            if rank > best:
                taken.append(play)
                best = rank
        return taken

    def _ranked(self, schedule: str) -> list[tuple[Play, float]]:
        """Return a schedule's plays, and never asking, each with its success on tune layouts,
        without these on its own.
        """
        every = [self.plays[NEVER][0], *(self.plays[schedule] if schedule != NEVER else ())]
        tuned = {play.candidate: play for of in self.tune.values() for play in of}
        return [(play, tuned.get(play.candidate, play).rate) for play in every]

    def oracle_front(self) -> list[Play]:
        """Return the oracle's outcomes where an episode may take 0, 1, 2, ... messages at most.

        The oracle is an ego that knows how each episode ends. An episode that needs more messages
        to succeed is played without asking.
        """
        bound, alone = self.oracle, self.plays[NEVER][0].costs
        cheap = [bound.messages <= cap for cap in range(int(bound.messages.max()) + 1)]
        costs = [np.where(of[..., None], bound.costs, alone) for of in cheap]
        return [
            Play(bound.candidate, bound.success * of, spent, bound.success_rule)
            for of, spent in zip(cheap, costs, strict=True)
        ]

    def area(self, schedule: str, cost: str = "messages") -> Estimate:
        """Return a schedule's success averaged over budgets of a cost, with a bootstrap interval.

        `schedule` names a rule for whom to ask. A budget is how much of the cost an episode may
        take on average, from the cost of never asking to that of always asking all; `cost` is one
        of `COSTS`.
        """
        of_bound = [(play, play.rate) for play in self.oracle_front()]
        ranked = of_bound if schedule == ORACLE else self._ranked(schedule)
        success = self._successes([play for play, _ in ranked])
        least = self._resampled([self.plays[NEVER][0].of(cost)])
        spent = self._resampled([play.of(cost) for play, _ in ranked]) - least
        most = self._resampled([self.everybody.of(cost)]) - least
        ranks = np.array([rank for _, rank in ranked])
        return self._interval(_area(success, np.clip(spent, 0.0, most), ranks, most[:, 0]))

    def _interval(self, values: Floats) -> Estimate:
        return resampled_estimate(values, self.counts.shape[1], self.success_rule.clusters)

    def _resampled(self, values: Sequence[Floats]) -> Floats:
        """Return means of values (S, E) in each resample, (1 + RESAMPLES, P)."""
        return _means(self.counts / self.counts.shape[1], values)

    def _successes(self, plays: Sequence[Play]) -> Floats:
        """Return success of plays, as it counts, in each resample, (1 + RESAMPLES, P)."""
        return _means(self.success_rule.weights(self.counts), [play.success for play in plays])

    @cached_property
    def regret(self) -> Estimate:
        """Return how much success better asking could add, at most: the oracle's less the paper's.

        The oracle is an ego that knows how each episode ends; the paper's schedule (rule for whom
        to ask) asks by the entropy of the ego's intent. The difference is paired by episode.
        """
        return self.success_rule.difference(self.oracle.success, self.paper.success)

    @cached_property
    def rows(self) -> list[Chosen]:
        """Return the rows of the table of schedules: the paper's, all compared ones, the oracle.

        A schedule is a rule for whom the ego asks; the paper's asks by the entropy of its answer.
        The oracle is an ego that knows how each episode ends.
        """
        chosen = [self.chosen(name) for name in self.names]
        raw = [self.success_rule.p_value(play.success, self.paper.success) for play in chosen]
        rows = [self._row(self.paper, None)]
        for play, p in zip(chosen, corrected(raw), strict=True):
            rows.append(self._row(play, p))
        return [*rows, self._row(self.oracle, None)]

    def _row(self, play: Play, p: float | None) -> Chosen:
        success_rule, success = self.success_rule, self._successes([play, self.paper, self.oracle])
        messages = self._resampled([play.messages, self.paper.messages])
        return Chosen(
            play,
            success_rule.estimate(play.success),
            success_rule.plain.estimate(play.success),
            success_rule.difference(play.success, self.paper.success),
            p,
            success_rule.difference(play.success, self.random_like(play)),
            self._interval(_ratio(success[:, 0] - success[:, 1], success[:, 2] - success[:, 1])),
            self._interval(_ratio(messages[:, 0], messages[:, 1])),
            self.area(play.candidate.schedule),
            self.area(play.candidate.schedule, "energy_j"),
        )

    def random_like(self, play: Play) -> Floats:
        """Return the success of asking at random with as many messages as `play`, (S, E).

        The axes are S channel seeds and E episodes. It is interpolated, 0 to 1, between the two
        `random` schedules (rules for whom to ask) whose mean numbers of messages are next to that
        of `play`.
        """
        most = self.point.ask.max_helpers
        every = [play for play in self.plays[RANDOM] if play.candidate.most == most]
        ladder = sorted(
            [self.plays[NEVER][0], *every, self.everybody], key=lambda p: float(p.messages.mean())
        )
        means = np.array([p.messages.mean() for p in ladder])
        wanted = min(float(play.messages.mean()), float(means[-1]))
        above = int(np.clip(np.searchsorted(means, wanted), 1, len(ladder) - 1))
        part = (wanted - means[above - 1]) / max(means[above] - means[above - 1], 1e-12)
        return np.asarray((1 - part) * ladder[above - 1].success + part * ladder[above].success)


def compare(
    stored: ReplayedRun,
    tune: ReplayedRun | None,
    point: OperatingPoint,
    names: Sequence[str],
    seeds: Sequence[int],
    budget: float,
    success_rules: Mapping[ReplayedRun, Success],
    progress: Callable[[int], None],
) -> Compared:
    """Play every schedule on a run, and on a run on tune layouts if there is one.

    A schedule is a rule for whom the ego asks.

    Args:
        stored: the run whose answers are used; schedules are reported on it.
        tune: a run on layouts (start situations) for choosing settings, which suggests the settings
            that are tried; None if there is none.
        point: the operating point: everything else that a decision depends on.
        names: names of the schedules.
        seeds: the channel's seeds.
        budget: share of the messages of the paper's schedule that a chosen setting may take.
        success_rules: how success of each run is averaged over its episodes.
        progress: called with 1 for each step and schedule.

    Raises:
        UserError: no schedule can change anything at the operating point.
    """
    refuse_idle(point)
    run = choices(stored, point, seeds, progress)
    tune_run = choices(tune, point, seeds, progress) if tune else None
    run_plays: dict[str, list[Play]] = {}
    tune_plays: dict[str, list[Play]] = {}
    for name in dict.fromkeys((PAPER, NEVER, ALWAYS, RANDOM, *names)):
        tried = candidates(tune_run or run, point, name)
        run_plays[name] = plays(run, point, tried, success_rules[stored])
        if tune and tune_run:
            tune_plays[name] = plays(tune_run, point, tried, success_rules[tune])
        progress(1)
    oracle = Candidate(ORACLE, None, point.ask.max_helpers)
    bound = Play(oracle, *run.oracle(), success_rules[stored])
    return Compared(stored.name, point, tuple(names), run_plays, tune_plays, bound, budget)


def run_schedules(
    runs: Sequence[ReplayedRun],
    tune: Sequence[ReplayedRun],
    condition: str,
    names: Sequence[str],
    seeds: Sequence[int],
    budget: float,
    out: Path,
    progress: Progress,
) -> list[Compared]:
    """Compare schedules on runs, each with its run on tune layouts, or without any.

    A schedule is a rule for whom the ego asks; tune layouts are start situations for choosing
    settings. Returns a comparison for each run, with the outcome of every setting of every
    schedule.

    Args:
        runs: the runs whose answers are used.
        tune: a run on tune layouts for each of `runs`, in their order; or none.
        condition: the settings of radio, asking and fusion, as they are typed, such as
            `6g:max_helpers=1`.
        names: names of the schedules.
        seeds: the channel's seeds.
        budget: share of the messages of the paper's schedule that a chosen setting may take.
        out: the folder to write.
        progress: told how many steps there are, and called with 1 for each.

    Raises:
        UserError: no schedule changes anything, or the folder `out` has another comparison, or a
            run is on other layouts.
        Unanswered: too many questions got no answer; the runs keep all others.
    """
    every = [*runs, *tune]
    for run in tune:
        layouts(run, "tune", runs)
    for run, tune_run in zip(runs, tune, strict=False):
        _refuse_unlike(run, tune_run)
    manifest = {
        "sources": [run.manifest() for run in every],
        "condition": condition,
        "schedules": list(names),
        "budget": budget,
        "seeds": list(seeds),
    }
    refuse_other(out, "schedule", manifest)
    steps = sum(run.dataset.scenario.parameters.decisions for run in every)
    progress.more(steps + len(runs) * len(names))
    success_rules = counted(every)
    compared = []
    for run, tune_run in zip_longest(runs, tune):
        point = point_of([run], condition)
        result = compare(run, tune_run, point, names, seeds, budget, success_rules, progress)
        compared.append(result)
    for run in every:
        run.settle()
    return compared


def _refuse_unlike(run: ReplayedRun, tune: ReplayedRun) -> None:
    """Raise UserError if settings would be chosen by answers of another model or scenario."""
    unlike = different(setup(run.run, run.dataset.scenario), setup(tune.run, tune.dataset.scenario))
    if unlike:
        one, other = printable(run.run.path), printable(tune.run.path)
        raise UserError(
            f"--tune {other} differs from {one} in {unlike}; give a run that differs in its "
            "layouts alone, in the order of the runs"
        )


def in_order(names: Collection[str]) -> list[str]:
    """Return names of schedules in the order of tables: the usual ones first.

    A schedule is a rule for whom the ego asks.
    """
    first = [name for name in FIRST if name in names]
    return [*first, *(name for name in names if name not in FIRST)]


def _means(weights: Floats, values: Sequence[Floats]) -> Floats:
    """Return means over seeds and, by weights (B, E), over episodes,
    of P values (S, E) each, (B, P).
    """
    return np.asarray(weights @ np.array([each.mean(axis=0) for each in values]).T)


def _at(plays: Sequence[Play], candidate: Candidate) -> Play:
    return next(play for play in plays if play.candidate == candidate)


def _area(success: Floats, messages: Floats, ranks: Floats, most: Floats) -> Floats:
    """Return the mean over budgets from 0 to `most`, (B,), of the success, (B, P),
    of the setting taken at each budget.

    At a budget that setting is taken which ranks highest, (P,), of those whose messages,
    (B, P), it allows.
    """
    order = np.lexsort((np.broadcast_to(-ranks, messages.shape), messages), axis=1)
    costs = np.take_along_axis(messages, order, 1)
    until = np.concatenate([costs[:, 1:], most[:, None]], axis=1)
    best = np.full(len(success), -np.inf)
    rows, taken, area = np.arange(len(success)), np.zeros(len(success)), np.zeros(len(success))
    for place, at in enumerate(order.T):
        better = ranks[at] > best
        best, taken = np.where(better, ranks[at], best), np.where(better, success[rows, at], taken)
        area += taken * (until[:, place] - costs[:, place])
    return _ratio(area, most)


def _ratio(part: Floats, whole: Floats) -> Floats:
    """Return a share, NaN of nothing."""
    return np.where(whole > 0, part / np.where(whole > 0, whole, 1.0), np.nan)


SLACK = 1.1  # by which messages may exceed on these layouts what they were on tune layouts
BUDGETS = {"messages": "messages per episode", "energy_j": "joules per episode"}
HEADS = (
    "schedule",
    "balanced %",
    "success %",
    "msgs",
    "J",
    "over paper's",
    "gap closed %",
    "p",
    "over random, points",
    "messages, % of the paper's",
    "on air, ms",
    "latency, ms",
    "area, %",
    "area over joules, %",
)
JOULES, IF_BALANCED = ("J", "area over joules, %"), ("balanced %",)


def schedule_study(
    compared: Sequence[Compared], runs: Sequence[ReplayedRun], seeds: Sequence[int]
) -> Study:
    """Return the study (tables, pictures and sentences) of schedules that were compared.

    A schedule is a rule for whom to ask. `compared` has an item for each model's run, `runs` are
    all runs that were played, those on tune layouts (start situations for choosing settings)
    included, and `seeds` the channel's seeds.
    """
    first, data = compared[0], tables(compared)
    words = first.success_rule.words
    tuned = bool(first.tune)
    chosen = (
        f"Both were chosen for the most {words} on tune layouts, within "
        f"{100 * first.budget:.0f} % of the paper's messages there."
        if tuned
        else "Both are the defaults of the condition and of the schedule; give a run on tune "
        "layouts to have "
        "them chosen."
    )
    best = (
        "that is best on tune layouts"
        if tuned
        else "that is best on these layouts, which flatters it"
    )
    return Study(
        "schedule",
        "Whom the ego asks, and when",
        [sentence for run in compared for sentence in headline(run)],
        [
            "Decisions are made again from stored answers with the same random draws, channel "
            f"seeds {', '.join(map(str, seeds))}; n is {first.regret.n} episodes, differences are "
            "paired by episode, and 95 % intervals are over episodes; those of shares and areas "
            "come from a bootstrap. The oracle knows how every course ends: it is a bound and no "
            "schedule.",
            "After a schedule's name stand the most helpers that it asks, and the threshold above "
            "which it asks. "
            + chosen
            + f" A line of the figure shows, of the settings within a budget, the one {best}.",
        ],
        [_table(run) for run in compared],
        data,
        {
            "sources": [run.manifest() for run in runs],
            "condition": first.point.name,
            "schedules": first.names,
            "budget": first.budget,
            "seeds": list(seeds),
            "versions": versions(),
        },
        data["schedules"],
        lambda draws: {"fronts": _fronts(draws, compared)},
        [caveat for run in runs for caveat in run.caveats],
    )


def name_of(row: Chosen) -> str:
    """Return the label of a row, such as `entropy 1, 0.8`: schedule, most helpers and threshold.

    A schedule is a rule for whom the ego asks: the helpers for whom asking is worth more than the
    threshold. `row` has the comparison of one.
    """
    return f"{row.play.candidate.schedule} {row.play.candidate}"


def headline(compared: Compared) -> list[str]:
    """Return sentences on how much better asking could be done, and which schedule does best.

    A schedule is a rule for whom the ego asks. They compare the oracle, an ego that knows how each
    episode ends, with the paper's schedule, which asks by the entropy of the ego's answer.
    """
    regret, words = compared.regret, compared.success_rule.words
    bound = compared.oracle.means["messages"]
    sentences = [
        f"{compared.name}, {compared.point.name}: {words} of the oracle is {interval_of(regret)} "
        f"points above that of entropy above {compared.point.ask.tau_nats:g} (n = {regret.n} "
        f"episodes), with {bound:.1f} instead of "
        f"{compared.paper.means['messages']:.1f} messages per episode."
    ]
    within = [row for row in compared.rows[1:-1] if row.messages.value <= SLACK * compared.budget]
    if compared.tune and within:
        by_name = {name_of(row): row for row in within}
        success = {name: row.play.success for name, row in by_name.items()}
        first, *close = compared.success_rule.most(success)
        best = by_name[first]
        if close:
            outcome = (
                f"no schedule clearly has the most {words}: it is {interval_of(best.success)} %, "
                f"and these cannot be told apart there: {some_of([first, *close])}."
            )
        else:
            outcome = (
                f"{first} has the most {words}, {interval_of(best.success)} %, a difference of "
                f"{interval_of(best.over_paper)} points from the paper's schedule: it closes "
                f"{interval_of(best.closed)} % of that gap with {interval_of(best.messages)} % "
                "of the messages."
            )
        budget = f"{100 * compared.budget:g} % of the paper's messages"
        sentences.append(f"Chosen on tune layouts within {budget}, {outcome}")
    return sentences


def _fronts(draws: Draws[Any], compared: Sequence[Compared]) -> Any:
    panels = [
        (f"{run.name}, {run.point.name}", BUDGETS[cost], list(_steps(run, cost)))
        for run in compared
        for cost in BUDGETS
        if cost == "messages" or run.energy
    ]
    return draws.fronts(panels, compared[0].success_rule.words)


def _steps(run: Compared, cost: str) -> Iterator[Steps]:
    """Yield the settings that are taken as the budget grows."""

    def steps(
        label: str,
        plays: Sequence[Play],
        colour: str,
        line: Line = "-",
        marker: str = "",
        size: float = 3.0,
    ) -> Steps:
        success = [100 * play.rate for play in plays]
        costs = [play.means[cost] for play in plays]
        return Steps(label, costs, success, colour, line, marker, size)

    for n, name in enumerate(name for name in run.names if name != NEVER):
        yield steps(
            name,
            run.front(name, cost),
            COLOURS[n % len(COLOURS)],
            "-" if n < len(COLOURS) else ":",
            MARKERS[n % len(MARKERS)],
        )
    yield steps("oracle, a bound", run.oracle_front(), INK, "--")
    tau = f"entropy above {run.point.ask.tau_nats:g}"
    yield steps(tau, [run.paper], INK, "", "*", 9.0)


def _table(run: Compared) -> Table:
    words, balanced = run.success_rule.words, run.success_rule.metric == BALANCED
    plain = "success %" if balanced else ""  # for which 80 columns have no room beside the other
    hidden = (*(() if run.energy else JOULES), *(() if balanced else IF_BALANCED))
    heads = [head for head in HEADS if head not in hidden]
    rows = []
    for n, row in enumerate(run.rows):
        means, paper = row.play.means, n == 0  # which is not compared with itself
        over, closed, share = (
            DASH if paper else interval_of(e) for e in (row.over_paper, row.closed, row.messages)
        )
        cells = (
            name_of(row) + " (the paper's)" * paper,
            interval_of(row.success),
            interval_of(row.plain),
            f"{means['messages']:.1f}",
            f"{means['energy_j']:.1f}",
            over,
            closed,
            p_cell(row.p),
            interval_of(row.over_random),
            share,
            f"{means['airtime_ms']:.3f}",
            f"{means['latency_ms']:.1f}",
            interval_of(row.area),
            interval_of(row.area_j),
        )
        rows.append([cell for head, cell in zip(HEADS, cells, strict=True) if head in heads])
    return Table(
        f"{run.name}, {run.point.name}",
        heads,
        rows,
        "Messages, milliseconds on air and joules are per episode, latency is per decision. Over "
        f"paper's: {words} less that of the paper's schedule, in points; over random: less that "
        "of the schedule random with as many messages. Gap: from the paper's schedule to the "
        f"oracle. Area: {words} averaged over budgets from no message to always asking all; over "
        "joules, from the joules of asking nobody. p comes from the interval and is corrected by "
        "Holm's method for all schedules of the table; bold: 0.05 or less. All settings are in "
        "settings.csv.",
        terminal=[n for n, head in enumerate(heads[: heads.index("p")]) if head != plain],
    )


def tables(compared: Sequence[Compared]) -> "dict[str, pd.DataFrame]":
    """Return the data frames `schedules` and `settings`, by these names, to write as files.

    A schedule is a rule for whom to ask. `schedules` has a row for each at its chosen setting, with
    its comparison; `settings` one for each setting that was played, with its success and mean
    costs.
    """
    import pandas as pd

    def ends(name: str, e: Estimate) -> dict[str, Any]:
        return {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}

    def place(run: Compared, play: Play) -> dict[str, Any]:
        of = play.candidate
        where = {"run": run.name, "condition": run.point.name}
        return {**where, "schedule": of.schedule, "threshold": of.threshold, "max_helpers": of.most}

    schedules, settings = list[dict[str, Any]](), list[dict[str, Any]]()
    for run in compared:
        for row in run.rows:
            values = {**place(run, row.play), "lead": run.success_rule.metric}
            values |= ends("success", row.plain)
            if run.success_rule.metric == BALANCED:
                values |= ends("balanced_success", row.success)
            values |= {"n": row.success.n, **row.play.means}
            values |= ends("over_paper", row.over_paper)
            values["p_holm"] = row.p
            values |= ends("over_random", row.over_random)
            values |= ends("gap_closed", row.closed)
            values |= ends("messages_share", row.messages)
            values |= ends("area", row.area)
            values |= ends("area_j", row.area_j)
            schedules.append(values)
        for schedule, plays in run.plays.items():
            front = run.front(schedule)
            for play in plays:
                values = {**place(run, play), **_rates(play), **play.means, **_on_tune(run, play)}
                values["on_front"] = any(play is taken for taken in front)
                settings.append(values)
    return {"schedules": pd.DataFrame(schedules), "settings": pd.DataFrame(settings)}


def _rates(play: Play) -> dict[str, float]:
    balanced = {"balanced_success": play.rate} if play.success_rule.metric == BALANCED else {}
    return {"success": float(play.success.mean()), **balanced}


def _on_tune(run: Compared, play: Play) -> dict[str, float | None]:
    on_tune = {each.candidate: each for each in run.tune.get(play.candidate.schedule, ())}
    rates = _rates(on_tune[play.candidate]) if on_tune else {"success": None}
    return {f"{name}_on_tune": rate for name, rate in rates.items()}
