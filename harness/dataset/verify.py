"""Whether a dataset is what it says: its files by digest, each decision point by schema and by sense."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness.core.errors import UserError, printable
from harness.core.files import sha256_bytes, sha256_file
from harness.dataset.schema import fits_manifest, fits_record, manifest_validator, record_validator
from harness.world import scenarios
from harness.world.scenario import Scenario


def read_manifest(path: Path) -> tuple[dict[str, Any], str]:
    """The manifest, valid by the schema of its scenario, and its digest."""
    file = path / "manifest.json"
    try:
        data = file.read_bytes()
        manifest = _parsed(data)
    except FileNotFoundError:
        raise UserError(
            f"{printable(path)} is no dataset (no manifest.json); build one with `harness dataset build`"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(file)} cannot be read ({printable(error)}); build the dataset again"
        ) from None
    scenario = _scenario(file, manifest)
    valid = fits_manifest(scenario, manifest)
    for broken in () if valid else manifest_validator(scenario).iter_errors(manifest):
        raise UserError(
            f"{printable(file)} at {printable(broken.json_path)}: {printable(broken.message)}; "
            "build the dataset again"
        )
    return manifest, sha256_bytes(data)


def _scenario(file: Path, manifest: Any) -> Scenario:
    """The scenario that a manifest names; some other where it names none, which its schema then refuses."""
    name = manifest.get("scenario") if isinstance(manifest, dict) else None
    try:
        return scenarios.get(name if isinstance(name, str) else scenarios.DEFAULT)
    except UserError as error:
        raise UserError(f"{printable(file)}: {error}") from None


def check(path: Path) -> list[str]:
    """Everything that is wrong with a dataset, one line each, with file and line number. Empty if sound."""
    manifest, _ = read_manifest(path)
    problems = list(file_problems(path, manifest))
    if (path / "scenes.jsonl").is_file():
        found = list(records(path / "scenes.jsonl", manifest))
        problems += [problem for _, of_line in found for problem in of_line]
        last = found[-1][0] if found and not found[-1][1] else None
        if len(found) != manifest["decisions"]:
            stated = manifest["decisions"]
            problems.append(f"scenes.jsonl: {len(found)} decision points, the manifest says {stated}")
        elif last and last["episode"] + 1 != manifest["episodes"]:
            stated = manifest["episodes"]
            problems.append(f"scenes.jsonl: {last['episode'] + 1} episodes, the manifest says {stated}")
    return problems


def file_problems(path: Path, manifest: dict[str, Any]) -> Iterator[str]:
    """Which files of the manifest are missing or changed, a line each."""
    for name, expected in manifest["files"].items():
        if not (path / name).is_file():
            yield f"{name}: missing"
        elif sha256_file(path / name) != expected:
            yield f"{name}: changed, its sha256 is not the manifest's"


def records(file: Path, manifest: dict[str, Any]) -> Iterator[tuple[dict[str, Any], list[str]]]:
    """Each line's record, and what is wrong with it; a record is good for use only if nothing is."""
    scenario = scenarios.get(manifest["scenario"])
    fits = fits_record(scenario)
    before: tuple[int, int] | None = (-1, 0)  # episode and step; None after a line that cannot be read
    with file.open("rb") as lines:
        for number, text in enumerate(lines, 1):
            where = f"{file.name} line {number}"
            last, before = before, None
            if not text.endswith(b"\n"):
                yield {}, [f"{where}: cut off"]
                continue
            try:
                record = _parsed(text)
            except (ValueError, RecursionError) as error:
                yield {}, [f"{where}: no JSON ({printable(error)})"]
                continue
            wrong = () if fits(record) else record_validator(scenario).iter_errors(record)
            broken = sorted(wrong, key=lambda e: e.json_path)
            problems = [f"{where} at {printable(e.json_path)}: {printable(e.message)}" for e in broken[:3]]
            if not broken:
                problems = [f"{where}: {what}" for what in _contradictions(scenario, record)]
                before = (record["episode"], record["step"])
                if last and before not in ((last[0], last[1] + 1), (last[0] + 1, 0)):
                    problems.append(f"{where}: scene {record['scene']} does not follow the line before")
            yield record, problems


def released(file: Path) -> Iterator[tuple[dict[str, Any], list[str]]]:
    """Each line's record of a file known by its digest, in the form of `records`."""
    with file.open("rb") as lines:
        for text in lines:
            yield json.loads(text), []


def _parsed(text: bytes) -> Any:
    """JSON without NaN and Infinity. Raises ValueError, or RecursionError where it is nested too deeply."""

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON number")

    return json.loads(text, parse_constant=refuse)


def _contradictions(scenario: Scenario, record: dict[str, Any]) -> list[str]:
    """Where one part of a record speaks against another, which no schema can state."""
    state, graphs = record["state"], record["graphs"]
    ids = [v["id"] for v in state["vehicles"]]
    parts = [v["part"] for v in state["vehicles"]]
    viewers = {v["id"] for v in state["vehicles"] if v["part"] != "other"}
    nodes = {node["id"] for graph in graphs.values() for node in graph["nodes"]}
    conflicts = [conflict for graph in graphs.values() for conflict in graph["conflicts"]]
    holds = {
        "scene is not <episode>-<step>": record["scene"] == f"{record['episode']:05d}-{record['step']}",
        "state is of another step": state["step"] == record["step"],
        "state is of another episode seed": state["episode_seed"] == record["episode_seed"],
        "two vehicles have one id": len(set(ids)) == len(ids),
        "the ego is not the first vehicle alone": [n for n, p in enumerate(parts) if p == "ego"] == [0],
        "graphs are not those of the ego and the helpers": graphs.keys() == viewers,
        "a graph is of another viewer": all(graph["viewer"] == viewer for viewer, graph in graphs.items()),
        "distances are not those of the ego and the helpers": record["distance_m"].keys() == viewers,
        "a conflict is on a path that does not cross the ego's": {
            (c["sector"], c["route"]) for c in conflicts
        }
        <= scenario.road().crossings.keys(),
        "a graph names a vehicle that is not there": nodes | {c["with"] for c in conflicts} <= set(ids),
        "the dangerous vehicle is not there": record["danger"]["vehicle"] in (None, *ids),
        "sections are not one a vehicle": len(record["snapshot"]["sections"]) == len(ids),
    }
    return [what for what, true in holds.items() if not true]
