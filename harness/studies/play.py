"""Play a source of intents at every point of a panel, and sum up with intervals."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Floats, Ints
from harness.core.plugins import Shipped
from harness.core.quantiles import student_quantile
from harness.core.statistics import Estimate, known_mean, seed_interval
from harness.evaluate.table import columns
from harness.evaluate.walk import Ask, Decided, World, walk
from harness.runs.decisions import DECIMALS
from harness.runs.estimates import halved, in_range, over_episodes, over_seeds
from harness.runs.headline import BALANCED
from harness.runs.metric_values import known_in, of_decisions
from harness.runs.metrics import METRICS
from harness.runs.percentiles import PERCENTILES, percentiles
from harness.studies.axes import Setting

if TYPE_CHECKING:
    import pandas as pd

FIRST = ("source", "panel", "condition", "variable", "value")
EPISODE_COLUMNS = {
    "success": "success_rate",
    "trigger_rate": "trigger_rate",
    "latency_ms": "latency_proxy_ms",
    "messages": "messages_per_episode",
    "effective_loss": "effective_loss",
}
ENDS = ("success_rate", "unsafe_rate", "late_rate")
PER_DECISION = (
    "latency_proxy_ms",
    "deadline_miss_rate",
    "trigger_rate",
    "messages_per_episode",
    "bits_per_episode",
    "effective_loss",
    "observed_reply_loss",
)
COLUMNS = (
    "latency_ms",
    "deadline_missed",
    "triggered",
    "messages",
    "request_bits",
    "reply_bits",
    "unasked_bits",
    "effective_loss",
    "observed_loss",
)
Read = Callable[[Decided[Any]], dict[str, Floats]]  # columns of decisions, (n, ...)
Rows = Sequence[Mapping[str, Any]]  # of a summary


@dataclass(frozen=True)
class WalkResult:
    """Hold the results of one operating point for S channel seeds and E of the episodes.

    An operating point is everything a decision depends on besides scene and model. `episodes` (E,)
    has the episodes' numbers, and `ends` (S, E) how they end, such as success, by metric; NaN where
    one was left out. The n decisions are those of all these episodes: `columns` has their values by
    name, (n, ...), and `places` (n,) the index of each decision's episode in the flattened (S, E).
    """

    episodes: Ints  # their numbers, (E,)
    # how each episode ended, by metric: 1 or 0 for each of `ENDS`, such as success, and for success
    # with and without a danger where that is known, (S, E); NaN where an episode was left out
    ends: Mapping[str, Floats]
    # values of n decisions, by name of what was read of each, such as `latency_ms`, (n, ...)
    columns: Mapping[str, Floats]
    places: Ints  # index of each decision's episode in the flattened (S, E) array, row by row, (n,)


@runtime_checkable
class Source(Protocol):
    """Describe where a study's intents come from: a finished run, or what an extension draws.

    An intent is a vehicle's probabilities of the ego's actions. `name` is the source's in tables,
    `episodes` the number of episodes for a channel seed, and `same_episodes` whether all seeds have
    the same ones.
    """

    name: str  # what figures call it
    episodes: int  # how many episodes it plays with each channel seed
    same_episodes: bool  # whether every seed plays the same episodes

    def manifest(self) -> dict[str, Any]:
        """Return where the intents come from, as plain values for the study's manifest.

        An intent is a vehicle's probabilities of actions.
        """
        ...

    def walked(
        self, settings: Sequence[Setting], seeds: Sequence[int]
    ) -> Iterator[Iterable[WalkResult]]:
        """Yield the results at each point of a sweep's grid, in parts of some episodes each.

        `settings` are these points: an operating point (set of settings) with a number of vehicles,
        those nearest to the ego. `seeds` are those of the radio channel, and all points have the
        same draws of it. A point's parts must be consumed before the next point.
        """
        ...


SOURCES = Shipped[Source]("swarmdrive.sources", Source, {})  # of none but extensions that ship


def metric_columns(part: Decided[Any]) -> dict[str, Floats]:
    """Return what a study's metrics need of n decisions, as columns by name, (n,) each.

    The names are `COLUMNS`, such as `latency_ms` and `messages`. `part` is the decisions of some
    episodes under one set of settings.
    """
    every = columns(part)
    return {name: every[name] for name in COLUMNS}


def walk_through(
    world: World[Any],
    points: Sequence[OperatingPoint],
    ask: Ask[Any],
    seeds: Sequence[int],
    episodes: Ints,
    ties: str,
    read: Read = metric_columns,
) -> Iterator[tuple[dict[str, Floats], Ints]]:
    """Play a world under several sets of settings; yield for each what n decisions came to.

    An item is the columns of the n decisions by name, (n, ...), and the episode of each, (n,): an
    index into the (S, E) episodes of all seeds, counted row by row.

    Args:
        world: where decisions come from and lead to, such as recorded scenes.
        points: the operating points: all that a decision depends on besides scene and model.
        ask: returns what vehicles intend in scenes: their probabilities of actions.
        seeds: S seeds of the radio channel's random draws.
        episodes: numbers of the E episodes, ascending, (E,).
        ties: which of equally likely actions is taken, `drawn` or `first`.
        read: returns columns of n decisions, (n,), or (n, H) for H messages; they are rounded, and
            NaN where a step has fewer helpers.
    """
    parts: dict[OperatingPoint, list[dict[str, Floats]]] = {point: [] for point in points}
    places: dict[OperatingPoint, list[Ints]] = {point: [] for point in points}
    ascending = np.argsort(seeds)
    for decided in walk(world, points, ask, ties):
        for part in decided:
            parts[part.point].append(read(part))
            row = ascending[np.searchsorted(seeds, part.due.seed, "right", sorter=ascending) - 1]
            place = row * len(episodes) + np.searchsorted(episodes, part.due.episode)
            places[part.point].append(place)
    for point, steps in parts.items():
        whole = {}
        for column in steps[0]:
            values = _below([step[column] for step in steps])
            decimals = DECIMALS.get(column)
            whole[column] = values if decimals is None else values.round(decimals)
        yield whole, np.concatenate(places[point])


def _below(arrays: Sequence[Floats]) -> Floats:
    """Return arrays (n,) or (n, H) one below the other, NaN where one has fewer columns."""
    if arrays[0].ndim == 1:
        return np.concatenate(arrays)
    wide = max(array.shape[1] for array in arrays)
    padded = []
    for array in arrays:
        missing = ((0, 0), (0, wide - array.shape[1]))
        padded.append(np.pad(array, missing, constant_values=np.nan))
    return np.concatenate(padded)


@dataclass(frozen=True)
class PanelResult:
    """Hold the results of one source at the grid points of a panel, as pandas tables.

    A source is such as a run, and a panel a named set of grid points, operating points with a
    number of vehicles. `summary` has a row for each grid point, metric and kind of interval, with
    `mean`, `ci_low`, `ci_high` and `n`; `episodes` one for each grid point, seed and episode.
    """

    # a row a grid point, metric and interval: `source`, `panel`, the columns of `Setting.place`,
    # `metric`, `mean`, `ci_low`, `ci_high`, `n`, `interval`
    summary: "pd.DataFrame"
    episodes: "pd.DataFrame"  # a row a grid point, seed and episode


def play(
    source: Source,
    panel: str,
    settings: Sequence[Setting],
    seeds: Sequence[int],
    progress: Callable[[int], None],
    tell: Callable[[Rows], object] = lambda rows: None,
) -> PanelResult:
    """Score a source of answers at every point of a grid, with every channel seed.

    A source is such as a run, and each of `settings` a point: an operating point (set of settings)
    with a number of vehicles. The same seed gives the same random draws of the radio channel at all
    of them. `panel` is the name of this set of points in tables; `progress` is called with 1 after
    each, and `tell` with the rows of its summary. Returns tables of means and of episodes.
    """
    rows, places, episodes = list[dict[str, Any]](), list[dict[str, Any]](), list[dict[str, Any]]()
    for setting, walks in zip(settings, source.walked(settings, seeds), strict=True):
        parts = [_part(walk, len(seeds)) for walk in walks]
        metrics = {}
        for name in parts[0].metrics:
            metrics[name] = np.hstack([part.metrics[name] for part in parts])
        by_seed = []
        for n in range(len(seeds)):
            of_seed = np.concatenate([part.latency_ms[n] for part in parts])
            by_seed.append(percentiles(of_seed))
        latency_ms = np.array(by_seed)
        # Where axes are crossed, the columns of each come last.
        place = {"source": source.name, "panel": panel, **setting.place}
        first = {name: place.pop(name) for name in FIRST}
        places.append({**first, **place})
        first_row = len(rows)
        for metric, estimate, interval in _estimates(source, metrics, latency_ms):
            row = {
                **first,
                "metric": metric,
                "mean": estimate.value,
                "ci_low": estimate.low,
                "ci_high": estimate.high,
                "n": estimate.n,
                "interval": interval,
                **place,
            }
            rows.append(row)
        numbers = np.concatenate([part.episodes for part in parts])
        played = {
            "seed": np.repeat(seeds, len(numbers)),
            "episode": np.tile(numbers, len(seeds)),
            **{name: metrics[metric].ravel() for name, metric in EPISODE_COLUMNS.items()},
        }
        is_known = ~np.isnan(played["success"])
        episodes.append({name: values[is_known] for name, values in played.items()})
        tell(rows[first_row:])
        progress(1)
    import pandas as pd  # after what people wait for

    # One frame of all points, since one of each takes longer than to play it.
    counts = [len(played["episode"]) for played in episodes]
    whole = pd.DataFrame(places).loc[np.repeat(np.arange(len(counts)), counts)]
    for n, name in enumerate(episodes[0], len(FIRST)):
        whole.insert(n, name, np.concatenate([played[name] for played in episodes]))
    whole = whole.reset_index(drop=True).astype({"success": bool, "messages": int})
    return PanelResult(pd.DataFrame(rows), whole.round({"latency_ms": 3, "effective_loss": 6}))


class _Part(NamedTuple):
    """Some episodes: their numbers (E,), metrics (S, E), and each seed's latencies (n,)."""

    episodes: Ints
    metrics: Mapping[str, Floats]
    latency_ms: Sequence[Floats]


def _part(walked: WalkResult, seeds: int) -> _Part:
    n = len(walked.episodes)
    seed, latency_ms = walked.places // n, walked.columns["latency_ms"]
    metrics = {**walked.ends, **by_episode(walked, PER_DECISION)}
    return _Part(walked.episodes, metrics, [latency_ms[seed == place] for place in range(seeds)])


def by_episode(walked: WalkResult, names: Sequence[str]) -> dict[str, Floats]:
    """Return a study's metrics of decisions, averaged over each episode, by name, (S, E) each.

    `walked` has the decisions of S seeds of the channel's draws and E episodes; `names` are those
    of the metrics. A value is NaN where an episode was left out.
    """
    success = walked.ends["success_rate"]

    def metric(name: str) -> Floats:
        values = of_decisions(METRICS[name], walked.columns, walked.places, success.size)
        return np.where(np.isnan(success), np.nan, values.reshape(success.shape))

    return {name: metric(name) for name in names}


def _estimates(
    source: Source, metrics: Mapping[str, Floats], latency_ms: Floats
) -> Iterator[tuple[str, Estimate, str]]:
    over = over_seeds if source.same_episodes else over_own_episodes
    clusters: Ints | None = getattr(source, "clusters", None)  # sources of packages may lack it
    names = known_in(metrics)
    for name in (*metrics, BALANCED):
        if name not in names:
            continue
        yield name, halved(name, lambda each: over(each, metrics[each]), shared=True), "seed means"
        if source.same_episodes:
            estimate = halved(
                name,
                lambda each: over_episodes(each, metrics[each], clusters),
                clusters=clusters,
            )
            yield name, estimate, "episodes"
    for percent, values in zip(PERCENTILES, latency_ms.T, strict=True):
        yield f"latency_p{percent}_ms", seed_interval(values), "seed means"


def over_own_episodes(name: str, values: Floats) -> Estimate:
    """Return a metric's mean with an interval over seeds that have different episodes.

    `values` are (S, E), over S seeds and the E episodes of each; `name` is the metric's. The
    interval is Student's t over the means of seeds. Episodes that are drawn in fixed shares make
    these means too alike, down to the rounding of the shares; so the means of a yes or no count as
    having a standard deviation of at least half an episode.
    """
    estimate = seed_interval(known_mean(values, axis=1))
    if name not in ENDS or estimate.n < 2:
        return in_range(name, estimate)
    quantile = student_quantile(estimate.n - 1, 0.975)
    least = quantile * 0.5 / values.shape[1] / math.sqrt(estimate.n)
    half = float(np.fmax(estimate.high - estimate.value, least))  # no interval where all agree
    return in_range(name, replace(estimate, low=estimate.value - half, high=estimate.value + half))


def joined(parts: Sequence[PanelResult]) -> PanelResult:
    """Put the tables of several sources and panels together, one after another.

    A source is such as a run, and a panel a named set of settings that a sweep scores.
    """
    import pandas as pd

    summary = pd.concat([part.summary for part in parts], ignore_index=True)
    episodes = pd.concat([part.episodes for part in parts], ignore_index=True)
    return PanelResult(summary, episodes)
