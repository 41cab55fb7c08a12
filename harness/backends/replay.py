"""Replay: the answers of an earlier run, so that a changed parser or rule is scored without a model."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Completion, Request
from harness.cards import Card
from harness.errors import UserError, printable
from harness.files import digest, sha256_file


def open(card: Card, **_: Any) -> "Replay":
    """The answers stored in the run folder that a card names.

    Raises:
        UserError: it is no finished run.
    """
    run = Path(card.weights or "")
    rows = run / "rows.jsonl"
    if not rows.is_file():
        raise UserError(f"{printable(run)} is no finished run: it has no rows.jsonl; finish it with --resume")
    stored = {}
    with rows.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                stored.update({f"{row['scene']}/{viewer}": a for viewer, a in row["answers"].items()})
            except (ValueError, KeyError, TypeError, AttributeError):
                raise UserError(f"{printable(rows)} line {number} is no row of a run; run it again") from None
    return Replay(run, stored)


class Replay:
    """Looks answers up by scene and viewer. A prompt that was never asked is an error, not a guess."""

    def __init__(self, run: Path, stored: dict[str, dict[str, Any]]) -> None:
        self.run = run
        self.stored = stored

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in order."""
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Completion:
        answer = self.stored.get(request.id)
        if answer is None:
            raise UserError(
                f"{printable(self.run)} holds no answer for {request.id}; "
                "replay a run of the same dataset and limit"
            )
        if answer["prompt_sha256"] != digest(request.messages):
            raise UserError(
                f"{printable(self.run)} was asked {request.id} with another prompt; "
                "replay it with that run's --prompt"
            )
        return Completion(
            request.id, answer["raw"], answer["prompt_tokens"], answer["completion_tokens"],
            answer["finish_reason"], answer["seconds"], answer["batch_size"], answer["error"],
        )  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """The run and the digest of its rows."""
        manifest = json.loads((self.run / "run.json").read_text(encoding="utf-8"))
        return {
            "engine": "replay", "rows_sha256": sha256_file(self.run / "rows.jsonl"),
            "of": {"model": manifest["model"], "identity": manifest["identity"]},
        }  # fmt: skip
