"""A model that costs something, at a server of the tests."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from misbehaving import Asked, Server, serving
from served import answer

CARD = """engine = "openai"
description = "One that costs something"
weights = "m"

[server]
base_url = "URL"

[price]
input = 1000.0
output = 2000.0
currency = "EUR"

[latency]
source = "paper"
basis = "none declared"
"""
# of an answer of 12 tokens read and 20 written, which the server states
EACH = (12 * 1000 + 20 * 2000) / 1e6


@contextmanager
def priced(
    folder: Path, patch: pytest.MonkeyPatch, says: Callable[[Asked], None] = answer
) -> Iterator[Server]:
    """Serve the model `mine`, whose card lies in a project in this folder."""
    patch.setenv("NO_PROXY", "127.0.0.1")
    patch.delenv("OPENAI_API_KEY", raising=False)
    (folder / "swarmdrive.toml").touch()
    (folder / "models").mkdir()
    with serving(says) as server:
        (folder / "models" / "mine.toml").write_text(CARD.replace("URL", server.url))
        yield server


def typed_eval(data: Path, *more: str) -> tuple[str | Path, ...]:
    fixed = (
        "--condition",
        "6g",
        "--seeds",
        "0:1",
        "--ask",
        "all",
        "--batch-size",
        "4",
        "--out",
        "run",
    )
    return "eval", "--model", "mine", "--dataset", data, *fixed, *more


def cost_of(run: str) -> Any:
    return json.loads(Path(run, "run.json").read_text()).get("cost")
