"""Report layouts that state tune seeds, as somebody who means harm would have them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import msgspec
import pytest
from former import SCENARIO

from harness.core.files import sha256_bytes
from harness.core.seeds import purpose
from harness.dataset.build import build
from harness.dataset.load import load
from harness.dataset.schema import scene_id
from harness.world.state import WorldState

SEED = 3_000_000  # of no layout that ships
# Of few decisions, whose tree is soon built.
FEW = replace(SCENARIO, parameters=replace(SCENARIO.parameters, decisions=3, time_limit_s=4.0))


@pytest.fixture(scope="session")
def relabelled(once: Callable[..., Path]) -> Path:
    """Two report layouts under tune seeds, with every digest and id in order."""

    def fill(folder: Path) -> None:
        build(FEW, folder / "relabelled", 2, SEED, 1, lambda done: None)
        relabel(folder / "relabelled", {n: n for n in range(2)})

    return once("relabelled", fill) / "relabelled"


@pytest.fixture(scope="session")
def run_of_it(once: Callable[..., Path], relabelled: Path) -> Path:
    """What the proxy answers there, helpers included."""
    from evaluating import run, spec_of

    spec = spec_of(load(relabelled), ask="all", seeds=(0,))
    return once("run-of-relabelled", lambda folder: run(spec, folder / "run")) / "run"


def relabel(
    dataset: Path, seeds: dict[int, int], of_tree: Callable[[Any], None] | None = None,
    of_scenes: Callable[[Any], None] | None = None,
) -> None:  # fmt: skip
    """Give a dataset's layouts other seeds, and change trees and scenes,
    as somebody who means harm would.
    """
    with ZipFile(dataset / "layouts.zip") as file:
        entries = {each: file.read(each) for each in file.namelist()}
    manifest = json.loads((dataset / "manifest.json").read_text())
    for number, seed in seeds.items():
        tree = json.loads(entries[f"{number:05d}/tree.json"])
        tree["episode_seed"] = seed
        for step, level in enumerate(tree["levels"]):
            name = f"{number:05d}/{step}.jsonl"
            records = [json.loads(line) for line in entries[name].splitlines()]
            for point, record in zip(level, records, strict=True):
                if of_scenes:
                    of_scenes(record)
                record["episode_seed"] = record["state"]["episode_seed"] = seed
                state = msgspec.convert(record["state"], WorldState)
                record["scene"] = point["scene"] = scene_id(number, state)
            entries[name] = "".join(json.dumps(record) + "\n" for record in records).encode()
        hashes = [
            sha256_bytes(entries[f"{number:05d}/{n}.jsonl"]) for n in range(len(tree["levels"]))
        ]
        tree["scenes_sha256"] = hashes
        if of_tree:
            of_tree(tree)
        entries[f"{number:05d}/tree.json"] = json.dumps(tree).encode()
        manifest["trees_sha256"][number] = sha256_bytes(entries[f"{number:05d}/tree.json"])
    manifest |= {"seed": seeds[0], "purpose": purpose(seeds[0], manifest["episodes"])}
    (dataset / "manifest.json").write_text(json.dumps(manifest))
    with ZipFile(dataset / "layouts.zip", "w") as file:
        for name, data in entries.items():
            file.writestr(name, data)
