"""Read a frozen dataset; a part without its stated digest or form is refused."""

import os
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import msgspec
import numpy as np
from msgspec import structs

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable, sayable, unknown
from harness.core.files import text_of
from harness.core.memory import uncollected
from harness.core.resources import entries, folder
from harness.core.resources import find as beside
from harness.core.statistics import cluster_numbers
from harness.dataset.forest import Forest
from harness.dataset.schema import Manifest, Record, Tree, plain_type
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
from harness.world.drivers import CONSTANT, OPEN_LOOP, UNIFORM, constant, open_loop
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.seats import places_by
from harness.world.state import WorldState

# How many of a dataset's scenes and trees stay in memory, the last ones read: some 120 and 100 MB.
SCENES_KEPT, TREES_KEPT = 4096, 512
TREES_AT_ONCE = 256  # how many trees become arrays at a time, in a pass over all trees


@dataclass(frozen=True)
class Earlier:
    """Have the decision point before another, in memory: calling it returns `scene`."""

    scene: "Scene | None"  # the decision point before another; None at the first

    def __call__(self) -> "Scene | None":
        return self.scene


@dataclass(frozen=True)
class Scene:
    """Hold one decision point of a dataset or of a drive: its state and its scene graphs.

    A scene graph is what one vehicle knows of the state. An agent is a vehicle that decides; the
    scene is as the agent that decides here sees it, with itself as the ego.
    """

    record: Record  # state and scene graphs, as a dataset has them
    # results computed from the scene, by name, kept so that they are computed once
    notes: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    # the scenario as it is here: as the vehicle that decides plays it, with itself as the ego, and
    # on this layout's road; None where that is the scenario's own ego, and its only road
    seat: Scenario | None = None
    agent: int = 0  # index of who decides among the vehicles that can be asked; the ego has 0
    several: bool = False  # whether vehicles beside the ego can decide in this scenario
    # returns the decision point before this one, or None at the first of a course and where it is
    # not known
    before: Callable[[], "Scene | None"] = field(default=Earlier(None), repr=False, compare=False)

    @classmethod
    def of(cls, record: Record, scenario: Scenario) -> "Scene":
        """Return a scene of a scenario's own ego, on its layout's road, by its record."""
        return cls(record, seat=own_road(scenario, record.episode_seed))

    @property
    def id(self) -> str:
        return self.record.scene

    @property
    def state(self) -> WorldState:
        return self.record.state

    @cached_property
    def graphs(self) -> Mapping[str, SceneGraph]:
        """Return the scene graph of the ego and of each helper, by the vehicle's id, the ego first.

        A scene graph is what one vehicle knows of the state.
        """
        graphs = self.record.graphs
        return {v.id: graphs[v.id] for v in self.state.vehicles if v.id in graphs}

    @cached_property
    def viewers(self) -> tuple[str, ...]:
        return tuple(self.graphs)

    def viewer(self, name: str | None) -> str:
        """Return a viewer's id: `name` itself, or the ego's for None.

        Raises UserError if no viewer of this scene has that name.
        """
        if name is not None and name not in self.viewers:
            raise unknown(f"viewer of scene {printable(self.id, 40)}", name, self.viewers)
        return self.viewers[0] if name is None else name

    def place(self, viewer: int) -> int:
        """Return the index of a vehicle among all that can be asked, the scenario's own ego first.

        `viewer` is its index in this scene's `viewers`, which begin with the agent, the vehicle
        that decides, of this scene.
        """
        if not viewer:
            return self.agent
        return viewer if viewer > self.agent else viewer - 1

    def changed(self, **fields: Any) -> "Scene":
        record = structs.replace(self.record, **fields)
        return replace(self, record=record, notes={})


def own_road(scenario: Scenario, seed: int) -> Scenario | None:
    """Return a scenario as the layout of a seed has it; None if its name alone says the road."""
    return scenario.at(seed) if scenario.has_own_world else None


def by_seat(scenes: Iterable[Scene], scenario: Scenario) -> Mapping[Scenario, list[int]]:
    """Group scenes by which vehicle decides: return their indices in `scenes` by scenario.

    A key is the scenario as that vehicle plays it, with itself as the ego: `scenario` itself for
    the scenario's own ego. Where several vehicles decide, each needs its own words and roads.
    """
    return places_by(scene.seat or scenario for scene in scenes)


class Trees(Sequence[Tree]):
    """Hold the decision trees of some episodes, each read when it is used.

    A decision tree has every course that decisions can take from one start situation. `numbers` are
    the episodes', and `read` returns the tree of a number.
    """

    def __init__(self, numbers: Iterable[int], read: Callable[[int], Tree]) -> None:
        self.numbers, self.read = tuple(numbers), read
        self.known = frozenset(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, place: Any, /) -> Any:
        return self.read(self.numbers[place])


@dataclass(frozen=True)
class Dataset:
    """Hold a verified dataset; its trees and scenes are read and verified when they are used.

    A decision tree has all that decisions can lead to from one layout, a start situation; a scene
    is one decision point.
    """

    path: Path  # the dataset's folder
    manifest: Manifest  # what the dataset was built from, and the digest of each file
    sha256: str  # hex digest of the manifest, which pins every file
    trees: Trees  # the decision trees of its layouts, in the order of the episodes
    trusted: bool = False  # whether it is a released dataset, whose digests vouch for its scenes
    kept: int = SCENES_KEPT  # how many scenes stay in memory, the last ones read
    # scenes that were read, by id
    _scenes: dict[str, Scene] = field(default_factory=dict, repr=False, compare=False)
    # ids of scenes whose content was found sound
    _checked: set[str] = field(default_factory=set, repr=False, compare=False)

    def __reduce__(self) -> Any:
        # Another process reads what it needs: to send what lies in memory would take longer.
        return Dataset, (self.path, self.manifest, self.sha256, self.trees, self.trusted)

    @property
    def name(self) -> str:
        return self.manifest.name

    @cached_property
    def scenario(self) -> Scenario:
        """Return the scenario, with the parameters with which the dataset was built."""
        return scenario_of(self.manifest)

    @property
    def actions(self) -> tuple[str, ...]:
        return tuple(self.manifest.actions)

    @property
    def episodes(self) -> tuple[int, ...]:
        return self.trees.numbers

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(self.manifest.seed + number for number in self.episodes)

    @cached_property
    def nodes(self) -> int:
        if len(self.trees) == self.manifest.episodes:
            return self.manifest.nodes
        return sum(len(level) for tree in self.trees for level in tree.levels)

    @cached_property
    def forest(self) -> Forest:
        return Forest.of(tuple(self.trees), self.actions, self.scenario.parameters)

    @property
    def dangerous(self) -> Bools:
        """Return whether each of the E episodes has a danger, a mask (E,).

        A danger is a vehicle that would meet an ego which keeps its speed.
        """
        return np.array([tree.danger.sector is not None for tree in self.trees])

    @property
    def clusters(self) -> Ints | None:
        """Return the number from 0 of each episode's cluster, (E,); None if each is of its own.

        A cluster is what layouts are cut from, such as a recording of traffic.
        """
        return cluster_numbers(self.cluster_names)

    @property
    def cluster_names(self) -> list[str | None]:
        """Return the name of each episode's cluster, (E,); None for one of its own."""
        return [self.scenario.cluster_of(seed) for seed in self.seeds]

    @property
    def lost(self) -> int:
        """Return in how many episodes the ego collides before its first action takes effect."""
        lag_s, forest = self.scenario.parameters.decision_lag_s, self.forest
        before_any = np.zeros(len(forest.edges), dtype=bool)  # whether each edge ends so
        for n, edge in enumerate(forest.edges):
            end = edge.end
            if end and end.result == "collision" and end.time_s <= lag_s:
                before_any[n] = True
        first_edges = forest.edge[forest.root]
        return int(before_any[first_edges].all(axis=1).sum())

    def of_episodes(self, numbers: Collection[int]) -> "Dataset":
        """Return this dataset restricted to the episodes with these numbers, in its own order.

        Nothing is read again.
        """
        if len(numbers) == len(self.episodes) and set(numbers) == set(self.episodes):
            return self
        trees = Trees((number for number in self.episodes if number in numbers), self.trees.read)
        return replace(self, trees=trees)

    @property
    def whole(self) -> "Dataset":
        """Return this dataset with all episodes of its folder, if some were left out."""
        return replace(self, trees=Trees(range(self.manifest.episodes), self.trees.read))

    def reference_success(self) -> dict[str, Floats]:
        """Return the success of each reference policy in each of E episodes, (E,), by name.

        It is 0 or 1, and for `uniform`, which draws actions, a probability. References need no
        model: they are the drivers, which are rules, `uniform`, and where their actions are known
        `constant` and `open-loop`, which always take the same ones.
        """
        parts: dict[str, list[Floats]] = {}
        action, actions = constant(self.scenario), open_loop(self.scenario)
        for start in range(0, len(self.trees), TREES_AT_ONCE):
            forest = self.of_episodes(self.episodes[start : start + TREES_AT_ONCE]).forest
            success = {name: forest.driver_success(name).astype(float) for name in forest.drivers}
            if action in forest.actions:
                success[CONSTANT] = forest.constant_success(action).astype(float)
            if actions and set(actions) <= set(forest.actions):
                success[OPEN_LOOP] = forest.sequence_success(actions).astype(float)
            success[UNIFORM] = forest.uniform_success()
            for name, values in success.items():
                parts.setdefault(name, []).append(values)
        return {name: np.concatenate(of_trees) for name, of_trees in parts.items()}

    def scenes(self, ids: Sequence[str]) -> list[Scene]:
        """Return the scenes with these ids, in their order, read from the folder where needed.

        A scene is one decision point. Raises UserError for a damaged one and KeyError for an
        unknown id.
        """
        missing: dict[tuple[int, int], list[int]] = {}  # indices within each level of each tree
        for name in ids:
            if name not in self._scenes:
                *level, place = self._place(name)
                missing.setdefault((level[0], level[1]), []).append(place)
        if missing:
            with opened(self.path) as file:
                for (number, step), places in missing.items():
                    seat = own_road(self.scenario, self.manifest.seed + number)
                    for record in self._records(file, self.trees.read(number), step, places):
                        before = partial(self._before, record.scene)
                        self._scenes[record.scene] = Scene(record, seat=seat, before=before)
        scenes = [self._scenes[name] for name in ids]
        for name in list(islice(self._scenes, max(0, len(self._scenes) - self.kept))):
            del self._scenes[name]
        return scenes

    def _before(self, name: str) -> Scene | None:
        """Return the decision point that leads to the one of this id; None at the first."""
        number, step, place = self._place(name)
        if not step:
            return None
        for point in self.trees.read(number).levels[step - 1]:
            if any(edge.to == place for edge in point.edges):
                return self.scenes([point.scene])[0]
        return None

    def __contains__(self, name: str) -> bool:
        try:
            self._place(name)
        except KeyError:
            return False
        return True

    def _place(self, name: str) -> tuple[int, int, int]:
        """Return a point's episode, step and index in that level.
        Raises KeyError for an unknown id.
        """
        if match := re.match("([0-9]{5})-([0-9])", name):
            episode, step = map(int, match.groups())
            levels = self.trees.read(episode).levels if episode in self.trees.known else []
            for place, point in enumerate(levels[step] if step < len(levels) else ()):
                if point.scene == name:
                    return episode, step, place
        raise KeyError(name)

    def _records(
        self, file: ZipFile, tree: Tree, step: int, places: Sequence[int]
    ) -> Iterator[Record]:
        try:
            lines = read_level(file, tree, step)
        except Damaged as damage:
            raise unusable(self.path, str(damage)) from None
        scenario = self.scenario.at(tree.episode_seed)
        for place in places:
            name = tree.levels[step][place].scene
            if self.trusted or name in self._checked:  # the level's digest vouches for it
                yield msgspec.json.decode(lines[place], type=plain_type(scenario))
                continue
            record, problems = decoded(scenario, lines[place], self.manifest, name)
            for problem in problems:
                raise unusable(self.path, problem)
            if record:
                self._checked.add(name)
                yield record

    def scene(self, scene_id: str) -> Scene:
        """Return the scene with the id `scene_id`, or with the only id that begins like this.

        A scene is one decision point. Raises UserError if there is none, or several.
        """
        ids = self.forest.ids
        matches = [name for name in ids if name.startswith(scene_id)] if scene_id else []
        if len(matches) != 1:
            candidates = matches or ids
            rest = " … (first dozen)" if len(candidates) > 12 else ""
            raise unknown("scene", scene_id, candidates[:12], rest)
        return self.scenes(matches)[0]

    def courses(self) -> tuple[str, ...]:
        """Return the ids of all decision points that some rule-based driver goes through, in order.

        They are those that reasonable driving leads to. Such a driver is a rule that decides
        without a model.
        """
        forest = self.forest
        visited = [forest.visited(chosen) for chosen in forest.drivers.values()]
        return tuple(forest.ids[n] for n in np.unique(np.concatenate(visited)).tolist())


def find(name: str) -> Path:
    """Return the folder of a dataset, given by its path or by its name.

    A name is one that ships or the project's. Raises UserError if there is no such dataset.
    """
    if os.path.isdir(name):  # unlike Path.is_dir, false for a name too long to be one
        sayable("dataset", os.path.basename(name))
        return Path(name)
    names = {manifest.parent.name for manifest in entries("datasets", "*/manifest.json")}
    if name in names:
        return beside("datasets", name)
    if name in released():
        raise UserError(
            f"dataset {printable(name)} is not in this installation, which has the newest of each "
            "family; clone the repository, which has all"
        )
    if os.path.isfile(name):
        raise UserError(
            f"dataset {printable(name)} is a file; a dataset is a folder that `harness dataset "
            "build` makes, and files of other programs are not read"
        )
    raise unknown("dataset", name, names, "; or give a folder made by `harness dataset build`")


def argument(path: Path) -> str:
    """Return the text by which `find` finds a dataset's folder again: its name, or else its path.

    The path is relative if the folder is below the current one.
    """
    try:
        if find(path.name).resolve() == path.resolve():
            return path.name
    except UserError:  # nothing of that name, or two
        pass
    target, here = path.resolve(), Path.cwd().resolve()
    return str(target.relative_to(here) if target.is_relative_to(here) else target)


def released() -> dict[str, str]:
    """Return the digest of the manifest of each dataset that is released, by its name.

    They are pinned in `datasets/released.toml`, so that no released dataset can change.
    """
    pins = folder("datasets") / "released.toml"
    return tomllib.loads(text_of(pins)) if pins.is_file() else {}


@uncollected()
def load(path: Path, limit: int | None = None) -> Dataset:
    """Read the dataset in the folder `path`; with `limit`, only its first episodes.

    Every file and every decision tree must have the digest in the manifest, and a tree pins its
    scenes. For a released dataset, whose manifest is pinned, this is enough; the content of any
    other dataset is checked as well. Raises UserError if a file is missing, changed or broken.
    """
    manifest, digest = read_manifest(path)
    for problem in file_problems(path, manifest):
        raise unusable(path, problem)
    trusted = digest in released().values()
    trees = Trees(range(manifest.episodes)[:limit], _Folder(path, manifest, trusted))
    for number in trees.numbers:
        trees.read(number)
    return Dataset(path, manifest, digest, trees, trusted)


@dataclass(frozen=True)
class _Folder:
    """Reads an episode's tree from a dataset's folder.
    Raises UserError if the dataset is damaged.
    """

    path: Path
    manifest: Manifest
    trusted: bool
    _kept: dict[int, Tree] = field(default_factory=dict, repr=False, compare=False)
    _checked: set[int] = field(default_factory=set, repr=False, compare=False)

    def __reduce__(self) -> Any:
        return _Folder, (self.path, self.manifest, self.trusted, {}, self._checked)

    def __call__(self, number: int) -> Tree:
        if number in self._kept:
            return self._kept[number]
        sound = self.trusted or number in self._checked
        try:
            with opened(self.path) as file:
                tree = read_tree(file, self.manifest, number, sound)
        except Damaged as damage:
            raise unusable(self.path, str(damage)) from None
        self._checked.add(number)
        self._kept[number] = tree
        if len(self._kept) > TREES_KEPT:
            del self._kept[next(iter(self._kept))]
        return tree
