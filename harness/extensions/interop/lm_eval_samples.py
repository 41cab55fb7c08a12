"""Read answers of lm-evaluation-harness: a file `samples_TASK_DATE.jsonl` of `--log_samples`.

A line is a document under one filter of answers, with a number for each metric.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from harness.core.errors import UserError, one_line, printable
from harness.core.files import BROKEN, LARGEST, digest, opened
from harness.extensions.interop.sample_pairs import Key, SampleLog
from harness.extensions.interop.sample_values import MOST_SCORERS, decoded, number

NAME = re.compile(r"samples_(?P<task>.+)_\d{4}-\d\d-\d\dT[\d.-]+\.jsonl")
NO_FILTER = "none"  # the name of the filter that changes nothing


class Line(msgspec.Struct):
    """Hold what a line says of a document: its number, itself, the right answer and the filter.

    `arguments` have the prompt that the model was given.
    """

    doc_id: int | str
    metrics: tuple[str, ...]
    doc: Any = None
    target: Any = None
    arguments: Any = None
    filter: str = NO_FILTER


def read(file: Path) -> SampleLog:
    """Read a file of answers within bounds. Raises UserError if it is none."""
    try:
        return _log(file)
    except (*BROKEN, msgspec.MsgspecError) as error:
        reason = getattr(error, "strerror", None) or one_line(error) or type(error).__name__
        raise UserError(
            f"{printable(file)} is no file of answers of lm-eval ({printable(reason)}); give a "
            "samples_….jsonl file that it wrote with --log_samples"
        ) from None


def _log(file: Path) -> SampleLog:
    inputs, scores = dict[Key, str](), dict[str, dict[Key, float]]()
    prompts = dict[Key, str]()
    for data in _lines(file):
        values = decoded(data, dict[str, Any])
        line = msgspec.convert(values, Line)
        key = line.doc_id, 1
        question = digest([line.doc, line.target])
        if inputs.setdefault(key, question) != question:
            raise ValueError(f"document {line.doc_id} is there with two inputs")
        if line.arguments is not None:
            prompts[key] = digest(line.arguments)
        for scorer, value in _numbers(line, values):
            numbers = scores.setdefault(scorer, {})
            if key in numbers:
                raise ValueError(f"document {line.doc_id} is there twice for {scorer}")
            numbers[key] = value
        if len(scores) > MOST_SCORERS:
            raise ValueError(f"it has more than {MOST_SCORERS} metrics")
    if not inputs:
        raise ValueError("it has no answers")
    match = NAME.fullmatch(file.name)
    task = match["task"] if match else file.stem
    model = file.absolute().parent.name  # lm-eval's folder for a model; the file does not say
    return SampleLog(file, task, model, "", "success", inputs, {}, scores, prompts)


def _lines(file: Path) -> Iterator[bytes]:
    """Yield the lines that are not empty. Raises ValueError for one above the limit of records."""
    with opened(file, "rows") as lines:
        while line := lines.readline(LARGEST["record"] + 1):
            if len(line) > LARGEST["record"]:
                raise ValueError(f"a line is larger than {LARGEST['record'] >> 20} MB")
            if line.strip():
                yield line


def _numbers(line: Line, values: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a line by metric; under a filter by `METRIC,FILTER`, as lm-eval does."""
    for metric in line.metrics:
        name = metric if line.filter == NO_FILTER else f"{metric},{line.filter}"
        yield name, number(values.get(metric))
