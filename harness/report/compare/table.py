"""A finished run's numbers by condition, seed and episode, with the names that its summary has for them."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.statistics import brier, negative_log_likelihood, safe_target
from harness.evaluate.live_spec import FORMAT as DRIVEN
from harness.runs.folder import Run
from harness.runs.summary import PERCENTILES

if TYPE_CHECKING:
    import pandas as pd

KEY = ["condition", "seed", "episode"]
PER_EPISODE = ("success_rate", "unsafe_rate", "late_rate", "messages_per_episode")
LIVE_PER_EPISODE = {  # with the column of episodes.csv that it is
    "least_gap_m": "least_gap_m", "hard_brakings_per_episode": "hard_brakings",
    "other_crashes_per_episode": "other_crashes", "decisions_per_episode": "decisions",
    "skipped_per_episode": "skipped", "never_acted_per_episode": "never_acted",
}  # fmt: skip
LIVE_ENDS = ("collision_rate", "at_fault_rate", "time_out_rate", "off_road_rate", "time_to_clear_s")
PER_DECISION = (
    "latency_proxy_ms", "deadline_miss_rate", "trigger_rate", "effective_loss", "observed_reply_loss",
    "entropy_nats", "normalised_entropy", "brier", "negative_log_likelihood", "fallback_rate", "fusion_ms",
    "merge_failed_rate",
)  # fmt: skip
MEANS = (*PER_EPISODE, *LIVE_ENDS, *LIVE_PER_EPISODE, *PER_DECISION)
METRICS = (*MEANS, *(f"latency_p{percent}_ms" for percent in PERCENTILES))


def tables(run: Run) -> tuple["pd.DataFrame", "pd.Series[float]"]:
    """A run's numbers by episode and its latencies by decision.

    Returns:
        A row a condition, seed and episode (the index, `KEY`), with `MEANS`, each a mean over the episode's
        decisions (NaN where none is known), and `end`: `success`, or how it failed.
        The latency of every decision in ms, by `KEY`; NaN where unknown.
    """
    import pandas as pd

    live = run.config["format"] == DRIVEN
    columns: dict[str, Any] = {
        "condition": str, "seed": int, "episode": int, "success": bool, "failure": str, "messages": float,
    }  # fmt: skip
    if live:
        columns |= {"fault": str, "time_s": float, **dict.fromkeys(LIVE_PER_EPISODE.values(), float)}
    ended = pd.read_csv(
        run.path / "episodes.csv", usecols=list(columns), dtype=columns, keep_default_na=False
    ).set_index(KEY)
    episodes = ended.index.get_level_values("episode").unique()
    wanted = pd.MultiIndex.from_product([run.conditions, run.config["seeds"], episodes])
    if len(ended) != len(wanted) or not wanted.isin(ended.index).all():
        raise ValueError("episodes.csv has not every episode in every condition and seed")
    failure = ended.failure.where(~ended.success, "")
    found = {
        "success_rate": ended.success,
        "unsafe_rate": ~ended.success & (failure != "late"),
        "late_rate": ~ended.success & (failure == "late"),
        "messages_per_episode": ended.messages,
    }
    if live:
        found |= {f"{how}_rate": failure == how for how in ("collision", "time_out", "off_road")}
        found |= {
            "at_fault_rate": ended.fault == "ego",
            "time_to_clear_s": ended.time_s.where(ended.success | (failure == "late")),
            **{name: ended[column] for name, column in LIVE_PER_EPISODE.items()},
        }
    decided = pd.DataFrame.from_records(list(_decisions(run)), columns=[*KEY, *PER_DECISION])
    decided = decided.astype(dict.fromkeys(PER_DECISION, float)).set_index(KEY)
    table = pd.DataFrame(found).astype(float).join(decided.groupby(level=KEY).mean())
    if np.isinf(table).any(axis=None):
        raise ValueError("a number of its decisions or episodes is infinite")
    end = failure.where(~ended.success, "success")
    return table.reindex(columns=list(MEANS)).assign(end=end), decided.latency_proxy_ms


def _decisions(run: Run) -> Iterator[tuple[Any, ...]]:
    """`KEY` and `PER_DECISION` of every decision; None where unknown."""
    most = float(np.log(max(len(run.config["actions"]), 2)))
    loss = {c["name"]: _loss(OperatingPoint.from_dict(c)) for c in run.config["conditions"]}
    for row in run.rows:
        made = row["decisions"]
        scores: Any = [(None, None)] * len(made)
        if "safe" in row and made:  # nobody knows what every action would have led to in a live moment
            safe, fused = np.array(row["safe"], dtype=bool), np.array([d["fused"] for d in made], dtype=float)
            target = np.broadcast_to(safe_target(safe), fused.shape)
            scores = zip(
                brier(fused, target), negative_log_likelihood(fused, np.broadcast_to(safe, fused.shape)),
                strict=True,
            )  # fmt: skip
        for d, (squared, logarithmic) in zip(made, scores, strict=True):
            nats, lost = d["entropy_nats"], [not message["delivered"] for message in d["messages"]]
            yield (
                d["condition"], d["seed"], row["episode"], d["latency_ms"], d["deadline_missed"],
                d["triggered"], d.get("effective_loss", loss[d["condition"]] if d["triggered"] else None),
                sum(lost) / len(lost) if lost else None, nats, nats and nats / most, squared, logarithmic,
                d["own_failed"], d.get("fusion_ms"), d.get("merge_failed"),
            )  # fmt: skip


def _loss(point: OperatingPoint) -> float | None:
    """Probability that a crossing is lost; None where it hangs on who is there, which no frozen row says."""
    if point.profile is None or point.density_coupled or point.helper_rounds:
        return None
    return getattr(point.channel(), "loss", None)
