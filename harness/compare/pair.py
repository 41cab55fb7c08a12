"""Two finished runs on the same scenes with the same luck, read and laid out alike."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.channel import PROFILES
from harness.drive.folder import LIVE
from harness.drive.spec import FORMAT as DRIVEN
from harness.errors import UserError, printable
from harness.metrics import brier, negative_log_likelihood, safe_target
from harness.operating_point import OperatingPoint
from harness.report.words import facts
from harness.run.folder import FROZEN, Run, read
from harness.run.summary import PERCENTILES

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
SETTINGS = ("model", "prompt", "answer", "thinking", "dtype", "latency", "identity", "versions")


@dataclass(frozen=True)
class Side:
    """One of the two runs.

    Attributes:
        run: as it was read.
        scenes: what pins its scenes: the dataset's digest, or the scenario and the first layout seed.
        on: its scenes, for people.
        seeds: of the channel's luck, ascending.
        settings: what may make a difference, by dotted name; None is left out.
        table: a row a condition, seed and episode (the index, `KEY`), with `MEANS`, each a mean over the
            episode's decisions (NaN where none is known), and `end`: `success`, or how it failed.
        latency_ms: of every decision, by `KEY`; NaN where unknown.
        answers: role and verdict of each answer, by request id.
    """

    run: Run
    scenes: Any
    on: str
    seeds: tuple[int, ...]
    settings: Mapping[str, str]
    table: "pd.DataFrame"
    latency_ms: "pd.Series[float]"
    answers: Mapping[str, tuple[str, str]]

    @property
    def episodes(self) -> frozenset[int]:
        """Numbers of its episodes."""
        return frozenset(self.table.index.get_level_values("episode"))


@dataclass(frozen=True)
class Pair:
    """Two runs that can be compared.

    Attributes:
        a: the one that is the base.
        b: the one that is compared with it.
        conditions: names that both have, in the order of `a`.
        seeds: seeds of the channel's luck, the same in both.
        episodes: numbers of the episodes that both have.
    """

    a: Side
    b: Side
    conditions: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: tuple[int, ...]


def pair(a: Path, b: Path) -> Pair:
    """Read two runs.

    Raises:
        UserError: a folder is no finished run, or the two have not the same scenes and seeds, or no condition
            or episode in common.
    """
    one, other = _side(a), _side(b)
    shown = f"{printable(a)} and {printable(b)}"
    if one.run.config["format"] != other.run.config["format"]:
        raise UserError(
            f"{shown}: one was made by `harness eval` and one by `harness drive`; give two of a kind, or "
            "see `harness fidelity`"
        )
    if one.scenes != other.scenes:
        raise UserError(
            f"{shown} are not of the same scenes ({printable(one.on, 60)} and {printable(other.on, 60)}); "
            "make both on the same"
        )
    if one.seeds != other.seeds:
        seeds = " and ".join(printable(list(side.seeds), 40) for side in (one, other))
        raise UserError(f"{shown} have different seeds ({seeds}); make both with the same --seeds")
    conditions = tuple(name for name in one.run.conditions if name in other.run.conditions)
    if not conditions:
        names = " and ".join(printable(", ".join(side.run.conditions), 60) for side in (one, other))
        raise UserError(f"{shown} have no condition in common ({names}); make both with the same --condition")
    episodes = one.episodes & other.episodes
    if not episodes:
        raise UserError(f"{shown} have no episode in common; make both on the same episodes")
    return Pair(one, other, conditions, one.seeds, tuple(sorted(episodes)))


def _side(path: Path) -> Side:
    run = read(path, FROZEN, LIVE)
    config = run.config
    try:
        if config["format"] == DRIVEN:
            scenes = [config["scenario"], config["first_seed"]]
            on = f"{config['scenario']['name']} from layout seed {config['first_seed']}"
        else:
            scenes = config["dataset"]["sha256"]
            on = f"{config['dataset']['name']} {config['dataset']['sha256'][:12]}"
        seeds = tuple(sorted(int(seed) for seed in config["seeds"]))
        table, latency_ms = _tables(run)
        return Side(run, scenes, on, seeds, _settings(run), table, latency_ms, dict(_answers(run)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{printable(path)} is no finished run ({printable(error)}); make the run again"
        ) from None


def _settings(run: Run) -> dict[str, str]:
    config = {"answer": run.answer, **run.config}
    told = {key: config[key] for key in SETTINGS if key in config}
    # Through the class, so that a setting which an older run does not know has the value it had then.
    points = [asdict(OperatingPoint.from_dict(c)) for c in config["conditions"]]
    told["condition"] = {point["name"]: point for point in points}
    return {name: str(value) for name, value in facts(told) if value is not None}


def _tables(run: Run) -> tuple["pd.DataFrame", "pd.Series[float]"]:
    """`Side.table` and `Side.latency_ms`."""
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
    return PROFILES[point.profile].loss if point.loss is None else point.loss


def _answers(run: Run) -> Iterator[tuple[str, tuple[str, str]]]:
    for row in run.rows:
        for viewer, answer in (*row["answers"].items(), *row.get("merged", {}).items()):
            yield f"{row['scene']}/{viewer}", (answer["role"], answer["verdict"])
