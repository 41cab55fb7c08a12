"""Rebuild a few layouts of a dataset from the seeds that it states, so that its purpose is a fact.

A folder can state any seeds, and layouts that numbers are reported of might be called tune layouts.
What learns from a dataset, or chooses by it, holds it against the simulator first, and against
others' scenes.

First scenes are held against what their seeds give, in milliseconds each. Whole trees take a second
or more, so that only a few are built. Which ones follows from the dataset and from the name of this
machine: typing a command again draws no others, and who made the dataset does not know them.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from importlib.util import find_spec
from typing import NamedTuple

import msgspec
from msgspec import UNSET, to_builtins
from msgspec.structs import replace

from harness.core.errors import UserError, printable
from harness.core.files import bytes_of, digest, sha256_bytes
from harness.core.plugins import say_once
from harness.core.resources import folder
from harness.dataset.load import Dataset, load, released
from harness.dataset.schema import Branching, Manifest, Record, Tree, scene_id
from harness.dataset.select import spot_check
from harness.world.scenario import Scenario
from harness.world.state import VehicleState, WorldState

BEGUN, REBUILT = 1000, 3  # layouts of which the first scene is built, and the whole tree


def refuse(dataset: Dataset, others: Iterable[Dataset] = ()) -> None:
    """Raise UserError unless a dataset is what its seeds give, and shares no layout with test data.

    A layout is the start situation of an episode, drawn by its seed. Some are rebuilt in the
    simulator; without the simulator this is skipped.

    Args:
        dataset: one that something is trained on or chosen by; a released one always passes.
        others: datasets on which the same command reports results, beside all that ship.
    """
    if dataset.trusted:
        return
    refuse_reported(dataset, (*others, *_reported(dataset.scenario.name)))
    if find_spec("highway_env") is None:
        say_once(
            f"dataset {printable(dataset.path)}: whether its layouts are those of its seeds is not "
            "checked, which needs highway-env"
        )
    for difference in differences(dataset):
        raise UserError(f"dataset {printable(dataset.path)}: {difference}; build it again")


def refuse_reported(dataset: Dataset, others: Iterable[Dataset]) -> None:
    """Raise UserError if a dataset to learn from shares a start with data to report results on.

    `others` are the datasets to report on. Starts, first scenes of episodes, are equal if all
    numbers of their vehicles, rounded to 0.01, are, whatever their seeds. Those of two scenarios,
    such as two recordings, are equal if `Start.is_part` says so.
    """
    starts = _starts(dataset)
    for other in others:
        is_other = other.scenario.name != dataset.scenario.name
        _refuse_shared(f"dataset {printable(dataset.path)}", starts, other, is_other)


def refuse_drawn(scenario: Scenario, seeds: Iterable[int]) -> None:
    """Raise UserError if a layout to learn from begins as one of a released report dataset does.

    Seeds tell layouts of one scenario apart; of another, such as a recording of the same traffic,
    they say nothing.
    """
    reported = [each for each in _reported(scenario.name) if each.scenario.name != scenario.name]
    if not reported:
        return
    starts = [Start.of(f"layout {seed}", _first_state(scenario, seed)) for seed in seeds]
    for other in reported:
        _refuse_shared(f"scenario {printable(scenario.name)}", starts, other, True)


def _refuse_shared(what: str, starts: Sequence["Start"], other: Dataset, is_other: bool) -> None:
    """Raise UserError at a start that a dataset, `is_other` of another scenario, has, too."""
    other_starts: dict[str, list[Start]] = {}
    for start in _starts(other):
        other_starts.setdefault(start.ego if is_other else start.whole, []).append(start)
    for start in starts:
        for same in other_starts.get(start.ego if is_other else start.whole, ()):
            if not is_other or start.is_part(same):
                raise UserError(
                    f"{what} has {start.name}, which is {same.name} of {printable(other.name)}, "
                    "and numbers are reported of that; build one of other seeds"
                )


def differences(dataset: Dataset) -> Iterator[str]:
    """Yield a line if start situations of a dataset are not what the seeds that it states give.

    A layout is such a situation, drawn by its seed. The first scene of up to `BEGUN` layouts is
    rebuilt, then up to `REBUILT` whole decision trees (all that decisions lead to). Nothing is
    yielded if the simulator is not installed.
    """
    if find_spec("highway_env") is None:
        return
    if dataset.scenario.world:
        yield from dataset.scenario.world.problems(dataset.scenario)
    numbers = _other_starts(dataset, drawn(dataset, BEGUN))
    numbers = numbers or _other_trees(dataset, drawn(dataset, REBUILT))
    if numbers:
        from importlib.metadata import version

        stated_version = dataset.manifest.versions.get("highway-env", "none")
        here, there = version("highway-env"), printable(stated_version, 20)
        versions = "" if here == stated_version else f" by highway-env {here}, of {there}"
        seed = dataset.manifest.seed + numbers[0]
        more = f"; {len(numbers) - 1} more" if len(numbers) > 1 else ""
        yield f"layout {numbers[0]} is not what layout seed {seed} gives{versions}{more}"


def drawn(dataset: Dataset, count: int) -> list[int]:
    """Draw up to `count` episodes of a dataset to rebuild, by number; the same on one machine."""
    return spot_check(dataset.episodes, dataset.sha256, count)


def _other_starts(dataset: Dataset, numbers: Sequence[int]) -> list[int]:
    """Return which of these layouts have another first scene than the simulator gives."""
    forest, scenario, seed = dataset.forest, dataset.scenario, dataset.manifest.seed
    ids = [forest.ids[root] for root in forest.root.tolist()]
    first = dict(zip(dataset.episodes, ids, strict=True))
    dataset.scenes([first[number] for number in numbers])  # checks their content
    differing = []
    for number in sorted(numbers):
        if scene_id(number, _first_state(scenario, seed + number)) != first[number]:
            differing.append(number)
    return differing


def _other_trees(dataset: Dataset, numbers: Sequence[int]) -> list[int]:
    """Return which of these layouts have another tree than the simulator gives."""
    from harness.dataset.freeze import freeze

    seeds = {number: dataset.manifest.seed + number for number in numbers}
    differing = list[int]()
    for number, rebuilt in zip(numbers, freeze(dataset.scenario, seeds), strict=True):
        tree = dataset.trees.read(number)
        records = [record for level in rebuilt.scenes for record in level]
        ids = [point.scene for level in tree.levels for point in level]
        scenes = dataset.scenes(ids)  # checks their content
        if (
            tree.danger != records[0].danger
            or _courses(rebuilt.branchings, tree) != _courses(tree.levels, tree)
            or [_seen(record) for record in records] != [_seen(scene.record) for scene in scenes]
        ):
            differing.append(number)
    return differing


def _courses(levels: Sequence[Sequence[Branching]], stored_tree: Tree) -> list[list[object]]:
    """Return the decision points of a layout by step, what drivers do there,
    and where each action leads.

    Edges are without what that of an older dataset, `stored_tree`, does not have.
    """
    has_conflicts = stored_tree.levels[0][0].edges[0].ttc_s is not UNSET
    courses = []
    for level in levels:
        points: list[object] = []
        for point in level:
            edges = point.edges
            if not has_conflicts:
                edges = [replace(edge, ttc_s=UNSET, pet_s=UNSET) for edge in edges]
            points.append((point.scene, point.drivers, edges))
        courses.append(points)
    return courses


def _seen(record: Record) -> tuple[object, ...]:
    """Return what a scene states beside its state, whose digest is in its id."""
    return record.danger, record.graphs, record.distance_m, record.range_m


def _reported(scenario: str) -> Iterator[Dataset]:
    """Yield the released datasets of a scenario, all of which are of report seeds.

    Of a family, such as that of recordings, those of all its scenarios are.
    """
    pinned, family = released().values(), scenario.partition(":")[0]
    for path in sorted(folder("datasets").glob("*/manifest.json")):
        data = bytes_of(path, "record")
        if sha256_bytes(data) not in pinned:
            continue
        # Pinned, so that it is decoded as it is: checks of a recording would take seconds.
        manifest = msgspec.json.decode(data, type=Manifest)
        if manifest.scenario.partition(":")[0] == family and manifest.purpose == "report":
            yield load(path.parent)


class Start(NamedTuple):
    """Hold what is there as an episode begins, by digests of numbers to 1 cm or 0.01."""

    name: str  # the first scene's id, or which layout it is
    whole: str  # of all vehicles
    ego: str  # of how the ego drives, wherever it is
    others: frozenset[str]  # of each other: where it is from the ego, and how it drives

    @classmethod
    def of(cls, name: str, state: WorldState) -> "Start":
        """Return the start that a state is."""
        ego, *others = state.vehicles
        whole = digest([_coarse(vehicle) for vehicle in state.vehicles])
        return cls(name, whole, _moves(ego, ego), frozenset(_moves(each, ego) for each in others))

    def is_part(self, other: "Start") -> bool:
        """Return whether both egos drive alike, half of whom one has at least beside the same.

        So it is of two recordings of one traffic, whatever they call it, and how much of it they
        show.
        """
        fewer = min(len(self.others), len(other.others))
        return self.ego == other.ego and 0 < fewer <= 2 * len(self.others & other.others)


def _moves(vehicle: VehicleState, ego: VehicleState) -> str:
    """Return the digest of where a vehicle is as the ego sees it, and how it drives, to 0.01.

    It is the same however the map is turned.
    """
    dx_m, dy_m = vehicle.x_m - ego.x_m, vehicle.y_m - ego.y_m
    cos, sin = math.cos(ego.heading_rad), math.sin(ego.heading_rad)
    turned_rad = math.remainder(vehicle.heading_rad - ego.heading_rad, math.tau)
    numbers = (dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin, turned_rad, vehicle.speed_mps)
    return digest([vehicle.kind, *(round(number, 2) + 0.0 for number in numbers)])


def _starts(dataset: Dataset) -> list[Start]:
    """Return the starts of all episodes of a dataset, whatever the seeds are."""
    forest = dataset.forest
    scenes = dataset.scenes([forest.ids[root] for root in forest.root.tolist()])
    return [Start.of(f"scene {scene.id}", scene.state) for scene in scenes]


def _first_state(scenario: Scenario, seed: int) -> WorldState:
    """Return the state in which the layout of a seed begins."""
    from harness.world.world import World

    return World.start(scenario, seed).state()


def _coarse(vehicle: VehicleState) -> dict[str, object]:
    """Return a vehicle with its numbers to 0.01,
    since a difference of a rounding makes no other layout.
    """
    fields = to_builtins(vehicle).items()
    return {key: round(value, 2) if isinstance(value, float) else value for key, value in fields}
