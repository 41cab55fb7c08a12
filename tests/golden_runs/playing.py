"""Stored completions, played by a server that speaks OpenAI's chat completions.

The wire is public, so what is stored depends on no module of the program and on no engine's
numerics. A completion is found by the SHA-256 of its messages, as JSON with sorted keys.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adapter import Row
from misbehaving import Asked, serving

MODEL = "played"
NEEDED = (
    "prompt_sha256", "raw", "finish_reason", "prompt_tokens", "completion_tokens", "label_mass",
)  # fmt: skip
CARD = """engine = "openai"
description = "Stored completions of swarm-tiny"
weights = "m"

[server]
base_url = "{url}"
key_env = "NO_SUCH_KEY"
retries = 0

[latency]
source = "card"
inference_s = 0.145
basis = "declared for the tests"
"""


def sha256_of(messages: Any) -> str:
    """What a prompt is found by."""
    canonical = json.dumps(messages, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def store(file: Path, answers: Iterable[Row]) -> None:
    """Keep what a model said, from tables of answers:
    a line a prompt, in the order of their digests.
    """
    found = {row["prompt_sha256"]: {name: row[name] for name in NEEDED} for row in answers}
    lines = [json.dumps(found[key], ensure_ascii=False) + "\n" for key in sorted(found)]
    file.write_text("".join(lines), encoding="utf-8", newline="")


@contextmanager
def project(file: Path, folder: Path) -> Iterator[list[str]]:
    """Make a folder a project with a model `played`, whose server has a file's completions.

    Yields:
        Prompts that were asked and that the file has not, to be looked at in the end.
    """
    lines = file.read_text(encoding="utf-8").split("\n")
    stored = {row["prompt_sha256"]: row for row in map(json.loads, filter(None, lines))}
    missing: list[str] = []

    def play(asked: Asked) -> None:
        row = stored.get(sha256_of(asked.body["messages"]))
        if row is None:
            missing.append(asked.body["messages"][-1]["content"])
            asked.reply({"error": "no completion is stored for this prompt"}, 404)
        else:
            asked.reply(_completion(row, asked.body))

    with serving(play) as server:
        (folder / "models").mkdir(parents=True)
        (folder / "swarmdrive.toml").touch()
        (folder / "models" / f"{MODEL}.toml").write_text(
            CARD.format(url=server.url), encoding="utf-8"
        )
        yield missing


def _completion(row: Row, asked: dict[str, Any]) -> dict[str, Any]:
    choice: dict[str, Any] = {
        "index": 0, "finish_reason": row["finish_reason"], "message": {"content": row["raw"]},
    }  # fmt: skip
    if asked.get("logprobs"):
        mass = float(row["label_mass"])
        shares = json.loads(row["raw"])["action_distribution"]
        # The letters stand for the actions in the order in which the prompt names them.
        options = asked["messages"][-1]["content"].rpartition(": ")[2].rstrip(".").split(", ")
        top = [
            {"token": letter, "logprob": math.log(max(shares[action] * mass, 1e-12))}
            for letter, action in (option.split(" ") for option in options)
        ]
        choice["logprobs"] = {"content": [{**top[0], "top_logprobs": top}]}
    tokens = {name: int(row[name]) for name in ("prompt_tokens", "completion_tokens") if row[name]}
    return {"choices": [choice], "usage": tokens}
