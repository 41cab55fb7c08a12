"""Tabulate decisions: one row for each decision point, condition and seed."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.coordination.streams import Sent
from harness.core.arrays import Ints, any_of
from harness.dataset.load import Scene
from harness.evaluate.agreement import broken_words
from harness.evaluate.walk import Decided
from harness.radio import wrapped
from harness.runs.decisions import Decisions, Labels, by_action, by_message


@lru_cache(maxsize=1 << 10)
def busy_ratio(point: OperatingPoint) -> float:
    """Return the share of time, 0 to 1, that a condition's channel is busy with others' packets.

    `point` is the condition, its settings of the radio, of asking helpers and of fusing their
    messages. NaN if the channel model does not know it.
    """
    return wrapped.busy_ratio(point.physical) if point.physical else float("nan")


def columns(decided: Decided[Any]) -> dict[str, Any]:
    """Return what n decisions under one condition came to, as numeric columns of a table.

    `decided` has the decisions, with their exchange of messages and results. Arrays are `(n,)`, by
    column name, such as `messages`, `triggered`, `entropy_nats` and `latency_ms`; NaN where
    unknown.
    """
    c, point = decided.result, decided.point
    anybody, unknown = any_of(c.on_time), np.full(c.messages.shape, np.nan)
    streamed = decided.streamed or Sent(unknown, unknown, unknown)
    streamed_s = decided.streamed.airtime_s if decided.streamed else 0.0
    return {
        "messages": c.messages,
        "requests": c.requests,
        "request_bits": c.request_bits,
        "reply_bits": c.reply_bits,
        "unasked": streamed.messages,
        "unasked_bits": streamed.bits,
        "airtime_ms": (c.airtime_s + streamed_s) * 1000,
        "unasked_ms": streamed.airtime_s * 1000,
        "triggered": c.triggered,
        "busy_ratio": np.full(c.messages.shape, busy_ratio(point)),
        "own_failed": c.own_failed,
        "entropy_nats": c.entropy_nats,
        "normalised_entropy": c.normalised_entropy,
        "own_weight": c.weights[..., 0],
        "latency_ms": c.latency_s * 1000,
        "deadline_missed": np.where(np.isnan(c.latency_s), np.nan, c.deadline_missed),
        "fusion_ms": c.fusion_s * 1000,
        "fusion_failed": np.where(anybody & point.has_fusion_call, c.fusion_failed, np.nan),
        "effective_loss": np.where(c.triggered, c.loss, np.nan),
        "observed_loss": c.observed_loss,
    }


def table(
    decided: Sequence[Decided[Scene]], more: Mapping[str, Any], actions: Sequence[str]
) -> Decisions:
    """Return the table of decisions, sorted by episode, step, scene, condition and seed.

    There is a row for each. `decided` has n decisions in parts of one condition each, in any order;
    `more` has further columns by name, `(n,)`, in that order. `actions` are the names of the
    meta-actions, in order. A condition is a named set of settings of the radio, of asking helpers
    and of fusing their messages.
    """
    points_by_id = {id(part.decision_points): part.decision_points for part in decided}
    lengths = [len(decision_points) for decision_points in points_by_id.values()]
    starts = np.cumsum([0, *lengths]).tolist()
    start = dict(zip(points_by_id, starts, strict=False))
    scenes = [scene for decision_points in points_by_id.values() for scene in decision_points]
    vehicles = max(len(scene.viewers) for scene in scenes) - 1
    helpers = max(vehicles, *(part.said.attackers.shape[1] for part in decided))
    at = np.concatenate([start[id(part.decision_points)] + part.due.at for part in decided])
    n_each = [len(part.due.at) for part in decided]
    points = list(dict.fromkeys(part.point.name for part in decided))
    point = np.repeat([points.index(part.point.name) for part in decided], n_each)

    def of_scenes(values: Iterable[Any]) -> Any:
        return np.array(list(values))[at]

    def widened(arrays: Iterable[Any]) -> Any:
        return np.concatenate(
            [np.pad(array, ((0, 0), (0, helpers - array.shape[1]))) for array in arrays]
        )

    def of_messages(name: str) -> Any:
        return widened(getattr(part.result, name) for part in decided)

    numbers = [columns(part) for part in decided]
    is_asked, arrival_s = of_messages("asked"), of_messages("arrival_s")
    sent = {
        "delivered": of_messages("delivered"),
        "on_time": of_messages("on_time"),
        "arrival_ms": np.where(np.isfinite(arrival_s), arrival_s * 1000, np.nan),
        "weight": widened([part.result.weights[:, 1:] for part in decided]),
        "trust": of_messages("trust"),
        "attacker": widened([part.said.attackers for part in decided]),
    }
    # an attacker may have several voices
    voices = [f"voice-{n + 1}" for n in range(helpers - vehicles)]
    senders: list[list[str | None]] = []
    for scene in scenes:
        absent = [None] * (vehicles + 1 - len(scene.viewers))
        senders.append([*scene.viewers[1:], *absent, *voices])
    of_messages_by_column: dict[str, Any] = {}
    for name, messages in sent.items():
        of_messages_by_column |= by_message(name, np.where(is_asked, messages, np.nan))
    episode = of_scenes(scene.record.episode for scene in scenes)
    step = of_scenes(scene.record.step for scene in scenes)
    ids = [scene.id for scene in scenes]
    rank = np.unique(ids, return_inverse=True)[1]
    order = np.lexsort((point, rank[at], step, episode))
    joined: dict[str, Any] = {}
    for name in numbers[0]:
        joined[name] = np.concatenate([part[name] for part in numbers])
    values = {
        **joined,
        **by_action("fused", np.concatenate([part.result.fused for part in decided]), actions),
        "broke_word": np.concatenate([broken_words(part) for part in decided]),
        **more,
        **of_messages_by_column,
        "seed": np.concatenate([part.due.seed for part in decided]),
        "episode": episode,
        "step": step,
    }
    labels = {
        "scene": _labels(ids, at),
        "danger": _labels([s.record.danger.sector for s in scenes], at),
        "condition": Labels(point, points),
        "agent": _labels([s.viewers[0] if s.several else None for s in scenes], at),
        "action": Labels(np.concatenate([part.result.action for part in decided]), actions),
    }
    for h in range(helpers):
        labels[f"helper_{h + 1}"] = _labels([row[h] for row in senders], at, is_asked[:, h])
    return Decisions.of({**values, **labels}, actions, helpers).take(order)


def packed(decisions: Decisions, layouts: Sequence[Sequence[int]]) -> Decisions:
    """Return decisions that are sorted by episode, packed, in groups that can be read apart.

    `layouts` are the numbers of each group's episodes, ascending.
    """
    groups = (decisions.take(rows) for rows in _rows(decisions, layouts))
    return Decisions.packed(groups, [decisions], least=1)


def of_all_seeds(
    tables: Sequence[Decisions],
    points: Sequence[OperatingPoint],
    layouts: Sequence[Sequence[int]],
) -> Decisions:
    """Return one table of several, which have the same episodes under different channel seeds.

    Rows are sorted by episode, step, decision point, condition and seed; `points` are the
    conditions, in the order of the rows. A condition is a named set of settings of the radio, of
    asking helpers and of fusing their messages. Several tables come `packed`, and so does the
    result: the episodes of each of `layouts` are in memory together.
    """
    if len(tables) == 1:
        return tables[0]
    rows_by_table = [_rows(table, layouts) for table in tables]

    def merged() -> Iterator[Decisions]:
        for rows_of_group in zip(*rows_by_table, strict=True):
            pairs = zip(tables, rows_of_group, strict=True)
            yield _merged([table.take(rows) for table, rows in pairs], points)

    return Decisions.packed(merged(), tables)


def _rows(decisions: Decisions, layouts: Sequence[Sequence[int]]) -> list[range]:
    """Return which rows are of each group of episodes."""
    firsts = [numbers[0] for numbers in layouts[1:]]
    ends = np.searchsorted(decisions.whole("episode"), firsts).tolist()
    return [range(*pair) for pair in pairwise([0, *ends, len(decisions)])]


def _merged(parts: Sequence[Decisions], points: Sequence[OperatingPoint]) -> Decisions:
    whole = Decisions.concat(parts)
    ids = sorted(set().union(*(part.scenes for part in parts)))
    condition = whole.codes("condition", [point.name for point in points])
    order = np.lexsort(
        (condition, whole.codes("scene", ids), whole.whole("step"), whole.whole("episode"))
    )
    return whole.take(order)


def _labels(of_scenes: Sequence[str | None], at: Ints, mask: Any = True) -> Labels:
    names = list(dict.fromkeys(label for label in of_scenes if label is not None))
    code: dict[str | None, int] = {None: -1, **{name: place for place, name in enumerate(names)}}
    return Labels(np.where(mask, np.array([code[label] for label in of_scenes])[at], -1), names)
