"""A finished run as a source: its answers are coordinated again, and no model is asked."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from harness.coordination.channel import Draws
from harness.coordination.exchange import nearest
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools
from harness.core.errors import UserError, printable
from harness.evaluate.again import Asking, second_answers
from harness.evaluate.intents import Answered, intents
from harness.evaluate.merging import Merged, delivered
from harness.evaluate.scoring import Scored, draw, score
from harness.evaluate.success import Table, table
from harness.evaluate.timing import PAPER, inference_s
from harness.runs.folder import Run, dataset_of, read
from harness.studies.setting import Setting


class Stored:
    """An evaluated run, with its own inference times or the `paper`'s.

    Attributes:
        run: its folder.
        name: model, prompt and answer mode.
        vehicles: the most that any of its scenes has, the ego included.
        seeds: the run's own.
        points: the run's operating points, by name.
        same_episodes: every seed plays the run's.
    """

    same_episodes = True

    def __init__(self, folder: Path, latency: str | None = None) -> None:
        self.run: Run = read(folder)
        config = self.run.config
        self.name = f"{config['model']['name']} · {config['prompt']['version']} · {self.run.answer}"
        self.seeds = tuple(int(seed) for seed in config["seeds"])
        self.points = {str(c["name"]): OperatingPoint.from_dict(c) for c in config["conditions"]}
        rows = {row["scene"]: row for row in self.run.rows}
        whole = dataset_of(self.run)
        dataset = replace(whole, scenes=tuple(scene for scene in whole.scenes if scene.id in rows))
        if len(dataset.scenes) != len(rows):
            raise UserError(f"{printable(folder)} has scenes that its dataset has not; make the run again")
        by_id = {
            f"{scene}/{viewer}": a for scene, row in rows.items() for viewer, a in row["answers"].items()
        }
        self._dataset = dataset
        self._second: Merged | None = None
        known = intents(dataset, by_id, self.run.answer, bool(config["thinking"]))
        self._laid = table(dataset)
        self._latency = PAPER if latency == "paper" else dict(config["latency"])
        self._known = replace(known, inference_s=inference_s(self._latency, known.answers))
        self.vehicles = self._known.distance_m.shape[1]
        self._draw = lru_cache(maxsize=64)(self._drawn)

    def manifest(self) -> dict[str, Any]:
        """The run, the digest of its dataset, and where its times come from."""
        config = self.run.config
        return {
            "name": self.name, "run": str(self.run.path), "dataset_sha256": config["dataset"]["sha256"],
            "latency": self._latency,
        }  # fmt: skip

    def prepare(self, settings: Iterable[Setting], seeds: Sequence[int], asking: Asking) -> None:
        """Ask the model what these grid points need beyond the run's answers, if they need anything."""
        asked_again = [s for s in settings if s.point.asks_again]
        draws = [self._draw(seed) for seed in seeds]
        codes = [delivered(self._with(s.vehicles), [s.point], draws) for s in asked_again]
        if asked_again:
            points, every = [s.point for s in asked_again], np.unique(np.concatenate(codes))
            self._second, self._latency = second_answers(
                self.run, self._dataset, self._known, points, every, self._latency, asking
            )

    def scored(self, point: OperatingPoint, vehicles: int, seed: int) -> Iterator[tuple[Table, Scored]]:
        """Every decision at one operating point, with the ego and so many of the nearest vehicles."""
        known = self._with(vehicles)
        yield self._laid, score(self._laid, known, point, seed, self._draw(seed), self._second)

    def _with(self, vehicles: int) -> Answered:
        return replace(self._known, valid=self._known.valid & self._there(vehicles - 1))

    def _there(self, helpers: int) -> Bools:
        reach = np.nan_to_num(self._known.range_m, nan=np.inf)
        return nearest(np.isfinite(reach), reach, helpers)

    def _drawn(self, seed: int) -> Draws:
        return draw(self._laid, seed, self._known.valid.shape)
