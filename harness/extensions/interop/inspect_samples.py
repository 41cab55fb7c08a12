"""Read a log of Inspect AI, an `.eval` file: what each sample was asked and how it was scored.

A log is a ZIP archive of JSON files, one for each sample and epoch. Nothing of the package is
needed, and nothing in a log is run. https://inspect.aisi.org.uk/eval-logs.html
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from zipfile import ZipFile

import msgspec
from msgspec import Struct

from harness.core.errors import UserError, one_line, printable
from harness.core.files import BROKEN, LARGEST, digest, refuse_bomb
from harness.core.zips import BROKEN_ZIP, bounded_archive, piece
from harness.extensions.interop.sample_pairs import Key, SampleLog
from harness.extensions.interop.sample_values import MOST_SCORERS, decoded, number

LONGEST_LIST = 16 << 20  # bytes of the archive's list of files, of which it has 65,535 at most
T = TypeVar("T")


class Dataset(Struct):
    """Hold what a log says of its dataset: its name."""

    name: str | None = None


class Scorer(Struct):
    """Hold what a log says of one of its scorers: its name, and the options that it was given."""

    name: str
    options: Any = None


class Spec(Struct):
    """Hold what a log says of its evaluation: task, model, dataset and scorers."""

    task: str
    model: str
    dataset: Dataset
    scorers: list[Scorer] | None = None


class Header(Struct):
    """Hold the head of a log; `status` is `success` once all samples were asked."""

    eval: Spec
    status: str = "started"


class Error(Struct):
    """Hold why a sample has no answer."""

    message: str = ""


class Score(Struct):
    """Hold what a scorer said of a sample: a number, a text, or several by name."""

    value: Any = None


class Sample(Struct):
    """Hold one sample in one epoch: what was asked, the right answer, its scores and its error."""

    id: int | str
    epoch: int
    input: Any = None
    choices: Any = None
    target: Any = None
    scores: dict[str, Score] | None = None
    error: Error | None = None


def read(file: Path) -> SampleLog:
    """Read a log of Inspect AI within bounds. Raises UserError if the file is none."""
    try:
        with bounded_archive(file, "rows", LONGEST_LIST) as archive:
            refuse_bomb(archive, file.stat().st_size)
            return _log(file, archive)
    except (*BROKEN, *BROKEN_ZIP, msgspec.MsgspecError) as error:
        reason = getattr(error, "strerror", None) or one_line(error) or type(error).__name__
        raise UserError(
            f"{printable(file)} is no log of Inspect AI ({printable(reason)}); give an .eval file "
            "that `inspect eval` wrote"
        ) from None


def _log(file: Path, archive: ZipFile) -> SampleLog:
    names = archive.namelist()
    # Without a head the log is of an evaluation that goes on, or was killed.
    head = "header.json" if "header.json" in names else "_journal/start.json"
    header = _decoded(archive, head, Header)
    inputs, errors = dict[Key, str](), dict[Key, str]()
    scores = dict[str, dict[Key, float]]()
    for name in names:
        if not (name.startswith("samples/") and name.endswith(".json")):
            continue
        sample = _decoded(archive, name, Sample)
        key = sample.id, sample.epoch
        if key in inputs:
            raise ValueError(f"sample {sample.id} is there twice in epoch {sample.epoch}")
        inputs[key] = digest([_without_ids(sample.input), sample.choices, sample.target])
        if sample.error:
            errors[key] = sample.error.message
        for scorer, value in _numbers(sample.scores or {}):
            scores.setdefault(scorer, {})[key] = value
        if len(scores) > MOST_SCORERS:
            raise ValueError(f"it has more than {MOST_SCORERS} scorers")
    if not inputs:
        raise ValueError("it has no samples")
    spec = header.eval
    dataset = spec.dataset.name or ""
    options = {scorer.name: digest(scorer.options or {}) for scorer in spec.scorers or ()}
    return SampleLog(
        file,
        spec.task,
        spec.model,
        dataset,
        header.status,
        inputs,
        errors,
        scores,
        options=options,
    )


def _decoded(archive: ZipFile, name: str, kind: type[T]) -> T:
    return decoded(piece(archive, name, LARGEST["record"]), kind)


def _without_ids(question: Any) -> Any:
    """Return what a sample asks, without the ids of messages, which are new in each log."""
    if not isinstance(question, list):
        return question
    messages = []
    for message in question:
        is_message = isinstance(message, dict)
        messages.append([message.get("role"), message.get("content")] if is_message else message)
    return messages


def _numbers(scores: Mapping[str, Score]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a sample by scorer; of a scorer with several, by `SCORER/NAME`."""
    for scorer, score in scores.items():
        if isinstance(score.value, dict):
            for name, value in score.value.items():
                yield f"{scorer}/{name}", number(value)
        else:
            yield scorer, number(score.value)
