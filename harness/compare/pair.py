"""Two finished runs on the same scenes with the same luck, read and laid out alike."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.drive.folder import LIVE
from harness.drive.spec import FORMAT as DRIVEN
from harness.errors import UserError, printable
from harness.metrics import brier, negative_log_likelihood, safe_target
from harness.operating_point import OperatingPoint
from harness.report.words import facts
from harness.run.folder import FROZEN, Run, read

if TYPE_CHECKING:
    import pandas as pd

KEY = ["condition", "seed", "episode"]
PER_EPISODE = ("success_rate", "unsafe_rate", "late_rate", "messages_per_episode")
PER_DECISION = (
    "latency_proxy_ms", "deadline_miss_rate", "trigger_rate", "entropy_nats", "brier",
    "negative_log_likelihood", "fallback_rate",
)  # fmt: skip
METRICS = (*PER_EPISODE, *PER_DECISION)
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
        table: a row a condition, seed and episode (the index, `KEY`), with `METRICS`, each a mean over the
            episode's decisions (NaN where none is known), and `end`: `success`, or how it failed.
        answers: role and verdict of each answer, by request id.
    """

    run: Run
    scenes: Any
    on: str
    seeds: tuple[int, ...]
    settings: Mapping[str, str]
    table: "pd.DataFrame"
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
        return Side(run, scenes, on, seeds, _settings(run), _table(run), dict(_answers(run)))
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


def _table(run: Run) -> "pd.DataFrame":
    import pandas as pd

    columns = {
        "condition": str, "seed": int, "episode": int, "success": bool, "failure": str, "messages": float,
    }  # fmt: skip
    ended = pd.read_csv(
        run.path / "episodes.csv", usecols=list(columns), dtype=columns, keep_default_na=False
    ).set_index(KEY)
    episodes = ended.index.get_level_values("episode").unique()
    wanted = pd.MultiIndex.from_product([run.conditions, run.config["seeds"], episodes])
    if len(ended) != len(wanted) or not wanted.isin(ended.index).all():
        raise ValueError("episodes.csv has not every episode in every condition and seed")
    table = pd.DataFrame({
        "success_rate": ended.success,
        "unsafe_rate": ~ended.success & (ended.failure != "late"),
        "late_rate": ~ended.success & (ended.failure == "late"),
        "messages_per_episode": ended.messages,
    }).astype(float)  # fmt: skip
    decided = pd.DataFrame.from_records(list(_decisions(run)), columns=[*KEY, *PER_DECISION])
    means = decided.astype(dict.fromkeys(PER_DECISION, float)).groupby(KEY).mean()
    if np.isinf(table.join(means)).any(axis=None):
        raise ValueError("a number of its decisions or episodes is infinite")
    return table.join(means).assign(end=ended.failure.where(~ended.success, "success"))


def _decisions(run: Run) -> Iterator[tuple[Any, ...]]:
    """`KEY` and `PER_DECISION` of every decision; None where unknown."""
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
            yield (
                d["condition"], d["seed"], row["episode"], d["latency_ms"], d["deadline_missed"],
                d["triggered"], d["entropy_nats"], squared, logarithmic, d["own_failed"],
            )  # fmt: skip


def _answers(run: Run) -> Iterator[tuple[str, tuple[str, str]]]:
    for row in run.rows:
        for viewer, answer in (*row["answers"].items(), *row.get("merged", {}).items()):
            yield f"{row['scene']}/{viewer}", (answer["role"], answer["verdict"])
