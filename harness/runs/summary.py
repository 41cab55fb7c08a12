"""Compute `summary.csv` and `episodes.csv` from decisions, answers and how episodes ended."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from harness.core.arrays import Floats
from harness.core.statistics import (
    episode_interval,
    rate_difference,
    rate_interval,
    seed_interval,
    seed_rate_interval,
)
from harness.runs.decisions import Decisions
from harness.runs.metrics import (
    ALL,
    GAIN,
    LATENCY,
    METRICS,
    PERCENTILES,
    SUCCESS,
    Grid,
    World,
    by_episode,
    in_range,
    mean_by_place,
    metrics_of,
    over_episodes,
    over_seeds,
    percentiles,
    sum_by_place,
)
from harness.runs.records import Answer, AnswerFacts, Episode, Role, Score

BASELINE = "single-local"
ROLES: tuple[Role, ...] = ("ego", "helper", "merge", "blind")


def scores(
    world: World,
    grid: Grid,
    decisions: Decisions,
    episodes: Sequence[Episode],
    answers: Sequence[Answer | AnswerFacts],
) -> list[Score]:
    """Return every score of a run; `episodes` are in the order of the grid."""
    values = by_episode(metrics_of(world), grid, decisions, episodes)
    values = {name: v for name, v in values.items() if not (METRICS[name].optional and np.isnan(v).all())}
    latency_ms, places = decisions["latency_ms"], grid.places(decisions) // len(grid.episodes)
    return [
        *of_conditions(grid.conditions, values),
        *of_latencies(grid, [latency_ms[places == n] for n in range(len(grid.conditions) * len(grid.seeds))]),
        *_gains(grid.conditions, values[SUCCESS]),
        *_of_answers(answers, decisions),
    ]


def of_conditions(conditions: Sequence[str], values: Mapping[str, Floats]) -> Iterator[Score]:
    """Yield each metric's scores in each condition, over seeds and over episodes, from values (C, S, E)."""
    for index, condition in enumerate(conditions):
        for name, by_condition in values.items():
            yield Score.of(condition, name, over_seeds(name, by_condition[index]), "seed means")
            yield Score.of(condition, name, over_episodes(name, by_condition[index]), "episodes")
        total = values["messages_per_episode"][index].sum(axis=1)
        yield Score.of(condition, "message_count", seed_interval(total), "seed means")


def of_latencies(grid: Grid, latency_ms: Sequence[Floats]) -> Iterator[Score]:
    """Yield each condition's latency percentiles, means over seeds.

    `latency_ms` has the decisions' latencies for each condition and seed, in the order of the grid.
    """
    all_percentiles = np.array([percentiles(latencies) for latencies in latency_ms])
    for index, condition in enumerate(grid.conditions):
        own = all_percentiles[index * len(grid.seeds) : (index + 1) * len(grid.seeds)]
        for percent, values in zip(PERCENTILES, own.T, strict=True):
            estimate = in_range(LATENCY, seed_interval(values))
            yield Score.of(condition, f"latency_p{percent}_ms", estimate, "seed means")


def _gains(conditions: Sequence[str], success: Floats) -> Iterator[Score]:
    """Yield each condition's gain over `BASELINE`, from success (C, S, E)."""
    if BASELINE in conditions:
        for index, condition in enumerate(conditions):
            if condition != BASELINE:
                own, baseline, name = success[index], success[conditions.index(BASELINE)], GAIN + BASELINE
                yield Score.of(condition, name, seed_rate_interval(own - baseline), "seed means")
                yield Score.of(condition, name, rate_difference(own.T, baseline.T), "episodes")


def _of_answers(answers: Sequence[Answer | AnswerFacts], decisions: Decisions) -> Iterator[Score]:
    """Yield by role how answers were parsed, and how long they and their prompts are.

    Intervals are over episodes, since the answers of one episode are not independent.
    """
    numbers = decisions.whole("episode")
    episodes = {scene: numbers[rows.start] for scene, rows in decisions.scenes.items()}
    by_role = {role: [answer for answer in answers if answer.role == role] for role in ROLES}
    for role, role_answers in by_role.items():
        for verdict in ("strict", "recovered", "failed"):
            if role_answers:
                hits = np.array([float(answer.verdict == verdict) for answer in role_answers])
                episode = np.array([episodes[answer.scene] for answer in role_answers])
                yield Score.of(ALL, f"{verdict}_rate_{role}", rate_interval(hits, episode), "answers")
    for role, role_answers in by_role.items():
        if any(answer.turns > 1 for answer in role_answers):
            episode = np.array([episodes[answer.scene] for answer in role_answers])
            after = np.array([answer.verdict != "failed" for answer in role_answers])
            before = after & np.array([answer.turns == 1 for answer in role_answers])
            for when, hits in (("at_first", before), ("after_repair", after)):
                estimate = rate_interval(hits.astype(float), episode)
                yield Score.of(ALL, f"valid_{when}_rate_{role}", estimate, "answers")
    for role, role_answers in by_role.items():
        for what in ("prompt_tokens", "completion_tokens", "label_mass"):
            counts = [
                (value, episodes[answer.scene])
                for answer in role_answers
                if (value := getattr(answer, what)) is not None
            ]
            if counts:
                values, episode = np.array(counts, dtype=float).T
                estimate = in_range(what, episode_interval(values, episode.astype(int)))
                yield Score.of(ALL, f"{what}_{role}", estimate, "answers")


def counted(grid: Grid, decisions: Decisions, episodes: Sequence[Episode]) -> list[Episode]:
    """Return the episodes in the order of the grid, with the columns that follow from their decisions."""
    ordered, places = grid.ordered(episodes), grid.places(decisions)
    n = len(ordered)

    def totals(values: Floats) -> list[int]:
        return [int(total) for total in sum_by_place(values, places, n)]

    def means(name: str) -> list[Any]:
        return [None if v != v else v for v in mean_by_place(decisions[name], places, n).tolist()]

    columns = {
        "messages": totals(decisions["messages"]),
        "trigger_rate": means("triggered"),
        "latency_ms": [v and round(v, 3) for v in means("latency_ms")],
        "deadline_misses": totals(decisions["deadline_missed"]),
        "decisions": totals(np.ones(len(places))),
    }
    if not np.isnan(decisions["acted"]).all():
        columns["never_acted"] = totals(1.0 - decisions["acted"])
    return [
        replace(episode, **dict(zip(columns, values, strict=True)))
        for episode, *values in zip(ordered, *columns.values(), strict=True)
    ]
