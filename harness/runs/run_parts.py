"""Write and read the parts of a run that are kept while it goes on,
each a folder of some episodes.
"""

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from harness.core.files import bytes_of, write_whole
from harness.runs.decisions import DecisionFiles, Decisions
from harness.runs.folder import most_rows, records_of, whole
from harness.runs.records import (
    Answer,
    AnswerFacts,
    Episode,
)
from harness.runs.writer import csv_text, lines, ordered

_FACTS = msgspec.json.Decoder(AnswerFacts)


def part_files(
    decisions: Decisions,
    episodes: Sequence[Episode],
    answers: Iterable[Answer],
    viewers: Mapping[str, Sequence[str]],
) -> dict[str, bytes]:
    """Return the files of a part of a run, by name; the answers may be in any order.

    `viewers` has the ids of each decision point's viewers, the ego first.
    """
    return {
        "decisions.parquet": decisions.encoded(),
        "answers.jsonl": lines(ordered(answers, decisions, viewers)),
        "episodes.csv": csv_text(Episode, episodes).encode(),
    }


def write_part(out: Path, files: Mapping[str, bytes]) -> None:
    """Write a part of a run to its own folder, which exists only once it is complete."""
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, data in files.items():
        write_whole(part / name, data)
    os.replace(part, out)


def read_part(
    part: Path, actions: Sequence[str]
) -> tuple[Decisions, tuple[Episode, ...], list[AnswerFacts]]:
    """Read a part that `write_part` wrote. Raises UserError if it is broken."""
    return whole(
        part,
        lambda part: (
            *_read_tables(part, actions),
            facts_of(part),
        ),
    )


def facts_of(part: Path) -> list[AnswerFacts]:
    """Read a part's answers, without their texts. Raises UserError if it is broken."""
    return whole(part, lambda part: _FACTS.decode_lines(bytes_of(part / "answers.jsonl", "rows")))


def ends_of(part: Path) -> tuple[Episode, ...]:
    """Read how a part's episodes ended. Raises UserError if it is broken."""
    return whole(part, lambda part: records_of(part / "episodes.csv", Episode))


def _read_tables(part: Path, actions: Sequence[str]) -> tuple[Decisions, tuple[Episode, ...]]:
    episodes = records_of(part / "episodes.csv", Episode)
    return Decisions.read(part / "decisions.parquet", actions, most_rows(episodes)), episodes


def decisions_of(parts: Sequence[Path], actions: Sequence[str]) -> DecisionFiles:
    """Return the decisions of a run's parts."""
    return DecisionFiles([part / "decisions.parquet" for part in parts], tuple(actions))


def answers_in(part: Path) -> int:
    """Return the number of answers in a part."""
    return bytes_of(part / "answers.jsonl", "rows").count(b"\n")


def lines_of(parts: Iterable[Path]) -> Iterator[bytes]:
    """Yield the content of a run's `answers.jsonl` from its parts, one part at a time."""
    for part in parts:
        yield bytes_of(part / "answers.jsonl", "rows")
