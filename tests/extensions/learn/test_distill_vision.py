"""A small model that learns to see: what it is shown in training is what it is shown in a run."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import CAR, graph
from msgspec import structs

from harness.world.scene_graph import Node

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("highway_env", reason="needs the sim extra")

from former import SCENARIO
from teaching import SEED, drawn_by

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.extensions.learn.training.answers import cells, sights
from harness.extensions.learn.training.distill import Curriculum, distill
from harness.extensions.learn.training.lessons import Lessons, draw
from harness.extensions.learn.training.model import (
    END,
    MARKS,
    VISION,
    new_model,
    read_tokenizer,
    save_tokenizer,
    take_over,
    train_tokenizer,
)
from harness.extensions.learn.training.questions import Question, alone
from harness.extensions.learn.training.student import Student
from harness.extensions.learn.training.train import Plan
from harness.prompts import readout
from harness.prompts import versions as prompts
from harness.world.perception.camera import Sight

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

VERSIONS = (prompts.load("v7"), prompts.load("v8"))
PLAN = Plan({"excerpts": 4, "alone": 4, "messages": 8, "answers": 6}, batch=2)
LAYOUTS = 2


def silent(*_: object) -> None:
    pass


CAMERA = {"sensors": ("camera", "lidar"), "indicator": "off"}


@pytest.fixture(scope="module", autouse=True)
def _drawn_once(once: Any) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.extensions.learn.training.lessons.decision_points", drawn_by(once))
        yield


@pytest.fixture(scope="module")
def lessons(tmp_path_factory: pytest.TempPathFactory) -> Lessons:
    place = tmp_path_factory.mktemp("lessons")
    return draw(SCENARIO, VERSIONS, LAYOUTS, SEED, place, 1, silent)


@pytest.fixture(scope="module")
def folder(once: Any) -> Path:
    taught = Curriculum({SCENARIO: VERSIONS}, LAYOUTS, SEED)
    return once("seer", lambda out: distill(taught, PLAN, out, silent, silent, "cpu"))


@pytest.fixture(scope="module")
def asked(lessons: Lessons) -> list[Question]:
    return list(alone(lessons))[::17][:12]


def request(q: Question, answer: Any = "readout") -> Request:
    messages = q.read_out if answer == "readout" else q.messages
    return Request(q.key, q.graph.role, messages, q.actions, 160, answer=answer, image=q.image)


def test_every_question_of_an_image_prompt_has_its_viewers_picture(asked: list[Question]):
    for q in asked:
        assert q.image is not None
        assert q.image.pixels.shape == (VISION.height_px, VISION.width_px, 3)
    assert len({q.image.sha256 for q in asked if q.image}) > 1


def test_an_answer_names_only_those_whom_its_prompt_names(lessons: Lessons):
    for q in alone(lessons):
        if q.named:
            assert q.prompt.version == "v7"
            assert any(f"{c.vehicle} " in q.messages[-1]["content"] for c in q.graph.conflicts)


def test_whom_the_cameras_show_is_listed_nearest_first():
    def node(kind: str, forward_m: float, left_m: float, **more: Any) -> Node:
        return structs.replace(
            CAR, **{"type": kind, "forward_m": forward_m, "left_m": left_m, **CAMERA, **more}
        )

    def listed(*nodes: Node) -> str:
        return sights(graph("ego", nodes, ()))

    near = node("van", 11.7, 0.3, braking=True, indicator="left")
    far = node("car", 30.2, -3.6, braking=False, indicator="left")
    unseen = node("vehicle", 5.0, 1.0, sensors=("radar",), indicator=None)
    assert listed(far, unseen, near) == "van 12 0 brake; car 30 -4 left"
    assert listed(unseen) == "nobody"
    many = [node("car", 10.0 * n, 0.0) for n in range(1, 9)]
    assert listed(*many) == "; ".join(f"car {10 * n} 0" for n in range(1, 6))


def test_the_first_stage_asks_whom_the_picture_shows(lessons: Lessons, tmp_path: Path):
    student = Student([replace(lessons, scenes=lessons.scenes[::3])], PLAN, tmp_path, "cpu")
    learnt = student.lessons[0].scenes
    listed = [sights(scene.graphs[v]) for scene in learnt for v in scene.viewers]
    samples = student.samples("excerpts")
    said = [
        student.tokenizer.decode(s.ids[s.answer_at :].tolist(), skip_special_tokens=False)
        for s in samples
    ]
    assert all(sample.image is not None for sample in samples)
    assert [text[3:].removesuffix(END) for text in said] == [
        text for text in listed for _ in VERSIONS
    ]


def test_each_token_of_a_picture_says_how_far_the_nearest_vehicle_in_its_square_is(
    asked: list[Question],
):
    somebody = 0
    for q in asked:
        assert isinstance(q.image, Sight)
        frame, state, side = q.image.frame, q.image.state, VISION.patch_px * VISION.merge
        viewer = state.vehicle(q.image.viewer_id)
        away_m = {v.id: np.hypot(v.x_m - viewer.x_m, v.y_m - viewer.y_m) for v in state.vehicles}
        shown = cells(q.image).reshape(VISION.height_px // side, VISION.width_px // side)
        for row, column in np.ndindex(shown.shape):
            square = frame.owners[
                row * side : (row + 1) * side, column * side : (column + 1) * side
            ]
            inside = [
                away_m[frame.ids[n]] for n in np.unique(square) if n >= 0 and frame.ids[n] in away_m
            ]
            assert shown[row, column] == (min(9, 1 + int(min(inside) // 7.0)) if inside else 0)
            somebody += bool(inside)
    assert somebody > 20


def test_an_engine_reads_what_the_model_learnt_from(
    folder: Path,
    lessons: Lessons,
    asked: list[Question],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """The same tokens, and the same read-outs as training computed from its own patches and
    positions.
    """
    import torch

    model: Any = open_backend(
        cards.resolve(str(folder)), device="cpu", dtype="float32", batch_size=4
    )
    student = Student([lessons], PLAN, tmp_path, "cpu")
    student.tokenizer = model.chat.tokenizer.hub.backend_tokenizer
    student.letters = [student.tokenizer.token_to_id(x) for x in readout.letters(SCENARIO.actions)]
    # What training reads out; an untaught model also likes the letters with a blank before them.
    spelt = dict(
        zip(readout.letters(SCENARIO.actions), [[n] for n in student.letters], strict=True)
    )
    monkeypatch.setattr(
        model.chat, "spellings", lambda letters: {letter: spelt[letter] for letter in letters}
    )
    state = model.engine.model.state_dict()
    assert all(torch.equal(p, p.half().float()) for p in state.values()), "as F16 holds them"
    if student.model.get_input_embeddings().num_embeddings == len(model.chat.tokenizer.hub):
        student.model.load_state_dict(state)
    else:
        student.model = model.engine.model
    samples = student.reading(asked)
    filled = model.engine.model.config.image_token_id
    for q, sample in zip(asked, samples, strict=True):
        tokens = [filled if token < 0 else token for token in model.tokens(request(q))]
        assert tokens == sample.ids[: sample.answer_at].tolist()
    completions = model.complete([request(q) for q in asked])
    for p, completion in zip(student.read(samples), completions, strict=True):
        said = json.loads(completion.text)["action_distribution"]
        assert p == pytest.approx([said[a] for a in SCENARIO.actions], abs=2e-5)


def test_one_that_begins_as_a_model_of_texts_reads_texts_as_that_does(
    asked: list[Question], tmp_path: Path
):
    import torch

    tokenizer = train_tokenizer([m["content"] for q in asked for m in q.messages])
    base = new_model(tokenizer, 1)
    base.save_pretrained(tmp_path)
    save_tokenizer(tokenizer, tmp_path)
    more = read_tokenizer(tmp_path, sees=True)
    assert more.get_vocab_size() == tokenizer.get_vocab_size() + len(MARKS)
    seer = new_model(more, 2, sees=True)
    take_over(seer, tmp_path)
    ids = torch.tensor([more.encode(asked[0].messages[-1]["content"]).ids])
    with torch.inference_mode():
        one, other = base(ids).logits, seer(input_ids=ids).logits
    assert torch.allclose(one, other[..., : one.shape[-1]], atol=1e-5)


def test_a_picture_is_answered_as_the_base_answers_the_same_scene_graph_in_words(
    lessons: Lessons, asked: list[Question], tmp_path: Path
):
    tokenizer = train_tokenizer([m["content"] for q in asked for m in q.messages])
    new_model(tokenizer, 1).save_pretrained(tmp_path)
    save_tokenizer(tokenizer, tmp_path)
    both = replace(
        lessons, prompts=(prompts.load("v4"), prompts.load("v8")), scenes=lessons.scenes[::9]
    )
    student = Student([both], PLAN, tmp_path, "cpu", base=tmp_path)
    texts, pictures = (
        [q for q in student.questions if (q.image is None) == of] for of in (True, False)
    )
    read = student.read(student.reading(texts))  # the base's own, as nothing was learnt since
    for text, seen, intent, sample in zip(
        texts, pictures, read, student.reading(pictures), strict=True
    ):
        assert text.key.rpartition("/")[0] == seen.key.rpartition("/")[0]
        assert sample.target == pytest.approx(intent)
    assert all(s.target is q.label for q, s in zip(texts, student.reading(texts), strict=True))


def test_another_kind_of_model_is_no_base(folder: Path, tmp_path: Path):
    model = new_model(read_tokenizer(folder, sees=True), 0, sees=True)
    with pytest.raises(
        UserError, match=r"--base .*give the folder of a model that `harness model distill` made"
    ):
        take_over(model, folder)


@pytest.mark.exhaustive
def test_it_answers_in_every_mode(folder: Path, asked: list[Question]):
    model: Any = open_backend(
        cards.resolve(str(folder)), device="cpu", dtype="float32", batch_size=4
    )
    for answer in ("json", "constrained", "readout"):
        for completion in model.complete([request(q, answer) for q in asked[:3]]):
            assert completion.error is None
            assert completion.prompt_tokens > VISION.tokens


@pytest.mark.exhaustive
def test_both_engines_answer_its_image_prompts_alike(folder: Path, asked: list[Question]):
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    requests = [request(q) for q in asked[:2]]
    here = open_backend(cards.resolve(str(folder)), device="cpu", dtype="float32").complete(
        requests
    )
    card = cards.resolve(str(folder), "llama-cpp")
    assert card.projector == "mmproj-seer-f16.gguf"
    there = open_backend(card, device="cpu").complete(requests)
    for one, other in zip(here, there, strict=True):
        assert one.prompt_tokens == other.prompt_tokens
        p, q = (json.loads(c.text)["action_distribution"] for c in (one, other))
        assert p == pytest.approx(q, abs=0.02)


def test_the_picture_is_what_two_prompts_that_say_the_same_differ_in(
    folder: Path, asked: list[Question]
):
    model: Any = open_backend(
        cards.resolve(str(folder)), device="cpu", dtype="float32", batch_size=4
    )
    one, other = (
        asked[0],
        next(q for q in asked if q.image and q.image.sha256 != asked[0].image.sha256),
    )
    vocabulary = len(model.chat.tokenizer.hub)
    p = model.next_log_probs([request(one), replace(request(one), image=other.image)], vocabulary)
    assert np.abs(p[0] - p[1]).max() > 1e-4
