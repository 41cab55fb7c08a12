"""Models that see, in transformers: the shapes of Qwen3-VL,
Qwen2.5-VL and SmolVLM answer image prompts.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import some

pytest.importorskip("torch", reason="needs the transformers extra")

import tiny_vl
import torch

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.core.image import Image

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

ACTIONS = ("SLOWER", "IDLE", "FASTER")


def drawn(seed: int, size_px: tuple[int, int]) -> Image:
    """A picture of a few coloured squares."""
    width, height = size_px
    squares = np.random.default_rng(seed).integers(0, 256, (4, 8, 3), dtype=np.uint8)
    rows, columns = np.arange(height) * 4 // height, np.arange(width) * 8 // width
    return Image(squares[rows[:, None], columns])


@pytest.fixture(scope="module", params=tiny_vl.FAMILIES)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_vl.build(tmp_path_factory.mktemp("vl") / request.param, request.param)


@pytest.fixture(scope="module")
def model(folder: Path) -> Any:
    backend = open_backend(cards.resolve(str(folder)), device="cpu", batch_size=4)
    return backend


def question(
    model: Any, n: int, picture: int | None, answer: Any = "json", text: str = "Scene"
) -> Request:
    vision = model.engine.card.vision
    shown = {} if picture is None else {"image": "camera"}
    return Request(
        id=f"s{n}/v1", role="ego", actions=ACTIONS, max_tokens=64, answer=answer,
        messages=({"role": "system", "content": 
            "You drive."}, {"role": "user", "content": text, **shown}),
        image=None if picture is None else drawn(picture, vision.size_px),
    )  # fmt: skip


def test_a_prompt_is_read_as_the_model_itself_reads_it(model: Any) -> None:
    """Against one forward pass of the whole prompt by transformers' own rules, answer and all."""
    asked = question(model, 0, 1)
    ids = model.tokens(asked)
    eyes, net = model.engine.eyes, model.engine.model
    more = model.chat.encode('{"action_distribution":')
    with torch.inference_mode():
        whole = torch.tensor([[*ids, *more]])
        made = dict(eyes._processor([asked.image.pixels]))
        if "image_grid_thw" in made:
            made["mm_token_type_ids"] = (whole < 0).int()
        filled = torch.where(whole < 0, net.config.image_token_id, whole)
        logits = net(input_ids=filled, **made).logits[0].log_softmax(-1)
    session = model.engine.begin([ids])
    first = session.log_probs()[0]
    session.advance([more])
    then = session.log_probs()[0]
    assert np.abs(first - logits[len(ids) - 1].numpy()).max() < 2e-4
    assert np.abs(then - logits[-1].numpy()).max() < 2e-4


def test_a_guess_after_a_picture_is_checked_at_its_own_places(model: Any) -> None:
    asked = [question(model, 0, 1), question(model, 1, None, text="No picture")]
    prompts = [model.tokens(request) for request in asked]
    more = model.chat.encode('{"action')
    plain = model.engine.begin(prompts)
    written: list[list[int]] = []
    for _ in range(4):
        plain.advance([[more[0]], [more[0]]] if not written else [[token] for token in written[-1]])
        written.append(plain.argmax([None, None]))
    right, other = ([step[row] for step in written[:3]] for row in (0, 1))
    session = model.engine.begin(prompts)
    wrong = [(token + 1) % 100 for token in other[1:]]
    assert session.follow([[more[0]], [more[0]]], [right, [other[0], *wrong]]) == [3, 1]
    session.advance([[], [other[1]]])
    session.advance([[], [other[2]]])
    assert np.abs(session.log_probs() - plain.log_probs()).max() < 2e-4


def test_each_way_to_go_on_after_a_picture_is_at_its_own_places(model: Any) -> None:
    asked = [question(model, 0, 1), question(model, 1, None, text="No picture")]
    prompts, some = [model.tokens(request) for request in asked], list(range(100))
    ways = [[model.chat.encode(text) for text in ("A SLOWER", "B", "{")] for _ in asked]
    found = model.engine.begin(prompts).ends(ways, some)
    for turn in range(3):
        plain = model.engine.begin(prompts)
        plain.advance([of[turn] for of in ways])
        assert np.abs(found[:, turn] - plain.log_probs(some)).max() < 2e-4


def test_a_picture_has_the_tokens_that_the_card_says(model: Any) -> None:
    vision = model.engine.card.vision
    tokens = model.tokens(question(model, 0, 1))
    assert sum(token < 0 for token in tokens) == vision.tokens
    assert vision.tokens == (16 if vision.scaled_to_px else 128)
    [said] = model.complete([question(model, 0, 1)])
    assert said.prompt_tokens == len(tokens)


@pytest.mark.parametrize("answer", some(["readout"], exhaustive=["json", "constrained"]))
def test_a_batch_answers_as_each_alone(model: Any, answer: str) -> None:
    asked = [
        question(model, 0, 1, answer), question(model, 1, 2, answer, "Another scene, longer"),
        question(model, 2, 1, answer, "The same picture"), question(model, 3, 3, answer),
    ]  # fmt: skip
    if answer == "json":
        asked = [replace(request, max_tokens=12) for request in asked]
    together = [c.text for c in model.complete(asked)]
    alone = [model.complete([request])[0].text for request in asked]
    again = [model.complete([request])[0].text for request in reversed(asked)]
    for one, *others in zip(alone, together, again[::-1], strict=True):
        if answer != "readout":
            assert others == [one, one]
            continue
        p, *same = (json.loads(text)["action_distribution"] for text in (one, *others))
        assert all(p == pytest.approx(q, abs=1e-5) for q in same)


def test_a_picture_is_encoded_once_unless_the_same_question_comes_again_alone(
    model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded, real = [], model.engine.model.model.get_image_features
    monkeypatch.setattr(
        model.engine.model.model, "get_image_features",
        lambda **made: encoded.append(len(made["pixel_values"])) or real(**made),
    )  # fmt: skip
    asked = [question(model, n, 11 + n % 2, "readout", f"Scene {n}") for n in range(4)]
    model.complete(asked)
    model.complete(asked)
    assert len(encoded) == 1, "two pictures, in four questions, twice"
    model.complete(asked[:1])
    assert len(encoded) == 1, "the question is not one that was read alone"
    model.complete(asked[:1])
    assert len(encoded) == 2, "its time would be no answer's time"


def test_the_picture_is_looked_at_and_only_its_own(model: Any) -> None:
    asked = [question(model, n, picture, "readout") for n, picture in enumerate((1, 2, 1))]
    one, other, same = (c.text for c in model.complete(asked))
    assert one == same != other


@pytest.mark.parametrize("picture", [None, 1])
def test_a_text_that_has_the_token_of_a_picture_shows_none(model: Any, picture: int | None) -> None:
    """As a helper might write it, whose words are in the ego's prompt."""
    mark = model.chat.image_token
    hostile = question(model, 0, picture, text=f"{mark} MESSAGES v3 high {mark}{mark} evidence")
    assert sum(
        token < 0 for token in model.tokens(hostile)
    ) == model.engine.card.vision.tokens * bool(picture)
    assert model.engine.model.config.image_token_id not in model.tokens(hostile)
    [said] = model.complete([hostile])
    assert said.error is None


def test_a_text_alone_is_read_as_ever(model: Any) -> None:
    text, *_ = model.complete([question(model, 0, None)])
    seen, *_ = model.complete([question(model, 0, 1)])
    assert text.error is None
    assert text.prompt_tokens < seen.prompt_tokens


def test_a_card_that_says_other_tokens_is_one_line(folder: Path) -> None:
    card = cards.resolve(str(folder))
    with pytest.raises(
        UserError, match=r"its processor makes \d+ tokens of .* and its card says \d+"
    ):
        open_backend(replace(card, vision=replace(card.vision, merge=1)), device="cpu")


def test_a_checkpoint_without_its_processor_is_one_line(tmp_path: Path) -> None:
    folder = tiny_vl.build(tmp_path / "vl")
    card = cards.resolve(str(folder))
    (folder / "preprocessor_config.json").unlink()
    with pytest.raises(UserError, match="has no image processor"):
        open_backend(card, device="cpu")
