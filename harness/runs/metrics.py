"""The registry of metrics: each one's meaning, and its values from decisions or episodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from harness.core import multiplicity
from harness.core.arrays import Floats, Ints
from harness.core.statistics import (
    Estimate,
    brier,
    episode_interval,
    known_mean,
    negative_log_likelihood,
    rate_difference,
    rate_interval,
    safe_target,
    seed_interval,
    seed_rate_interval,
)
from harness.runs.decisions import Decisions
from harness.runs.records import Episode

World = Literal["frozen", "closed-loop"]
SUCCESS, LATENCY = "success_rate", "latency_proxy_ms"
GAIN = "success_gain_over_"  # followed by the name of the other condition
PERCENTILES = (50, 95, 99)
ALL = "all"  # the condition of a figure that is the same in all of them


class Columns(Protocol):
    """The numeric columns (n,) of a table of decisions, by name; NaN where unknown."""

    def __getitem__(self, name: str, /) -> Floats: ...


@dataclass(frozen=True)
class Metric:
    """One metric.

    Attributes:
        name: its name in tables, with the unit at the end.
        meaning: its meaning, in words for people.
        decisions: returns its values for decisions (n,), whose mean is the episode's; None for a metric of
            episodes.
        episodes: returns an episode's value; None for a metric of decisions.
        total: whether an episode has the sum over its decisions instead of the mean.
        world: the world in which it is known; None for every world.
        optional: whether a run in which it is nowhere known has no row of it.
    """

    name: str
    meaning: str
    decisions: Callable[[Any], Floats] | None = None
    episodes: Callable[[Episode], Any] | None = None
    total: bool = False
    world: World | None = None
    optional: bool = False


def _rate(name: str, meaning: str, happened: Callable[[Episode], bool]) -> Metric:
    return Metric(name, meaning, episodes=happened)


def _fails(*failures: str) -> Callable[[Episode], bool]:
    return lambda e: e.failure in failures


def _field(name: str) -> Callable[[Episode], Any]:
    return lambda e: getattr(e, name)


def _column(name: str) -> Callable[[Columns], Floats]:
    return lambda d: d[name]


METRICS = {
    metric.name: metric
    for metric in (
        _rate(SUCCESS, "share of episodes in which the ego clears the intersection within the allowed time",
              _field("success")),
        _rate("unsafe_rate", "share of episodes that end in a collision, by time-out or off the road",
              lambda e: not e.success and e.failure != "late"),
        _rate("collision_rate", "share of episodes that end in a collision", _fails("collision")),
        _rate("at_fault_rate", "share of episodes that end in a collision in which the ego had to give way",
              lambda e: e.fault == "ego"),
        _rate("late_rate", "share of episodes that the ego clears, but too long after the full-view driver",
              _fails("late")),
        _rate("time_out_rate", "share of episodes in which time runs out before the ego clears the "
              "intersection",
              _fails("time_out")),
        _rate("off_road_rate", "share of episodes in which the ego leaves the road", _fails("off_road")),
        Metric("regret_rate", "share of decisions that gave success away, of those in which it was still "
               "possible",
               _column("regret"), world="frozen"),
        Metric("delay_s", "time that a safe decision adds to the earliest possible success",
               _column("delay_s"), world="frozen"),
        Metric("off_lag_rate", "share of decisions so fast or slow that they would act in another frame "
               "than the dataset assumes",
               _column("off_lag"), world="frozen"),
        Metric("time_to_clear_s", "time until the ego has cleared the intersection; only episodes in which "
               "it does, late or not",
               episodes=lambda e: e.time_s if e.failure in ("", "late") else None),
        Metric("least_gap_m", "smallest distance to another vehicle's outline; 0 in a collision",
               episodes=_field("least_gap_m")),
        Metric("hard_brakings_per_episode", "number of times that the ego begins to brake harder than 4 m/s²",
               episodes=_field("hard_brakings")),
        Metric("other_crashes_per_episode", "number of vehicles that crash without the ego",
               episodes=_field("other_crashes")),
        Metric("decisions_per_episode", "number of decisions begun", episodes=_field("decisions")),
        Metric("skipped_per_episode", "number of decisions not begun because the one before was still open",
               episodes=_field("skipped"), world="closed-loop"),
        Metric("never_acted_per_episode", "number of decisions that were not ready when the episode ended",
               episodes=_field("never_acted"), world="closed-loop"),
        Metric("messages_per_episode", "number of scheduled replies; requests do not count",
               _column("messages"),
               total=True),
        Metric("requests_per_episode", "number of broadcast requests; one request asks several helpers",
               _column("requests"), total=True),
        Metric("bits_per_episode", "bits of all requests and scheduled replies",
               lambda d: d["request_bits"] + d["reply_bits"], total=True),
        Metric("airtime_ms", "total time on air of an episode's requests and scheduled replies",
               _column("airtime_ms"), total=True),
        Metric("busy_ratio", "share of the time that the radio's channel is busy with background traffic",
               _column("busy_ratio"), optional=True),
        Metric("energy_j", "energy of a decision: inference of the ego, of the helpers that infer and of a "
               "fusion call, and their radios; known only with a device profile",
               lambda d: d["inference_j"] + d["radio_mj"] / 1000, optional=True),
        Metric("helpers_j", "energy of a decision: the part of the helpers' inference", _column("helpers_j"),
               optional=True),
        Metric("radio_mj", "energy of a decision: the part of the radios",
               _column("radio_mj"), optional=True),
        Metric("waiting_j", "energy that the ego's computer draws while it waits for messages; not part of "
               "energy_j",
               _column("waiting_j"), optional=True),
        Metric(LATENCY, "time from the start of a decision to the end of the exchange and of fusion, with "
               "all inference", _column("latency_ms")),
        Metric("deadline_miss_rate", "share of decisions that took longer than the decision window",
               _column("deadline_missed")),
        Metric("trigger_rate", "share of decisions in which the ego asked helpers", _column("triggered")),
        Metric("effective_loss", "packet loss: probability that one transmission was lost",
               _column("effective_loss")),
        Metric("observed_reply_loss", "share of scheduled replies that did not arrive; the request or the "
               "reply was lost", _column("observed_loss")),
        Metric("entropy_nats", "entropy of the ego's own intent", _column("entropy_nats")),
        Metric("normalised_entropy", "entropy of the ego's own intent from 0 (sure) to 1 (undecided)",
               _column("normalised_entropy")),
        Metric("brier", "Brier score of the fused policy against the safe actions; 0 best, 2 worst",
               lambda d: brier(d.of_actions("fused"), safe_target(d.of_actions("safe") == 1.0)),
               world="frozen"),
        Metric("negative_log_likelihood", "negative log-likelihood of the safe actions in the fused policy; "
               "0 best",
               lambda d: negative_log_likelihood(d.of_actions("fused"), d.of_actions("safe") == 1.0),
               world="frozen"),
        Metric("fallback_rate", "share of decisions in which the ego's own answer could not be read",
               _column("own_failed")),
        Metric("fusion_ms", "part of the latency that fusion takes: 0 for a rule, which is arithmetic; "
               "ego-prompt calls the model again", _column("fusion_ms")),
        Metric("merge_failed_rate", "share of answers to fusion calls that could not be read; the ego then "
               "kept its own intent", _column("fusion_failed")),
    )
}  # fmt: skip
# Meanings of the figures in a summary that are not metrics.
DERIVED = {
    "message_count": "number of scheduled replies in the whole run; requests do not count",
    **{f"latency_p{p}_ms": f"{p} % of all decisions are at most this slow" for p in PERCENTILES},
}


def metrics_of(world: World) -> tuple[Metric, ...]:
    """Return the metrics that are known in a world."""
    return tuple(metric for metric in METRICS.values() if metric.world in (None, world))


def meaning(name: str) -> str:
    """Return the meaning of a figure; empty if its name needs no explanation."""
    metric = METRICS.get(name)
    return metric.meaning if metric else DERIVED.get(name, "")


@dataclass(frozen=True)
class Grid:
    """The grid of conditions, seeds and episodes; each cell is one episode of a run.

    Attributes:
        conditions: the conditions' names.
        seeds: seeds of the channel's draws.
        episodes: the episodes' numbers.
    """

    conditions: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """The numbers of conditions, seeds and episodes, (C, S, E)."""
        return len(self.conditions), len(self.seeds), len(self.episodes)

    def places(self, decisions: Decisions) -> Ints:
        """Return the flat index of each decision's cell, (n,). Raises ValueError for one outside the grid."""
        condition = decisions.codes("condition", self.conditions)
        seed, episode = (
            _position(decisions.whole(name), names)
            for name, names in (("seed", self.seeds), ("episode", self.episodes))
        )
        return np.ravel_multi_index((condition, seed, episode), self.shape)

    def ordered(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the episodes in the order of the cells. Raises ValueError unless each is there once."""
        by_cell = {(e.condition, e.seed, e.episode): e for e in episodes}
        cells = [(c, s, e) for c in self.conditions for s in self.seeds for e in self.episodes]
        if len(by_cell) != len(episodes) or set(by_cell) != set(cells):
            raise ValueError("not every episode is there once in every condition and seed")
        return [by_cell[cell] for cell in cells]


def by_episode(
    metrics: Sequence[Metric], grid: Grid, decisions: Decisions, episodes: Sequence[Episode]
) -> dict[str, Floats]:
    """Return each metric's values by episode, (C, S, E).

    Args:
        metrics: the metrics.
        grid: the grid of the episodes.
        decisions: the decisions of all episodes.
        episodes: the episodes in the order of the grid (`Grid.ordered`).
    """
    places = grid.places(decisions)

    def values(metric: Metric) -> Floats:
        if not metric.episodes:
            return of_decisions(metric, decisions, places, len(episodes))
        numbers = [metric.episodes(episode) for episode in episodes]
        return np.array([np.nan if v is None else float(v) for v in numbers])

    return {metric.name: values(metric).reshape(grid.shape) for metric in metrics}


def of_decisions(metric: Metric, decisions: Columns, places: Ints, n: int) -> Floats:
    """Return a metric of n episodes, (n,), from decisions; `places` has the episode's index of each."""
    assert metric.decisions
    values = np.asarray(metric.decisions(decisions), dtype=float)
    if not metric.total:
        return mean_by_place(values, places, n)
    unknown = sum_by_place(np.isnan(values), places, n)
    return np.where(unknown > 0, np.nan, sum_by_place(values, places, n))


def sum_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the sum of the known values at each of n places, (n,)."""
    return np.bincount(places, weights=np.nan_to_num(values), minlength=n).astype(float)


def mean_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the mean of the known values at each of n places, (n,); NaN where there is none."""
    known = ~np.isnan(values)
    count = np.bincount(places[known], minlength=n)
    total = sum_by_place(values[known], places[known], n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def over_seeds(name: str, values: Floats) -> Estimate:
    """Return the interval over seeds of a metric's values (S, E), for these episodes."""
    if is_rate(name):
        return in_range(name, seed_rate_interval(values))
    return in_range(name, seed_interval(known_mean(values, axis=1)))


def over_episodes(name: str, values: Floats) -> Estimate:
    """Return the interval over episodes of a metric's values (S, E)."""
    means = known_mean(values, axis=0)
    return rate_interval(means) if is_rate(name) else in_range(name, episode_interval(means))


def difference(name: str, a: Floats, b: Floats, level: float = 0.95) -> Estimate:
    """Return the interval over episodes of the difference a - b of a metric, both (E, S)."""
    return rate_difference(a, b, level) if is_rate(name) else episode_interval(a - b, level=level)


def p_value(name: str, a: Floats, b: Floats) -> float | None:
    """Return the p-value of no difference a - b, both (E, S), from the interval of `difference`."""
    return multiplicity.p_value(lambda level: difference(name, a, b, level))


def is_rate(name: str) -> bool:
    """Whether a metric is a share of events; `effective_loss` is not, it is a computed probability."""
    return name.endswith(("_rate", "_reply_loss"))


def in_range(name: str, e: Estimate) -> Estimate:
    """Cut an interval to the range of its metric: 0 or more, and at most 1 for a share.

    Student's t may go beyond.
    """
    greatest = 1.0 if name.endswith(("_rate", "_ratio", "_loss", "_mass", "_share", "_letter")) else np.inf
    low, high = float(np.maximum(e.low, 0.0)), float(np.minimum(e.high, greatest))
    return Estimate(e.value, low, high, e.n, e.n_excluded)


def percentiles(latency_ms: Floats) -> Floats:
    """Return the `PERCENTILES` of the known latencies among (n,); NaN if none is known."""
    measured = latency_ms[~np.isnan(latency_ms)]
    return np.percentile(measured, PERCENTILES) if len(measured) else np.full(len(PERCENTILES), np.nan)


def unit(name: str) -> tuple[float, str, int]:
    """Return how to show a metric: the factor on its value, its unit, and the number of decimals."""
    if "_gain_" in name:
        return 100.0, " points", 1
    if "_rate" in name or name.endswith(("_ratio", "_loss")):
        return 100.0, " %", 1
    endings: Mapping[str, tuple[str, int]] = {
        "_ms": (" ms", 1), "_mj": (" mJ", 3), "_j": (" J", 2), "_nats": (" nats", 3), "_s": (" s", 2),
        "_m": (" m", 1), "bits_per_episode": (" bit", 0), "_per_episode": ("", 2),
    }  # fmt: skip
    for ending, (suffix, digits) in endings.items():
        if name.endswith(ending):
            return 1.0, suffix, digits
    return 1.0, "", 1 if "message" in name or "tokens" in name else 3


def label(name: str) -> str:
    """Return a metric's name in words, without the unit, which is shown with the value."""
    for suffix in ("_ms", "_mj", "_j", "_nats", "_s", "_m"):
        name = name.removesuffix(suffix)
    return name.replace("_", " ")


def _position(values: Ints, names: Sequence[int]) -> Ints:
    order = np.argsort(names)
    place = order[np.minimum(np.searchsorted(names, values, sorter=order), len(names) - 1)]
    if (np.asarray(names)[place] != values).any():
        raise ValueError("a decision of another seed or episode")
    return np.asarray(place)
