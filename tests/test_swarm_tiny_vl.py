"""The shipped model that takes pictures: its tokens see, and both engines read them alike."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import spec_of, with_ego

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
pytest.importorskip("highway_env", reason="needs the sim extra")

import torch

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.core.arrays import Floats
from harness.dataset.load import Dataset, find, load
from harness.evaluate.requests import requests
from harness.world.perception.camera import Sight

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

MODEL, FOLDER = "swarm-tiny-vl", Path(__file__).parents[1] / "models" / "swarm-tiny-vl"
SCENES = 5


@pytest.fixture(scope="module")
def shipped() -> Dataset:
    return load(find("roundabout-entry-v1"), limit=SCENES)


def asked(shipped: Dataset, image: str) -> list[Request]:
    """What every viewer is asked at the first decision point of each layout,
    by the picture alone.
    """
    spec = with_ego(spec_of(shipped, MODEL, "v8", answer="readout"), image=image)
    steps = shipped.forest.step
    first = [name for name, at in shipped.forest.place.items() if steps[at] == 0]
    return list(requests(spec, shipped.scenes(first)))


def intents(engine: str, questions: list[Request]) -> Floats:
    backend = open_backend(cards.resolve(MODEL, engine), device="cpu", batch_size=8)
    completions = backend.complete(questions)
    assert [c.error for c in completions] == [None] * len(questions)
    return np.array([list(json.loads(c.text)["action_distribution"].values()) for c in completions])


@pytest.mark.exhaustive
def test_its_picture_tokens_see(shipped: Dataset) -> None:
    """What each token of a picture is read as, on report layouts;
    its decisions make no use of it yet.
    """
    backend: Any = open_backend(cards.resolve(MODEL, "transformers"), device="cpu")
    model, tokenizer = backend.engine.model, backend.chat.tokenizer.hub
    filled = model.config.image_token_id
    digits = model.get_input_embeddings().weight[
        tokenizer.convert_tokens_to_ids(list("0123456789"))
    ]
    answers, train = (
        pytest.importorskip(f"harness.extensions.learn.training.{n}") for n in ("answers", "train")
    )
    read, shown = [], []
    for question in asked(shipped, "own"):
        assert isinstance(question.image, Sight)
        ids = np.array(
            [filled if token < 0 else token for token in backend.tokens(question)], dtype=np.int32
        )
        sample = train.Sample(ids, 1, "", len(ids), None, image=question.image)
        with torch.inference_mode():
            [hidden] = train.hidden_states(model, [sample])
            read.append((hidden[torch.from_numpy(ids[1:] == filled)] @ digits.T).argmax(1).numpy())
        shown.append(answers.cells(question.image))
    told, true = np.concatenate(read), np.concatenate(shown)
    somebody = true > 0
    assert somebody.sum() > 8 * SCENES
    assert (told[~somebody] == 0).mean() >= 0.95
    assert (np.abs(told - true)[somebody] <= 1).mean() >= 0.9


def test_both_engines_answer_its_image_prompts_alike(shipped: Dataset) -> None:
    questions = asked(shipped, "own")[:6]
    one, other = (intents(engine, questions) for engine in ("transformers", "llama-cpp"))
    assert one == pytest.approx(other, abs=0.02)


def test_it_is_small() -> None:
    files = [FOLDER / name for name in ("swarm-tiny-vl-f16.gguf", "mmproj-swarm-tiny-vl-f16.gguf")]
    assert sum(file.stat().st_size for file in files) <= 3e6
