"""A run's tables as text, for people and other programs. They are written in pieces, whole or not at all."""

import csv
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.csv as pacsv

from harness.core.files import replacing, write_whole
from harness.core.junit import Case
from harness.core.junit import junit as test_suite
from harness.runs.decisions import Decisions
from harness.runs.folder import Run
from harness.runs.records import TURNS, Answer, Episode

AT_ONCE = 10_000  # decisions that are written together


def decisions_csv(decisions: Decisions, path: Path) -> Path:
    """A line a decision, the columns of `decisions.parquet`; nothing where one is unknown."""
    plain = pa.schema(
        (one.name, pa.string() if pa.types.is_dictionary(one.type) else one.type)
        for one in decisions.table.schema
    )
    with replacing(path) as part, pacsv.CSVWriter(part, plain) as writer:
        for piece in decisions.table.to_batches(AT_ONCE):
            writer.write_table(pa.Table.from_batches([piece]).cast(plain))
    return path


def decisions_jsonl(decisions: Decisions, path: Path) -> Path:
    """An object a decision, the columns of `decisions.parquet`; null where one is unknown."""
    encoder = msgspec.json.Encoder()
    with replacing(path) as part, part.open("wb") as file:
        for piece in decisions.table.to_batches(AT_ONCE):
            file.write(encoder.encode_lines(piece.to_pylist()))
    return path


def junit(run: Run, path: Path) -> Path:
    """A test case an episode and condition in JUnit's XML; it fails where a seed has no success."""
    ends: dict[tuple[str, int], list[Episode]] = {}
    for end in run.episodes:
        ends.setdefault((end.condition, end.episode), []).append(end)
    cases = []
    for (condition, episode), by_seed in ends.items():
        failed = [f"{end.failure} with seed {end.seed}" for end in by_seed if not end.success]
        of = f"{run.source} · {run.manifest.variant} · {condition}"
        said = f"{len(failed)} of {len(by_seed)} seeds: {', '.join(failed)}"
        cases.append(Case(of, f"episode {episode}", said if failed else None))
    write_whole(path, test_suite(f"harness {run.manifest.name}", cases))
    return path


def answers_csv(answers: Sequence[Answer], actions: Sequence[str], path: Path) -> Path:
    """A line an answer: the fields of `answers.jsonl`, a column an action for the intent."""
    fields = (*Answer.__struct_fields__, *TURNS)
    plain = [name for name in fields if name not in ("intent", "message", "first")]
    unknown = [None] * len(actions)
    with replacing(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*plain, *(f"intent_{action}" for action in actions), "message"])
        for answer in answers:
            values = {
                **{name: getattr(answer, name) for name in plain},
                "heard": "+".join(answer.heard), "repairs": " ".join(answer.repairs),
            }  # fmt: skip
            message = answer.message and msgspec.json.encode(answer.message).decode()
            writer.writerow([*values.values(), *(answer.intent or unknown), message])
    return path
