"""`harness dataset build`: episodes into a folder, in any number of processes, and on after a kill.

Each finished episode is a file of its own under `.building/`; when all are there they become one
`scenes.jsonl`. The bytes depend on the scenario, the seed, the number of episodes and the folder's name
alone.
"""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from harness import __version__
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, sha256_bytes, write_whole
from harness.core.parallel import spread
from harness.dataset.freeze import Behaviour, freeze
from harness.dataset.schema import FILE_NAME, manifest_schema, record_schema, record_type
from harness.world.scenario import Scenario

WORK = ".building"


def build(
    scenario: Scenario, out: Path, episodes: int, seed: int, workers: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Build a dataset in `out`.

    Args:
        scenario: what is frozen.
        out: folder to make; its name is the dataset's name.
        episodes: how many; episode e has layout seed `seed + e`.
        seed: first layout seed.
        workers: processes.
        progress: called with the number of episodes just finished.

    Returns:
        The manifest.

    Raises:
        UserError: the folder holds a finished dataset, or one begun with other settings, or something else.
    """
    config = {
        **settings(scenario),
        "behaviour": asdict(Behaviour()),
        "episodes": episodes,
        "seed": seed,
        "versions": {
            "harness": __version__,
            **{name: version(name) for name in ("highway-env", "numpy", "shapely")},
        },
    }
    if not re.fullmatch(FILE_NAME, out.absolute().name):
        raise UserError(
            f"--out {printable(out)} cannot name a dataset; end it in letters, digits, '.', '_' or '-', "
            "a letter or digit first"
        )
    work = _begin(out, config)
    done = [e for e in range(episodes) if (work / _shard(e)).is_file()]
    progress(len(done))
    todo = sorted(set(range(episodes)) - set(done))
    spread(partial(_freeze_to_file, scenario, work, seed), todo, workers, progress)

    shards = [(work / _shard(e)).read_bytes() for e in range(episodes)]
    files = {
        "README.md": _readme(out.absolute().name, config).encode(),
        "scenes.jsonl": b"".join(shards),
        "scene.schema.json": _pretty(record_schema(scenario)),
        "manifest.schema.json": _pretty(manifest_schema()),
    }
    manifest = {
        "format": "swarmdrive-dataset/1",
        "name": out.absolute().name,
        **config,
        "decisions": sum(shard.count(b"\n") for shard in shards),
        "files": {name: sha256_bytes(data) for name, data in files.items()},
    }
    for name, data in files.items():
        write_whole(out / name, data)
    write_whole(out / "manifest.json", _pretty(manifest))
    shutil.rmtree(work)
    return manifest


def settings(scenario: Scenario) -> dict[str, Any]:
    """What decides how an episode goes, as JSON has it: scenario, actions, parameters."""
    parameters: dict[str, Any] = json.loads(canonical_json(asdict(scenario.parameters)))
    return {"scenario": scenario.name, "actions": list(scenario.actions), "parameters": parameters}


def _begin(out: Path, config: dict[str, Any]) -> Path:
    """The working folder, new or the one a killed build left. Refuses to touch anything else."""
    shown = printable(out)
    if (out / "manifest.json").exists():
        raise UserError(f"--out {shown} already holds a finished dataset; choose another folder or delete it")
    work = out / WORK
    if (work / "config.json").is_file():
        if json.loads((work / "config.json").read_text()) != config:
            raise UserError(
                f"--out {shown} holds a build begun with other settings; repeat those to go on, or delete it"
            )
    elif out.is_dir() and any(p.name != WORK for p in out.iterdir()):
        raise UserError(f"--out {shown} is a folder with other files in it; choose an empty or a new one")
    elif out.exists() and not out.is_dir():
        raise UserError(f"--out {shown} is a file; choose a folder")
    try:
        write_whole(work / "config.json", canonical_json(config))
    except OSError as error:
        raise UserError(
            f"--out {shown} cannot be written ({error.strerror}); choose another folder"
        ) from None
    return work


def _shard(episode: int) -> str:
    return f"{episode:05d}.jsonl"


def _freeze_to_file(scenario: Scenario, work: Path, seed: int, episode: int) -> None:
    records = freeze(scenario, seed + episode, episode, Behaviour())
    lines = [canonical_json(record) + "\n" for record in records]
    for line in lines:
        msgspec.json.decode(line, type=record_type(scenario))  # a record that breaks its own form is a bug
    write_whole(work / _shard(episode), "".join(lines))


def _pretty(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def _readme(name: str, config: dict[str, Any]) -> str:
    return f"""# {name}

{config["episodes"]} episodes of `{config["scenario"]}`, seeds {config["seed"]} to \
{config["seed"] + config["episodes"] - 1}, one record a decision point.
Built by `harness dataset build {config["scenario"]} --episodes {config["episodes"]} --seed {config["seed"]}`.

- `scenes.jsonl`: one JSON object a line; fields and units in `scene.schema.json`.
- `manifest.json`: scenario parameters, behaviour, versions, and the sha256 of every file.

Each record holds the whole state, every viewer's scene graph, and an outcome table: each meta-action taken,
followed by the full-view driver until the episode ends. `harness dataset check` verifies all of it.
"""
