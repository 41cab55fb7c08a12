"""The record of a live run: a row a moment with every raw text, and a row an episode."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.coordination.coordinate import Coordination
from harness.coordination.operating_point import OperatingPoint
from harness.core.statistics import known_mean
from harness.dataset.load import Scene
from harness.evaluate.branches import Episode, Trajectory
from harness.evaluate.intents import Intents
from harness.evaluate.live_spec import Drive
from harness.evaluate.merging import Merged
from harness.runs.record import by_scene, by_viewer, number
from harness.world.outcome import Outcome

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]

# What is counted in a decision, of which an episode has the mean.
MEANS = (
    "latency_ms", "deadline_missed", "triggered", "effective_loss", "observed_loss", "entropy_nats",
    "normalised_entropy", "own_failed", "fusion_ms", "merge_failed",
)  # fmt: skip


def moments(
    scenes: Sequence[Scene], known: Intents, made: Sequence[list[Row]], second: Merged | None
) -> list[Row]:
    """A row a moment: its answers, and what each condition and seed that was there made of them.

    `merged` has the ego's second answers by whose messages it had, where there are any.
    """
    again = by_scene(scenes, known, second) if second else {}
    return [
        {
            "scene": scene.id,
            "episode": scene.record["episode"],
            "step": scene.record["step"],
            "danger": scene.record["danger"]["sector"],
            "answers": by_viewer(scene, known, i),
            **({"merged": again[i]} if i in again else {}),
            "decisions": made[i],
        }
        for i, scene in enumerate(scenes)
    ]


def decisions(
    c: Coordination,
    point: OperatingPoint,
    seeds: Sequence[int],
    viewers: Sequence[Sequence[str]],
    actions: Sequence[str],
) -> Iterator[Row]:
    """One condition's decisions (n,), each of an episode with its seed; `acted` is not known yet."""
    table = {
        "action": c.action, "deadline_missed": c.deadline_missed, "entropy_nats": c.entropy_nats.round(6),
        "fused": c.fused.round(6), "latency_ms": (c.latency_s * 1000).round(3),
        "normalised_entropy": c.normalised_entropy.round(6), "own_failed": c.own_failed,
        "triggered": c.triggered, "effective_loss": np.where(c.triggered, c.loss, np.nan),
        "observed_loss": c.observed_loss, "own_weight": c.weights[:, 0].round(6),
        "fusion_ms": (c.fusion_s * 1000).round(3),
        "merge_failed": np.where(c.on_time.any(axis=1) & point.asks_again, c.merge_failed, np.nan),
    }  # fmt: skip
    columns: dict[str, list[Any]] = {name: values.tolist() for name, values in table.items()}
    arrival_ms = (c.arrival_s * 1000).round(3).tolist()
    for i, seed in enumerate(seeds):
        messages = [
            {
                "from": viewer, "arrival_ms": number(arrival_ms[i][j]),
                "delivered": bool(c.delivered[i, j]), "on_time": bool(c.on_time[i, j]),
                "weight": number(round(float(c.weights[i, 1 + j]), 6)),
            }
            for j, viewer in enumerate(viewers[i]) if c.asked[i, j]
        ]  # fmt: skip
        row: Row = {k: number(v[i]) if isinstance(v[i], float) else v[i] for k, v in columns.items()}
        named = {"condition": point.name, "seed": seed, "action": actions[row["action"]]}
        yield {**row, **named, "acted": False, "messages": messages}


def ended(one: Trajectory, episode: Episode, reference: Outcome | None) -> Row:
    """What became of an episode; it is `late` if it cleared too long after the `reference`."""
    found = one.world.outcome
    outcome = found.judged(reference, one.world.scenario.parameters) if reference else found
    delay_s = None
    if reference and reference.time_s is not None and reference.success and found.success:
        delay_s = round((found.time_s or 0.0) - reference.time_s, 3)
    known = {name: [_float(d[name]) for d in episode.decisions] for name in MEANS}
    return {
        "episode": one.number,
        "layout_seed": one.world.seed,
        "danger": one.world.layout.danger or "none",
        "condition": episode.point.name,
        "seed": episode.seed,
        "result": outcome.result,
        "time_s": outcome.time_s,
        "clear_s": found.time_s if found.success else None,
        "delay_s": delay_s,
        "partner": outcome.partner,
        "striker": outcome.striker,
        "fault": outcome.fault,
        "least_gap_m": round(outcome.least_gap_m, 3),
        "hard_brakings": one.world.hard_brakings,
        "other_crashes": outcome.other_crashes,
        "decisions": len(episode.decisions),
        "skipped": episode.skipped,
        "never_acted": sum(not d["acted"] for d in episode.decisions),
        "messages": sum(len(d["messages"]) for d in episode.decisions),
        "deadline_misses": sum(d["deadline_missed"] for d in episode.decisions),
        "means": {name: number(float(known_mean(np.array(values), 0))) for name, values in known.items()},
    }


def _float(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def episodes(spec: Drive, rows: Sequence[Row]) -> "pd.DataFrame":
    """The table of `episodes.csv`: a frozen run's columns, then what only driving shows."""
    import pandas as pd

    return pd.DataFrame(
        {
            "model": spec.card.name, "prompt": spec.prompt.version, "answer": spec.answer,
            "condition": e["condition"], "seed": e["seed"], "episode": e["episode"], "danger": e["danger"],
            "success": e["result"] == "cleared", "failure": "" if e["result"] == "cleared" else e["result"],
            "delay_s": e["delay_s"], "messages": e["messages"], "trigger_rate": e["means"]["triggered"],
            "latency_ms": e["means"]["latency_ms"], "deadline_misses": e["deadline_misses"],
            **{k: e[k] for k in (
                "layout_seed", "time_s", "partner", "striker", "fault", "least_gap_m", "hard_brakings",
                "other_crashes", "decisions", "skipped", "never_acted",
            )},
        }
        for e in rows
    )  # fmt: skip
