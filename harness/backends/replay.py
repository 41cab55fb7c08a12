"""Replay: the answers of an earlier run, so that a changed parser or rule is scored without a model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Completion, Request
from harness.backends.cards import Card
from harness.backends.registry import find
from harness.core.errors import UserError, printable
from harness.core.files import digest, sha256_file
from harness.runs.folder import Run, read
from harness.runs.records import Latency


def open(card: Card, **_: Any) -> "Replay":
    """The answers stored in the run folder that a card names.

    Raises:
        UserError: it is no finished run, or a driver's, which is asked for the ego alone.
    """
    run = read(Path(card.weights or ""))
    of = find(str(run.manifest.model.get("engine")))
    if of and not of.capabilities.asks_helpers:
        raise UserError(
            f"{printable(run.path)} is a run of a driver; "
            f"run it again with --model {printable(run.manifest.model['name'])}"
        )
    return Replay(run)


class Replay:
    """Looks answers up by scene and viewer. A prompt that was never asked is an error, not a guess."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._answers = {answer.id: answer for answer in run.answers}

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._completion(request) for request in requests]

    def _completion(self, request: Request) -> Completion:
        answer, shown, manifest = self._answers.get(request.id), printable(self._run.path), self._run.manifest
        if answer is None:
            raise UserError(
                f"{shown} holds no answer for {request.id}; replay a run of the same dataset and limit"
                + (", whose conditions delivered the same messages" if "+" in request.id else "")
            )
        # Free and constrained answers have the same prompt.
        if manifest.answer != request.answer:
            raise UserError(f"{shown} was run with --answer {manifest.answer}; replay it with the same")
        if answer.prompt_sha256 != digest(request.messages):
            raise UserError(
                f"{shown} was asked {request.id} with another prompt or dataset; "
                "replay it with that run's --prompt and --dataset"
            )
        if request.thinking != manifest.thinking:
            how = "off; leave --thinking out" if request.thinking else "on; add --thinking"
            raise UserError(f"{shown} was run with thinking {how}")
        return Completion(
            request.id, answer.raw, answer.prompt_tokens, answer.completion_tokens,
            answer.finish_reason, answer.seconds, answer.batch_size, answer.error,  # type: ignore[arg-type]
            answer.label_mass, answer.retries, answer.cached, answer.slow_s,
        )  # fmt: skip

    def latency(self) -> Latency:
        return self._run.manifest.latency

    def identity(self) -> dict[str, Any]:
        """The run and the digest of its answers."""
        return {
            "engine": "replay", "answers_sha256": sha256_file(self._run.path / "answers.jsonl"),
            "of": {"model": self._run.manifest.model, "identity": self._run.manifest.identity},
        }  # fmt: skip
