"""Reading a frozen dataset: what is read has the digest its manifest states, or is not used."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.dataset.schema import manifest_schema, record_validator
from harness.errors import UserError, printable, unknown
from harness.files import sha256_bytes, sha256_file
from harness.resources import folder
from harness.scene import WorldState

DEFAULT = "occluded-intersection-v1"


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
    manifest: dict[str, Any]
    sha256: str
    scenes: tuple[Scene, ...]

    @property
    def name(self) -> str:
        """Name in the manifest."""
        return str(self.manifest["name"])

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the environment's order."""
        return tuple(self.manifest["actions"])

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
    """Folder of a dataset given by path or by the name of a shipped one."""
    if Path(name).is_dir():
        return Path(name)
    known = [p.name for p in folder("datasets").iterdir() if (p / "manifest.json").is_file()]
    if name in known:
        return folder("datasets") / name
    raise unknown("dataset", name, known, "; or give a folder made by `harness dataset build`")


def load(path: Path, limit: int | None = None) -> Dataset:
    """Read and verify a dataset; with `limit`, keep its first episodes only.

    Raises:
        UserError: a file is missing, changed or broken.
    """
    manifest, digest = read_manifest(path)
    for name, expected in manifest["files"].items():
        file = path / name
        if not file.is_file():
            raise UserError(
                f"dataset file {printable(file)} is missing; restore it or build the dataset again"
            )
        if sha256_file(file) != expected:
            raise UserError(
                f"dataset file {printable(file)} has changed (sha256 differs from manifest.json); "
                "`harness dataset check` shows where"
            )
    scenes = []
    with (path / "scenes.jsonl").open("rb") as lines:
        for number, text in enumerate(lines, 1):
            try:
                record = json.loads(text)
                if limit is not None and record["episode"] >= limit:
                    break
                scenes.append(Scene(record))
            except (ValueError, KeyError, TypeError) as error:
                raise UserError(
                    f"dataset file {printable(path / 'scenes.jsonl')} line {number} is no decision point "
                    f"({printable(error)}); build the dataset again"
                ) from None
    if not scenes:
        raise UserError(f"dataset {printable(path)} holds no scenes; build it with at least one episode")
    return Dataset(path, manifest, digest, tuple(scenes))


def read_manifest(path: Path) -> tuple[dict[str, Any], str]:
    """The manifest, valid by its schema, and its digest."""
    from jsonschema import Draft202012Validator

    file = path / "manifest.json"
    try:
        data = file.read_bytes()
        manifest = json.loads(data)
    except FileNotFoundError:
        raise UserError(
            f"{printable(path)} is no dataset (no manifest.json); build one with `harness dataset build`"
        ) from None
    except (OSError, ValueError) as error:
        raise UserError(
            f"{printable(file)} cannot be read ({printable(error)}); build the dataset again"
        ) from None
    for broken in Draft202012Validator(manifest_schema()).iter_errors(manifest):
        raise UserError(f"{printable(file)} at {broken.json_path}: {printable(broken.message)}")
    return manifest, sha256_bytes(data)


def check(path: Path) -> list[str]:
    """Everything that is wrong with a dataset, one line each, with file and line number. Empty if sound."""
    manifest, _ = read_manifest(path)
    problems = []
    for name, expected in manifest["files"].items():
        file = path / name
        if not file.is_file():
            problems.append(f"{name}: missing")
        elif sha256_file(file) != expected:
            problems.append(f"{name}: changed, its sha256 is not the manifest's")
    if (path / "scenes.jsonl").is_file():
        problems += _check_scenes(path / "scenes.jsonl", manifest)
    return problems


def _check_scenes(file: Path, manifest: dict[str, Any]) -> list[str]:
    validator = record_validator(tuple(manifest["actions"]))
    problems, seen = [], set()
    with file.open("rb") as lines:
        number = 0
        for number, text in enumerate(lines, 1):
            where = f"{file.name} line {number}"
            if not text.endswith(b"\n"):
                problems.append(f"{where}: cut off")
            try:
                record = json.loads(text)
            except (ValueError, RecursionError) as error:
                problems.append(f"{where}: no JSON ({printable(error)})")
                continue
            errors = sorted(validator.iter_errors(record), key=lambda e: e.json_path)
            problems += [f"{where} at {e.json_path}: {printable(e.message)}" for e in errors[:3]]
            if not errors:
                if record["scene"] in seen:
                    problems.append(f"{where}: scene {record['scene']} appears twice")
                seen.add(record["scene"])
        if number != manifest["decisions"]:
            problems.append(
                f"{file.name}: {number} decision points, the manifest says {manifest['decisions']}"
            )
    return problems
