"""How long a run's answers took, by role."""

import math
from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
from msgspec.structs import replace

from harness.runs import percentiles
from harness.runs.records import Answer, AnswerFacts, Times


def times(answers: Iterable[Answer | AnswerFacts]) -> dict[str, Times]:
    """Return for each role how long answers took: percentiles of the seconds, with intervals.

    A role is who answers: `ego`, `helper`, or `merge` (the ego after it heard messages). Only
    answers that were timed and came at the first attempt count.
    """
    by_role: dict[str, list[Answer | AnswerFacts]] = {}
    for answer in answers:
        if answer.seconds is not None and answer.error is None and not answer.retries:
            by_role.setdefault(answer.role, []).append(answer)
    times_of_role = {}
    for role, role_answers in by_role.items():
        details = {
            "first_token": _times(role_answers, "first_token_s"),
            "token": _times(role_answers, "token_s"),
        }
        times_of_role[role] = replace(cast("Times", _times(role_answers, "seconds")), **details)
    return times_of_role


def _times(answers: Sequence[Answer | AnswerFacts], which: str) -> Times | None:
    """Return percentiles of the answers' time in the field `which`; None if no answer has it."""
    timed = [answer for answer in answers if getattr(answer, which) is not None]
    if not timed:
        return None
    values = np.array([getattr(answer, which) for answer in timed])
    episodes = [answer.scene.partition("-")[0] for answer in timed]
    intervals = {
        percent: None if math.isnan(low) else (round(low, 6), round(high, 6))
        for percent, (low, high) in percentiles.intervals(values, episodes).items()
    }
    median, low, high = np.percentile(values, (50, 5, 95)).round(6).tolist()
    return Times(len(timed), median, low, high, intervals[50], intervals[95])
