"""What changed from one run to another: metrics, episodes, answers and settings."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.core.arrays import Floats
from harness.core.paired import SuccessTest, success_test
from harness.core.statistics import Estimate, known_mean, paired_difference
from harness.report.compare import percentiles
from harness.report.compare.pair import Pair, Side
from harness.report.compare.table import MEANS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Difference:
    """One metric in one condition, in its own unit (shares from 0 to 1).

    Attributes:
        metric: its name.
        a: mean of A over the episodes and seeds in which both know it; of a latency percentile, itself.
        b: mean of B over the same.
        change: B - A, paired by episode and seed, with a 95 % interval over episodes: Student's t; of a
            latency percentile, a bootstrap's.
    """

    metric: str
    a: float
    b: float
    change: Estimate


@dataclass(frozen=True)
class Turned:
    """An episode that succeeds in one run and not in the other.

    Attributes:
        episode: its number.
        seeds: in which it does.
        a: how it ends in A: `success`, or how it fails.
        b: how it ends in B.
    """

    episode: int
    seeds: tuple[int, ...]
    a: str
    b: str


@dataclass(frozen=True)
class InCondition:
    """What changed in one condition.

    Attributes:
        condition: its name.
        differences: metrics that both runs know.
        test: of the difference in success; None for a single episode whose success depends on the seed.
        gained: episodes from failure to success.
        lost: episodes from success to failure.
    """

    condition: str
    differences: tuple[Difference, ...]
    test: SuccessTest | None
    gained: tuple[Turned, ...]
    lost: tuple[Turned, ...]


@dataclass(frozen=True)
class AnswersTurned:
    """Answers to the same requests that were read with another verdict.

    Attributes:
        role: of who answered: `ego`, `helper` or `merge`.
        a: verdict in A: `strict`, `recovered` or `failed`.
        b: verdict in B.
        requests: their ids.
    """

    role: str
    a: str
    b: str
    requests: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """B against A.

    Attributes:
        pair: the two runs.
        settings: name, A's value and B's of every setting in which they differ; None where one has none.
        conditions: what changed in each.
        answers: which answers changed their verdict.
        answers_in_both: answers by role that both runs have.
    """

    pair: Pair
    settings: tuple[tuple[str, str | None, str | None], ...]
    conditions: tuple[InCondition, ...]
    answers: tuple[AnswersTurned, ...]
    answers_in_both: dict[str, int]


def compare(pair: Pair) -> Comparison:
    """Hold B against A."""
    a, b = pair.a.answers, pair.b.answers
    both = [request for request in a if request in b]
    turned: dict[tuple[str, str, str], list[str]] = {}
    for request in both:
        (role, before), (_, after) = a[request], b[request]
        if before != after:
            turned.setdefault((role, before, after), []).append(request)
    return Comparison(
        pair=pair,
        settings=tuple(_settings(pair)),
        conditions=tuple(_in_condition(pair, name) for name in pair.conditions),
        answers=tuple(AnswersTurned(*how, tuple(ids)) for how, ids in sorted(turned.items())),
        answers_in_both=dict(Counter(a[request][0] for request in both)),
    )


def _settings(pair: Pair) -> Iterator[tuple[str, str | None, str | None]]:
    a, b = pair.a.settings, pair.b.settings
    left_out = tuple(
        f"condition.{name}." for side in (pair.a, pair.b) for name in side.run.conditions
        if name not in pair.conditions
    )  # fmt: skip
    for name in {**a, **b}:
        # A description changes nothing, and how often a time was measured is no setting.
        if a.get(name) != b.get(name) and not name.startswith(("model.description", "latency.n.", *left_out)):
            yield name, a.get(name), b.get(name)


def _in_condition(pair: Pair, condition: str) -> InCondition:
    a, b = (_of(side.table, condition, pair) for side in (pair.a, pair.b))
    differences = [_difference(name, _laid(a[name], pair), _laid(b[name], pair)) for name in MEANS]
    differences += [
        Difference(f"latency_p{percent}_ms", before, after, change)
        for percent, before, after, change in percentiles.differences(
            _decided(pair.a, condition, pair), _decided(pair.b, condition, pair), len(pair.episodes)
        )
    ]
    return InCondition(
        condition=condition,
        differences=tuple(d for d in differences if d.change.n),
        test=success_test(_laid(a["success_rate"], pair), _laid(b["success_rate"], pair)),
        gained=tuple(_turned(a, b, (a.end != "success") & (b.end == "success"))),
        lost=tuple(_turned(a, b, (a.end == "success") & (b.end != "success"))),
    )


def _of(table: "pd.DataFrame", condition: str, pair: Pair) -> "pd.DataFrame":
    """One condition's rows, by seed and episode, in the same order in both runs."""
    import pandas as pd

    rows = pd.MultiIndex.from_product([pair.seeds, pair.episodes], names=["seed", "episode"])
    there = table.index.get_level_values("condition") == condition
    return table[there].droplevel("condition").reindex(rows)


def _decided(side: Side, condition: str, pair: Pair) -> list[percentiles.Decided]:
    """Each seed's latencies, with the places of their episodes."""
    index = side.latency_ms.index
    there = (index.get_level_values("condition") == condition) & index.get_level_values("episode").isin(
        pair.episodes
    )
    found = side.latency_ms[there]
    place = np.searchsorted(pair.episodes, found.index.get_level_values("episode")).astype(np.int64)
    seed, value = np.asarray(found.index.get_level_values("seed")), np.asarray(found, dtype=np.float64)
    return [(place[seed == s], value[seed == s]) for s in pair.seeds]


def _laid(column: "pd.Series[float]", pair: Pair) -> Floats:
    """(E, S) from seeds and, in each, episodes."""
    return np.asarray(column, dtype=float).reshape(len(pair.seeds), len(pair.episodes)).T


def _difference(metric: str, a: Floats, b: Floats) -> Difference:
    unknown = np.isnan(a) | np.isnan(b)
    before, after = (float(known_mean(known_mean(np.where(unknown, np.nan, x), 1), 0)) for x in (a, b))
    return Difference(metric, before, after, paired_difference(b, a))


def _turned(a: "pd.DataFrame", b: "pd.DataFrame", which: "pd.Series[bool]") -> Iterator[Turned]:
    ends = a[["end"]].join(b[["end"]], lsuffix="_a", rsuffix="_b")[which].reset_index()
    for _, rows in ends.groupby(["episode", "end_a", "end_b"]):
        first = rows.iloc[0]
        yield Turned(int(first.episode), tuple(map(int, rows.seed)), str(first.end_a), str(first.end_b))
