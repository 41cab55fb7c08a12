"""How long a run's answers took, by role."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import numpy as np
from msgspec.structs import replace

from harness.core.arrays import Ints
from harness.runs import percentiles
from harness.runs.records import Answer, AnswerFacts, Times


def times(
    answers: Iterable[Answer | AnswerFacts],
    episodes: Sequence[int] = (),
    clusters: Ints | None = None,
) -> dict[str, Times]:
    """Return for each role how long answers took: percentiles of the seconds, with intervals.

    A role is who answers: `ego`, `helper`, or `merge` (the ego after it heard messages). Only
    answers that were timed and came at the first attempt count. Intervals are over episodes, or
    over the `clusters`, (E,), of the E `episodes`, which are numbers, if they have some.
    """
    cluster_of = clusters_by_text(episodes, clusters)
    by_role: dict[str, list[Answer | AnswerFacts]] = {}
    for answer in answers:
        if answer.seconds is not None and answer.error is None and not answer.retries:
            by_role.setdefault(answer.role, []).append(answer)
    times_of_role = {}
    for role, role_answers in by_role.items():
        details = {
            "first_token": _times(role_answers, "first_token_s", cluster_of),
            "token": _times(role_answers, "token_s", cluster_of),
        }
        whole = cast("Times", _times(role_answers, "seconds", cluster_of))
        times_of_role[role] = replace(whole, **details)
    return times_of_role


def clusters_by_text(episodes: Sequence[int], clusters: Ints | None) -> dict[str, str]:
    """Return the name of each episode's cluster by the beginning of its scenes' ids.

    `episodes` are the numbers of E episodes and `clusters`, (E,), those of their clusters. Empty if
    each episode is of its own.
    """
    numbers = [] if clusters is None else clusters.tolist()
    pairs = zip(episodes, numbers, strict=clusters is not None)
    return {f"{episode:05d}": f"cluster {number}" for episode, number in pairs}


def unit(answer: Answer | AnswerFacts, cluster_of: Mapping[str, str]) -> str:
    """Return what an answer is counted under: its cluster, of those by scene, or its episode."""
    episode = answer.scene.partition("-")[0]
    return cluster_of.get(episode, episode)


def _times(
    answers: Sequence[Answer | AnswerFacts], which: str, cluster_of: Mapping[str, str]
) -> Times | None:
    """Return percentiles of the answers' time in the field `which`; None if no answer has it."""
    timed = [answer for answer in answers if getattr(answer, which) is not None]
    if not timed:
        return None
    values = np.array([getattr(answer, which) for answer in timed])
    units = [unit(answer, cluster_of) for answer in timed]
    ends = percentiles.intervals(values, units, is_clustered=bool(cluster_of))
    intervals = {
        percent: None if math.isnan(low) else (round(low, 6), round(high, 6))
        for percent, (low, high) in ends.items()
    }
    median, low, high = np.percentile(values, (50, 5, 95)).round(6).tolist()
    return Times(len(timed), median, low, high, intervals[50], intervals[95])
