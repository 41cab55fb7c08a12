"""A finished run as a source: its answers are coordinated again, and no model is asked what the run has."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from harness.backends.base import AnswerMode, Backend
from harness.backends.cache import cached, default_file
from harness.backends.cards import Card
from harness.backends.registry import open_backend
from harness.coordination.coordinate import FusionCall
from harness.coordination.exchange import nearest
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Ints
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.files import alone, canonical_json
from harness.dataset.load import Scene
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.latency import PAPER
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.runs.folder import dataset_of, read
from harness.studies.play import Walked, walk_through

CALLS = "fusion-calls.jsonl"  # what fusion calls that none of the run's conditions needed say


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

    def __init__(
        self, folder: Path, latency: str | None = None,
        more: Callable[[int], None] = lambda count: None, done: Callable[[int], None] = lambda count: None,
    ) -> None:  # fmt: skip
        """A run. `more` is told how many fusion calls are owed, and `done` how many have an answer."""
        self.run = read(folder)
        if self.run.world != "frozen":
            raise UserError(
                f"{printable(folder)} was driven, and other decisions lead elsewhere; "
                "give a folder made by `harness eval`"
            )
        manifest = self.run.manifest
        self.name = str(manifest.variant)
        self.seeds = manifest.seeds
        self.points = {str(c["name"]): OperatingPoint.from_dict(c) for c in manifest.conditions}
        mine, whole = self.run.decisions.scenes, dataset_of(self.run)
        self._dataset = replace(whole, scenes=tuple(scene for scene in whole.scenes if scene.id in mine))
        if len(self._dataset.scenes) != len(mine):
            raise UserError(f"{printable(folder)} has scenes that its dataset has not; make the run again")
        self.vehicles = max(len(scene.viewers) for scene in self._dataset.scenes)
        self._asker = Asker(
            self._spec(), self._open, PAPER if latency == "paper" else manifest.latency, folder / CALLS,
            {answer.id: answer for answer in self.run.answers}, done, more,
        )  # fmt: skip
        self._world = lru_cache(maxsize=2)(partial(FrozenWorld, self._dataset))
        self._intents: dict[str, Intents] = {}  # of each step, by the first of its scenes

    def manifest(self) -> dict[str, Any]:
        """The run, the digest of its dataset, and where its times come from."""
        return {
            "name": self.name, "run": str(self.run.path), "dataset_sha256": self._dataset.sha256,
            "latency": msgspec.to_builtins(self._asker.latency),
        }  # fmt: skip

    def walked(self, point: OperatingPoint, vehicles: int, seeds: Sequence[int]) -> Iterator[Walked]:
        """All episodes, with the ego and so many of the nearest vehicles.

        Raises:
            UserError: the point has the run's model fuse, and it cannot.
        """
        replace(self._asker.spec, points=(point,))
        world = self._world(tuple(seeds)).undecided()
        columns, places = walk_through(world, point, _Nearest(self, vehicles - 1), seeds, world.numbers)
        verdicts = world.verdicts(point)
        ends = {
            name: np.stack([getattr(verdict, field) for verdict in verdicts]).astype(float)
            for name, field in (("success_rate", "success"), ("unsafe_rate", "unsafe"), ("late_rate", "late"))
        }
        yield Walked(world.numbers, ends, columns, places)

    def intents(self, moments: Sequence[Scene]) -> Intents:
        """What every vehicle intends, from the run's answers."""
        if moments[0].id not in self._intents:
            self._intents[moments[0].id] = self._asker(moments)
        return self._intents[moments[0].id]

    def fusion_call(self, moments: Sequence[Scene], codes: Ints) -> Callable[[Ints], FusionCall]:
        """The ego's answers to these sets of messages; what the run has not is asked, and kept in it."""
        try:
            with alone(self.run.path / f".{CALLS}.lock"):
                return self._asker.fusion_call(moments, codes)
        except BlockingIOError:
            raise UserError(f"{printable(self.run.path)} is being written by another process; wait") from None

    def _spec(self) -> Spec:
        """The evaluation that made the run, with all that decides its answers."""
        manifest, shown = self.run.manifest, printable(self.run.path)
        version = manifest.prompt["version"]
        prompt = versions.load(version)
        if prompt.sha256 != manifest.prompt["sha256"]:
            raise UserError(
                f"{shown}: prompt {printable(version)} has changed since; restore it or run again"
            )
        return Spec(
            convert(manifest.model, Card, f"{shown}: its model"), prompt, FrozenSource(self._dataset), (),
            manifest.seeds, thinking=manifest.thinking, answer=cast("AnswerMode", manifest.answer),
            batch_size=manifest.batch_size, dtype=manifest.dtype,
        )  # fmt: skip

    def _open(self) -> Backend:
        spec = self._asker.spec
        backend = open_backend(spec.card, dtype=spec.dtype, batch_size=spec.batch_size)
        stored, now = self.run.manifest.identity, msgspec.json.decode(canonical_json(backend.identity()))
        if now != stored:
            other = [key for key in {**now, **stored} if now.get(key) != stored.get(key)]
            raise UserError(
                f"{printable(self.run.path)}: the model is not what it was "
                f"({printable(', '.join(other))}); run again"
            )
        return cached(backend, spec.card, default_file())


class _Nearest:
    """A run's intents, of which only the nearest helpers' count."""

    def __init__(self, stored: Stored, helpers: int) -> None:
        self._stored, self._helpers = stored, helpers

    def __call__(self, moments: Sequence[Scene]) -> Intents:
        intents = self._stored.intents(moments)
        reach = np.nan_to_num(intents.range_m, nan=np.inf)
        return replace(intents, valid=intents.valid & nearest(np.isfinite(reach), reach, self._helpers))

    def fusion_call(self, moments: Sequence[Scene], codes: Ints) -> Callable[[Ints], FusionCall]:
        return self._stored.fusion_call(moments, codes)
