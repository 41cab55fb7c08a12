"""Replay: the answers of an earlier run, so that a changed parser or rule is scored without a model."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Completion, Request
from harness.backends.cards import Card
from harness.backends.registry import find
from harness.core.errors import UserError, printable
from harness.core.files import digest, sha256_file


def open(card: Card, **_: Any) -> "Replay":
    """The answers stored in the run folder that a card names.

    Raises:
        UserError: it is no finished run, or a driver's, which is asked for the ego alone.
    """
    run = Path(card.weights or "")
    rows, shown = run / "rows.jsonl", printable(run)
    if not rows.is_file() or not (run / "run.json").is_file():
        raise UserError(
            f"{shown} is no finished run: it lacks rows.jsonl or run.json; finish it with --resume"
        )
    stored, line = {}, "run.json"
    try:
        manifest = json.loads((run / "run.json").read_text(encoding="utf-8"))
        of = find(manifest["model"]["engine"])
        if of and not of.capabilities.asks_helpers:
            raise UserError(
                f"{shown} is a run of a driver; run it again with --model {manifest['model']['name']}"
            )
        with rows.open(encoding="utf-8") as lines:
            for number, text in enumerate(lines, 1):
                line = f"rows.jsonl line {number}"
                row = json.loads(text)
                answers = {**row["answers"], **row.get("merged", {})}
                stored.update({f"{row['scene']}/{viewer}": a for viewer, a in answers.items()})
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"{shown}: {line} is not of a run; run it again") from None
    return Replay(run, manifest, stored)


class Replay:
    """Looks answers up by scene and viewer. A prompt that was never asked is an error, not a guess.

    Attributes:
        run: the run's folder.
        manifest: its manifest, with the latency that its decisions were made with.
        stored: answers by request id.
    """

    def __init__(self, run: Path, manifest: dict[str, Any], stored: dict[str, dict[str, Any]]) -> None:
        self.run = run
        self.manifest = manifest
        self.stored = stored

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Completion:
        answer, shown = self.stored.get(request.id), printable(self.run)
        if answer is None:
            raise UserError(
                f"{shown} holds no answer for {request.id}; replay a run of the same dataset and limit"
                + (", whose conditions delivered the same messages" if "+" in request.id else "")
            )
        # Free and constrained answers have the same prompt. A run of an older version has no answer mode.
        if (mode := self.manifest.get("answer", "json")) != request.answer:
            raise UserError(f"{shown} was run with --answer {printable(mode)}; replay it with the same")
        if answer["prompt_sha256"] != digest(request.messages):
            raise UserError(
                f"{shown} was asked {request.id} with another prompt or dataset; "
                "replay it with that run's --prompt and --dataset"
            )
        if request.thinking != self.manifest["thinking"]:
            how = "off; leave --thinking out" if request.thinking else "on; add --thinking"
            raise UserError(f"{shown} was run with thinking {how}")
        return Completion(
            request.id, answer["raw"], answer["prompt_tokens"], answer["completion_tokens"],
            answer["finish_reason"], answer["seconds"], answer["batch_size"], answer["error"],
            # Runs of older versions hold none of these.
            answer.get("label_mass"), answer.get("retries", 0), answer.get("cached", False),
            answer.get("slow_s", 0.0),
        )  # fmt: skip

    def latency(self) -> dict[str, Any]:
        found: dict[str, Any] = self.manifest["latency"]
        return found

    def identity(self) -> dict[str, Any]:
        """The run and the digest of its rows."""
        return {
            "engine": "replay", "rows_sha256": sha256_file(self.run / "rows.jsonl"),
            "of": {"model": self.manifest["model"], "identity": self.manifest["identity"]},
        }  # fmt: skip
