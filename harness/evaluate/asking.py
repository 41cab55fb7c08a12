"""Asking: every viewer of every scene once, kept as they come, so that a killed run continues."""

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

from harness.backends.base import Backend, Completion, Request, Role
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, digest
from harness.dataset.load import Scene
from harness.evaluate.spec import Spec
from harness.prompts import readout
from harness.world.perception.graph import truth_graph

Answer = dict[str, Any]
CHUNK = 64  # requests that are asked for, and kept, at a time, at least


def request_count(spec: Spec) -> int:
    """How many requests an evaluation makes."""
    return sum(1 if spec.card.engine == "driver" else len(scene.viewers) for scene in spec.dataset.scenes)


def most_tokens(spec: Spec, role: Role) -> int:
    """Most tokens that an answer may have, its thought included where the model is asked to think."""
    answer = spec.card.max_new_tokens or spec.prompt.max_answer_tokens[role]
    return answer + (spec.card.thinking_tokens if spec.thinking else 0)


def requests(spec: Spec, scenes: Sequence[Scene]) -> Iterator[Request]:
    """What is asked, scene by scene, the ego first. Drivers are asked for the ego alone."""
    scenario = spec.dataset.scenario
    for scene in scenes:
        truth = truth_graph(scenario, scene.state) if spec.card.privileged else None
        for viewer in scene.viewers if spec.card.engine != "driver" else scene.viewers[:1]:
            graph = scene.record["graphs"][viewer]
            role: Role = graph["role"]
            yield Request(
                id=f"{scene.id}/{viewer}",
                role=role,
                messages=_messages(spec, graph),
                actions=spec.dataset.actions,
                max_tokens=most_tokens(spec, role),
                form=spec.prompt.helper_answer,
                answer=spec.answer,
                thinking=spec.thinking,
                view=graph,
                truth=truth,
                scenario=scenario,
            )


def _messages(spec: Spec, graph: Mapping[str, Any]) -> tuple[Mapping[str, str], ...]:
    rendered = spec.prompt.render(graph, spec.dataset.actions, words=spec.dataset.scenario.words)
    return readout.asked(rendered, spec.dataset.actions) if spec.answer == "readout" else rendered


def ask_all(
    spec: Spec, backend: Backend, asked: Iterable[Request], kept: Path, progress: Callable[[int], None]
) -> dict[str, Answer]:
    """Ask what is still owed and keep each answer in a file at once.

    Args:
        spec: the evaluation.
        backend: who answers.
        asked: the questions, in the same order whenever the run is taken up again.
        kept: JSON Lines file of answers so far; may be torn at its end by a kill.
        progress: called with the number of answers just had, those kept from before included.

    Returns:
        Answers by request id.
    """
    answers = read_kept(kept)
    # Chunks begin at the same places in a resumed run, and a torn one is asked again whole: an engine may
    # answer with an eye on a request's company.
    size = spec.batch_size * math.ceil(CHUNK / spec.batch_size)
    asked = iter(asked)
    with kept.open("a", encoding="utf-8") as file:
        while chunk := list(islice(asked, size)):
            if any(request.id not in answers for request in chunk):
                _ask(backend, chunk, file, answers)
            progress(len(chunk))
    return answers


def _ask(backend: Backend, chunk: list[Request], file: TextIO, answers: dict[str, Answer]) -> None:
    for request, completion in zip(chunk, backend.complete(chunk), strict=True):
        answers[request.id] = answer = answer_of(request, completion)
        file.write(canonical_json([request.id, answer]) + "\n")
    file.flush()
    os.fsync(file.fileno())


def answer_of(request: Request, completion: Completion) -> Answer:
    """What is kept of an answer."""
    # A lone surrogate cannot be written to a file; nothing else of the text is touched.
    text = completion.text.encode("utf-8", "replace").decode("utf-8")
    return {
        "raw": text,
        "finish_reason": completion.finish_reason,
        "error": completion.error,
        "prompt_tokens": completion.prompt_tokens,
        "completion_tokens": completion.completion_tokens,
        "seconds": completion.seconds,
        "batch_size": completion.batch_size,
        "label_mass": completion.label_mass,
        "retries": completion.retries,
        "cached": completion.cached,
        "slow_s": completion.slow_s,
        "prompt_sha256": digest(request.messages),
    }


def read_kept(kept: Path) -> dict[str, Answer]:
    """Answers kept so far. A torn last line is dropped and asked again."""
    if not kept.is_file():
        return {}
    data = kept.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        with kept.open("r+b") as file:
            file.truncate(len(whole))
    try:
        return dict(json.loads(line) for line in whole.splitlines())
    except (ValueError, TypeError) as error:
        raise UserError(
            f"{printable(kept)} is damaged ({printable(error)}); delete its folder and start again"
        ) from None
