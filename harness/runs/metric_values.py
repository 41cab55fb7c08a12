"""The values of metrics by episode, from decisions and from how episodes ended."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.core.arrays import MOST, Bools, Floats, Ints
from harness.core.errors import one_line, printable
from harness.core.plugins import say_once
from harness.core.strangers import aside
from harness.runs.decisions import Decisions
from harness.runs.grid import Grid
from harness.runs.headline import BALANCED
from harness.runs.metric import Columns, Metric
from harness.runs.metrics import METRICS, entry
from harness.runs.places import mean_by_place, sum_by_place
from harness.runs.records import Episode


def by_episode(
    metrics: Sequence[Metric], grid: Grid, decisions: Decisions, episodes: Sequence[Episode]
) -> dict[str, Floats]:
    """Return the value of each metric in each episode, by the metric's name, (C, S, E).

    The axes are those of the grid: C conditions, S channel seeds and E episodes; `episodes`, a
    record of how each ended, are in that order. `decisions` are those of all episodes. NaN where
    unknown.
    """
    places = grid.places(decisions)

    def values(metric: Metric) -> Floats:
        if metric.episodes:
            return of_ends(metric, grid, episodes)
        return of_decisions(metric, decisions, places, len(episodes)).reshape(grid.shape)

    return {metric.name: values(metric) for metric in metrics}


def of_ends(metric: Metric, grid: Grid, episodes: Sequence[Episode]) -> Floats:
    """Return a metric's value in each episode from how the episodes ended, (C, S, E).

    NaN where unknown. The axes are those of the grid: C conditions, S seeds of the channel's random
    draws and E episodes; `episodes`, a record of each, are in that order.
    """
    function = metric.episodes
    assert function

    def values() -> Floats:
        numbers = [function(episode) for episode in episodes]
        return np.array([np.nan if v is None else float(v) for v in numbers])

    return _values(metric, values, len(episodes)).reshape(grid.shape)


def of_decisions(metric: Metric, decisions: Columns, places: Ints, n: int) -> Floats:
    """Return a metric's value for each of n episodes, (n,), from their m decisions; NaN if unknown.

    `places`, (m,), is the index from 0 to n - 1 of each decision's episode.
    """
    function = metric.decisions
    assert function
    pieces = decisions.pieces() if isinstance(decisions, Decisions) else [decisions]

    def of_pieces() -> Floats:
        of_each = [_floats(function(piece)) for piece in pieces]
        return of_each[0] if len(of_each) == 1 else np.concatenate(of_each)

    values = _values(metric, of_pieces, len(places))
    if not metric.total:
        return mean_by_place(values, places, n)
    unknown = sum_by_place(np.isnan(values), places, n)
    return np.where(unknown > 0, np.nan, sum_by_place(values, places, n))


def _values(metric: Metric, values: Callable[[], Floats], n: int) -> Floats:
    """Return a metric's values, (n,). Those of a package that fails are unknown,
    and a line says so.
    """
    if metric is METRICS.of_harness.get(metric.name):
        return values()
    what = f"metric {printable(metric.name)} of a package"
    try:
        with aside(what):
            numbers = values()
        if numbers.shape != (n,):
            raise ValueError(f"it has values of shape {numbers.shape}, not ({n},)")
        most = min(metric.most, MOST)
        if not ((numbers >= 0) & (numbers <= most) | np.isnan(numbers)).all():
            raise ValueError(f"it has values beyond 0 to {most:g}")
    except Exception as error:  # a stranger's code
        reason = one_line(error).removeprefix(f"{what} ") or type(error).__name__
        # though figures are computed part by part
        say_once(f"{what}: {reason}; its figure is unknown")
        return np.full(n, np.nan)
    return numbers


def _floats(values: Any) -> Floats:
    """Return a metric's values as floats, (n,). Raises ValueError for complex numbers."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        raise ValueError(f"it has values of type {array.dtype}, not numbers")
    return array.astype(float)


def by_danger(success: Floats, dangerous: Bools) -> dict[str, Floats]:
    """Return success with a danger, and success without, by the metrics' names, (..., E) each.

    `success` is (..., E), 1 or 0, of E episodes; `dangerous` is a mask (E,) of those with a danger.
    NaN in the episodes of the other kind.
    """
    parts = (np.where(part, success, np.nan) for part in (dangerous, ~dangerous))
    return dict(zip(entry(BALANCED).halves, parts, strict=True))


def known_in(values: Mapping[str, Floats]) -> list[str]:
    """Return the names of the metrics that a run with these values states, in order.

    `values` has each metric's values by episode. Metrics of one half (with or without a danger) are
    stated only if there are episodes of both.
    """
    names = {name for name, v in values.items() if not (entry(name).optional and np.isnan(v).all())}
    both = names.issuperset(entry(BALANCED).halves)
    return [
        m.name
        for m in METRICS.values()
        if (m.name in names or m.halves) and (both or not (m.half or m.halves))
    ]
