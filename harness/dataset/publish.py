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
from harness.core.figures import number_or_none
from harness.core.files import making, refuse_taken, sha256_file, write_whole
from harness.core.progress import Progress
from harness.core.statistics import rate_interval
from harness.dataset import rebuilt
from harness.dataset.card import CROISSANT, README, Table, croissant, path_of, readme
from harness.dataset.columns import SCHEMA
from harness.dataset.load import Dataset, Scene, load
from harness.dataset.schema import FILE_NAME
from harness.dataset.verify import read_manifest
from harness.world.scenario import Scenario
from harness.world.scenario_of_package import is_ours
from harness.world.scenarios import title
from harness.world.scene_graph import SceneGraph

TOGETHER = 8  # layouts in a row group, and in memory
# from a scene graph, and the scenario as its scene has it, to messages that ask the viewer
Chat = Callable[[SceneGraph, Scenario | None], list[dict[str, str]]]


def publish(
    folders: Sequence[Path],
    out: Path,
    ask: Callable[[Scenario], tuple[str, Chat]],
    progress: Progress,
    suite: str | None = None,
) -> Sequence[Table]:
    """Write datasets as Parquet tables, with a card and a Croissant file, to a new folder.

    A card is a page that describes them for people, Croissant for programs. Returns a description
    of each table. Equal datasets and prompts give equal bytes, with one version of the harness and
    of Arrow.

    Args:
        folders: of the datasets; one is in memory at a time.
        out: the folder, which exists only once it is complete.
        ask: returns, for a scenario, the name of the prompt version and a function from a scene
            graph (what one vehicle knows) to the chat messages that ask that vehicle.
        progress: counts layouts, the start situations of episodes.
        suite: the name of all datasets together; that of the first one if None.

    Raises UserError if the folder exists, a name is not allowed, two datasets have one name, or one
    is damaged, or to be learnt from and not what its seeds give, and OSError if the folder cannot
    be written.
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
    """Write the table of a dataset to a folder; return what the card says of it."""
    if data.manifest.purpose != "report":
        rebuilt.refuse(data)  # others learn from it
    scenario, file, count = data.scenario, folder / path_of(data.name), 0
    prompt, chat = ask(scenario)
    with pq.ParquetWriter(file, SCHEMA, compression="zstd") as writer:
        for start in range(0, len(data.episodes), TOGETHER):
            layouts = data.of_episodes(data.episodes[start : start + TOGETHER])
            rows = _rows(layouts, chat)
            writer.write_table(pa.Table.from_pylist(rows, SCHEMA))
            count += len(rows)
            progress(len(layouts.episodes))
    clusters, references = data.clusters, {}
    for key, success in data.reference_success().items():
        references[key] = rate_interval(success, clusters)
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
        None if clusters is None else int(clusters.max()) + 1,
        is_ours(scenario.layout) and not scenario.has_own_world,
    )


def _rows(data: Dataset, chat: Chat) -> list[dict[str, Any]]:
    """Return the decision points of a few layouts as rows."""
    forest = data.forest
    actions = list(forest.actions)
    ids = [*forest.ids, None]  # -1 leads nowhere
    results = [edge.end.result if edge.end else None for edge in forest.edges]
    safe, avoids_harm = forest.safe.tolist(), forest.avoids_harm.tolist()
    worth, delays_s = forest.worth.tolist(), forest.delay_s.tolist()
    children, edges = forest.child.tolist(), forest.edge.tolist()
    choices = {name: places.tolist() for name, places in forest.drivers.items()}
    rows = []
    for n, scene in enumerate(data.scenes(forest.ids)):
        row = _row(scene, chat)
        row["scenario"] = data.scenario.name
        row["actions"] = actions
        row["safe"] = safe[n]
        row["avoids_harm"] = avoids_harm[n]
        row["value"] = worth[n]
        row["delay_s"] = [number_or_none(delay_s) for delay_s in delays_s[n]]
        row["next_scene"] = [ids[child] for child in children[n]]
        row["result"] = [results[edge] for edge in edges[n]]
        row["drivers"] = _json({name: actions[places[n]] for name, places in choices.items()})
        rows.append(row)
    return rows


def _row(scene: Scene, chat: Chat) -> dict[str, Any]:
    """Return the columns of a decision point that its scene tells without its tree."""
    record, viewers = scene.record, scene.viewers
    return {
        "scene": scene.id,
        "layout_seed": record.episode_seed,
        "episode": record.episode,
        "step": record.step,
        "danger_sector": record.danger.sector,
        "danger_vehicle": record.danger.vehicle,
        "prompt": chat(scene.graphs[viewers[0]], scene.seat),
        "viewers": list(viewers),
        "scene_graphs": [_json(graph) for graph in scene.graphs.values()],
        "distance_m": [record.distance_m.get(viewer) for viewer in viewers],
        "range_m": [record.range_m.get(viewer) for viewer in viewers],
        "state": _json(record.state),
    }


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
