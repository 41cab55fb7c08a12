"""Export a run's tables as text files;
a file is written in pieces, and appears only once it is complete.
"""

import csv
from collections.abc import Iterable, Sequence
from io import StringIO
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.csv as pacsv

from harness.core.files import neutral, replacing, write_whole
from harness.core.junit import Case
from harness.core.junit import junit as test_suite
from harness.core.places import text
from harness.runs.decisions import Decisions
from harness.runs.folder import Run
from harness.runs.records import TURNS, Answer, Episode
from harness.runs.schemas import schemas
from harness.runs.unanswered import lacking

AT_ONCE = 10_000  # decisions in a piece


def decisions_csv(decisions: Decisions, path: Path) -> Path:
    """Write decisions as CSV with the columns of `decisions.parquet`, and return the file's path.

    Unknown values are empty. A text that a spreadsheet would take for a formula gets an apostrophe
    before it.
    """
    plain = pa.schema(
        (column.name, pa.string() if pa.types.is_dictionary(column.type) else column.type)
        for column in decisions.rows.schema
    )
    with replacing(path) as part, pacsv.CSVWriter(part, plain) as writer:
        for piece in decisions.rows.to_batches(AT_ONCE):
            table = pa.Table.from_batches([piece]).cast(plain)
            writer.write_table(
                pa.table([_neutral(column) for column in table.columns], schema=plain)
            )
    return path


def _neutral(column: pa.ChunkedArray) -> pa.ChunkedArray:
    return (
        pa.chunked_array([map(neutral, column.to_pylist())])
        if pa.types.is_string(column.type)
        else column
    )


def decisions_jsonl(decisions: Decisions, path: Path) -> Path:
    """Write decisions as JSON Lines, with the columns of `decisions.parquet`; unknown is null."""
    encoder = msgspec.json.Encoder()
    with replacing(path) as part, part.open("wb") as file:
        for piece in decisions.rows.to_batches(AT_ONCE):
            file.write(encoder.encode_lines(piece.to_pylist()))
    return path


def schemas_json(actions: Sequence[str], folder: Path) -> list[Path]:
    """Write the JSON Schemas of a run's files and of messages, and return the files' paths.

    `actions` are the names of the run's meta-actions, and `folder` is where the files go.
    """
    files = []
    for name, schema in schemas(actions).items():
        text = msgspec.json.format(msgspec.json.encode(schema), indent=1)
        write_whole(folder / name, text + b"\n")
        files.append(folder / name)
    return files


def junit(run: Run, path: Path) -> Path:
    """Write a run as JUnit's XML, which servers of tests read: a case for an episode and condition.

    A case fails if the episode fails with any seed of the channel's draws. It is an error if a
    request got no answer, unless that counts as a lost message.
    """
    errors = _unanswered(run)
    episodes: dict[tuple[str, int], list[Episode]] = {}
    for outcome in run.episodes:
        episodes.setdefault((outcome.condition, outcome.episode), []).append(outcome)
    cases = []
    for (condition, episode), by_seed in episodes.items():
        failed = [
            f"{outcome.failure} with seed {outcome.seed}"
            for outcome in by_seed
            if not outcome.success
        ]
        group = f"{run.source} · {run.manifest.variant} · {condition}"
        failure = f"{len(failed)} of {len(by_seed)} seeds: {', '.join(failed)}"
        words = errors.get((condition, episode))
        error = f"{words}: the model could not be asked" if words else None
        cases.append(Case(group, f"episode {episode}", failure if failed else None, error))
    write_whole(path, test_suite(f"harness {run.manifest.name}", cases))
    return path


def _unanswered(run: Run) -> dict[tuple[str, int], str]:
    """Return by condition and episode what a question said that got no answer."""
    answers, errors = list(lacking(run)), dict[tuple[str, int], str]()
    if not answers:
        return errors
    decisions = run.decisions
    numbers, conditions = decisions.whole("episode"), decisions.codes("condition", run.conditions)
    for answer in answers:
        for row in decisions.scenes.get(answer.scene, ()):
            if answer.role != "merge" or decisions["fusion_failed"][row] == 1.0:
                errors.setdefault(
                    (run.conditions[conditions[row]], int(numbers[row])), text(answer.error or "")
                )
    return errors


def junit_of_none(run: Path, error: str) -> str:
    """Return JUnit's XML with one error for a run that stopped because its model did not answer.

    `run` is the run's folder, which names the test, and `error` the error's message, in which
    file names stand in place of paths.
    """
    name = run.absolute().name
    return test_suite(f"harness {name}", [Case(name, "the model answers", error=text(error))])


def answers_csv(answers: Iterable[Answer], actions: Sequence[str], path: Path) -> Path:
    """Write answers as CSV: the fields of `answers.jsonl`, and each action's probability.

    `actions` are the names of the meta-actions, in the order of the probabilities. Paths in errors
    are reduced to file names. A text that a spreadsheet would take for a formula gets an apostrophe
    before it.
    """
    fields = (*Answer.__struct_fields__, *TURNS)
    plain = [name for name in fields if name not in ("intent", "message", "first")]
    unknown = [None] * len(actions)
    with replacing(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.write(_line([*plain, *(f"intent_{action}" for action in actions), "message"]))
        for answer in answers:
            values = {
                **{name: answer.cell(name) for name in plain},
                "heard": "+".join(answer.heard),
                "repairs": " ".join(answer.repairs),
                "detail": text(answer.detail),
                "error": answer.error and text(answer.error),
                "extension": _json(answer.cell("extension")),
            }
            file.write(
                _line([*values.values(), *(answer.intent or unknown), _json(answer.message)])
            )
    return path


def rows_csv(columns: Sequence[str], rows: Iterable[Sequence[object]], path: Path) -> Path:
    """Write rows of cells as CSV below the names of their columns, and return the file's path.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """
    with replacing(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.writelines(_line(cells) for cells in (columns, *rows))
    return path


def _json(value: object) -> str | None:
    return None if value is None else msgspec.json.encode(value).decode()


def _line(cells: Sequence[object]) -> str:
    """Return a line of CSV that ends in a line feed; cells with any break are quoted."""
    line = StringIO()
    csv.writer(line, lineterminator="\r\n").writerow([neutral(cell) for cell in cells])
    return line.getvalue()[:-2] + "\n"
