"""Image prompts: whose eyes the picture is from, and what stands in its place in an ablation."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import spec_of

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.vision import Vision
from harness.coordination.named_points import named_point
from harness.coordination.parts import PLAIN, Question
from harness.core.errors import UserError
from harness.core.resources import folder
from harness.dataset.load import Dataset, Scene, load
from harness.evaluate.agent import Agent
from harness.evaluate.live_world import LiveSource
from harness.evaluate.pictures import GREY, another
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.world.perception.camera import frame
from harness.world.scene_graph import SceneGraph

QWEN3 = Vision(512, 256, patch_px=16, merge=2, least_px=65536, most_px=16777216)
SEES = replace(cards.load("qwen3-4b"), vision=QWEN3)


@pytest.fixture(scope="module")
def crossing() -> Dataset:
    return load(folder("datasets") / "occluded-intersection-v2", 3)


def spec(dataset: Dataset, image: Any = "own", version: str = "v7", vision: Vision = QWEN3) -> Spec:
    card = replace(SEES, vision=vision)
    return replace(spec_of(dataset), ego=Agent(card, prompts.load(version), image=image))


class Unseen(Question):
    """Asked of who is shown nothing."""

    def shown(self, graph: SceneGraph) -> SceneGraph:
        return graph.blinded()


UNSEEN = Unseen("unseen", pictured=False)


def asked(of: Spec, scene: Scene, question: Question = PLAIN) -> dict[str, Request]:
    return {r.id.partition("/")[2]: r for r in requests(of, [scene], question)}


# -- pictures of a question ------------------------------------------------------------------------


def test_every_viewer_is_shown_what_its_own_cameras_see(crossing: Dataset):
    scene = crossing.scenes(crossing.forest.ids[:1])[0]
    for viewer, request in asked(spec(crossing), scene).items():
        assert request.image is not None
        seen = frame(crossing.scenario, scene.state, viewer)
        assert np.array_equal(request.image.pixels, seen.pixels)
        assert request.image.sha256 == seen.sha256
        assert [("image" in m) for m in request.messages] == [False, True]


def test_a_model_is_shown_pictures_of_its_own_size(crossing: Dataset):
    scene = crossing.scenes(crossing.forest.ids[:1])[0]
    small = spec(crossing, vision=Vision(448, 224, patch_px=14, merge=2))
    assert {r.image.pixels.shape for r in asked(small, scene).values() if r.image} == {
        (224, 448, 3)
    }


def test_a_blank_picture_says_nothing_and_a_question_without_one_has_it(crossing: Dataset):
    scene = crossing.scenes(crossing.forest.ids[:1])[0]
    blank = [
        *asked(spec(crossing, "blank"), scene).values(),
        *asked(spec(crossing), scene, UNSEEN).values(),
    ]
    assert len(blank) == 4 + 3
    for request in blank:
        assert request.image is not None
        assert np.all(request.image.pixels == GREY)


def test_another_scene_is_of_another_episode_at_the_same_step_and_always_the_same(
    crossing: Dataset,
):
    of, forest = spec(crossing, "another"), crossing.forest
    for scene in crossing.scenes(forest.ids[:40:7]):
        other = another(of, scene)
        assert other.id == another(of, scene).id
        assert other.record.episode != scene.record.episode
        assert other.record.step == scene.record.step
        viewer = scene.viewers[1]
        request = asked(of, scene)[viewer]
        assert request.image is not None
        assert (
            request.image.sha256 == frame(crossing.scenario, other.state, other.viewers[1]).sha256
        )


def test_without_its_picture_a_prompt_is_its_text(crossing: Dataset):
    scene = crossing.scenes(crossing.forest.ids[:1])[0]
    with_it, without = asked(spec(crossing), scene), asked(spec(crossing, "none"), scene)
    for viewer, request in without.items():
        assert request.image is None
        assert [m["content"] for m in request.messages] == [
            m["content"] for m in with_it[viewer].messages
        ]
        assert not any("image" in m for m in request.messages)


def test_image_alone_says_nothing_of_anybody_around(crossing: Dataset):
    for scene in crossing.scenes(crossing.forest.ids[:20]):
        for viewer, graph in scene.graphs.items():
            _, user = prompts.load("v8").render(
                graph, crossing.actions, words=crossing.scenario.prompt_words
            )
            named = {node.id for node in graph.nodes} - {graph.ego.id, viewer}
            assert not named & set(user["content"].replace(":", " ").replace(",", " ").split())


@pytest.mark.parametrize("image", ["own", "none"])
@pytest.mark.parametrize("content", ["objects", "both", "oracle"])
def test_a_prompt_that_shows_no_objects_is_not_asked_again_with_more_of_them(
    crossing: Dataset, image: str, content: str
):
    """A picture is what the ego's own cameras see, whatever others list."""
    point = named_point(f"6g:content={content}")
    driven = replace(spec(crossing, image, "v8"), source=LiveSource(0, 2))
    for of in (spec(crossing, image, "v8"), driven):
        with pytest.raises(UserError, match="prompt v8 shows no objects in its text") as problem:
            replace(of, points=(point,))
        assert "\n" not in str(problem.value)
    assert replace(spec(crossing, image, "v7"), points=(point,)).points == (point,)


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "version", "vision", "said"),
    [
        ("own", "v7", None, "it shows a picture, and qwen3-4b reads texts alone"),
        ("blank", "v2", QWEN3, "prompt v2 shows no picture"),
        ("mine", "v7", QWEN3, "unknown image 'mine'; known: another, blank, none, own"),
    ],
)
def test_what_cannot_be_shown_is_one_line(image: Any, version: str, vision: Any, said: str):
    with pytest.raises(UserError, match=said):
        Agent(replace(SEES, vision=vision), prompts.load(version), image=image)


@pytest.mark.parametrize("name", ["qwen3-4b", "qwen3-4b:llama-cpp", "openai-example"])
def test_no_engine_shows_a_picture_to_a_model_of_texts(name: str):
    with pytest.raises(UserError, match=r"v7: it shows a picture, and .* reads texts alone"):
        Agent(cards.load(name), prompts.load("v7"))


def test_a_model_of_texts_takes_the_text_of_an_image_prompt():
    assert Agent(cards.load("qwen3-4b"), prompts.load("v7"), image="none").image == "none"


def test_pictures_of_other_scenes_are_a_datasets(crossing: Dataset):
    one = crossing.of_episodes({0})
    with pytest.raises(
        UserError, match=r"no other episode of .* at step 0; give a greater --limit"
    ):
        another(spec(one, "another"), one.scenes(one.forest.ids[:1])[0])
    ego = Agent(SEES, prompts.load("v7"), image="another")
    with pytest.raises(
        UserError, match="--image another: pictures of other scenes are a dataset's"
    ):
        replace(spec(crossing), ego=ego, source=LiveSource(200000, 2))


def test_a_prompt_with_examples_shows_no_picture(tmp_path: Path):
    copy = tmp_path / "vx"
    copy.mkdir()
    for file in Path(folder("prompts") / "v6").iterdir():
        (copy / file.name).write_text(file.read_text())
    table = copy / "prompt.toml"
    table.write_text(table.read_text() + 'image = "camera"\n')
    with pytest.raises(UserError, match=r"an example shows no picture"):
        prompts.load("vx", tmp_path)


# -- tokens of a picture ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size_px", "patch_px", "least_px", "most_px", "tokens"),
    [
        # Qwen2.5-VL and Qwen3-VL, as their processors count (class defaults).
        ((224, 224), 14, 3136, 1003520, 64), ((224, 224), 16, 65536, 16777216, 64),
        ((256, 256), 14, 3136, 1003520, 81), ((256, 256), 16, 65536, 16777216, 64),
        ((448, 224), 14, 3136, 1003520, 128), ((448, 224), 16, 65536, 16777216, 98),
        ((512, 256), 14, 3136, 1003520, 162), ((512, 256), 16, 65536, 16777216, 128),
        ((384, 192), 14, 3136, 1003520, 98), ((384, 192), 16, 65536, 16777216, 72),
        ((640, 160), 14, 3136, 1003520, 138), ((640, 160), 16, 65536, 16777216, 100),
        ((600, 600), 14, 3136, 1003520, 441), ((600, 600), 16, 65536, 16777216, 361),
        ((512, 256), 16, 65536, 65536, 55),
    ],
)  # fmt: skip
def test_a_picture_has_as_many_tokens_as_the_processors_make(
    size_px: tuple[int, int], patch_px: int, least_px: int, most_px: int, tokens: int
):
    assert Vision(*size_px, patch_px, 2, least_px, most_px).tokens == tokens


def test_a_picture_scaled_to_one_size_has_that_size():
    assert Vision(512, 256, 16, 4, scaled_to_px=(512, 512)).tokens == 64
