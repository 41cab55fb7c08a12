"""What a number format changes: the same JSON answers in each, on transformers and OpenVINO.

    python benchmarks/number_formats.py [--prompts 500] [--formats openvino:auto ...] [--out FOLDER]

Prompts of v10, spread over the scenes of a dataset, at temperature 0 on a CPU in batches of 8 after
one that warms up. An answer is compared with that of transformers in float32: its text, and its
likeliest action. What a format wrote is kept in FOLDER, and is read there and not made again.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.dataset.load import find, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.parsing.parse import parse
from harness.prompts import versions

SMALLEST = "--model swarm-tiny --prompts 2 --batch 1 --formats transformers:float32 --out reports/f"
NEEDS = "torch"
REFERENCE = "transformers:float32"
FORMATS = (
    REFERENCE,
    "transformers:bfloat16",
    "openvino:float32",
    "openvino:bfloat16",
    "openvino:auto",
)


class Written(NamedTuple):
    """Hold what a model wrote in one number format, and the CPU seconds that it took."""

    texts: list[str]
    cpu_s: float


def main() -> None:
    """Print a row for each format."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="smollm2-135m")
    arguments.add_argument("--dataset", default="occluded-intersection-v3")
    arguments.add_argument("--prompts", type=int, default=500)
    arguments.add_argument("--batch", type=int, default=8)
    arguments.add_argument("--formats", nargs="+", choices=FORMATS, default=FORMATS)
    arguments.add_argument("--out", type=Path, default=Path("reports/number-formats"))
    given = arguments.parse_args()
    asked = questions(given.model, given.dataset, given.prompts)
    written = {each: of_format(each, asked, given) for each in given.formats}
    reference = written[REFERENCE]
    expected = actions(asked, reference.texts)
    print(f"{len(asked)} answers, {len(set(reference.texts))} different ones in {REFERENCE}")
    print("| format | answers a CPU s | same text | same likeliest action | read |")
    print("|---|--:|--:|--:|--:|")
    for name, done in written.items():
        found = actions(asked, done.texts)
        same = equal(done.texts, reference.texts)
        alike, read = equal(found, expected), len(found) - found.count(None)
        pace = len(asked) / done.cpu_s
        print(f"| {name} | {pace:.2f} | {same} | {alike} | {read} of {len(asked)} |")


def questions(model: str, dataset: str, count: int) -> list[Request]:
    """Return as many questions, to all that are asked in scenes spread over a dataset."""
    data = load(find(dataset))
    agent = Agent(cards.resolve(model), versions.load("v10"), "json")
    spec = Spec(agent, FrozenSource(data), (), (0,))
    every = list(requests(spec, data.scenes(data.courses())))
    by_scene = groupby(every, lambda request: request.id.partition("/")[0])
    scenes = [list(of_scene) for _, of_scene in by_scene]
    step = max(1, len(scenes) * len(scenes[0]) // count)
    # whole scenes: a fixed step through requests may meet egos alone, whose answers are all one
    return list(chain.from_iterable(scenes[::step]))[:count]


def of_format(name: str, asked: list[Request], given: argparse.Namespace) -> Written:
    """Return what the model writes in a format: that which is kept, or else asked now."""
    file = given.out / f"{name.replace(':', '-')}.json"
    key = [given.model, *(request.id for request in asked)]
    if file.exists() and (kept := json.loads(file.read_text()))["key"] == key:
        return Written(kept["texts"], kept["cpu_s"])
    engine, dtype = name.split(":")
    card = of_engine(given.model, engine)
    backend = open_backend(card, device="cpu", dtype=dtype, batch_size=given.batch)
    backend.complete(asked[: given.batch])
    start_s = time.process_time()
    texts = [done.text for done in backend.complete(asked)]
    cpu_s = time.process_time() - start_s
    given.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"key": key, "texts": texts, "cpu_s": cpu_s}))
    return Written(texts, cpu_s)


def of_engine(model: str, engine: str) -> Card:
    """Return the model's card on an engine; OpenVINO reads the file of llama.cpp."""
    if engine == "transformers":
        return cards.resolve(model, engine)
    return replace(cards.resolve(model, "llama-cpp"), engine=engine)


def actions(asked: list[Request], texts: list[str]) -> list[int | None]:
    """Return the place of each answer's likeliest action; None where none is read."""
    places: list[int | None] = []
    for request, text in zip(asked, texts, strict=True):
        intent = parse(text, role=request.role, actions=request.actions).intent
        places.append(intent.index(max(intent)) if intent else None)
    return places


def equal(one: Sequence[object], other: Sequence[object]) -> int:
    """Return how many of two lists' values are equal, place by place."""
    return sum(a == b for a, b in zip(one, other, strict=True))


if __name__ == "__main__":
    main()
