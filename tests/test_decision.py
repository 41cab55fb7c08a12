"""The decision answer mode: what is asked, who is asked which way, and what a refusal is."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluating import run, scenes_of, spec_of, with_ego

from harness.backends import cards
from harness.backends.base import Completion, Request, failed
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.parsing.parse import Status, parse
from harness.prompts import versions
from harness.prompts.decision import MEANINGS
from harness.runs import folder
from harness.world import scenarios


@pytest.fixture(scope="module")
def data(small_path: Path) -> Dataset:
    return load(small_path, limit=1)


def deciding(
    data: Dataset, prompt: str = "v9", points: Sequence[str] = ("single-local",), **how: Any
) -> Spec:
    spec = spec_of(data, "swarm-tiny", points=tuple(map(named_point, points)))
    return with_ego(
        spec, prompt=versions.load(prompt), **{"answer": "decision", "letters": None, **how}
    )


def asked(data: Dataset, **options: Any) -> list[Request]:
    return list(requests(deciding(data, **options), scenes_of(data)[:1]))


def test_a_decision_asks_in_the_scenarios_words_about_what_the_prompt_says(data: Dataset) -> None:
    ego, helper, *_ = asked(data)
    words = data.scenario.prompt_words
    for request in (ego, helper):
        assert request.question is not None
        system, user = request.messages
        assert system["content"] == request.question.instructions
        assert words["task"] in request.question.instructions
        assert user["content"].startswith(request.question.state)
        assert user["content"].endswith("Answer with one letter: A SLOWER, B IDLE, C FASTER.")
        assert "JSON" not in user["content"] + system["content"]
        assert f"SLOWER: go one speed level down, of {words['speeds']} m/s\n" in user["content"]
    assert ego.question is not None
    assert helper.question is not None
    assert "Your task" in ego.question.instructions
    assert "You help car v1" in helper.question.instructions
    assert helper.shape.role == "ego", "a helper's evidence is numbers alone"


def test_every_action_of_every_scenario_has_a_meaning() -> None:
    for name in scenarios.names():
        assert set(scenarios.get(name).actions) <= set(MEANINGS)


def test_orders_share_the_state_and_list_the_options_as_the_letters(data: Dataset) -> None:
    request = asked(data, letters="cyclic", flip=True)[0]
    assert request.question is not None
    texts = [chat[-1]["content"] for chat in (request.messages, *request.orders, *request.flips)]
    assert len(texts) == 6
    for text in texts:
        assert text.startswith(request.question.state + "\n")
        lines = text.removeprefix(request.question.state + "\n").splitlines()
        listed = [line.partition(":")[0] for line in lines[:-1]]
        letters = ", ".join(
            f"{letter} {action}" for letter, action in zip("ABC", listed, strict=True)
        )
        assert lines[-1] == f"Answer with one letter: {letters}."


def test_a_scenario_may_say_what_its_actions_mean(data: Dataset) -> None:
    own = replace(data.scenario, words={**data.scenario.words, "IDLE": "wait for the robot"})
    agent = Agent(cards.load("swarm-tiny"), versions.load("v9"), "decision")
    graph = next(iter(scenes_of(data)[0].graphs.values()))
    question = agent.chats(graph, own.actions, own.prompt_words)["question"]
    assert question.meanings["IDLE"] == "wait for the robot"
    assert (
        agent.chats(graph, ("HOVER", "IDLE"), own.prompt_words)["question"].meanings["HOVER"]
        is None
    )


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"prompt": "v10"}, "prompt v10 has examples"),
        ({"points": ("6g:consensus=ego-prompt",)}, "a decision gives no messages to fuse"),
        ({"sums": "divide"}, "answers in decision"),
    ],
)
def test_what_a_decision_cannot_do_is_refused_in_one_line(
    data: Dataset, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(UserError, match=reason) as refused:
        deciding(data, **options)
    assert "\n" not in str(refused.value)


def test_a_decision_is_not_sampled_and_helps_an_ego_that_is(data: Dataset) -> None:
    spec = deciding(data)
    with pytest.raises(
        UserError, match=r"--temperature 0.7: a decision is a distribution already; use"
    ):
        spec.changed(temperature=0.7)
    written = replace(spec.ego, answer="json", letters=None)
    mixed = replace(spec, ego=written, helpers=(spec.ego,)).changed(
        temperature=0.7, sampling_seed=1
    )
    ego, *helpers = requests(mixed, scenes_of(data)[:1])
    assert (ego.temperature, ego.sample, ego.question) == (0.7, 1, None)
    assert {(helper.temperature, helper.question is None) for helper in helpers} == {(0.0, False)}


def test_a_refusal_is_an_answer_that_failed_and_no_fault_of_the_engine(data: Dataset) -> None:
    request = asked(data)[0]
    answer = answer_of(request, Completion(request.id, "", 10, 0, "refusal", None, 1))
    assert (answer.status, answer.verdict, answer.intent, answer.error) == (
        "refused",
        "failed",
        None,
        None,
    )
    assert answer_of(request, failed(request, "gone")).status == "engine_error"
    assert (
        parse("{}", role="ego", actions=("IDLE",), finish_reason="refusal").status is Status.REFUSED
    )


@pytest.mark.slow
def test_a_chat_model_decides_by_a_read_out_and_its_run_is_replayed(
    data: Dataset, tmp_path: Path
) -> None:
    pytest.importorskip("llama_cpp")
    spec = deciding(
        data, points=("single-local", "6g", "6g:loss=0,tau=0,content=objects"), flip=True
    )
    run(spec, tmp_path / "a")
    first = folder.read(tmp_path / "a")
    assert {answer.status for answer in first.answers} == {"strict"}
    assert all(answer.label_mass is not None and answer.message is None for answer in first.answers)
    assert any(answer.heard for answer in first.answers), (
        "the ego is asked once more, about objects"
    )
    assert first.manifest.answer == "decision"
    replayed = with_ego(spec, card=cards.resolve(f"replay:{tmp_path / 'a'}"))
    run(replayed, tmp_path / "b")
    again = folder.read(tmp_path / "b")
    assert [a.intent for a in again.answers] == [a.intent for a in first.answers]
    assert list(again.decisions.labels("action")) == list(first.decisions.labels("action"))
    with pytest.raises(UserError, match="--answer decision; replay it with the same"):
        run(with_ego(replayed, answer="readout"), tmp_path / "c")
    texts = {
        json.loads(a.raw)["action_distribution"].keys() == set(data.actions) for a in first.answers
    }
    assert texts == {True}
