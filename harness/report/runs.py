"""The runs that one report holds side by side."""

import json
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.memory import uncollected
from harness.dataset.load import Dataset
from harness.runs.contradictions import refuse
from harness.runs.folder import Run, read
from harness.runs.records import ClosedLoop, FrozenScenes
from harness.runs.run_dataset import dataset_of
from harness.world.scenario import Scenario


@dataclass(frozen=True)
class Runs:
    """Hold the finished runs that one report shows: on the same scenes, in the same world.

    `names` has the display name of each of `runs`. `dataset` has the scenes of frozen runs; it is
    None for closed-loop runs, which a simulator plays.
    """

    runs: tuple[Run, ...]  # in the order given
    names: tuple[str, ...]  # model, prompt and, where two would be equal, more
    dataset: Dataset | None  # where the scenes of frozen runs are from; None for closed-loop runs

    @property
    def live(self) -> bool:
        """Return whether the runs are closed-loop runs, which have no dataset.

        In closed loop a simulator plays the episodes.
        """
        return self.dataset is None

    @property
    def actions(self) -> tuple[str, ...]:
        """Return the names of what the ego can do, the meta-actions of the runs.

        Every probability distribution is in this order.
        """
        return self.runs[0].actions

    @property
    def scenario(self) -> Scenario:
        """Return the scenario in which the runs' episodes play, with the parameters it had then."""
        if self.dataset is not None:
            return self.dataset.scenario
        return self.runs[0].manifest.scenario

    def of_scenes(self, ids: Collection[str]) -> "Runs":
        """Return a copy with some scenes alone, by id, and the decision trees of their episodes.

        A decision tree has every course that actions can lead to from one start situation.
        """
        runs = tuple(run.of_scenes(ids) for run in self.runs)
        layouts = {number for run in runs for number in run.grid.episodes}
        return replace(self, runs=runs, dataset=self.dataset and self.dataset.of_episodes(layouts))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Return the names of all conditions of the runs, each once.

        A condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        return tuple(dict.fromkeys(name for run in self.runs for name in run.conditions))


@uncollected()
def gather(paths: Sequence[Path], dataset: Dataset | Path | None = None) -> Runs:
    """Read runs that one report shows together.

    Args:
        paths: the runs' folders.
        dataset: the runs' dataset, already loaded (the right one is read if its digest differs), or
            the folder to find it in; None to look where it was.

    Raises:
        UserError: a folder is no run or contradicts itself, its dataset is missing or has changed,
            two runs have different scenes, or a folder is given for closed-loop runs.
    """
    runs = [read(path) for path in dict.fromkeys(paths)]
    if not isinstance(dataset, Dataset):  # else they were just made
        for run in runs:
            refuse(run)
    first, *rest = runs
    for run in rest:
        if _scenes(first) != _scenes(run):
            raise UserError(
                f"{printable(first.path)} and {printable(run.path)} are not of the same scenes "
                f"({_scene_words(first)} and {_scene_words(run)}{parameters_apart(first, run)}); "
                "report them apart"
            )
    world = first.manifest.world
    if not isinstance(world, FrozenScenes):
        if isinstance(dataset, Path):
            raise UserError(
                f"--dataset {printable(dataset)}: {printable(first.path)} was driven; leave it out"
            )
        run_dataset = None
    elif isinstance(dataset, Dataset) and dataset.sha256 == world.sha256:
        run_dataset = dataset
    else:
        run_dataset = dataset_of(first, dataset if isinstance(dataset, Path) else None)
    return Runs(tuple(runs), _names(runs), run_dataset)


def _scenes(run: Run) -> Any:
    """Return what pins a run's scenes."""
    world = run.manifest.world
    if isinstance(world, FrozenScenes):
        return run.actions, world.sha256
    return run.actions, world.scenario, world.first_seed


def _scene_words(run: Run) -> str:
    world = run.manifest.world
    if isinstance(world, FrozenScenes):
        return f"{printable(world.name, 40)} {printable(world.sha256, 12)}"
    return f"driven in closed loop from layout seed {world.first_seed}"


def parameters_apart(one: Run, other: Run) -> str:
    """Return in words, after a comma, which parameters of two driven runs' scenarios differ."""
    worlds = one.manifest.world, other.manifest.world
    given = [world.pinned[1] for world in worlds if isinstance(world, ClosedLoop)]
    texts = []
    for name in sorted(given[0].keys() | given[1].keys()) if len(given) == 2 else ():
        values = [json.dumps(each.get(name)) for each in given]
        if values[0] != values[1]:
            texts.append(f", {printable(name, 40)} {printable(' and '.join(values), 60)}")
    return "".join(texts[:3])


def _names(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return names that tell the runs apart, with no more than that takes: model and prompt,
    then the answer mode, the folder, and a number.
    """
    parts = list[tuple[str, ...]]()
    for run in runs:
        variant = run.manifest.variant
        if variant.helpers:
            parts.append((str(variant), run.path.name))
        else:
            model = f"{variant.model} · {variant.prompt}"
            parts.append((model, variant.answer, run.path.name))
    for count in (1, 2, 3):
        names = [" · ".join(of_run[:count]) for of_run in parts]
        if len(set(names)) == len(names):
            return tuple(names)
    total, turn = Counter(names), Counter[str]()
    for n, name in enumerate(names):
        turn[name] += 1
        names[n] += f" ({turn[name]})" if total[name] > 1 else ""
    return tuple(names)
