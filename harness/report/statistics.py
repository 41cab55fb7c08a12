"""What the report's charts show, counted from the tables of runs: a table a chart, as plain rows.

Shares are 0 to 1. Where a row has `low` and `high` they are a 95 % interval over episodes.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.statistics import rate_interval
from harness.parsing.status import Status
from harness.runs.folder import Run
from harness.runs.metrics import LATENCY, SUCCESS

Table = list[dict[str, Any]]
ENTROPY_NATS, TOKENS, ARRIVAL_MS = 0.1, 25, 10.0  # widths of bins
CERTAINTY = 0.1
ENERGIES = ("ego's inference", "helpers' inference", "radios")


def success(run: Run) -> Table:
    """Return success and latency of each condition, of which both are known."""
    rows = []
    for condition in run.conditions:
        latency, rate = run.score(condition, LATENCY), run.score(condition, SUCCESS)
        if latency and rate:
            rows.append({
                "condition": condition, "latency_ms": latency.value, "latency_low": latency.low,
                "latency_high": latency.high, "success": rate.value, "low": rate.low, "high": rate.high,
                "n": rate.n, "interval": rate.interval,
            })  # fmt: skip
    return rows


def statuses(run: Run) -> Table:
    """Return how many answers of each role have which status."""
    order = {status: n for n, status in enumerate(map(str, Status))}
    count = Counter((a.role, order.get(a.status, -1), a.status, a.verdict) for a in run.answers)
    of = Counter(a.role for a in run.answers)
    return [
        {"role": role, "status": status, "verdict": verdict, "count": n, "share": n / of[role], "n": of[role]}
        for (role, _, status, verdict), n in sorted(count.items())
    ]


def reliability(run: Run) -> Table:
    """Return how often the action taken was safe, by how probable fusion held it."""
    certainty = run.decisions.of_actions("fused").max(axis=1)
    bins = np.minimum((certainty / CERTAINTY).astype(int), round(1 / CERTAINTY) - 1)
    return list(_shares(run, bins, certainty, 1.0 - run.decisions["regret"], "certainty"))


def errors(run: Run) -> Table:
    """Return how often a decision was unsafe, by the entropy of the ego's own intent."""
    nats = run.decisions["entropy_nats"]
    bins = np.where(np.isnan(nats), -1, nats / ENTROPY_NATS).astype(int)
    return list(_shares(run, bins, nats, run.decisions["regret"], "entropy_nats"))


def _shares(run: Run, bins: Ints, value: Floats, hits: Floats, name: str) -> Iterator[dict[str, Any]]:
    conditions, episodes = run.decisions.codes("condition", run.conditions), run.decisions.whole("episode")
    for n, condition in enumerate(run.conditions):
        for place in np.unique(bins[(conditions == n) & (bins >= 0)]):
            here = (conditions == n) & (bins == place) & ~np.isnan(hits)
            if here.any():
                share = rate_interval(hits[here], episodes[here])
                yield {
                    "condition": condition, name: round(float(value[here].mean()), 4), "share": share.value,
                    "low": share.low, "high": share.high, "n": share.n,
                }  # fmt: skip


def entropies(run: Run) -> Table:
    """Return how uncertain the ego's own answers are."""
    p = [a.intent for a in run.answers if a.role == "ego" and a.intent]
    if not p:
        return []
    probabilities = np.array(p, dtype=float)
    nats = -np.sum(probabilities * np.log(np.where(probabilities > 0, probabilities, 1.0)), axis=1)
    return _histogram(nats, ENTROPY_NATS, "entropy_nats")


def tokens(run: Run) -> Table:
    """Count the tokens of prompts by role, where the engine counts them."""
    by_role: dict[str, list[float]] = {}
    for answer in run.answers:
        if answer.prompt_tokens is not None:
            by_role.setdefault(answer.role, []).append(answer.prompt_tokens)
    return [{"role": role, **bar} for role, of in by_role.items() for bar in _histogram(of, TOKENS, "tokens")]


def replies(run: Run) -> Table:
    """Count the replies that were scheduled, by how they ended."""
    d = run.decisions
    delivered, on_time = d.of_messages("delivered"), d.of_messages("on_time")
    by_reply = {
        "on time": on_time == 1.0,
        "late": (delivered == 1.0) & (on_time == 0.0),
        "lost": delivered == 0.0,
    }
    conditions = d.codes("condition", run.conditions)
    rows = []
    for place, condition in enumerate(run.conditions):
        count = {reply: int(which[conditions == place].sum()) for reply, which in by_reply.items()}
        total = sum(count.values())
        rows += [
            {"condition": condition, "reply": reply, "count": n, "share": n / total, "n": total}
            for reply, n in count.items() if n
        ]  # fmt: skip
    return rows


def energies(run: Run) -> Table:
    """What a decision takes in joules, by who takes it, with the total's interval; where all is known."""
    rows = []
    for condition in run.conditions:
        total, helpers, radio = (run.score(condition, n) for n in ("energy_j", "helpers_j", "radio_mj"))
        if total and helpers and radio:
            sent, thought = (radio.value or 0.0) / 1000, helpers.value or 0.0
            joules = ((total.value or 0.0) - thought - sent, thought, sent)
            of_total = {
                "total_j": total.value, "low": total.low, "high": total.high, "n": total.n,
                "interval": total.interval,
            }  # fmt: skip
            rows += [
                {"condition": condition, "part": part, "joules": of_part, **of_total}
                for part, of_part in zip(ENERGIES, joules, strict=True)
            ]
    return rows


def arrivals(run: Run) -> Table:
    """Return when replies that are not lost arrive, in ms from the start of the decision."""
    d = run.decisions
    arrival_ms, conditions = d.of_messages("arrival_ms"), d.codes("condition", run.conditions)
    by_condition = {name: arrival_ms[conditions == place] for place, name in enumerate(run.conditions)}
    return [
        {"condition": condition, **bar}
        for condition, of in by_condition.items()
        if len(known := of[~np.isnan(of)])
        for bar in _histogram(known, ARRIVAL_MS, "arrival_ms")
    ]


def _histogram(values: Sequence[float] | Floats, width: float, name: str) -> Table:
    """Return bars of one width with their lower end, from the first that is not empty to the last."""
    # A value on a bin's edge belongs to the bin above it, whatever rounding makes of the quotient.
    bins = np.floor(np.asarray(values, dtype=float) / width + 1e-9).astype(int)
    first = int(bins.min())
    count = np.bincount(bins - first)
    return [
        {name: round((first + n) * width, 6), "count": int(c), "share": float(c / len(bins))}
        for n, c in enumerate(count)
    ]
