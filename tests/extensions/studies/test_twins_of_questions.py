"""Twins of questions with examples, with a picture, and for a decision model;
and which twin is named.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import scenes_of, spec_of, with_ego
from graphs import CAR, COMING, STANDING, TRUCK, graph

from harness.backends import cards
from harness.backends.vision import Vision
from harness.coordination.named_points import named_point
from harness.core.resources import folder
from harness.core.statistics import Estimate
from harness.dataset.load import Dataset, load
from harness.evaluate.agent import Agent
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.extensions.studies.twins.asking import _twins as twins_of
from harness.extensions.studies.twins.asking import lack
from harness.extensions.studies.twins.declared import TWINS
from harness.extensions.studies.twins.scoring import Row, headline
from harness.prompts import versions
from harness.prompts.examples import Example, Examples
from harness.world import scenarios

QWEN3 = Vision(512, 256, patch_px=16, merge=2, least_px=65536, most_px=16777216)
YIELD = '{"action_distribution":{"SLOWER":0.90,"IDLE":0.10,"FASTER":0.00}}'
GO = '{"action_distribution":{"SLOWER":0.00,"IDLE":0.25,"FASTER":0.75}}'
WARN = f'{{"evidence":"v2 from left","risk":"high",{YIELD[1:]}'
SHOWN = Examples(
    scenarios.DEFAULT,
    (
        Example(100_007, graph("ego", [CAR, TRUCK], [COMING]), YIELD),
        Example(100_009, graph("ego", [TRUCK], [STANDING]), GO),
    ),
    (Example(100_007, graph("helper", [CAR], [COMING]), WARN),),
)


def with_examples(spec: Spec) -> Spec:
    return with_ego(spec, prompt=replace(spec.ego.prompt, examples=SHOWN))


def test_where_letters_stand_for_other_actions_so_do_those_of_the_examples(small: Dataset) -> None:
    spec = with_examples(with_ego(spec_of(small, "swarm-tiny"), answer="readout"))
    question = next(requests(spec, scenes_of(small)[:1]))
    other = TWINS["letters"].text(spec, question)
    assert "A FASTER, B SLOWER, C IDLE" in other.messages[-1]["content"]
    assert [m["content"] for m in other.messages if m["role"] == "assistant"] == ["B", "A"]


def test_a_prompt_with_metres_in_its_examples_has_no_twin_in_feet(small: Dataset) -> None:
    spec, scene = spec_of(small, "swarm-tiny"), scenes_of(small)[0]
    view = scene.graphs["v1"]
    assert TWINS["units"].graph(spec, scene, view) != view
    shown = with_examples(spec)
    assert TWINS["units"].graph(shown, scene, view) == view
    question = next(requests(shown, [scene]))
    assert TWINS["units"].text(shown, question) == question


def deciding(data: Dataset) -> Spec:
    spec = spec_of(data, "swarm-tiny", points=(named_point("single-local"),))
    return with_ego(spec, prompt=versions.load("v2"), answer="decision", letters=None)


@pytest.mark.parametrize("twin", ["units", "order", "paraphrase"])
def test_a_twin_changes_the_question_with_the_chat(small_path: Path, twin: str) -> None:
    data = load(small_path, limit=1)
    spec = deciding(data)
    change = TWINS[twin].text
    assert change is not None
    changed = [(r, change(spec, r)) for r in requests(spec, scenes_of(data)[:3])]
    assert any(old.question != new.question for old, new in changed)
    for old, new in changed:
        assert old.question is not None
        assert new.question is not None
        assert (old.messages == new.messages) == (old.question == new.question)
        assert new.messages[-1]["content"].startswith(new.question.state)


@pytest.mark.parametrize("version", ["v7", "v8"])
def test_only_a_mirrored_scene_has_another_picture_which_is_mirrored(version: str) -> None:
    crossing = load(folder("datasets") / "occluded-intersection-v2", 3)
    card = replace(cards.load("qwen3-4b"), vision=QWEN3)
    of = replace(spec_of(crossing), ego=Agent(card, versions.load(version), image="own"))
    mirrored = 0
    for scene in crossing.scenes(crossing.forest.ids[:12:3]):
        questions = list(requests(of, [scene]))
        for twin in TWINS.values():
            if twin.senders or lack(of, twin):
                continue
            for _, _, question, other in twins_of(of, twin, scene, questions):
                assert question.image
                assert other.image
                same = question.image.pixels
                if twin.name == "mirrored":
                    mirrored += 1
                    same = same[:, ::-1]
                assert np.array_equal(other.image.pixels, same), twin.name
    assert mirrored > 4


def test_twins_name_the_pair_that_clearly_holds_least_often() -> None:
    def row(value: float, low: float, high: float) -> Row:
        of = Estimate(value, low, high, 9, 0)
        broken: Any = () if value == 1 else (None,)
        return Row(twin, "ego", 9, of, of, of, broken)

    twin = next(iter(TWINS.values()))
    whole, low, near = row(1.0, 0.9, 1.0), row(0.5, 0.4, 0.6), row(0.55, 0.45, 0.7)
    assert f"Least often holds {twin.name}, ego: 50.0 %" in headline([whole, low])
    said = headline([whole, low, replace(near, role="helper")])
    assert f"the intervals of these overlap: ({twin.name}, ego) and ({twin.name}, helper)." in said
    assert "Least often holds" not in said
