"""What a number format changes: the same answers in each, on transformers and OpenVINO.

    python benchmarks/number_formats.py [--answer readout] [--formats openvino:auto ...]

Prompts of v10, spread over the scenes of a dataset, at temperature 0 on a CPU in batches of 8 after
one that warms up, read-outs in one order of letters. An answer is compared with that of
transformers in float32: its text, its likeliest action, and the greatest difference of a
probability. What a format wrote is kept in the folder `--out`, and is read there and not made
again.
"""

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.backends import cards
from harness.backends.base import Letters, Request
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
    arguments.add_argument("--answer", choices=("json", "readout"), default="json")
    arguments.add_argument("--batch", type=int, default=8)
    arguments.add_argument("--formats", nargs="+", choices=FORMATS, default=FORMATS)
    arguments.add_argument("--out", type=Path, default=Path("reports/number-formats"))
    given = arguments.parse_args()
    asked = questions(given)
    written = {each: of_format(each, asked, given) for each in given.formats}
    reference = written[REFERENCE]
    expected = intents(asked, reference.texts)
    print(f"{len(asked)} answers, {len(set(reference.texts))} different ones in {REFERENCE}")
    print(f"likeliest actions there: {Counter(map(likeliest, expected))}")
    print("| format | answers a CPU s | same text | same likeliest action | mean, greatest diff. |")
    print("|---|--:|--:|--:|--:|")
    for name, answers in written.items():
        here = intents(asked, answers.texts)
        texts = equal(answers.texts, reference.texts)
        actions = equal(list(map(likeliest, here)), list(map(likeliest, expected)))
        apart = np.abs(np.array(here) - np.array(expected)).max(axis=1)
        pace = len(asked) / answers.cpu_s
        differences = f"{np.nanmean(apart):.2g}, {np.nanmax(apart):.2g}"
        print(f"| {name} | {pace:.2f} | {texts} | {actions} | {differences} |")


def questions(given: argparse.Namespace) -> list[Request]:
    """Return as many questions, to all that are asked in scenes spread over a dataset."""
    data, count = load(find(given.dataset)), given.prompts
    letters: Letters | None = "raw" if given.answer == "readout" else None
    card, prompt = cards.resolve(given.model), versions.load("v10")
    agent = Agent(card, prompt, given.answer, letters=letters)
    spec = Spec(agent, FrozenSource(data), (), (0,))
    every = list(requests(spec, data.scenes(data.courses())))
    by_scene = groupby(every, lambda request: request.id.partition("/")[0])
    scenes = [list(of_scene) for _, of_scene in by_scene]
    step = max(1, len(scenes) * len(scenes[0]) // count)
    # whole scenes: a fixed step through requests may meet egos alone, whose answers are all one
    return list(chain.from_iterable(scenes[::step]))[:count]


def of_format(name: str, asked: list[Request], given: argparse.Namespace) -> Written:
    """Return what the model writes in a format: that which is kept, or else asked now."""
    file = given.out / f"{given.answer}-{name.replace(':', '-')}.json"
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


def intents(asked: list[Request], texts: list[str]) -> list[Sequence[float]]:
    """Return each answer's probabilities of the actions; NaN where none can be read."""
    intents: list[Sequence[float]] = []
    for request, text in zip(asked, texts, strict=True):
        intent = parse(text, **request.shape._asdict()).intent
        intents.append(intent or [math.nan] * len(request.actions))
    return intents


def likeliest(intent: Sequence[float]) -> int | None:
    """Return the place of an answer's likeliest action; None where none is read."""
    return None if math.isnan(intent[0]) else int(np.argmax(intent))


def equal(one: Sequence[object], other: Sequence[object]) -> int:
    """Return how many of two lists' values are equal, place by place."""
    return sum(a == b for a, b in zip(one, other, strict=True))


if __name__ == "__main__":
    main()
