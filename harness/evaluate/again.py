"""Asking the model of a finished run something more: second answers that none of its conditions needed."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from harness.backends.base import AnswerMode
from harness.backends.cache import cached, default_file
from harness.backends.cards import Card
from harness.backends.registry import open_backend
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Ints
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.files import alone, canonical_json
from harness.dataset.load import Dataset
from harness.evaluate.asking import Answer, ask_all, read_kept
from harness.evaluate.intents import Answered
from harness.evaluate.merging import Merged, merged, requests
from harness.evaluate.spec import Spec
from harness.evaluate.timing import merge_latency, merge_s
from harness.prompts import versions as prompts
from harness.runs.folder import Run

KEPT, TIMES = "merged.jsonl", "merged.json"  # in the run's folder


@dataclass(frozen=True)
class Asking:
    """Who is told how it goes: `more` questions are owed, so many are `done`."""

    more: Callable[[int], None] = lambda count: None
    done: Callable[[int], None] = lambda count: None


def second_answers(
    run: Run,
    dataset: Dataset,
    known: Answered,
    points: Sequence[OperatingPoint],
    codes: Ints,
    latency: dict[str, Any],
    asking: Asking,
) -> tuple[Merged, dict[str, Any]]:
    """The ego's second answers to these sets of messages; what the run has not is asked, and kept in it.

    Args:
        run: the finished run.
        dataset: its scenes, in the order of `known`.
        known: its intents.
        points: operating points that need them.
        codes: who was heard in which decision (`merging.delivered`).
        latency: where times come from, as in the run's manifest.
        asking: who is told how it goes.

    Returns:
        The answers, and the latency with the time of a second inference.

    Raises:
        UserError: the model or the prompt is not the run's any more, or the run's can merge no messages.
    """
    spec = spec_of(run, dataset, points)
    asked = list(requests(spec, known, codes))
    kept, times = run.path / KEPT, run.path / TIMES
    if times.is_file():
        latency = {**json.loads(times.read_text(encoding="utf-8")), **latency}
    had: dict[str, Answer] = {
        f"{row['scene']}/{heard}": a for row in run.rows for heard, a in row.get("merged", {}).items()
    }
    by_id = {**read_kept(kept), **had}
    owed = [request for request in asked if request.id not in by_id]
    if owed or "merge_s" not in latency:
        backend = open_backend(spec.card, dtype=spec.dtype, batch_size=spec.batch_size)
        _same(backend.identity(), run)
        asking.more(len(owed))
        answering = cached(backend, spec.card, default_file())
        try:
            with alone(run.path / f"{KEPT}.lock"):
                by_id |= ask_all(spec, answering, owed, kept, asking.done)
                latency = merge_latency(spec, backend, latency, asked, by_id, times)
        except BlockingIOError:
            raise UserError(f"{printable(run.path)} is being written by another process; wait") from None
    answers = [by_id[request.id] for request in asked]
    return merged(spec, codes, answers, merge_s(latency, answers)), latency


def spec_of(run: Run, dataset: Dataset, points: Sequence[OperatingPoint]) -> Spec:
    """The evaluation that made a run, with all that decides its answers, at other operating points."""
    config, shown = run.config, printable(run.path)
    version = str(config["prompt"]["version"])
    prompt = prompts.load(version)
    if prompt.sha256 != config["prompt"]["sha256"]:
        raise UserError(f"{shown}: prompt {printable(version)} has changed since; restore it or run again")
    try:
        card = convert(config["model"], Card, "its model")
    except UserError as error:
        raise UserError(f"{shown}: run.json is of another version ({printable(error)}); run again") from None
    return Spec(
        card, prompt, dataset, tuple(points), tuple(config["seeds"]), thinking=bool(config["thinking"]),
        answer=cast("AnswerMode", run.answer), batch_size=config["batch_size"], dtype=config.get("dtype"),
    )  # fmt: skip


def _same(identity: Mapping[str, Any], run: Run) -> None:
    stored = run.config["identity"]
    now = json.loads(canonical_json(identity))
    if now != stored:
        other = [key for key in {**now, **stored} if now.get(key) != stored.get(key)]
        raise UserError(
            f"{printable(run.path)}: the model is not what it was ({printable(', '.join(other))}); run again"
        )
