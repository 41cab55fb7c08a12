"""Publish datasets in forms that other programs load:
Parquet tables, a card and a Croissant file.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from harness.core.errors import UserError, printable
from harness.core.figures import known
from harness.core.files import making, refuse_taken, sha256_file, write_whole
from harness.core.progress import Progress
from harness.core.statistics import rate_interval
from harness.dataset.card import CROISSANT, README, Table, croissant, path_of, readme
from harness.dataset.columns import SCHEMA
from harness.dataset.load import Dataset, Scene, load
from harness.dataset.schema import FILE_NAME
from harness.dataset.verify import read_manifest
from harness.world.scenario import Scenario
from harness.world.scenarios import title
from harness.world.scene_graph import SceneGraph

TOGETHER = 8  # layouts in a row group, and in memory
Chat = Callable[[SceneGraph], list[dict[str, str]]]  # what asks a viewer, as messages


def publish(
    folders: Sequence[Path],
    out: Path,
    ask: Callable[[Scenario], tuple[str, Chat]],
    progress: Progress,
    suite: str | None = None,
) -> Sequence[Table]:
    """Write the tables of some datasets, their card and their Croissant file to a new folder.

    Equal datasets and prompts give equal bytes, with one version of the harness and of Arrow.

    Args:
        folders: of the datasets; one is in memory at a time.
        out: the folder, which exists only once it is complete.
        ask: of a scenario, the prompt version and what asks by it.
        progress: counts layouts.
        suite: how the datasets together are named; by the first of them if None.

    Raises UserError if the folder is there, the name will not do, two datasets have one name, or
    one is damaged, and OSError if the folder cannot be written.
    """
    refuse_taken("--out", out)
    manifests = [read_manifest(folder)[0] for folder in folders]
    names = [manifest.name for manifest in manifests]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UserError(
            f"two datasets are named {printable(twice)}; build one again under another name"
        )
    name = suite or names[0]
    if not re.fullmatch(FILE_NAME, name):
        raise UserError(
            f"suite {printable(name)} cannot name what is published; use letters, digits, '.', '_' "
            "and '-', a letter or digit first"
        )
    progress.more(sum(manifest.episodes for manifest in manifests))
    with making(out) as part:
        (part / "data").mkdir()
        tables = [_table(load(folder), part, ask, progress) for folder in folders]
        write_whole(part / README, readme(name, tables))
        write_whole(part / CROISSANT, croissant(name, tables))
    return tables


def _table(
    data: Dataset, folder: Path, ask: Callable[[Scenario], tuple[str, Chat]], progress: Progress
) -> Table:
    scenario, file, count = data.scenario, folder / path_of(data.name), 0
    prompt, chat = ask(scenario)
    with pq.ParquetWriter(file, SCHEMA, compression="zstd") as writer:
        for start in range(0, len(data.episodes), TOGETHER):
            layouts = data.of_episodes(data.episodes[start : start + TOGETHER])
            rows = _rows(layouts, chat)
            writer.write_table(pa.Table.from_pylist(rows, SCHEMA))
            count += len(rows)
            progress(len(layouts.episodes))
    references = {key: rate_interval(success) for key, success in data.reference_success().items()}
    return Table(
        data.manifest,
        data.sha256,
        title(scenario),
        scenario.parameters.decision_lag_s,
        data.trusted,
        prompt,
        count,
        sha256_file(file, "rows"),
        file.stat().st_size,
        references,
    )


def _rows(data: Dataset, chat: Chat) -> list[dict[str, Any]]:
    """Return the decision points of a few layouts as rows."""
    forest = data.forest
    ids = [*forest.ids, None]  # -1 leads nowhere
    ends = [edge.end.result if edge.end else None for edge in forest.edges]
    of_trees = zip(
        forest.safe.tolist(),
        forest.avoids_harm.tolist(),
        forest.worth.tolist(),
        [list(map(known, delays_s)) for delays_s in forest.delay_s.tolist()],
        [[ids[n] for n in child] for child in forest.child.tolist()],
        [[ends[n] for n in edge] for edge in forest.edge.tolist()],
        strict=True,
    )
    keys = ("safe", "avoids_harm", "value", "delay_s", "next_scene", "result")
    chosen = {name: places.tolist() for name, places in forest.drivers.items()}
    actions = list(forest.actions)
    return [
        {
            **_row(scene, chat),
            "scenario": data.scenario.name,
            "actions": actions,
            **dict(zip(keys, of_actions, strict=True)),
            "drivers": _json({name: actions[places[n]] for name, places in chosen.items()}),
        }
        for n, (scene, of_actions) in enumerate(zip(data.scenes(forest.ids), of_trees, strict=True))
    ]


def _row(scene: Scene, chat: Chat) -> dict[str, Any]:
    record, viewers = scene.record, scene.viewers
    return {
        "scene": scene.id,
        "layout_seed": record.episode_seed,
        "episode": record.episode,
        "step": record.step,
        "danger_sector": record.danger.sector,
        "danger_vehicle": record.danger.vehicle,
        "prompt": chat(scene.graphs[viewers[0]]),
        "viewers": list(viewers),
        "scene_graphs": [_json(graph) for graph in scene.graphs.values()],
        "distance_m": [record.distance_m.get(viewer) for viewer in viewers],
        "range_m": [record.range_m.get(viewer) for viewer in viewers],
        "state": _json(record.state),
    }


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
