"""Compute `summary.csv` and `episodes.csv` from decisions, answers and how episodes ended."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product
from typing import Any

import numpy as np
from msgspec import structs

from harness.core.arrays import Floats, Ints
from harness.core.statistics import (
    Estimate,
    cluster_numbers,
    episode_interval,
    rate_interval,
    seed_interval,
    seed_rate_interval,
)
from harness.runs.decisions import Decisions
from harness.runs.estimates import difference, halved, in_range, over_episodes, over_seeds
from harness.runs.grid import Grid
from harness.runs.headline import BALANCED, PAIRED, SUCCESS
from harness.runs.metric import World
from harness.runs.metric_names import ALL, BASELINE, GAIN, GAINS, LATENCY
from harness.runs.metric_values import by_episode, known_in
from harness.runs.metrics import METRICS, entry, metrics_of
from harness.runs.percentiles import PERCENTILES, percentiles
from harness.runs.places import least_by_place, mean_by_place, sum_by_place
from harness.runs.records import Answer, AnswerFacts, Episode, Score, roles
from harness.runs.reliability import Judged, estimates


@dataclass(frozen=True)
class Figures:
    """Hold all that a run's scores are computed from, for some of its E episodes.

    An episode is played under C conditions, named sets of settings of the radio, of asking helpers
    and of fusing their messages, and with S seeds of the channel's random numbers. `values` has
    each metric by name, (C, S, E), and `latency_ms` the latencies of all decisions, an array (n,)
    for each condition and seed. `judged` has for each condition its decisions with exactly one
    optimal action; `answers` come with the number of their episode.
    """

    grid: Grid  # the conditions, seeds and episodes
    # values of each metric by its name, (C, S, E) for E episodes; NaN where unknown
    values: Mapping[str, Floats]
    # latencies of all decisions, ms, an array (n,) for each condition and seed in the order of the
    # grid: all seeds of the first condition, then of the second
    latency_ms: Sequence[Floats]
    # for each condition its decisions with exactly one optimal action: their probability of the
    # likeliest action, and whether that was right
    judged: Sequence[Judged]
    # the answers, each with the number of its episode
    answers: Sequence[tuple[Answer | AnswerFacts, int]]
    # what each episode's layout is cut from, such as a recording, (E,); None for one of its own
    cluster_names: Sequence[str | None]

    @classmethod
    def of(
        cls,
        world: World,
        grid: Grid,
        decisions: Decisions,
        episodes: Sequence[Episode],
        answers: Iterable[Answer | AnswerFacts],
    ) -> "Figures":
        """Compute the figures of a run in a world, `frozen` (recorded scenes) or `closed-loop`.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.

        Args:
            world: the kind of world, which says what metrics there are.
            grid: the run's conditions, seeds and episodes.
            decisions: those of all episodes, in any order.
            episodes: how each ended, in the order of the grid: by condition, seed and number.
            answers: all answers that the decisions are made of.
        """
        cells, latency_ms = grid.places(decisions), decisions["latency_ms"]
        places = cells // len(grid.episodes)
        order = np.argsort(places, kind="stable")
        starts = np.searchsorted(
            places[order], np.arange(1, len(grid.conditions) * len(grid.seeds))
        )
        numbers = decisions.whole("episode")
        episode_of = {scene: int(numbers[rows.start]) for scene, rows in decisions.scenes.items()}
        return cls(
            grid,
            by_episode(metrics_of(world), grid, decisions, episodes),
            np.split(latency_ms[order], starts),
            judged_of(grid, decisions, cells),
            [(answer, episode_of[answer.scene]) for answer in answers],
            [episode.cluster for episode in episodes[: len(grid.episodes)]],
        )

    @classmethod
    def joined(cls, grid: Grid, parts: Iterable["Figures"]) -> "Figures":
        """Return the figures of a run from those of its parts, which have different episodes.

        `grid` is the run's, whose episodes are in the order of the parts; each part is let go of
        before the next is asked for.
        """
        values, start = dict[str, Floats](), 0
        sizes, latency_ms, judged = list[int](), list[Sequence[Floats]](), list[Sequence[Judged]]()
        answers, cluster_names = list[tuple[Answer | AnswerFacts, int]](), list[str | None]()
        for part in parts:
            sizes.append(len(part.grid.episodes))
            stop = start + sizes[-1]
            for name, of_part in part.values.items():
                values.setdefault(name, np.empty(grid.shape))[..., start:stop] = of_part
            latency_ms.append(part.latency_ms)
            judged.append(part.judged)
            answers += part.answers
            cluster_names += part.cluster_names
            start = stop
        return cls(
            grid,
            values,
            [np.concatenate(each) for each in zip(*latency_ms, strict=True)],
            [Judged.joined(each, sizes) for each in zip(*judged, strict=True)],
            answers,
            cluster_names,
        )

    def scores(self, older: bool = False) -> list[Score]:
        """Return the scores of all metrics, each with its intervals, as lines of `summary.csv`.

        `older` computes figures of calibration (how sure policies are, and how often right) as the
        oldest runs did (version 1 of `harness.core.versions.FIGURES`): from any number of episodes,
        and of an interval without width where all resamples are alike.
        """
        names = known_in(self.values)
        gains = GAINS if BALANCED in names else {SUCCESS: GAIN}
        clusters = cluster_numbers(self.cluster_names)
        answers = self.answers
        if clusters is not None:
            cluster_of = dict(zip(self.grid.episodes, clusters.tolist(), strict=True))
            answers = [(answer, cluster_of[episode]) for answer, episode in answers]
        return [
            *of_conditions(self.grid.conditions, self.values, names, clusters),
            *of_latencies(self.grid, self.latency_ms),
            *_of_judged(self.grid, self.judged, older, clusters),
            *_gains(self.grid.conditions, self.values, gains, clusters),
            *_of_answers(answers),
        ]


def of_conditions(
    conditions: Sequence[str],
    values: Mapping[str, Floats],
    names: Sequence[str],
    clusters: Ints | None = None,
) -> Iterator[Score]:
    """Yield the scores of the metrics `names` in each of C conditions.

    `values` has each metric's values by its name, (C, S, E), over S channel seeds and E episodes. A
    metric has one score with an interval over seeds, and one with an interval over episodes: over
    their `clusters`, (E,), if they have some.
    """
    for index, condition in enumerate(conditions):

        def scores(name: str, index: int = index, condition: str = condition) -> Iterator[Score]:
            seeds = halved(name, lambda each: over_seeds(each, values[each][index]), shared=True)
            yield Score.of(condition, name, seeds, "seed means")
            episodes = halved(
                name,
                lambda each: over_episodes(each, values[each][index], clusters),
                clusters=clusters,
            )
            yield Score.of(condition, name, episodes, "episodes")

        yield from chain.from_iterable(map(scores, names))
        total = values["messages_per_episode"][index].sum(axis=1)
        yield Score.of(condition, "message_count", seed_interval(total), "seed means")


def of_latencies(grid: Grid, latency_ms: Sequence[Floats]) -> Iterator[Score]:
    """Yield the scores of each condition's latency percentiles, in ms, as means over seeds.

    `grid` has the run's conditions and seeds. `latency_ms` has an array of n decisions, (n,), for
    each condition and seed: all seeds of the first condition, then of the second. A condition is a
    named set of settings of the radio, of asking helpers and of fusing their messages.
    """
    names = {m.percentile: m.name for m in METRICS.values() if m.percentile}
    all_percentiles = np.array([percentiles(latencies) for latencies in latency_ms])
    for index, condition in enumerate(grid.conditions):
        of_condition = all_percentiles[index * len(grid.seeds) : (index + 1) * len(grid.seeds)]
        for percent, values in zip(PERCENTILES, of_condition.T, strict=True):
            yield Score.of(
                condition, names[percent], in_range(LATENCY, seed_interval(values)), "seed means"
            )


def judged_of(grid: Grid, decisions: Decisions, cells: Ints) -> list[Judged]:
    """Return for each condition its decisions with exactly one optimal action.

    An action is optimal if success is still possible after it, where it is possible at all. `cells`
    has for each of n decisions, (n,), the index of its condition, seed and episode in a flattened
    array (C, S, E) of the C conditions, S seeds and E episodes of `grid` (`Grid.places`). A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    parts, start = list[list[Judged]](), 0
    for piece in decisions.pieces():
        stop = start + len(piece)
        condition, _, episode = np.unravel_index(cells[start:stop], grid.shape)
        fused, optimal = piece.of_actions("fused"), piece.of_actions("safe") == 1.0
        rows = [np.flatnonzero(condition == place) for place in range(len(grid.conditions))]
        parts.append([Judged.of(fused[here], optimal[here], episode[here]) for here in rows])
        start = stop
    sizes = [0] * len(parts)  # all have the run's episodes
    return [Judged.joined(each, sizes) for each in zip(*parts, strict=True)]


def _of_judged(
    grid: Grid, judged: Sequence[Judged], older: bool, clusters: Ints | None
) -> Iterator[Score]:
    """Yield each condition's figures of all its judged decisions, where there are any."""
    pooled = {metric.name: metric.pooled for metric in METRICS.values() if metric.pooled}
    for condition, decisions in zip(grid.conditions, judged, strict=True):
        if len(decisions.sure):
            figures = estimates(
                decisions, list(pooled.values()), len(grid.episodes), older, clusters
            )
            for name, figure in zip(pooled, figures, strict=True):
                yield Score.of(condition, name, in_range(name, figure), "episodes")


def _gains(
    conditions: Sequence[str],
    values: Mapping[str, Floats],
    gains: Mapping[str, str],
    clusters: Ints | None,
) -> Iterator[Score]:
    """Yield each condition's gains over `BASELINE`, by the name of what is gained,
    from values (C, S, E).
    """
    if BASELINE not in conditions:
        return
    base = conditions.index(BASELINE)
    for (n, condition), (name, gain) in product(enumerate(conditions), gains.items()):
        if n != base:

            def gain_by_seed(each: str, n: int = n) -> Estimate:
                return seed_rate_interval(values[each][n] - values[each][base])

            yield Score.of(condition, gain, halved(name, gain_by_seed, shared=True), "seed means")
            parts = entry(name).halves or (name,)
            pairs = [(values[part][n].T, values[part][base].T) for part in parts]
            change = difference(name, pairs, clusters=clusters)
            yield Score.of(condition, gain, change, PAIRED)


def _of_answers(answers: Sequence[tuple[Answer | AnswerFacts, int]]) -> Iterator[Score]:
    """Yield each metric of a role's answers, each of which comes with the number of its unit.

    Intervals are over units, episodes or their clusters, since the answers of one unit are not
    independent.
    """
    by_role = {}
    for role in roles():
        pairs = [(answer, episode) for answer, episode in answers if answer.role == role]
        if pairs:
            by_role[role] = tuple(zip(*pairs, strict=True))
    for metric in METRICS.values():
        if metric.answers and metric.role in by_role:
            role_answers, numbers = by_role[metric.role]
            values, episodes = metric.answers(role_answers), np.array(numbers)
            if (is_known := ~np.isnan(values)).any():
                if metric.interval == "rate":
                    estimate = rate_interval(values, episodes)
                else:
                    estimate = in_range(
                        metric.name, episode_interval(values[is_known], episodes[is_known])
                    )
                yield Score.of(ALL, metric.name, estimate, "answers")


def counted(grid: Grid, decisions: Decisions, episodes: Sequence[Episode]) -> list[Episode]:
    """Return the episodes' records, completed by what is counted in their decisions.

    These are counts and means such as messages, latency in ms and deadline misses. `episodes` and
    the result are in the order of the grid: by condition (named set of settings), channel seed and
    number.
    """
    ordered, places = grid.ordered(episodes), grid.places(decisions)
    n = len(ordered)

    def totals(values: Floats) -> list[int]:
        return [int(total) for total in sum_by_place(values, places, n)]

    def numbers_or_none(values: Floats) -> list[Any]:
        return [None if v != v else v for v in values.tolist()]

    def means(name: str) -> list[Any]:
        return numbers_or_none(mean_by_place(decisions[name], places, n))

    columns = {
        "messages": totals(decisions["messages"]),
        "trigger_rate": means("triggered"),
        "latency_ms": [v and round(v, 3) for v in means("latency_ms")],
        "deadline_misses": totals(decisions["deadline_missed"]),
        "decisions": totals(np.ones(len(places))),
    }
    for name in ("miss", "false_alarm", "short_ttc", "short_pet"):
        columns[name] = [None if share is None else share > 0 for share in means(name)]
    for name in ("ttc_s", "pet_s"):
        columns[f"least_{name}"] = numbers_or_none(least_by_place(decisions[name], places, n))
    if not np.isnan(decisions["acted"]).all():
        columns["never_acted"] = totals(1.0 - decisions["acted"])
    shared_columns = [_shared(values) for values in columns.values()]
    rows = zip(*shared_columns, strict=True)
    return [
        structs.replace(episode, **dict(zip(columns, values, strict=True)))
        for episode, values in zip(ordered, rows, strict=True)
    ]


def _shared(values: Sequence[Any]) -> list[Any]:
    """Return the values, of which those that are equal are one object: episodes may be millions."""
    objects: dict[Any, Any] = {}
    return [objects.setdefault(value, value) for value in values]
