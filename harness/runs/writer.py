"""Write a run's folder: the tables of a finished run, and the lines of its answers."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import msgspec
import pyarrow as pa
from msgspec.structs import asdict

from harness.core.files import replacing, sha256_file, write_whole
from harness.runs import formats
from harness.runs.decisions import DecisionFiles, Decisions
from harness.runs.difficulty import FILE as DIFFICULTY
from harness.runs.difficulty import Layout
from harness.runs.digests import digests_of
from harness.runs.folder import Record
from harness.runs.records import (
    Answer,
    Episode,
    Manifest,
    Score,
    Variant,
)

NOBODY: Mapping[str, Sequence[str]] = MappingProxyType({})
_ENCODER = msgspec.json.Encoder()


def write(
    out: Path,
    manifest: Manifest,
    decisions: Decisions | DecisionFiles,
    episodes: Sequence[Episode],
    answers: Iterable[bytes],
    scores: Sequence[Score],
    layouts: Sequence[Layout] = (),
) -> None:
    """Write a run's files into the folder `out`, the manifest last.

    Args:
        out: the run's folder.
        manifest: the run's settings and origin, for `run.json`.
        decisions: the rows of `decisions.parquet`, already rounded.
        episodes: the rows of `episodes.csv`.
        answers: pieces of the content of `answers.jsonl`, in order.
        scores: the rows of `summary.csv`.
        layouts: the rows of `difficulty.csv`, which is not written without any.
    """
    with replacing(out / "answers.jsonl") as part, part.open("wb") as file:
        file.writelines(answers)
    decisions.write(out / "decisions.parquet")
    with replacing(out / "episodes.csv") as part, part.open("wb") as file:
        write_csv(file, Episode, episodes, manifest.variant)
    write_whole(out / "summary.csv", csv_text(Score, scores, manifest.variant))
    if layouts:
        write_whole(out / DIFFICULTY, csv_text(Layout, layouts))
    answers_sha256 = sha256_file(out / "answers.jsonl", "rows")
    write_whole(out / "run.json", record_text(manifest.as_file(), answers_sha256))
    # a report often follows, which needs memory for its own tables
    pa.default_memory_pool().release_unused()


def record_text(record: Mapping[str, Any], answers_sha256: str) -> bytes:
    """Return the text of a `run.json`, with the digests of what it states.

    `record` has its content as plain values by name, and `answers_sha256` is the digest of the
    run's `answers.jsonl`.
    """
    digests = digests_of(record, answers_sha256)
    return msgspec.json.format(_ENCODER.encode({**record, "digests": digests}), indent=1) + b"\n"


def lines(answers: Sequence[Answer]) -> bytes:
    """Return answers encoded as lines of JSON, as `answers.jsonl` has them."""
    return _ENCODER.encode_lines(answers)


def ordered(
    answers: Iterable[Answer], decisions: Decisions, viewers: Mapping[str, Sequence[str]] = NOBODY
) -> list[Answer]:
    """Return answers in the order of `answers.jsonl`: by scene, in the order of the decisions.

    In a scene come the ego's, the helpers' to the plain question, their answers to other questions,
    then fusion calls, each in the order of `viewers` (vehicle ids by scene). Answers of a scene
    without a decision, or by another vehicle, are left out.
    """

    def place(answer: Answer) -> tuple[Any, ...]:
        first = viewers[answer.scene].index(answer.viewer) if answer.scene in viewers else 0
        return order[answer.scene], answer.heard, answer.question, first

    order = {scene: n for n, scene in enumerate(dict.fromkeys(decisions.labels("scene")))}
    reached = (answer for answer in answers if answer.scene in order)
    return sorted((a for a in reached if a.viewer in viewers.get(a.scene, (a.viewer,))), key=place)


def csv_text(kind: type[Record], records: Iterable[Record], variant: Variant | None = None) -> str:
    """Return records as CSV, as `write_csv` writes them."""
    return csv_bytes(kind, list(records), variant).decode()


def csv_bytes(
    kind: type[Record], records: Sequence[Record], variant: Variant | None = None
) -> bytes:
    """Return records as CSV in UTF-8, as `write_csv` writes them."""
    content = io.BytesIO()
    write_csv(content, kind, records, variant)
    return content.getvalue()


def write_csv(
    file: BinaryIO, kind: type[Record], records: Sequence[Record], variant: Variant | None = None
) -> None:
    """Write records as CSV: the columns of `variant`, then one for each field; None is empty.

    Columns of `formats.SPARSE` are left out if no record has a value.
    """
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    variant_columns = asdict(variant) if variant else {}
    columns = {}
    for field, name in zip(kind.__struct_fields__, kind.__struct_encode_fields__, strict=True):
        is_sparse = field in formats.SPARSE
        if not is_sparse or any(getattr(record, field) is not None for record in records):
            columns[field] = name
    writer.writerow([*variant_columns, *columns.values()])
    values = attrgetter(*columns)
    writer.writerows((*variant_columns.values(), *values(record)) for record in records)
    text.detach()  # what is written so far is flushed; the file stays open
