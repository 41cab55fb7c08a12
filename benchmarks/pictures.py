"""Decisions a CPU second with and without pictures, and what part of them is drawing and encoding.

A model of the shipped size and random weights reads letters out: what it says means nothing, what
it costs is the same. The limit is the same prompt without its picture.

    python benchmarks/pictures.py [--decisions 40]
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, cast

import torch
from rows import Row, finish

from harness.backends import cards
from harness.backends.base import Backend, Request
from harness.backends.registry import open_backend
from harness.dataset.load import find, load
from harness.evaluate.agent import Agent, ImageMode
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.extensions.learn.training.model import new_model, save_tokenizer, train_tokenizer
from harness.prompts import versions
from harness.world.perception import camera

SMALLEST = "--decisions 1"
TABLE = ""
NEEDS = "torch"
DATASET = "occluded-intersection-v2"
ASKED = (("v7", "none"), ("v7", "own"), ("v8", "own"))


def main() -> None:
    """Print a table, and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--decisions", type=int, default=40)
    given = arguments.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    print(f"{'prompt':<22}{'decisions/s':>12}{'/ text':>8}{'drawing':>9}{'encoding':>10}{'n':>5}")
    with TemporaryDirectory() as folder:
        for version, image in ASKED:
            asked = questions(Path(folder), version, cast(ImageMode, image), given.decisions)
            backend: Any = open_backend(cards.resolve(folder), device="cpu", dtype="float32")
            whole_s, drawing_s = timed(backend, asked), drawn(asked)
            row = {
                "prompt": version,
                "image": image,
                "n": given.decisions,
                "decisions_per_s": given.decisions / whole_s,
                "drawing": drawing_s / whole_s,
                "encoding": encoded(backend, asked) / whole_s,
            }
            rows.append(row)
            ratio = row["decisions_per_s"] / rows[0]["decisions_per_s"]
            print(
                f"{f'{version}, image {image}':<22}{row['decisions_per_s']:>12.2f}{ratio:>8.2f}"
                f"{row['drawing']:>9.0%}{row['encoding']:>10.0%}{given.decisions:>5}"
            )
    plain, *others = rows
    n, limit = given.decisions, 1000 / plain["decisions_per_s"]
    figures = [
        Row(
            f"a decision with pictures, `{row['prompt']}`, CPU",
            1000 / row["decisions_per_s"],
            "ms",
            n,
            limit,
        )
        for row in others
    ]
    finish(figures, prompts=rows)


def questions(folder: Path, version: str, image: ImageMode, decisions: int) -> list[Request]:
    """All that is asked at some decision points,
    of a model that is made in the folder if it is not there.
    """
    dataset, prompt = load(find(DATASET)), versions.load(version)
    scenes = dataset.scenes(dataset.courses()[:decisions])
    if not (folder / "config.json").is_file():
        words = dataset.scenario.prompt_words
        graphs = [graph for scene in scenes for graph in scene.graphs.values()]
        texts = [
            m["content"] for g in graphs for m in prompt.render(g, dataset.actions, words=words)
        ]
        tokenizer = train_tokenizer(texts, sees=True)
        new_model(tokenizer, 0, sees=True).save_pretrained(folder)
        save_tokenizer(tokenizer, folder)
    ego = Agent(cards.resolve(str(folder)), prompt, "readout", image=image)
    return list(requests(Spec(ego, FrozenSource(dataset), (), (0,)), scenes))


def timed(backend: Backend, asked: Sequence[Request]) -> float:
    """CPU seconds of all answers, pictures drawn on the way."""
    backend.complete(asked[:8])
    camera._drawn.cache_clear()
    begun_s = process_time()
    backend.complete([replace(request) for request in asked])
    return process_time() - begun_s


def drawn(asked: Sequence[Request]) -> float:
    """CPU seconds of drawing their pictures."""
    camera._drawn.cache_clear()
    begun_s = process_time()
    for request in asked:
        if request.image:
            _ = request.image.pixels
    return process_time() - begun_s


def encoded(backend: Any, asked: Sequence[Request]) -> float:
    """CPU seconds of the image processor and the vision encoder."""
    pictures = [request.image.pixels for request in asked if request.image]
    if not pictures:
        return 0.0
    processor, model = backend.engine.eyes._processor, backend.engine.model
    begun_s = process_time()
    with torch.inference_mode():
        for start in range(0, len(pictures), 8):
            made = processor(pictures[start : start + 8])
            model.model.get_image_features(made["pixel_values"], made["image_grid_thw"])
    return process_time() - begun_s


if __name__ == "__main__":
    main()
