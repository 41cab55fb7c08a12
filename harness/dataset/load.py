"""Reading a frozen dataset: what has not the digest and the form that were stated for it is not used."""

import os
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, overload
from zipfile import ZipFile

import msgspec
import numpy as np

from harness.core.arrays import Bools
from harness.core.errors import UserError, unknown
from harness.core.memory import uncollected
from harness.core.resources import entries, folder
from harness.core.resources import find as beside
from harness.dataset.forest import Forest
from harness.dataset.schema import Manifest, Tree
from harness.dataset.verify import (
    Damaged,
    decoded,
    file_problems,
    opened,
    read_level,
    read_manifest,
    read_tree,
    scenario_of,
    unusable,
)
from harness.world.scenario import Scenario
from harness.world.state import WorldState

# Of a dataset, the last that were read stay: some 120 and 100 MB.
SCENES_KEPT, TREES_KEPT = 4096, 512
TREES_AT_ONCE = 256  # whose arrays are made where every tree is asked something


@dataclass(frozen=True)
class Scene:
    """One decision point, frozen.

    Attributes:
        record: what the dataset has of it.
        notes: what was worked out from it, by name, and need not be again.
    """

    record: dict[str, Any]
    notes: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def id(self) -> str:
        """`<episode>-<step>-<digest>`."""
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


class Trees(Sequence[Tree]):
    """The decision trees of some episodes by place; each is read when it is asked for."""

    def __init__(self, numbers: Iterable[int], read: Callable[[int], Tree]) -> None:
        """The trees of these episodes; `read` gives an episode's."""
        self.numbers, self.read = tuple(numbers), read

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, place: int, /) -> Tree: ...
    @overload
    def __getitem__(self, place: slice, /) -> "Trees": ...

    def __getitem__(self, place: int | slice, /) -> "Tree | Trees":
        if isinstance(place, slice):
            return Trees(self.numbers[place], self.read)
        return self.read(self.numbers[place])

    @cached_property
    def _numbers(self) -> frozenset[int]:
        return frozenset(self.numbers)

    def of_episode(self, number: int) -> Tree:
        """An episode's. Raises KeyError if it is none of these."""
        if number not in self._numbers:
            raise KeyError(number)
        return self.read(number)


@dataclass(frozen=True)
class Dataset:
    """A verified dataset. Its trees and scenes are read, and verified, when they are asked for.

    Attributes:
        path: its folder.
        manifest: its manifest.
        sha256: digest of the manifest, which pins every file.
        trees: the decision trees of its layouts, in order of episode.
        trusted: it is a released one, whose scenes are known by their digests.
    """

    path: Path
    manifest: Manifest
    sha256: str
    trees: Trees
    trusted: bool = False
    _scenes: dict[str, Scene] = field(default_factory=dict, repr=False, compare=False)
    _checked: set[str] = field(default_factory=set, repr=False, compare=False)

    @property
    def name(self) -> str:
        """Name in the manifest."""
        return self.manifest.name

    @cached_property
    def scenario(self) -> Scenario:
        """What was frozen, with the parameters that it was frozen with."""
        return scenario_of(self.manifest)

    @property
    def actions(self) -> tuple[str, ...]:
        """Meta-actions, in the environment's order."""
        return tuple(self.manifest.actions)

    @property
    def episodes(self) -> tuple[int, ...]:
        """Numbers of the episodes."""
        return self.trees.numbers

    @property
    def seeds(self) -> tuple[int, ...]:
        """Layout seeds of the episodes."""
        return tuple(self.manifest.seed + number for number in self.episodes)

    @cached_property
    def nodes(self) -> int:
        """How many decision points the trees have."""
        if len(self.trees) == self.manifest.episodes:
            return self.manifest.nodes
        return sum(len(level) for tree in self.trees for level in tree.levels)

    @cached_property
    def forest(self) -> Forest:
        """The trees as arrays."""
        return Forest.of(tuple(self.trees), self.actions, self.scenario.parameters.delay_allowance_s)

    def of_episodes(self, numbers: Collection[int]) -> "Dataset":
        """The same with these episodes only."""
        trees = Trees((number for number in self.episodes if number in numbers), self.trees.read)
        return replace(self, trees=trees)

    def driver_success(self) -> dict[str, Bools]:
        """Whether each reference driver succeeds in each episode, (E,)."""
        some = [
            replace(self, trees=self.trees[at : at + TREES_AT_ONCE]).forest
            for at in range(0, len(self.trees), TREES_AT_ONCE)
        ]
        drivers = some[0].drivers
        return {name: np.concatenate([forest.driver_success(name) for forest in some]) for name in drivers}

    def scenes(self, ids: Sequence[str]) -> list[Scene]:
        """The scenes of decision points. Raises UserError for a damaged one, KeyError for an unknown one."""
        wanted: dict[tuple[int, int], list[int]] = {}  # places in each level of each tree
        for name in ids:
            if name not in self._scenes:
                *level, place = self._place(name)
                wanted.setdefault((level[0], level[1]), []).append(place)
        if wanted:
            with opened(self.path) as file:
                for (number, step), places in wanted.items():
                    for record in self._records(file, self.trees.read(number), step, places):
                        self._scenes[record["scene"]] = Scene(record)
        scenes = [self._scenes[name] for name in ids]
        for name in list(islice(self._scenes, max(0, len(self._scenes) - SCENES_KEPT))):
            del self._scenes[name]
        return scenes

    def __contains__(self, name: str) -> bool:
        """Whether this is the id of one of its decision points."""
        try:
            self._place(name)
        except KeyError:
            return False
        return True

    def _place(self, name: str) -> tuple[int, int, int]:
        """A decision point's episode, step and place in that level. Raises KeyError for an unknown one."""
        if begins := re.match("([0-9]{5})-([0-9])", name):
            episode, step = map(int, begins.groups())
            for at, level in enumerate(self.trees.of_episode(episode).levels):
                for place, point in enumerate(level if at == step else ()):
                    if point.scene == name:
                        return episode, step, place
        raise KeyError(name)

    def _records(
        self, file: ZipFile, tree: Tree, step: int, places: Sequence[int]
    ) -> Iterator[dict[str, Any]]:
        try:
            lines = read_level(file, tree, step)
        except Damaged as damage:
            raise unusable(self.path, str(damage)) from None
        for place in places:
            name = tree.levels[step][place].scene
            if self.trusted or name in self._checked:  # the level's digest is the same
                yield msgspec.json.decode(lines[place])
                continue
            record, problems = decoded(lines[place], self.manifest, name)
            for problem in problems:
                raise unusable(self.path, problem)
            self._checked.add(name)
            yield record

    def scene(self, scene_id: str) -> Scene:
        """The scene of that id, or of the one id that begins so."""
        ids = self.forest.ids
        begin_so = [name for name in ids if name.startswith(scene_id)] if scene_id else []
        if len(begin_so) != 1:
            shown = (begin_so or ids)[:12]
            raise unknown("scene", scene_id, shown, " … (first dozen)" if len(begin_so or ids) > 12 else "")
        return self.scenes(begin_so)[0]

    def courses(self) -> tuple[str, ...]:
        """Ids of the decision points that the reference drivers come to."""
        forest = self.forest
        met = [forest.visited(chosen) for chosen in forest.drivers.values()]
        return tuple(forest.ids[n] for n in np.unique(np.concatenate(met)).tolist())


def find(name: str) -> Path:
    """Folder of a dataset given by path, or by the name of a shipped one or of the project's."""
    if os.path.isdir(name):  # unlike Path.is_dir, false for a name too long to be one
        return Path(name)
    known = {manifest.parent.name for manifest in entries("datasets", "*/manifest.json")}
    if name in known:
        return beside("datasets", name)
    raise unknown("dataset", name, known, "; or give a folder made by `harness dataset build`")


def argument(path: Path) -> str:
    """What finds a dataset again: its name, else its path, from the current folder where it lies below."""
    try:
        if find(path.name).resolve() == path.resolve():
            return path.name
    except UserError:  # nothing of that name, or two
        pass
    whole, here = path.resolve(), Path.cwd().resolve()
    return str(whole.relative_to(here) if whole.is_relative_to(here) else whole)


def released_digests() -> set[str]:
    """Digests of the manifests of released datasets, `datasets/released.toml`."""
    pins = folder("datasets") / "released.toml"
    return set(tomllib.loads(pins.read_text()).values()) if pins.is_file() else set()


@uncollected()
def load(path: Path, limit: int | None = None) -> Dataset:
    """Read a dataset; with `limit`, its first episodes only.

    Every file has the digest its manifest states, and so has every tree, which pins its scenes. What a
    released dataset holds is then what it was when its manifest was pinned; any other's is checked.

    Raises:
        UserError: a file is missing, changed or broken.
    """
    manifest, digest = read_manifest(path)
    for problem in file_problems(path, manifest):
        raise unusable(path, problem)
    trusted = digest in released_digests()
    trees = Trees(range(manifest.episodes)[:limit], _Folder(path, manifest, trusted))
    for number in trees.numbers:
        trees.read(number)
    return Dataset(path, manifest, digest, trees, trusted)


@dataclass(frozen=True)
class _Folder:
    """Gives an episode's tree from a dataset's folder. Raises UserError where that is damaged."""

    path: Path
    manifest: Manifest
    trusted: bool
    _kept: dict[int, Tree] = field(default_factory=dict, repr=False, compare=False)
    _checked: set[int] = field(default_factory=set, repr=False, compare=False)

    def __call__(self, number: int) -> Tree:
        if number in self._kept:
            return self._kept[number]
        try:
            with opened(self.path) as file:
                tree = read_tree(file, self.manifest, number, self.trusted or number in self._checked)
        except Damaged as damage:
            raise unusable(self.path, str(damage)) from None
        self._checked.add(number)
        self._kept[number] = tree
        if len(self._kept) > TREES_KEPT:
            del self._kept[next(iter(self._kept))]
        return tree
