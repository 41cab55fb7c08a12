"""What is served against what is answered in this process: the furthest probability, and the time.

The model is asked what `harness eval --answer decision` asks about scenes of six datasets, one
question at a time: in this process, and by this program's own client through a `harness serve` of
the same model, engine and number format.

    python benchmarks/serving.py [--model swarm-tiny] [--wire systemone] [--prompts 500]
                                 [--letters cyclic]
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter
from typing import Any

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.dataset.load import find, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions

SMALLEST = "--prompts 6"
NEEDS = "llama_cpp"
DATASETS = (
    "occluded-intersection-v2",
    "blind-merge-v1",
    "do-not-pass-v1",
    "hard-brake-ahead-v1",
    "parking-exit-v1",
    "roundabout-entry-v1",
)
AIM = 1e-6


def main() -> None:
    """Print the comparison as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="swarm-tiny")
    arguments.add_argument("--wire", default="systemone", choices=["systemone", "decisions"])
    arguments.add_argument("--prompts", type=int, default=500)
    arguments.add_argument("--letters", choices=["raw", "cyclic"])
    given = arguments.parse_args()
    agent = Agent(
        cards.resolve(given.model), versions.load("v9"), "decision", letters=given.letters
    )
    asked = questions(agent, given.prompts)
    here, here_ms = answers(open_backend(agent.card, batch_size=1), asked)
    with serving(given.model, *(["--letters", given.letters] if given.letters else [])) as url:
        card = cards.load(f"{given.wire}-example")
        assert card.server is not None
        client = open_backend(
            replace(card, server=replace(card.server, base_url=url)), batch_size=1
        )
        # A client asks one question; in which orders its letters are read is the server's matter.
        there, there_ms = answers(client, [request.alike(orders=()) for request in asked])
    furthest = max(
        abs(one[o] - other[o]) for one, other in zip(here, there, strict=True) for o in one
    )
    result = {
        "model": given.model,
        "wire": given.wire,
        "prompts": len(asked),
        "furthest": furthest,
        "here_ms": round(here_ms, 2),
        "served_ms": round(there_ms, 2),
        "ok": furthest <= AIM,
    }
    for name, value in result.items():
        print(f"{name:<12}{value}")
    print(json.dumps(result))


def questions(agent: Agent, number: int) -> list[Request]:
    """Return as many questions of each dataset, the egos' and their helpers'."""
    found: list[Request] = []
    for i, name in enumerate(DATASETS):
        data = load(find(name))
        spec = Spec(agent, FrozenSource(data), points=tuple(POINTS.values()), seeds=(0,))
        all_of_them = list(requests(spec, data.scenes(data.forest.ids[:number])))
        wanted = (number - len(found)) // (len(DATASETS) - i)
        found += all_of_them[:: max(1, len(all_of_them) // wanted)][:wanted]
    return found


def answers(backend: Backend, asked: list[Request]) -> tuple[list[dict[str, Any]], float]:
    """Return the probabilities of each answer, and the milliseconds an answer takes."""
    start_s = perf_counter()
    done: list[Completion] = [backend.complete([request])[0] for request in asked]
    took_ms = (perf_counter() - start_s) / len(asked) * 1000
    return [json.loads(completion.text)["action_distribution"] for completion in done], took_ms


@contextmanager
def serving(model: str, *options: str) -> Iterator[str]:
    """Yield the base URL of `harness serve`."""
    command = [sys.executable, "-m", "harness", "serve", "--model", model, "--port", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        try:
            yield process.stdout.readline().split()[0].rstrip(",")
        finally:
            process.kill()


if __name__ == "__main__":
    main()
