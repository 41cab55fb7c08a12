"""A finished run as a source: its answers are coordinated again, and no model is asked."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from harness.arrays import Bools
from harness.errors import UserError, printable
from harness.exchange import Luck, nearest
from harness.frozen import Table, table
from harness.operating_point import OperatingPoint
from harness.run.folder import Run, dataset_of, read
from harness.run.intents import intents
from harness.run.scoring import Scored, draw, score
from harness.run.timing import inference_s


class Stored:
    """An evaluated run.

    Attributes:
        run: its folder.
        name: model, prompt and answer mode.
        vehicles: the most that any of its scenes has, the ego included.
        seeds: the run's own.
        points: the run's operating points, by name.
    """

    def __init__(self, folder: Path) -> None:
        self.run: Run = read(folder)
        config = self.run.config
        self.name = f"{config['model']['name']} · {config['prompt']['version']} · {self.run.answer}"
        self.seeds = tuple(int(seed) for seed in config["seeds"])
        self.points = {str(c["name"]): OperatingPoint.from_dict(c) for c in config["conditions"]}
        rows = {row["scene"]: row for row in self.run.rows}
        whole = dataset_of(self.run)
        dataset = replace(whole, scenes=tuple(scene for scene in whole.scenes if scene.id in rows))
        if len(dataset.scenes) != len(rows):
            raise UserError(
                f"{printable(folder)} has scenes that its dataset has not; run `harness eval` again"
            )
        by_id = {
            f"{scene}/{viewer}": a for scene, row in rows.items() for viewer, a in row["answers"].items()
        }
        self._known = intents(dataset, by_id, self.run.answer, bool(config["thinking"]))
        self._laid = table(dataset)
        self._infer_s = inference_s(config["latency"], self._known.answers)
        self.vehicles = self._known.distance_m.shape[1]
        self._draw = lru_cache(maxsize=64)(self._drawn)

    def scored(self, point: OperatingPoint, vehicles: int, seed: int) -> tuple[Table, Scored]:
        """Every decision at one operating point, with the ego and so many of the nearest vehicles."""
        known = replace(self._known, valid=self._known.valid & self._there(vehicles - 1))
        return self._laid, score(self._laid, known, self._infer_s, point, seed, self._draw(seed))

    def _there(self, helpers: int) -> Bools:
        reach = np.nan_to_num(self._known.range_m, nan=np.inf)
        return nearest(np.isfinite(reach), reach, helpers)

    def _drawn(self, seed: int) -> Luck:
        return draw(self._laid, seed, self._known.valid.shape)
