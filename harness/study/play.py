"""Plays a source of intents at every point of a panel, and tells what came of it with intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from harness.arrays import Floats
from harness.files import write_whole
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
PLACE = ("source", "panel", "condition", "variable", "value")


class Source(Protocol):
    """Whose intents are coordinated: the calibrated proxy's, or a run's.

    Attributes:
        name: what figures call it.
    """

    @property
    def name(self) -> str:
        """What figures call it."""
        ...

    def manifest(self) -> dict[str, Any]:
        """What a reader needs to know of where the intents come from."""
        ...

    def scored(self, point: OperatingPoint, vehicles: int, seed: int) -> tuple[Table, Scored]:
        """Every decision at one operating point with one seed's luck; the same luck at every point."""
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
        scored = [source.scored(setting.point, setting.vehicles, seed) for seed in seeds]
        per_seed = [by_episode(laid, made, METRICS) for laid, made in scored]
        metrics = {name: np.stack([m[name] for m in per_seed]) for name in METRICS}
        rows += [
            {**place, "metric": metric, "mean": e.value, "ci_low": e.low, "ci_high": e.high, "n": e.n,
             "interval": interval}
            for metric, e, interval in _estimates(metrics, scored)
        ]  # fmt: skip
        for seed, (laid, _), found in zip(seeds, scored, per_seed, strict=True):
            frames.append(pd.DataFrame({
                **place, "seed": seed, "episode": laid.episodes,
                "success": found["success_rate"].astype(bool),
                "trigger_rate": found["trigger_rate"], "latency_ms": found["latency_proxy_ms"].round(3),
                "messages": found["messages_per_episode"].astype(int),
                "effective_loss": found["effective_loss"].round(6),
            }))  # fmt: skip
        progress(1)
    return Played(pd.DataFrame(rows), pd.concat(frames, ignore_index=True))


def _estimates(
    metrics: dict[str, Floats], scored: Sequence[tuple[Table, Scored]]
) -> Iterator[tuple[str, Estimate, str]]:
    same = all(laid is scored[0][0] for laid, _ in scored)  # else a seed has episodes of its own
    for name, values in metrics.items():  # (seeds, episodes)
        yield name, over_seeds(name, values), "seed means"
        if same:
            yield name, over_episodes(name, values), "episodes"
    yield from latency_percentiles([made for _, made in scored])


def described(panels: Mapping[str, Sequence[Setting]]) -> dict[str, list[dict[str, Any]]]:
    """The grid points, complete, for a manifest."""
    return {
        name: [{"value": s.value, "vehicles": s.vehicles, **asdict(s.point)} for s in settings]
        for name, settings in panels.items()
    }


def write_table(table: "pd.DataFrame", stem: Path) -> None:
    """Write a table as CSV and as JSON Lines."""
    write_whole(stem.with_suffix(".csv"), table.to_csv(index=False))
    write_whole(stem.with_suffix(".jsonl"), table.to_json(orient="records", lines=True))
