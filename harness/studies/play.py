"""Plays a source of intents at every point of a panel, and tells what came of it with intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Floats
from harness.core.statistics import Estimate
from harness.evaluate.scoring import Scored
from harness.evaluate.success import Table
from harness.runs.summary import by_episode, latency_percentiles, over_episodes, over_seeds
from harness.studies.episode_tables import EPISODE_METRICS, PLACE, of_episodes
from harness.studies.setting import Setting

if TYPE_CHECKING:
    import pandas as pd

METRICS = (
    "success_rate", "unsafe_rate", "late_rate", "latency_proxy_ms", "deadline_miss_rate", "trigger_rate",
    "messages_per_episode", "effective_loss", "observed_reply_loss",
)  # fmt: skip


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

    rows: list[dict[str, Any]] = []
    episodes: list[dict[str, Floats]] = []
    for setting in settings:
        place = (source.name, panel, setting.condition, setting.variable, setting.value)
        told = [_told(source, setting, seed) for seed in seeds]
        metrics = {name: np.stack([t[name] for t in told]) for name in METRICS}  # (seeds, episodes)
        rows += [
            {**dict(zip(PLACE, place, strict=True)), "metric": metric, "mean": e.value, "ci_low": e.low,
             "ci_high": e.high, "n": e.n, "interval": interval}
            for metric, e, interval in _estimates(source, metrics, [t["latency_s"] for t in told])
        ]  # fmt: skip
        episodes.append({name: metrics[name].ravel() for name in EPISODE_METRICS} | {
            "seed": np.repeat(seeds, metrics["success_rate"].shape[1]),
            "episode": np.concatenate([t["episode"] for t in told]),
        })  # fmt: skip
        progress(1)
    return Played(pd.DataFrame(rows), of_episodes(source.name, panel, settings, episodes))


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
