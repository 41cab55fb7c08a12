"""Plays a source of intents at every point of a panel, and tells what came of it with intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from harness.arrays import Floats
from harness.files import replacing
from harness.frozen import Table
from harness.metrics import Estimate
from harness.operating_point import OperatingPoint
from harness.run.scoring import Scored
from harness.run.summary import by_episode, latency_percentiles, over_episodes, over_seeds
from harness.study.axes import Value

if TYPE_CHECKING:
    import pandas as pd

METRICS = (
    "success_rate", "unsafe_rate", "late_rate", "latency_proxy_ms", "deadline_miss_rate", "trigger_rate",
    "messages_per_episode", "effective_loss", "observed_reply_loss",
)  # fmt: skip
ROWS = 100_000  # that are text in memory at a time
NAMES = ("source", "panel", "condition", "variable")
PLACE = (*NAMES, "value")


class Source(Protocol):
    """Whose intents are coordinated: the calibrated proxy's, or a run's.

    Attributes:
        name: what figures call it.
        same_episodes: whether every seed plays the same episodes.
    """

    same_episodes: bool

    @property
    def name(self) -> str:
        """What figures call it."""
        ...

    def manifest(self) -> dict[str, Any]:
        """What a reader needs to know of where the intents come from."""
        ...

    def scored(self, point: OperatingPoint, vehicles: int, seed: int) -> Iterator[tuple[Table, Scored]]:
        """Every decision at one operating point with one seed's luck, whole episodes at a time.

        It is the same luck at every point.
        """
        ...


@dataclass(frozen=True)
class Setting:
    """One grid point of a panel.

    Attributes:
        condition: name of the operating point that it is a change of.
        point: the operating point.
        vehicles: how many, the ego included.
        variable: what varies in the panel; empty where conditions are compared.
        value: its value there.
    """

    condition: str
    point: OperatingPoint
    vehicles: int
    variable: str = ""
    value: Value | None = None


@dataclass(frozen=True)
class Played:
    """What came of a panel.

    Attributes:
        summary: a row a grid point and metric: `PLACE`, `metric`, `mean`, `ci_low`, `ci_high`, `n`,
            `interval`.
        episodes: a row a grid point, seed and episode.
    """

    summary: "pd.DataFrame"
    episodes: "pd.DataFrame"


def play(
    source: Source, panel: str, settings: Sequence[Setting], seeds: Sequence[int],
    progress: Callable[[int], None],
) -> Played:  # fmt: skip
    """Play every grid point with every seed.

    Args:
        source: whose intents.
        panel: what tables call this set of grid points.
        settings: the grid points.
        seeds: of the luck; each is paired with itself across the points.
        progress: called with 1 whenever a grid point is done.
    """
    import pandas as pd

    rows, frames = [], []
    for setting in settings:
        place = dict(zip(PLACE, (
            source.name, panel, setting.condition, setting.variable, setting.value,
        ), strict=True))  # fmt: skip
        told = [_told(source, setting, seed) for seed in seeds]
        metrics = {name: np.stack([t[name] for t in told]) for name in METRICS}  # (seeds, episodes)
        rows += [
            {**place, "metric": metric, "mean": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n,
             "interval": interval}
            for metric, e, interval in _estimates(source, metrics, [t["latency_s"] for t in told])
        ]  # fmt: skip
        frames.append(pd.DataFrame({
            **place, "seed": np.repeat(seeds, metrics["success_rate"].shape[1]),
            "episode": np.concatenate([t["episode"] for t in told]).astype(int),
            "success": metrics["success_rate"].ravel().astype(bool),
            "trigger_rate": metrics["trigger_rate"].ravel(),
            "latency_ms": metrics["latency_proxy_ms"].ravel().round(3),
            "messages": metrics["messages_per_episode"].ravel().astype(int),
            "effective_loss": metrics["effective_loss"].ravel().round(6),
        }).astype(dict.fromkeys(NAMES, "category")))  # fmt: skip
        progress(1)
    return Played(pd.DataFrame(rows), joined(frames))


def _told(source: Source, setting: Setting, seed: int) -> dict[str, Floats]:
    """Each metric by episode, the episodes' numbers, and the latency of every decision."""
    pieces: dict[str, list[Any]] = {}
    for laid, made in source.scored(setting.point, setting.vehicles, seed):
        found = {
            **by_episode(laid, made, METRICS),
            "episode": laid.episodes,
            "latency_s": made.coordination.latency_s,
        }
        for name, values in found.items():
            pieces.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in pieces.items()}


def _estimates(
    source: Source, metrics: Mapping[str, Floats], latency_s: Sequence[Floats]
) -> Iterator[tuple[str, Estimate, str]]:
    for name, values in metrics.items():
        yield name, over_seeds(name, values), "seed means"
        if source.same_episodes:
            yield name, over_episodes(name, values), "episodes"
    yield from latency_percentiles(latency_s)


def joined(tables: "Sequence[pd.DataFrame]") -> "pd.DataFrame":
    """Tables of episodes, one below the other; what says where they belong is kept once."""
    import pandas as pd
    from pandas.api.types import union_categoricals

    found = {name: union_categoricals([t[name] for t in tables]) for name in NAMES}
    rest = pd.concat([t.drop(columns=list(NAMES)) for t in tables], ignore_index=True)
    return pd.concat([pd.DataFrame(found), rest], axis=1)


def described(panels: Mapping[str, Sequence[Setting]]) -> dict[str, list[dict[str, Any]]]:
    """The grid points, complete, for a manifest."""
    return {
        name: [{"value": s.value, "vehicles": s.vehicles, **asdict(s.point)} for s in settings]
        for name, settings in panels.items()
    }


def write_table(table: "pd.DataFrame", stem: Path) -> None:
    """Write a table as CSV and as JSON Lines, some rows at a time."""
    with replacing(stem.with_suffix(".csv")) as part:
        table.to_csv(part, index=False)
    with replacing(stem.with_suffix(".jsonl")) as part, part.open("w", encoding="utf-8") as file:
        for first in range(0, len(table), ROWS):
            file.write(table[first : first + ROWS].to_json(orient="records", lines=True))
