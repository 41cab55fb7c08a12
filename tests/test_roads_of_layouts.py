"""Where layouts have roads and goals of their own, a scene is shown with those of its layout."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from evaluating import spec_of

from harness.backends import cards
from harness.dataset.load import Dataset, find, load
from harness.dataset.publish import _row
from harness.evaluate.agent import Agent
from harness.evaluate.chats import Asking
from harness.evaluate.pictures import picture
from harness.evaluate.requests import requests
from harness.prompts import versions
from harness.prompts.budget import measure

NAME, PROMPT = "sumo-crossing-v1", "v4"
Chats = Mapping[tuple[str, ...], Any]  # by scene and viewer


@pytest.fixture(scope="module")
def crossing() -> Dataset:
    """A layout whose goal no other one has."""
    return load(find(NAME)).of_episodes(frozenset({9}))


@pytest.fixture(scope="module")
def sent(crossing: Dataset) -> Chats:
    """What models are asked."""
    scenes = crossing.scenes(crossing.courses())
    asked = requests(spec_of(crossing, "proxy", PROMPT), scenes)
    chats = {tuple(request.id.split("/")): request.messages for request in asked}
    task = crossing.scenario.at(crossing.seeds[0]).prompt_words["task"]
    assert task != crossing.scenario.prompt_words["task"]
    assert any(task in chat[0]["content"] for chat in chats.values())
    return chats


def test_the_prompt_that_is_shown_is_the_one_that_is_sent(
    sent: Chats, harness: Callable[..., Any]
) -> None:
    scene = next(iter(sent))[0]
    _, out, _ = harness("prompt", "show", PROMPT, "--dataset", NAME, "--scene", scene, "--json")
    shown = {viewer: json.loads(out)[viewer] for name, viewer in sent if name == scene}
    assert shown == {viewer: list(chat) for (name, viewer), chat in sent.items() if name == scene}


def test_what_is_measured_and_published_is_what_is_sent(sent: Chats, crossing: Dataset) -> None:
    scenes, prompt = crossing.scenes(crossing.courses()), versions.load(PROMPT)
    measured = list[Any]()
    measure(prompt, crossing, scenes, lambda chat: measured.append(chat) or 0, 0, lambda done: None)
    for chat in sent.values():
        assert chat in measured
    chat_of = Asking.of(crossing.scenario, PROMPT, "json").chat
    for scene in scenes:
        assert _row(scene, chat_of)["prompt"] == [*sent[scene.id, scene.viewers[0]]]


def test_a_picture_is_of_the_layouts_own_road(crossing: Dataset) -> None:
    ego = Agent(cards.load("swarm-tiny-vl"), versions.load("v7"))
    spec = spec_of(crossing, "proxy", PROMPT)
    object.__setattr__(spec, "ego", ego)
    [scene, *_] = crossing.scenes(crossing.courses())
    seen = picture(spec, 0, scene, scene.viewers[0])
    assert seen
    assert seen.scenario.layout_seed == crossing.seeds[0]  # type: ignore[attr-defined]
