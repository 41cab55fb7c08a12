"""Reading a frozen dataset: what has not the digest and the form that were stated for it is not used."""

import os
import tomllib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json
from harness.core.memory import uncollected
from harness.core.resources import entries, folder
from harness.core.resources import find as beside
from harness.dataset.schema import Manifest
from harness.dataset.verify import file_problems, read_manifest, records, released
from harness.world import scenarios
from harness.world.scenario import Scenario
from harness.world.state import WorldState


@dataclass(frozen=True)
class Scene:
    """One decision point, frozen."""

    record: dict[str, Any]

    @property
    def id(self) -> str:
        """`<episode>-<step>`."""
        return str(self.record["scene"])

    @cached_property
    def state(self) -> WorldState:
        """Everything that is there."""
        return WorldState.from_dict(self.record["state"])

    @property
    def viewers(self) -> tuple[str, ...]:
        """Ids of the ego and the helpers, the ego first."""
        return tuple(self.record["graphs"])

    def __post_init__(self) -> None:
        order = [v["id"] for v in self.record["state"]["vehicles"]]
        graphs = self.record["graphs"]
        object.__setattr__(
            self, "record", {**self.record, "graphs": {v: graphs[v] for v in order if v in graphs}}
        )


@dataclass(frozen=True)
class Dataset:
    """A verified dataset.

    Attributes:
        path: its folder.
        manifest: its manifest.
        sha256: digest of the manifest, which pins every file.
        scenes: in order of episode and step.
    """

    path: Path
    manifest: Manifest
    sha256: str
    scenes: tuple[Scene, ...]

    @property
    def name(self) -> str:
        """Name in the manifest."""
        return self.manifest.name

    @cached_property
    def scenario(self) -> Scenario:
        """What was frozen, with the manifest's parameters."""
        scenario = scenarios.get(self.manifest.scenario)
        usual = scenario.parameters
        given = {name: type(getattr(usual, name))(value) for name, value in self.manifest.parameters.items()}
        # In a dataset from before beacons everybody knew the truth.
        return replace(scenario, parameters=replace(usual, **{"perfect_knowledge": True, **given}))

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the environment's order."""
        return tuple(self.manifest.actions)

    @property
    def delay_allowance_s(self) -> float:
        """Needless delay that an episode is forgiven."""
        return cast(float, self.manifest.parameters["delay_allowance_s"])

    @property
    def episodes(self) -> tuple[int, ...]:
        """Numbers of the episodes."""
        return tuple(dict.fromkeys(scene.record["episode"] for scene in self.scenes))

    def scene(self, scene_id: str) -> Scene:
        """The scene of that id."""
        for scene in self.scenes:
            if scene.id == scene_id:
                return scene
        raise unknown("scene", scene_id, [s.id for s in self.scenes[:12]], " … (first dozen)")

    def outcome_arrays(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """For each scene and action (n, A): whether it is safe, and its delay in s.

        The delay is against the best safe action of that scene; NaN where the action is not safe.
        """
        tables = [[s.record["outcomes"][a] for a in self.actions] for s in self.scenes]
        safe = np.array([[o["result"] == "cleared" for o in row] for row in tables])
        time_s = np.array(
            [[o["time_s"] if o["result"] == "cleared" else np.inf for o in row] for row in tables]
        )
        with np.errstate(invalid="ignore"):
            delay_s = np.where(safe, time_s - time_s.min(axis=1, keepdims=True), np.nan)
        return safe, delay_s


def find(name: str) -> Path:
    """Folder of a dataset given by path, or by the name of a shipped one or of the project's."""
    if os.path.isdir(name):  # unlike Path.is_dir, false for a name too long to be one
        return Path(name)
    known = {manifest.parent.name for manifest in entries("datasets", "*/manifest.json")}
    if name in known:
        return beside("datasets", name)
    raise unknown("dataset", name, known, "; or give a folder made by `harness dataset build`")


def shared(one: Dataset, other: Dataset) -> int:
    """How many scenes of one are in the other too: of the same layout seed, or in the same state."""
    seeds = {scene.record["episode_seed"] for scene in other.scenes}
    states = {canonical_json(scene.record["state"]) for scene in other.scenes}
    return sum(
        scene.record["episode_seed"] in seeds or canonical_json(scene.record["state"]) in states
        for scene in one.scenes
    )


def released_digests() -> set[str]:
    """Digests of the manifests of released datasets, `datasets/released.toml`."""
    pins = folder("datasets") / "released.toml"
    return set(tomllib.loads(pins.read_text()).values()) if pins.is_file() else set()


@uncollected()
def load(path: Path, limit: int | None = None) -> Dataset:
    """Read and verify a dataset; with `limit`, keep its first episodes only.

    Every file has the digest its manifest states. The decision points of a released dataset are then what
    they were when its manifest was pinned; any other's are checked one by one.

    Raises:
        UserError: a file is missing, changed or broken.
    """
    manifest, digest = read_manifest(path)
    scenes: list[Scene] = []
    for problem in file_problems(path, manifest):
        raise _unusable(path, problem)
    file = path / "scenes.jsonl"
    for record, problems in released(file) if digest in released_digests() else records(file, manifest):
        if problems:
            raise _unusable(path, problems[0])
        if limit is not None and record["episode"] >= limit:
            break
        scenes.append(Scene(record))
    if not scenes:
        raise UserError(f"dataset {printable(path)} holds no scenes; build it with at least one episode")
    return Dataset(path, manifest, digest, tuple(scenes))


def _unusable(path: Path, problem: str) -> UserError:
    return UserError(
        f"dataset {printable(path)}, {problem}; `harness dataset check` lists all; restore or rebuild it"
    )
