"""Summary of a run: every metric with n, an interval, and what the interval is over.

Two intervals, because they answer different questions (docs/decisions/0004). `seed means`: Student's t across
seeds, the paper's error bars: how much the channel's luck moves the figure, given these very episodes.
`episodes`: how far it would move with other episodes of the scenario, each averaged over seeds and steps;
Wilson for yes/no outcomes that no seed changes, else Student's t. Both are conditional on the one set of
answers the model gave.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Floats
from harness.core.statistics import (
    Estimate,
    brier,
    episode_interval,
    known_mean,
    negative_log_likelihood,
    rate_interval,
    safe_target,
    seed_interval,
)  # fmt: skip
from harness.evaluate.asking import Answer
from harness.evaluate.intents import Answered
from harness.evaluate.merging import Merged
from harness.evaluate.scoring import Scored, statuses
from harness.evaluate.spec import Spec
from harness.evaluate.success import Table

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    "model", "prompt", "answer", "condition", "metric", "value", "ci_low", "ci_high", "n", "n_excluded",
    "interval",
)  # fmt: skip
ALL = "all"  # stands for the condition where a figure does not depend on it
BASELINE = "single-local"
# What an episode has or has not.
YES_OR_NO = (
    "success_rate", "unsafe_rate", "late_rate", "collision_rate", "time_out_rate", "off_road_rate",
    "at_fault_rate",
)  # fmt: skip
PERCENTILES = (50, 95, 99)


PER_EPISODE: dict[str, Callable[[Table, Scored], Any]] = {  # values (E,)
    "success_rate": lambda laid, r: r.verdict.success,
    "unsafe_rate": lambda laid, r: r.verdict.unsafe,
    "late_rate": lambda laid, r: r.verdict.late,
    "messages_per_episode": lambda laid, r: laid.by_episode(r.coordination.messages, fill=0).sum(axis=1),
}
PER_DECISION: dict[str, Callable[[Table, Scored], Any]] = {  # values (n,), of which an episode has the mean
    "latency_proxy_ms": lambda laid, r: r.coordination.latency_s * 1000,
    "deadline_miss_rate": lambda laid, r: np.where(
        np.isnan(r.coordination.latency_s), np.nan, r.coordination.deadline_missed
    ),
    "trigger_rate": lambda laid, r: r.coordination.triggered,
    "effective_loss": lambda laid, r: np.where(r.coordination.triggered, r.coordination.loss, np.nan),
    "observed_reply_loss": lambda laid, r: r.coordination.observed_loss,
    "entropy_nats": lambda laid, r: r.coordination.entropy_nats,
    "normalised_entropy": lambda laid, r: r.coordination.normalised_entropy,
    "brier": lambda laid, r: brier(r.coordination.fused, safe_target(laid.safe)),
    "negative_log_likelihood": lambda laid, r: negative_log_likelihood(r.coordination.fused, laid.safe),
    "fallback_rate": lambda laid, r: r.coordination.own_failed,
    "fusion_ms": lambda laid, r: r.coordination.fusion_s * 1000,
    "merge_failed_rate": lambda laid, r: np.where(
        r.coordination.on_time.any(axis=1) & r.point.asks_again, r.coordination.fusion_failed, np.nan
    ),
}
METRICS = (*PER_EPISODE, *PER_DECISION)


def summary(
    spec: Spec, laid: Table, known: Answered, runs: Sequence[Scored], second: Merged | None = None
) -> "pd.DataFrame":
    """The long table of `summary.csv`."""
    return long_table(spec, _estimates(spec, laid, known, runs, second))


def long_table(spec: Spec, estimates: Iterable[tuple[str, str, Estimate, str]]) -> "pd.DataFrame":
    """Estimates, each a condition, a metric, its value and what its interval is over, in `COLUMNS`."""
    import pandas as pd

    rows = [
        {
            "model": spec.card.name, "prompt": spec.prompt.version, "answer": spec.answer,
            "condition": condition, "metric": metric, "value": e.value, "ci_low": e.low, "ci_high": e.high,
            "n": e.n, "n_excluded": e.n_excluded, "interval": interval,
        }
        for condition, metric, e, interval in estimates
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _estimates(
    spec: Spec, laid: Table, known: Answered, runs: Sequence[Scored], second: Merged | None = None
) -> Iterator[tuple[str, str, Estimate, str]]:
    by_condition: dict[str, dict[str, Floats]] = {}
    for point in spec.points:
        mine = [r for r in runs if r.point == point]
        by_seed = [by_episode(laid, r) for r in mine]
        metrics = {name: np.stack([m[name] for m in by_seed]) for name in by_seed[0]}
        by_condition[point.name] = metrics
        for name, values in metrics.items():  # (seeds, episodes)
            yield point.name, name, over_seeds(name, values), "seed means"
            yield point.name, name, over_episodes(name, values), "episodes"
        yield from (
            (point.name, *found) for found in latency_percentiles([r.coordination.latency_s for r in mine])
        )
        total = np.array([float(r.coordination.messages.sum()) for r in mine])
        yield point.name, "message_count", seed_interval(total), "seed means"
    yield from gains(by_condition)
    given = {
        "ego": [row[0] for row in known.answers], "helper": [a for row in known.answers for a in row[1:]],
        "merge": second.answers if second else [],
    }  # fmt: skip
    yield from of_answers(
        statuses(known, second), {role: [a for a in all_ if a] for role, all_ in given.items()}
    )


def gains(by_condition: Mapping[str, Mapping[str, Floats]]) -> Iterator[tuple[str, str, Estimate, str]]:
    """What each condition gains over `BASELINE`; its `success_rate` is (seeds, episodes)."""
    if BASELINE in by_condition:
        for name, metrics in by_condition.items():
            if name != BASELINE:
                gain = metrics["success_rate"] - by_condition[BASELINE]["success_rate"]
                yield name, f"success_gain_over_{BASELINE}", seed_interval(gain.mean(axis=1)), "seed means"
                yield name, f"success_gain_over_{BASELINE}", episode_interval(gain.mean(axis=0)), "episodes"


def of_answers(
    verdicts: Mapping[str, Sequence[str]], answers: Mapping[str, Sequence[Answer]]
) -> Iterator[tuple[str, str, Estimate, str]]:
    """How answers were parsed, and how long they and their prompts are, by role."""
    for role, each in verdicts.items():
        for verdict in ("strict", "recovered", "failed"):
            if each:
                hits = np.array([float(v == verdict) for v in each])
                yield ALL, f"{verdict}_rate_{role}", rate_interval(hits), "answers"
    for role, given in answers.items():
        for what in ("prompt_tokens", "completion_tokens", "label_mass"):
            counts = [a[what] for a in given if a[what] is not None]
            if counts:
                estimate = episode_interval(np.array(counts, dtype=float))
                yield ALL, f"{what}_{role}", _in_range(what, estimate), "answers"


def by_episode(laid: Table, r: Scored, names: Iterable[str] = METRICS) -> dict[str, Floats]:
    """Metrics by episode, (E,): a share or a mean over its decisions."""

    def values(name: str) -> Floats:
        if name in PER_EPISODE:
            return np.asarray(PER_EPISODE[name](laid, r), dtype=float)
        return known_mean(laid.by_episode(np.asarray(PER_DECISION[name](laid, r), dtype=float)), axis=1)

    return {name: values(name) for name in names}


def latency_percentiles(latency_s: Sequence[Floats]) -> Iterator[tuple[str, Estimate, str]]:
    """`PERCENTILES` over all decisions of a seed, from each seed's (n,), with an interval over seeds."""
    known = [each[~np.isnan(each)] * 1000 for each in latency_s]
    unknown = np.full(len(PERCENTILES), np.nan)
    by_seed = np.array([np.percentile(each, PERCENTILES) if len(each) else unknown for each in known])
    for percent, values in zip(PERCENTILES, by_seed.T, strict=True):
        yield f"latency_p{percent}_ms", seed_interval(values), "seed means"


def over_seeds(name: str, values: Floats) -> Estimate:
    """Interval over seeds of a metric's values (seeds, episodes)."""
    return _in_range(name, seed_interval(known_mean(values, axis=1)))


def over_episodes(name: str, values: Floats) -> Estimate:
    """Interval over episodes of a metric's values (seeds, episodes)."""
    each = known_mean(values, axis=0)
    settled = each[~np.isnan(each)]
    # Student's t would give 0 of 20 episodes an interval of no width.
    if name in YES_OR_NO and np.isin(settled, (0.0, 1.0)).all():
        return rate_interval(each)
    return _in_range(name, episode_interval(each))


def _in_range(name: str, e: Estimate) -> Estimate:
    """Nothing here is below 0 and no share above 1, which Student's t does not know."""
    most = 1.0 if name.endswith(("_rate", "_loss", "_mass")) else np.inf
    return replace(e, low=float(np.maximum(e.low, 0.0)), high=float(np.minimum(e.high, most)))
