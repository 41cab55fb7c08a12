"""Verify a dataset: its files by digest,
and each tree and decision point by type and consistency.
"""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from weakref import finalize
from zipfile import ZipFile

import msgspec

from harness.core.config import convert
from harness.core.errors import UserError, printable, unknown
from harness.core.files import bytes_of, refuse_bomb, sha256_bytes, sha256_file
from harness.core.files import opened as opened_file
from harness.core.seeds import purposes, seeds_text
from harness.core.zips import BROKEN_ZIP
from harness.dataset.schema import (
    LAYOUTS,
    Manifest,
    Record,
    Tree,
    plain_type,
    record_type,
    scene_id,
)
from harness.world import scenarios
from harness.world.drivers import drivers_of
from harness.world.families import keep
from harness.world.scenario import Scenario
from harness.world.state import Snapshot

_MANIFEST = msgspec.json.Decoder(Manifest)
_TREE = msgspec.json.Decoder(Tree)
_JSON = msgspec.json.Decoder()
LARGEST_ENTRY = 1 << 28  # bytes


def read_manifest(path: Path) -> tuple[Manifest, str]:
    """Read `manifest.json` of the dataset folder `path`; return it and its SHA-256 digest, in hex.

    Raises UserError if it is missing or wrong.
    """
    file = path / "manifest.json"
    try:
        data = bytes_of(file, "record")
        manifest = _MANIFEST.decode(data)
    except FileNotFoundError:
        raise UserError(
            f"{printable(path)} is no dataset (no manifest.json); build one with `harness dataset "
            "build`"
        ) from None
    except msgspec.ValidationError as error:
        what = misfit(error, data, Manifest, "manifest")
        raise UserError(f"{printable(file)}: {what}; build the dataset again") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(file)} cannot be read ({printable(error)}); build the dataset again"
        ) from None
    try:
        keep(manifest.scenario, path)
        scenario = scenarios.get(manifest.scenario)
    except UserError as error:
        raise UserError(f"{printable(file)}: {error}") from None
    for problem in _manifest_problems(manifest, scenario):
        raise UserError(f"{printable(file)}: manifest {problem}; build the dataset again")
    try:
        built_from = scenario_of(manifest)
    except UserError as error:
        raise UserError(f"{printable(file)}: {error}; build the dataset again") from None
    for problem in _contradictions_of(manifest, built_from):
        raise UserError(f"{printable(file)}: manifest {problem}; build the dataset again")
    return manifest, sha256_bytes(data)


def _manifest_problems(manifest: Manifest, scenario: Scenario) -> Iterator[str]:
    """Yield what is wrong with a manifest that no type can state."""
    if len(manifest.trees_sha256) != manifest.episodes:
        yield (
            f"[trees_sha256] has {len(manifest.trees_sha256)} digests for {manifest.episodes} "
            "episodes"
        )
    usual = asdict(scenario.parameters)
    for name, value in manifest.parameters.items():
        if name not in usual:
            yield f"[parameters]: {unknown('parameter', name, usual)}"
            continue
        example = usual[name]
        other_list = isinstance(value, list) != isinstance(example, tuple)
        other_text = isinstance(value, str) != isinstance(example, str)
        if other_list or other_text:
            yield f"[parameters]: {name} = {printable(value)}; wanted is a value such as {example}"
    later = dict(scenario.parameters.later)
    if missing := usual.keys() - later.keys() - manifest.parameters.keys():
        yield f"[parameters] has no {', '.join(sorted(missing))}"
    if scenario.world is None:
        return
    here, stated_environment = scenario.world.configuration(scenario) or {}, manifest.environment
    if stated_environment != here:
        there = stated_environment or {}
        differing = sorted(key for key, value in here.items() if there.get(key, here) != value)
        yield (
            "[environment]: here its configuration has another "
            f"{', '.join(differing) or 'set of keys'}"
        )


def _contradictions_of(manifest: Manifest, scenario: Scenario) -> Iterator[str]:
    """Yield what a manifest states otherwise than its seeds and its scenario, as it was built from.

    The order of actions counts, for values of actions go by it.
    """
    count, here = manifest.episodes, ", ".join(scenario.actions)
    if manifest.actions != list(scenario.actions):
        there = printable(", ".join(manifest.actions), 100)
        yield f"[actions] is {there}; those of its scenario are {here}, in this order"
    if purposes(manifest.seed, count) != [manifest.purpose]:
        yield f"[purpose] is {manifest.purpose}, but it is of {seeds_text(manifest.seed, count)}"
    texts = (
        ("source", manifest.source, scenario.source),
        ("licence", manifest.licence, scenario.licence),
    )
    for key, there, here in texts:
        if there != here:
            yield f"[{key}] is {printable(there, 80)!r}; that of its scenario is {here!r}"


def scenario_of(manifest: Manifest) -> Scenario:
    """Return the scenario that a dataset was built from, with its parameters, by its manifest.

    The manifest is the record of what the dataset was built from.
    """
    return scenarios.of_manifest(manifest.scenario, manifest.parameters)


def check(path: Path) -> list[str]:
    """Return all problems of the dataset in the folder `path`, one line each; empty if none.

    Every file, decision tree and scene is read. Raises UserError if the manifest is missing or
    wrong.
    """
    manifest, _ = read_manifest(path)
    problems, nodes = list(file_problems(path, manifest)), 0
    try:
        scenario = scenario_of(manifest)
        with opened(path) as file:
            for episode in range(manifest.episodes):
                tree_problems, points = _check_tree(scenario, file, manifest, episode)
                problems += tree_problems
                nodes += points
    except UserError as error:
        return [*problems, str(error)]
    if not problems and nodes != manifest.nodes:
        problems.append(f"{LAYOUTS}: {nodes} decision points, the manifest says {manifest.nodes}")
    return problems


def _check_tree(
    scenario: Scenario, file: ZipFile, manifest: Manifest, episode: int
) -> tuple[list[str], int]:
    """Return what is wrong with a tree and its scenes, and how many decision points it has."""
    try:
        tree = read_tree(file, manifest, episode)
        of_layout, problems = scenario.at(tree.episode_seed), list[str]()
        for step, level in enumerate(tree.levels):
            for line, point in zip(read_level(file, tree, step), level, strict=True):
                problems += decoded(of_layout, line, manifest, point.scene)[1]
        return problems, sum(len(level) for level in tree.levels)
    except Damaged as error:
        return [str(error)], 0


def file_problems(path: Path, manifest: Manifest) -> Iterator[str]:
    """Yield a line for each file of the manifest that is missing or whose digest differs.

    `path` is the dataset's folder.
    """
    for name, expected in manifest.files.items():
        if not (path / name).is_file():
            yield f"{name}: missing"
        elif sha256_file(path / name, "rows") != expected:
            yield f"{name}: changed, its sha256 is not the manifest's"


class Damaged(Exception):
    """Report that a part of a dataset is missing, broken or differs from its digest."""


@contextmanager
def opened(path: Path) -> Iterator[ZipFile]:
    """Open the archive `layouts.zip` of the dataset folder `path`, as long as the context lasts.

    Its entries are not yet verified. Raises UserError if it cannot be read.
    """
    file = path / LAYOUTS
    try:
        now = file.stat()
        yield _layouts(file, (now.st_ino, now.st_size, now.st_mtime_ns), os.getpid())
    except (OSError, *BROKEN_ZIP) as error:
        raise unusable(path, f"{LAYOUTS}: cannot be read ({printable(error)})") from None


@lru_cache(maxsize=2)
def _layouts(file: Path, state: tuple[int, int, int], process: int) -> ZipFile:
    """Open a file and keep it open, since listing the content of a large one takes long.

    A changed `state` opens it anew. So does another `process`,
    since a forked one shares its parent's position in the file.
    """
    data = opened_file(file, "rows")
    try:
        layouts = ZipFile(data)
        refuse_bomb(layouts, state[1])
    except BaseException:
        data.close()
        raise
    finalize(layouts, data.close)
    return layouts


def _entry(file: ZipFile, name: str, sha256: str) -> bytes:
    """Read a file in `layouts.zip`. Raises Damaged if it does not have the digest that was
    pinned.
    """
    try:
        if file.getinfo(name).file_size > LARGEST_ENTRY:
            raise Damaged(f"{LAYOUTS} {name}: too large")
        data = file.read(name)
    except (OSError, KeyError, *BROKEN_ZIP) as error:
        raise Damaged(f"{LAYOUTS} {name}: cannot be read ({printable(error)})") from None
    if sha256_bytes(data) != sha256:
        raise Damaged(f"{LAYOUTS} {name}: changed, its sha256 is not the one that was pinned")
    return data


def read_tree(file: ZipFile, manifest: Manifest, episode: int, trusted: bool = False) -> Tree:
    """Read an episode's decision tree: every course that decisions can take from its start.

    `file` is the archive `layouts.zip`, `episode` the episode's number, and `manifest` has the
    tree's digest. The content of a `trusted` dataset is not checked beyond its digest and types.
    Raises Damaged if its digest or content is wrong.
    """
    name = tree_name(episode)
    data = _entry(file, name, manifest.trees_sha256[episode])
    try:
        tree = _TREE.decode(data)
    except msgspec.ValidationError as error:
        raise Damaged(f"{LAYOUTS} {name}: {misfit(error, data, Tree, 'tree')}") from None
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{LAYOUTS} {name}: no JSON ({printable(error)})") from None
    for problem in () if trusted else tree_contradictions(tree, manifest, episode):
        raise Damaged(f"{LAYOUTS} {name}: {problem}")
    return tree


def read_level(file: ZipFile, tree: Tree, step: int) -> list[memoryview]:
    """Read the scenes of one step of a decision tree as JSON lines, one for each decision point.

    They are in the order of the tree. `file` is the archive `layouts.zip`, and `step` the number of
    the decision, from 0. Raises Damaged if the digest or the number of lines is wrong.
    """
    name = level_name(tree.episode, step)
    lines = _lines(_entry(file, name, tree.scenes_sha256[step]))
    if len(lines) != len(tree.levels[step]):
        raise Damaged(
            f"{LAYOUTS} {name}: {len(lines)} scenes, the tree has {len(tree.levels[step])}"
        )
    return lines


def _lines(data: bytes) -> list[memoryview]:
    """Return the lines without copying them, since a walk reads one of ten."""
    view, lines, start = memoryview(data), list[memoryview](), 0
    while start < len(data):
        end = data.find(b"\n", start)
        if end < 0:
            end = len(data)
        lines.append(view[start:end])
        start = end + 1
    return lines


def tree_name(episode: int) -> str:
    """Return the name of the file with an episode's decision tree in `layouts.zip`.

    `episode` is the episode's number.
    """
    return f"{episode:05d}/tree.json"


def level_name(episode: int, step: int) -> str:
    """Return the name of the file with the scenes of one decision of an episode.

    It is in `layouts.zip`. `episode` is the episode's number, and `step` that of the decision, from
    0.
    """
    return f"{episode:05d}/{step}.jsonl"


def tree_contradictions(tree: Tree, manifest: Manifest, number: int) -> list[str]:
    """Return how a decision tree contradicts itself or the manifest, one phrase each.

    A tree has all that decisions lead to from the start of an episode, whose number is `number`.
    Types are checked elsewhere.
    """
    actions = Counter(manifest.actions)
    drivers = set(drivers_of(scenarios.get(manifest.scenario)))
    points = [point for level in tree.levels for point in level]
    edges = [edge for point in points for edge in point.edges]
    ids = [point.scene for point in points]
    chosen = {action for point in points for action in point.drivers.values()}
    ids_fit, children_exist = True, True
    for step, level in enumerate(tree.levels):
        ids_fit &= all(point.scene.startswith(f"{number:05d}-{step}-") for point in level)
        following = tree.levels[step + 1] if step + 1 < len(tree.levels) else []
        leads_to = [edge.to for point in level for edge in point.edges]
        children_exist &= all(child is None or child < len(following) for child in leads_to)
    one_edge_an_action = True
    for point in points:
        on_edges = Counter(action for edge in point.edges for action in edge.actions)
        one_edge_an_action &= on_edges == actions
    measures = [each for edge in edges for each in (edge.ttc_s, edge.pet_s)]
    collisions = [edge for edge in edges if edge.end and edge.end.result == "collision"]
    conditions = {
        "its number is not that of its folder": tree.episode == number,
        "its seed is not the manifest's, counted on": tree.episode_seed == manifest.seed + number,
        "the first level is not the start alone": len(tree.levels[0]) == 1,
        "there is not a digest a level": len(tree.scenes_sha256) == len(tree.levels),
        "two decision points have one id": len(set(ids)) == len(ids),
        "an id is not <episode>-<step>-<digest>": ids_fit,
        "a reference driver is missing": all(point.drivers.keys() == drivers for point in points),
        "a reference driver's action is not one of the manifest's": chosen <= actions.keys(),
        "the edges of a decision point are not one an action": one_edge_an_action,
        "an edge leads nowhere, or goes on after the end": all(
            (edge.to is None) != (edge.end is None) for edge in edges
        ),
        "an edge leads to a decision point that is not there": children_exist,
        "some edges have measures of conflicts, and some have not": (
            len({measure is msgspec.UNSET for measure in measures}) <= 1
        ),
        "a collision is no conflict": all(
            edge.ttc_s is msgspec.UNSET or (edge.ttc_s, edge.pet_s) == (0.0, 0.0)
            for edge in collisions
        ),
    }
    return [problem for problem, holds in conditions.items() if not holds]


def decoded(
    scenario: Scenario, line: memoryview, manifest: Manifest, name: str
) -> tuple[Record | None, list[str]]:
    """Decode a scene's JSON line; return the scene's record, and a line for each problem.

    The record is None if it cannot be decoded, and may be used only if there is no problem.
    `scenario` is the dataset's as the scene's layout has it (`Scenario.at`), `manifest` is the
    dataset's, which the record must fit, and `name` is the scene id that it should have.
    """
    kind, where = record_type(scenario), f"{LAYOUTS} scene {name}"
    try:
        record = msgspec.json.decode(line, type=kind)
    except msgspec.ValidationError as error:
        return None, [f"{where}: {misfit(error, line, kind, 'record')}"]
    except (ValueError, RecursionError) as error:
        return None, [f"{where}: no JSON ({printable(error)})"]
    problems = [f"{where}: {what}" for what in contradictions(scenario, record, manifest, name)]
    return msgspec.json.decode(line, type=plain_type(scenario)), problems


def unusable(path: Path, problem: str) -> UserError:
    """Return the error for the dataset in the folder `path` that has a problem.

    `problem` is a phrase, such as that a file is missing. The error says what to do about it.
    """
    return UserError(
        f"dataset {printable(path)}, {problem}; `harness dataset check` lists all; restore or "
        "rebuild it"
    )


def misfit(error: msgspec.ValidationError, text: bytes | memoryview, kind: type, what: str) -> str:
    """Return in one line where a JSON text does not fit the type `kind`, for an error.

    `text` was decoded as that, and `what` names it; `error` is msgspec's, which is used if no
    better words are found.
    """
    try:
        if isinstance(table := _JSON.decode(text), dict):
            convert(table, kind, what)
    except UserError as mistake:
        return str(mistake)
    except (ValueError, RecursionError):  # an error in a part that the typed reading did not reach
        pass
    return printable(error)


def contradictions(scenario: Scenario, record: Record, manifest: Manifest, name: str) -> list[str]:
    """Return how a scene's record contradicts itself, its scenario or the manifest, in phrases.

    A scene is one decision point of the dataset, and `name` the scene id that it should have.
    """
    state, graphs = record.state, record.graphs
    ids = [v.id for v in state.vehicles]
    viewers = {v.id for v in state.vehicles if v.part != "other"}
    nodes = {node.id for graph in graphs.values() for node in graph.nodes}
    conflicts = [conflict for graph in graphs.values() for conflict in graph.conflicts]
    named = nodes | {conflict.vehicle for conflict in conflicts}
    egos = [n for n, v in enumerate(state.vehicles) if v.part == "ego"]
    road, speeds = scenario.road(), manifest.parameters["target_speeds_mps"]
    # None in a world that is played elsewhere, whose snapshots are other ones
    snapshot = record.snapshot if isinstance(record.snapshot, Snapshot) else None
    conditions = {
        "it is the scene of another decision point": record.scene == name,
        "there is no target speed of that index": (
            isinstance(speeds, list) and (not snapshot or snapshot.speed_index < len(speeds))
        ),
        "scene is not <episode>-<step>-<digest>": record.scene.startswith(
            f"{record.episode:05d}-{record.step}-"
        ),
        "its id is not the digest of its state": record.scene == scene_id(record.episode, state),
        "state is of another step": state.step == record.step,
        "state is of another episode seed": state.episode_seed == record.episode_seed,
        "two vehicles have one id": len(set(ids)) == len(ids),
        "the ego is not the first vehicle alone": egos == [0],
        "graphs are not those of the ego and the helpers": graphs.keys() == viewers,
        "a graph is of another viewer": all(
            graph.viewer == viewer for viewer, graph in graphs.items()
        ),
        "distances are not those of the ego and the helpers": record.distance_m.keys() == viewers,
        "a conflict is on a path that does not meet the ego's": all(
            (c.sector, c.route) in (road.crossings if c.meets else road.paths) for c in conflicts
        ),
        "a graph names a vehicle that is not there": named <= set(ids),
        "ranges are not those of the helpers": record.range_m.keys() == viewers - {ids[0]},
        "the dangerous vehicle is not there": record.danger.vehicle in (None, *ids),
        "sections are not one a vehicle": not snapshot or len(snapshot.sections) == len(ids),
    }
    return [problem for problem, holds in conditions.items() if not holds]
