"""Describe published datasets: a card with metadata for hubs, and a Croissant file for programs.

The card is Markdown after YAML (as the Hugging Face hub reads it),
the other file JSON-LD (MLCommons Croissant 1.0).
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from harness import __version__
from harness.core.figures import amount, interval_of
from harness.core.seeds import Purpose, seeds_text
from harness.core.statistics import Estimate
from harness.dataset.columns import COLUMNS, Column
from harness.dataset.schema import Manifest

README, CROISSANT = "README.md", "croissant.json"
# How trainers name the parts of a dataset, by what its layout seeds are for.
SPLITS: dict[Purpose, str] = {"tune": "validation", "train": "train", "report": "test"}
TAGS = (
    "autonomous-driving",
    "cooperative-driving",
    "v2v",
    "decision-trees",
    "simulation",
    "benchmark",
)
PAPER = "https://arxiv.org/abs/2604.22852"
SIMULATED = "are simulated: no recording of a real road, vehicle or person is in them."
UNSTATED = "Not stated: whoever built the dataset decides. Write it here and above."
LICENCE = "https://www.apache.org/licenses/LICENSE-2.0"
# The hub's words for licences that data have and SPDX writes so, too, but for capitals.
HUB_LICENCES = {
    *("apache-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "cc0-1.0"),
    *(f"cc-by{kind}-4.0" for kind in ("", "-sa", "-nc", "-nd", "-nc-sa", "-nc-nd")),
}
# rows at which the hub's sizes end
SIZES = (1_000, 10_000, 100_000, 1_000_000, 10_000_000, 100_000_000)
KINDS = {"string": "sc:Text", "int64": "sc:Integer", "double": "sc:Float", "bool": "sc:Boolean"}


@dataclass(frozen=True)
class Table:
    """Describe a published table, a Parquet file made of a dataset: its source, size and results.

    A row is a decision point, a moment at which a vehicle decides.
    """

    manifest: Manifest  # manifest of the dataset that it was made of
    dataset_sha256: str  # hex digest of that manifest
    title: str  # name of its scenario, for people
    lag_s: float  # seconds from the moment of a decision to its action
    released: bool  # whether the dataset is one of the harness's own releases
    prompt: str  # name of the prompt version whose chats it has
    rows: int  # number of its decision points, one a row
    sha256: str  # hex digest of its Parquet file
    bytes: int  # size of that file, bytes
    # success of each policy that needs no model, by its name: the mean over layouts, start
    # situations
    references: Mapping[str, Estimate]
    recordings: int | None = None  # how many its layouts are cut from; None if each is drawn alone
    simulated: bool = False  # whether a scenario of the harness draws its scenes

    @property
    def name(self) -> str:
        return self.manifest.name

    @property
    def path(self) -> str:
        return path_of(self.name)

    @property
    def split(self) -> str:
        return SPLITS[self.manifest.purpose]

    @property
    def layouts(self) -> str:
        return seeds_text(self.manifest.seed, self.manifest.episodes)


def path_of(name: str) -> str:
    """Return the path of the Parquet file of the dataset `name` within the published folder."""
    return f"data/{name}.parquet"


def readme(name: str, tables: Sequence[Table]) -> str:
    """Return the card, a page in YAML and Markdown, of the published tables of datasets.

    `name` is what they have together. Texts from a manifest are quoted, so that none of them adds a
    key or a heading.
    """
    released = all(t.released for t in tables)
    head = _front_matter(name, tables)
    return _CARD.format(
        head=_lines(f"{key}: {json.dumps(value)}" for key, value in head.items()),
        name=name,
        first=tables[0],
        rows=sum(t.rows for t in tables),
        size=_megabytes(*tables),
        tables=_lines(_row(*_cells(t)) for t in tables),
        columns=_lines(_row(f"`{c.name}`", f"`{c.kind}`", c.meaning) for c in COLUMNS),
        references=_lines(_references(tables)),
        limits=_lines(f"- {limit}" for limit in limits(tables)),
        licence=f"[Apache-2.0]({LICENCE})." if released else _licence(tables),
        origin=_origin(tables),
        version=__version__,
        paper=PAPER,
        sources=_lines(f"- `{t.name}`, manifest sha256 `{t.dataset_sha256}`" for t in tables),
    )


def _licence(tables: Sequence[Table]) -> str:
    """Return what datasets state of the terms of their traffic; a line that asks for it if none."""
    licences = {t.name: _stated_licence(t) for t in tables}
    lines = _lines(f"- `{name}`: {_code(text)}" for name, text in licences.items() if text)
    return lines or UNSTATED


def _stated_licence(t: Table) -> str | None:
    return "Apache-2.0" if t.released else t.manifest.licence


def hub_licence(licences: Sequence[str | None]) -> str:
    """Return the hub's word for the terms of tables, of which each states a licence or none.

    It is `unknown` if any has none, and `other` if the hub has no word, or tables differ.
    """
    words = {(licence or "unknown").lower() for licence in licences}
    if "unknown" in words:
        return "unknown"
    word, *others = words
    return word if word in HUB_LICENCES and not others else "other"


def _origin(tables: Sequence[Table]) -> str:
    """Return where the traffic of datasets comes from, as far as they state it."""
    if all(t.simulated for t in tables):
        return f"The scenes {SIMULATED}"
    lines = []
    for t in tables:
        source = t.manifest.source
        if t.simulated:
            lines.append(f"- Scenes of `{t.name}` {SIMULATED}")
        else:
            lines.append(f"- Traffic of `{t.name}`: {_code(source) if source else 'not stated'}")
    return _lines(lines)


def _front_matter(name: str, tables: Sequence[Table]) -> dict[str, Any]:
    """Return the keys by which the hub lists a dataset and loads its tables."""
    configs = []
    for t in tables:
        files = [{"split": t.split, "path": t.path}]
        configs.append({"config_name": t.name, "data_files": files})
    return {
        "license": hub_licence([_stated_licence(t) for t in tables]),
        "pretty_name": name,
        "language": ["en"],
        "task_categories": ["text-generation", "reinforcement-learning", "robotics"],
        "tags": [*TAGS, "croissant"],
        "size_categories": [hub_size(sum(t.rows for t in tables))],
        "configs": configs,
    }


def _cells(t: Table) -> Sequence[object]:
    """Return a table's row in the list of the card's tables."""
    return (
        f"`{t.name}`",
        _code(t.title),
        t.manifest.episodes,
        t.rows,
        t.layouts,
        t.split,
        _megabytes(t),
        _code(t.prompt),
    )


def limits(tables: Sequence[Table]) -> Iterator[str]:
    """Yield sentences, for a dataset's card (page), on what the tables must not be used for."""
    splits = {t.split for t in tables}
    if SPLITS["report"] in splits:
        yield (
            "Rows of the split `test` are of report seeds, which results are quoted on. A model "
            "that has learnt from them cannot be measured on them any more."
        )
    if splits - {SPLITS["report"]}:
        yield (
            "Rows of other splits than `test` are for tuning and training; quote no result on them."
        )
    yield (
        "Rows of a layout are not independent: count layouts, not rows, as n, and keep a layout on "
        "one side of any split. `layout_seed` says which rows belong together."
    )
    yield (
        "A table holds every course, also such as no driver would take. A mean over rows is no "
        "success rate: for that, walk from `step` 0 along `next_scene`."
    )
    yield (
        "`danger_sector`, `danger_vehicle`, `safe` to `drivers` and `state` say what no car knows. "
        "A model that reads them is told the answer."
    )
    yield (
        "`prompt` asks the ego alone. What helpers say, and which of it a radio delivers, the "
        "harness simulates; no table has it."
    )
    lags = " or ".join(dict.fromkeys(f"{1000 * t.lag_s:.0f}" for t in tables))
    yield (
        f"An action acts {lags} ms after the moment of its decision, whoever decides. The trees do "
        "not say what becomes of a slower model."
    )
    simulated = all(t.simulated for t in tables)
    made = "Scenes, traffic and drivers" if simulated else "Consequences"
    yield (
        f"{made} are of one simulator, and texts are English: nothing here shows that a model is "
        "safe on a road."
    )


def croissant(name: str, tables: Sequence[Table]) -> str:
    """Return the Croissant 1.0 description (JSON-LD) of published tables, for programs.

    `name` is what they have together. It has each Parquet file with its digest, and each column
    with its meaning.
    """
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": name,
        "description": (
            "Decisions in cooperative driving, with the exact safety and value of every action."
        ),
        "url": PAPER,
        "citeAs": PAPER,
        "isLiveDataset": False,
        "keywords": TAGS,
        "rai:dataLimitations": list(limits(tables)),
        "distribution": [_file(t) for t in tables],
        "recordSet": [_record_set(t) for t in tables],
    }
    if all(t.released for t in tables):
        document["license"] = LICENCE
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _file(table: Table) -> dict[str, Any]:
    """Return Croissant's description of a table's file."""
    return {
        "@type": "cr:FileObject",
        "@id": table.path,
        "name": table.name,
        "contentUrl": table.path,
        "contentSize": f"{table.bytes} B",
        "encodingFormat": "application/x-parquet",
        "sha256": table.sha256,
    }


def _record_set(table: Table) -> dict[str, Any]:
    """Return Croissant's description of a table's rows."""
    return {
        "@type": "cr:RecordSet",
        "@id": table.name,
        "name": table.name,
        "description": f"{table.rows} decision points, {table.layouts}",
        "field": [_field(table, column) for column in COLUMNS],
    }


def _field(table: Table, column: Column) -> dict[str, Any]:
    """Return Croissant's description of a column, and of the parts of a structure."""
    is_list = pa.types.is_list(column.kind)
    kind = column.kind.value_type if is_list else column.kind
    name = f"{table.name}/{column.name}"
    source = {"fileObject": {"@id": table.path}, "extract": {"column": column.name}}
    field: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": name,
        "name": column.name,
        "description": column.meaning,
        "source": source,
    }
    if is_list:
        field["repeated"] = True
    if not pa.types.is_struct(kind):
        field["dataType"] = KINDS[str(kind)]
        return field
    field["subField"] = []
    for part in kind:
        sub_field = {
            "@type": "cr:Field",
            "@id": f"{name}/{part.name}",
            "name": part.name,
            "dataType": KINDS[str(part.type)],
            "source": {**source, "transform": {"jsonPath": part.name}},
        }
        field["subField"].append(sub_field)
    return field


def _references(tables: Sequence[Table]) -> Iterator[str]:
    """Yield the lines of the table of reference drivers."""
    names = list(dict.fromkeys(name for t in tables for name in t.references))
    yield _row("table", "n", *(f"`{name}`" for name in names))
    yield _row(*["---"] * (2 + len(names)))
    for t in tables:
        cells = (interval_of(t.references[name]) if name in t.references else "" for name in names)
        n = str(t.manifest.episodes)
        if t.recordings is not None:
            n = f"{n} of {amount(t.recordings, 'recording')}"
        yield _row(f"`{t.name}`", n, *cells)


def hub_size(rows: int) -> str:
    """Return the Hugging Face hub's size category of a number of rows, such as `10K<n<100K`."""
    words = [f"{n // 10**6}M" if n >= 10**6 else f"{n // 1000}K" for n in SIZES]
    reached = sum(rows >= least for least in SIZES)
    if not reached:
        return f"n<{words[0]}"
    if reached == len(words):
        return f"n>{words[-1]}"
    return f"{words[reached - 1]}<n<{words[reached]}"


def _row(*cells: object) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def _code(text: str) -> str:
    """Return a text as code in a cell of a table, whatever is in it."""
    safe = text.replace("`", "'").replace("|", "\\|")
    return f"`{' '.join(safe.split())}`"


def _megabytes(*tables: Table) -> str:
    return f"{sum(t.bytes for t in tables) / 1e6:.1f}"


def _lines(lines: Iterable[str]) -> str:
    return "\n".join(lines)


_CARD = """\
---
{head}
---

# {name}

Decisions in cooperative driving, each with what every action leads to. A model decides for one car, the
ego, which cannot see everything; cars around it, the helpers, see other parts of the scene. Every course
that decisions can take was driven in a simulator beforehand, so the safety and the value of each action are
exact.

```python
from datasets import load_dataset

rows = load_dataset("PATH OF THIS FOLDER", "{first.name}", split="{first.split}")
```

{rows} decision points, {size} MB of Parquet. A table is a configuration:

| table | scenario | layouts | rows | seeds | split | MB | prompt |
|---|---|---|---|---|---|---|---|
{tables}

| column | type | meaning |
|---|---|---|
{columns}

Lists have an entry for each of `viewers` (`scene_graphs`, `distance_m`, `range_m`) or for each of `actions`
(`safe` to `result`). To play an episode, begin at its row with `step` 0 and follow `next_scene`; it succeeds
if its last action is `safe`.

## What needs no model

Success in % of layouts [95 % interval over n layouts]. `full-view` sees everything, `local-view` what the
ego sees; `uniform` draws every action with the same probability.

{references}

## Limits

{limits}

## Licence and source

{licence}

{origin}

`harness dataset export` of SwarmDrive Harness {version} wrote this folder, after the
[SwarmDrive paper]({paper}), from:

{sources}
"""  # noqa: E501

_WORDS = (
    "citeAs",
    "column",
    "equivalentProperty",
    "extract",
    "field",
    "fileObject",
    "fileProperty",
    "fileSet",
    "format",
    "includes",
    "isLiveDataset",
    "jsonPath",
    "key",
    "md5",
    "parentField",
    "path",
    "recordSet",
    "references",
    "regex",
    "repeated",
    "replace",
    "samplingRate",
    "separator",
    "source",
    "subField",
    "transform",
)
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{word: f"cr:{word}" for word in _WORDS},
}
"""The context that Croissant 1.0 prescribes."""
