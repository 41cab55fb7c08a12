"""Write and read the parts of a run that are kept while it goes on,
each a folder of some episodes.
"""

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from harness.core.files import bytes_of, write_whole
from harness.core.seals import write_seal
from harness.runs.decisions import DecisionFiles, Decisions
from harness.runs.folder import most_rows, records_of, whole
from harness.runs.records import (
    Answer,
    AnswerFacts,
    Episode,
)
from harness.runs.writer import csv_bytes, lines, ordered

_FACTS = msgspec.json.Decoder(AnswerFacts)


def part_files(
    decisions: Decisions,
    episodes: Sequence[Episode],
    answers: Iterable[Answer],
    viewers: Mapping[str, Sequence[str]],
) -> dict[str, bytes]:
    """Return the content of the files of a part of a run (some of its episodes), by file name.

    The answers may be in any order. `viewers` maps a scene's id to the ids of the vehicles that may
    answer there, the ego first.
    """
    return {
        "decisions.parquet": decisions.encoded(),
        "answers.jsonl": lines(ordered(answers, decisions, viewers)),
        "episodes.csv": csv_bytes(Episode, episodes),
    }


def write_part(out: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of a part of a run to the folder `out`, which appears only when complete.

    `files` has their content by name. A seal (a signature with a key of this user), by which a
    later run knows its own files, is written beside the folder if this user can make one.
    """
    write_seal(out, files)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, data in files.items():
        write_whole(part / name, data)
    os.replace(part, out)


@dataclass(frozen=True)
class Piece:
    """Hold some layouts of a run, few enough that their decisions are in memory together."""

    layouts: Sequence[int]  # numbers of the episodes, one of each layout, ascending
    decisions: Decisions  # all that were made in them
    episodes: Sequence[Episode]  # how each ended under every condition and seed, in any order
    answers: Sequence[AnswerFacts]  # those that the decisions are made of


def read_part(part: Path, layouts: Sequence[int], actions: Sequence[str]) -> Iterator[Piece]:
    """Yield the decisions, episodes and answers (without texts) of a part of a run.

    `part` is its folder, as `write_part` wrote it, `layouts` are the numbers of its episodes, and
    `actions` the names of the meta-actions. Raises UserError if a file is broken.
    """
    decisions, episodes = whole(part, lambda part: _read_tables(part, actions))
    answers, pieces = facts_of(part), [*decisions.pieces()]
    if len(pieces) == 1:
        yield Piece(layouts, decisions, episodes, answers)
        return
    for piece in pieces:
        numbers, scenes = set(piece.whole("episode").tolist()), piece.scenes
        yield Piece(
            [number for number in layouts if number in numbers],
            piece,
            [episode for episode in episodes if episode.episode in numbers],
            [answer for answer in answers if answer.scene in scenes],
        )
        # those that were given away need not be held
        episodes = tuple(episode for episode in episodes if episode.episode not in numbers)


def decided_in(part: Path, actions: Sequence[str]) -> Decisions:
    """Return the decisions in the folder of a part, some of a run's episodes.

    `actions` are the names of the meta-actions. Raises UserError if a file is broken.
    """
    return whole(part, lambda part: _read_tables(part, actions)[0])


def facts_of(part: Path) -> list[AnswerFacts]:
    """Return the answers in the folder of a part of a run, without their texts.

    A part is some of the run's episodes, as one worker finished them. Raises UserError if the file
    is broken.
    """
    return whole(part, lambda part: _FACTS.decode_lines(bytes_of(part / "answers.jsonl", "rows")))


def ends_of(part: Path) -> tuple[Episode, ...]:
    """Return how the episodes of a part of a run ended, a record of each.

    A part is a folder of some of the run's episodes. Raises UserError if the file is broken.
    """
    return whole(part, lambda part: records_of(part / "episodes.csv", Episode))


def _read_tables(part: Path, actions: Sequence[str]) -> tuple[Decisions, tuple[Episode, ...]]:
    episodes = records_of(part / "episodes.csv", Episode)
    return Decisions.read(part / "decisions.parquet", actions, most_rows(episodes)), episodes


def decisions_of(parts: Sequence[Path], actions: Sequence[str]) -> DecisionFiles:
    """Return the decisions of all parts of a run as files, which are read one at a time.

    A part is a folder of some of the run's episodes, as one worker finished them. `parts` are the
    folders, and `actions` the names of the meta-actions.
    """
    return DecisionFiles([part / "decisions.parquet" for part in parts], tuple(actions))


def answers_in(part: Path) -> int:
    """Return the number of answers in the folder of a part, some of a run's episodes."""
    return bytes_of(part / "answers.jsonl", "rows").count(b"\n")


def lines_of(parts: Iterable[Path]) -> Iterator[bytes]:
    """Yield the answers of each part of a run as lines of JSON, to make its `answers.jsonl`.

    A part is a folder of some of the run's episodes; the order is that of `parts`.
    """
    for part in parts:
        yield bytes_of(part / "answers.jsonl", "rows")
