"""Whether a dataset is what it says: its files by digest, each decision point by form and by sense."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from harness.core.config import convert
from harness.core.errors import UserError, printable, unknown
from harness.core.files import sha256_bytes, sha256_file
from harness.dataset.schema import Manifest, Record, record_type
from harness.world import scenarios
from harness.world.scenario import BEACON_DIALS, Scenario

_MANIFEST = msgspec.json.Decoder(Manifest)
_JSON = msgspec.json.Decoder()
_Lines = Iterator[tuple[dict[str, Any], list[str]]]


def read_manifest(path: Path) -> tuple[Manifest, str]:
    """The manifest and its digest."""
    file = path / "manifest.json"
    try:
        data = file.read_bytes()
        manifest = _MANIFEST.decode(data)
    except FileNotFoundError:
        raise UserError(
            f"{printable(path)} is no dataset (no manifest.json); build one with `harness dataset build`"
        ) from None
    except msgspec.ValidationError as error:
        what = misfit(error, data, Manifest, "manifest")
        raise UserError(f"{printable(file)}: {what}; build the dataset again") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(file)} cannot be read ({printable(error)}); build the dataset again"
        ) from None
    try:
        scenario = scenarios.get(manifest.scenario)
    except UserError as error:
        raise UserError(f"{printable(file)}: {error}") from None
    for problem in _manifest_problems(manifest, scenario):
        raise UserError(f"{printable(file)}: manifest {problem}; build the dataset again")
    return manifest, sha256_bytes(data)


def _manifest_problems(manifest: Manifest, scenario: Scenario) -> Iterator[str]:
    """What is wrong with a manifest that no type can state."""
    if len(set(manifest.actions)) < len(manifest.actions):
        yield "[actions]: an action stands there twice"
    if "scenes.jsonl" not in manifest.files:
        yield "[files] has no scenes.jsonl"
    expected = asdict(scenario.parameters)
    for name, value in manifest.parameters.items():
        if name not in expected:
            yield f"[parameters]: {unknown('parameter', name, expected)}"
        elif isinstance(value, list) != isinstance(expected[name], tuple):
            yield f"[parameters]: {name} = {value}; wanted is a value such as {expected[name]}"
    # A dataset from before beacons does not declare them: everybody knew the truth.
    known = set() if "perfect_knowledge" in manifest.parameters else {*BEACON_DIALS}
    if missing := expected.keys() - manifest.parameters.keys() - known:
        yield f"[parameters] has no {', '.join(sorted(missing))}"


def check(path: Path) -> list[str]:
    """Everything that is wrong with a dataset, one line each, with file and line number. Empty if sound."""
    manifest, _ = read_manifest(path)
    problems = list(file_problems(path, manifest))
    if (path / "scenes.jsonl").is_file():
        count, last_episode = 0, None
        for record, of_line in records(path / "scenes.jsonl", manifest):
            problems += of_line
            count, last_episode = count + 1, None if of_line else record["episode"]
        if count != manifest.decisions:
            problems.append(f"scenes.jsonl: {count} decision points, the manifest says {manifest.decisions}")
        elif last_episode is not None and last_episode + 1 != manifest.episodes:
            problems.append(
                f"scenes.jsonl: {last_episode + 1} episodes, the manifest says {manifest.episodes}"
            )
    return problems


def file_problems(path: Path, manifest: Manifest) -> Iterator[str]:
    """Which files of the manifest are missing or changed, a line each."""
    for name, expected in manifest.files.items():
        if not (path / name).is_file():
            yield f"{name}: missing"
        elif sha256_file(path / name) != expected:
            yield f"{name}: changed, its sha256 is not the manifest's"


def records(file: Path, manifest: Manifest) -> _Lines:
    """Each line's record, and what is wrong with it; a record is good for use only if nothing is."""
    scenario = scenarios.get(manifest.scenario)
    kind = record_type(scenario)
    decoder = msgspec.json.Decoder(kind)
    before: tuple[int, int] | None = (-1, 0)  # episode and step; None after a line that cannot be read
    with file.open("rb") as lines:
        for number, text in enumerate(lines, 1):
            where = f"{file.name} line {number}"
            last, before = before, None
            if not text.endswith(b"\n"):
                yield {}, [f"{where}: cut off"]
                continue
            try:
                record = decoder.decode(text)
            except msgspec.ValidationError as error:
                yield {}, [f"{where}: {misfit(error, text, kind, 'record')}"]
                continue
            except (ValueError, RecursionError) as error:
                yield {}, [f"{where}: no JSON ({printable(error)})"]
                continue
            problems = [f"{where}: {what}" for what in contradictions(scenario, record, manifest)]
            before = (record.episode, record.step)
            if last and before not in ((last[0], last[1] + 1), (last[0] + 1, 0)):
                problems.append(f"{where}: scene {record.scene} does not follow the line before")
            yield _JSON.decode(text), problems


def released(file: Path) -> _Lines:
    """Each line's record of a file known by its digest, in the form of `records`."""
    with file.open("rb") as lines:
        for text in lines:
            yield _JSON.decode(text), []


def misfit(error: msgspec.ValidationError, text: bytes, kind: type, what: str) -> str:
    """What of a JSON text does not fit a type, in one line."""
    try:
        if isinstance(table := _JSON.decode(text), dict):
            convert(table, kind, what)
    except UserError as mistake:
        return str(mistake)
    except (ValueError, RecursionError):  # of a part that the typed reading did not come to
        pass
    return printable(error)


def contradictions(scenario: Scenario, record: Record, manifest: Manifest) -> list[str]:
    """Where one part of a record speaks against another or the manifest, which no type can state."""
    state, graphs = record.state, record.graphs
    ids = [v.id for v in state.vehicles]
    viewers = {v.id for v in state.vehicles if v.part != "other"}
    nodes = {node.id for graph in graphs.values() for node in graph.nodes}
    conflicts = [conflict for graph in graphs.values() for conflict in graph.conflicts]
    speeds = manifest.parameters["target_speeds_mps"]
    holds = {
        "the action is not one of the manifest's": record.behaviour.action in manifest.actions,
        "outcomes are not those of the manifest's actions": record.outcomes.keys() == set(manifest.actions),
        "there is no target speed of that index": isinstance(speeds, list)
        and record.snapshot.speed_index < len(speeds),
        "scene is not <episode>-<step>": record.scene == f"{record.episode:05d}-{record.step}",
        "state is of another step": state.step == record.step,
        "state is of another episode seed": state.episode_seed == record.episode_seed,
        "two vehicles have one id": len(set(ids)) == len(ids),
        "the ego is not the first vehicle alone": [n for n, v in enumerate(state.vehicles) if v.part == "ego"]
        == [0],
        "graphs are not those of the ego and the helpers": graphs.keys() == viewers,
        "a graph is of another viewer": all(graph.viewer == viewer for viewer, graph in graphs.items()),
        "distances are not those of the ego and the helpers": record.distance_m.keys() == viewers,
        "a conflict is on a path that does not cross the ego's": {(c.sector, c.route) for c in conflicts}
        <= scenario.road().crossings.keys(),
        "a graph names a vehicle that is not there": nodes | {c.vehicle for c in conflicts} <= set(ids),
        "ranges are not those of the helpers": record.range_m.keys() in (set(), viewers - {ids[0]}),
        "the dangerous vehicle is not there": record.danger.vehicle in (None, *ids),
        "sections are not one a vehicle": len(record.snapshot.sections) == len(ids),
    }
    return [what for what, true in holds.items() if not true]
