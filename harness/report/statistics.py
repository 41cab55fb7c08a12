"""What the report's charts show, counted from the rows of runs: a table a chart, as plain rows.

Shares are 0 to 1. Where a row has `low` and `high` they are a 95 % interval over episodes.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.statistics import share_interval
from harness.parsing.parse import Status
from harness.report.words import LATENCY, SUCCESS
from harness.runs.folder import Run, answers_of

Table = list[dict[str, Any]]
ENTROPY_NATS, TOKENS, ARRIVAL_MS = 0.1, 25, 10.0  # widths of bins
CERTAINTY = 0.1


@dataclass(frozen=True)
class Decisions:
    """All decisions of a run as arrays (n,).

    Attributes:
        condition: position among the run's conditions.
        episode: its number.
        entropy_nats: of the ego's own intent.
        certainty: the fused probability of the action taken.
        unsafe: 1, 0, or NaN where nobody knows or no action was safe.
    """

    condition: Ints
    episode: Ints
    entropy_nats: Floats
    certainty: Floats
    unsafe: Floats


def decisions(run: Run) -> Decisions:
    """Lay a run's decisions out as arrays."""
    place = {name: n for n, name in enumerate(run.conditions)}
    actions = list(run.config["actions"])
    found: list[tuple[float, ...]] = []
    for row in run.rows:
        judged = any(row.get("safe", ()))
        for d in row["decisions"]:
            found.append((
                place[d["condition"]], row["episode"],
                np.nan if d["entropy_nats"] is None else d["entropy_nats"],
                d["fused"][actions.index(d["action"])],
                float(not d["safe"]) if judged else np.nan,
            ))  # fmt: skip
    columns = np.array(found, dtype=float).reshape(-1, 5).T
    return Decisions(columns[0].astype(int), columns[1].astype(int), *columns[2:])


def success(run: Run) -> Table:
    """Success and latency of each condition, of which both are known."""
    told = []
    for condition in run.conditions:
        latency, rate = run.score(condition, LATENCY), run.score(condition, SUCCESS)
        if latency and rate:
            told.append({
                "condition": condition, "latency_ms": latency.value, "latency_low": latency.low,
                "latency_high": latency.high, "success": rate.value, "low": rate.low, "high": rate.high,
                "n": rate.n, "interval": rate.interval,
            })  # fmt: skip
    return told


def statuses(run: Run) -> Table:
    """How many answers of each role have which status."""
    count = Counter(
        (a["role"], a["status"], a["verdict"]) for row in run.rows for a in answers_of(row).values()
    )
    of: Counter[str] = Counter()
    for (role, _, _), n in count.items():
        of[role] += n
    order = list(map(str, Status))
    return [
        {"role": role, "status": status, "verdict": verdict, "count": n, "share": n / of[role], "n": of[role]}
        for (role, status, verdict), n in sorted(
            count.items(),
            key=lambda item: (item[0][0], order.index(item[0][1]) if item[0][1] in order else -1),
        )
    ]


def reliability(run: Run, found: Decisions) -> Table:
    """How often the action taken was safe, by how probable fusion held it."""
    bins = np.minimum((found.certainty / CERTAINTY).astype(int), round(1 / CERTAINTY) - 1)
    return list(_shares(run, found, bins, found.certainty, 1.0 - found.unsafe, "certainty"))


def errors(run: Run, found: Decisions) -> Table:
    """How often a decision was unsafe, by the entropy of the ego's own intent."""
    bins = np.where(np.isnan(found.entropy_nats), -1, found.entropy_nats / ENTROPY_NATS).astype(int)
    return list(_shares(run, found, bins, found.entropy_nats, found.unsafe, "entropy_nats"))


def _shares(
    run: Run, found: Decisions, bins: Ints, value: Floats, hits: Floats, name: str
) -> Iterator[dict[str, Any]]:
    for n, condition in enumerate(run.conditions):
        for one in np.unique(bins[(found.condition == n) & (bins >= 0)]):
            here = (found.condition == n) & (bins == one) & ~np.isnan(hits)
            if here.any():
                share = share_interval(hits[here], found.episode[here])
                yield {
                    "condition": condition, name: round(float(value[here].mean()), 4), "share": share.value,
                    "low": share.low, "high": share.high, "n": share.n,
                }  # fmt: skip


def entropies(run: Run) -> Table:
    """How uncertain the ego's own answers are."""
    p = [
        a["intent"] for row in run.rows for a in row["answers"].values() if a["role"] == "ego" and a["intent"]
    ]
    if not p:
        return []
    known = np.array(p, dtype=float)
    nats = -np.sum(known * np.log(np.where(known > 0, known, 1.0)), axis=1)
    return _histogram(nats, ENTROPY_NATS, "entropy_nats")


def tokens(run: Run) -> Table:
    """Tokens of prompts by role, where the engine counts them."""
    by_role: dict[str, list[float]] = {}
    for row in run.rows:
        for a in answers_of(row).values():
            if a.get("prompt_tokens") is not None:
                by_role.setdefault(a["role"], []).append(a["prompt_tokens"])
    return [{"role": role, **bar} for role, of in by_role.items() for bar in _histogram(of, TOKENS, "tokens")]


def replies(run: Run) -> Table:
    """What became of the replies that were scheduled."""
    count: Counter[tuple[str, str]] = Counter()
    for row in run.rows:
        for d in row["decisions"]:
            for m in d["messages"]:
                came = "on time" if m["on_time"] else "late" if m["delivered"] else "lost"
                count[d["condition"], came] += 1
    return [
        {"condition": condition, "reply": came, "count": n, "share": n / total, "n": total}
        for condition in run.conditions
        if (total := sum(count[condition, came] for came in ("on time", "late", "lost")))
        for came in ("on time", "late", "lost")
        if (n := count[condition, came])
    ]


def arrivals(run: Run) -> Table:
    """When replies that are not lost arrive, in ms from the start of the decision."""
    by_condition: dict[str, list[float]] = {}
    for row in run.rows:
        for d in row["decisions"]:
            of = by_condition.setdefault(d["condition"], [])
            of += [m["arrival_ms"] for m in d["messages"] if m["arrival_ms"] is not None]
    return [
        {"condition": condition, **bar}
        for condition, of in by_condition.items() if of
        for bar in _histogram(of, ARRIVAL_MS, "arrival_ms")
    ]  # fmt: skip


def _histogram(values: Sequence[float] | Floats, width: float, name: str) -> Table:
    """Bars of one width with their lower end, from the first that is not empty to the last."""
    # A value on a bin's edge belongs to the bin above it, whatever rounding makes of the quotient.
    bins = np.floor(np.asarray(values, dtype=float) / width + 1e-9).astype(int)
    first = int(bins.min())
    count = np.bincount(bins - first)
    return [
        {name: round((first + n) * width, 6), "count": int(c), "share": float(c / len(bins))}
        for n, c in enumerate(count)
    ]
