"""Summary of a live run: the frozen run's table with what only driving shows.

Intervals are as in `harness/runs/summary.py`. Here a seed may change what happens, so an episode's yes or no
is a mean over seeds and its interval Student's t, unless no seed changed any.
"""

from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.arrays import Floats
from harness.core.statistics import Estimate, seed_interval
from harness.evaluate.live_spec import Drive
from harness.runs.driven_record import MEANS, Row
from harness.runs.folder import answers_of
from harness.runs.summary import PERCENTILES, gains, long_table, of_answers, over_episodes, over_seeds

if TYPE_CHECKING:
    import pandas as pd

PER_EPISODE: dict[str, Callable[[Row], Any]] = {
    "success_rate": lambda row: row["result"] == "cleared",
    "unsafe_rate": lambda row: row["result"] in ("collision", "time_out", "off_road"),
    "collision_rate": lambda row: row["result"] == "collision",
    "at_fault_rate": lambda row: row["fault"] == "ego",
    "late_rate": lambda row: row["result"] == "late",
    "time_out_rate": lambda row: row["result"] == "time_out",
    "off_road_rate": lambda row: row["result"] == "off_road",
    "time_to_clear_s": lambda row: row["clear_s"],
    "least_gap_m": lambda row: row["least_gap_m"],
    "hard_brakings_per_episode": lambda row: row["hard_brakings"],
    "other_crashes_per_episode": lambda row: row["other_crashes"],
    "decisions_per_episode": lambda row: row["decisions"],
    "skipped_per_episode": lambda row: row["skipped"],
    "never_acted_per_episode": lambda row: row["never_acted"],
    "messages_per_episode": lambda row: row["messages"],
}
NAMES = {  # what a frozen run's summary calls the mean of a decision's count
    "latency_ms": "latency_proxy_ms", "deadline_missed": "deadline_miss_rate", "triggered": "trigger_rate",
    "observed_loss": "observed_reply_loss", "own_failed": "fallback_rate",
    "merge_failed": "merge_failed_rate",
}  # fmt: skip


def summary(spec: Drive, moments: Sequence[Row], episodes: Sequence[Row]) -> "pd.DataFrame":
    """The long table of `summary.csv`."""
    return long_table(spec, _estimates(spec, moments, episodes))


def _estimates(
    spec: Drive, moments: Sequence[Row], episodes: Sequence[Row]
) -> Iterator[tuple[str, str, Estimate, str]]:
    by_condition: dict[str, dict[str, Floats]] = {}
    latencies: dict[tuple[str, int], list[float]] = {}
    for row in moments:
        for made in row["decisions"]:
            latencies.setdefault((made["condition"], made["seed"]), []).append(made["latency_ms"])
    for point in spec.points:
        mine = [[r for r in episodes if (r["condition"], r["seed"]) == (point.name, s)] for s in spec.seeds]
        metrics = {name: _table(mine, of) for name, of in PER_EPISODE.items()}
        means = [[r["means"] for r in some] for some in mine]
        metrics |= {NAMES.get(name, name): _table(means, itemgetter(name)) for name in MEANS}
        by_condition[point.name] = metrics
        for name, values in metrics.items():
            yield point.name, name, over_seeds(name, values), "seed means"
            yield point.name, name, over_episodes(name, values), "episodes"
        for percent in PERCENTILES:
            each = np.array([[np.percentile(latencies[point.name, s], percent)] for s in spec.seeds])
            yield point.name, f"latency_p{percent}_ms", over_seeds("latency", each), "seed means"
        yield point.name, "message_count", seed_interval(metrics["messages_per_episode"].sum(1)), "seed means"
    yield from gains(by_condition)
    answers = [a for row in moments for a in answers_of(row).values()]
    by_role = {role: [a for a in answers if a["role"] == role] for role in ("ego", "helper", "merge")}
    yield from of_answers({role: [a["verdict"] for a in given] for role, given in by_role.items()}, by_role)


def _table(rows: Sequence[Sequence[Row]], of: Callable[[Row], Any]) -> Floats:
    """(seeds, episodes); NaN where there is no value."""
    return np.array([[np.nan if (v := of(row)) is None else float(v) for row in some] for some in rows])
