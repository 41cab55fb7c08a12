"""A promise where a model is served: how to act on each answer, as an episode would."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluating import run, spec_of
from starlette.testclient import TestClient

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.extensions.decide.acts import Acts
from harness.extensions.decide.app import Service
from harness.extensions.decide.asked import Act, Answered, Asked
from harness.extensions.decide.model import ServedModel, served
from harness.extensions.promise.promises import promise
from harness.prompts.decision import Question
from harness.runs.fit import question_of, write
from harness.runs.folder import read
from harness.world import scenarios
from harness.world.scenario import Scenario

pytestmark = pytest.mark.usefixtures("svg_alone")

Typed = Callable[..., tuple[int, str, str]]
TINY = served(cards.load("swarm-tiny"))


def answer(options: Sequence[str], shares: Sequence[float]) -> Answered:
    question = Question("", "", dict.fromkeys(options))
    return Answered(Asked(None, question, tuple(options)), tuple(shares), None)


@pytest.mark.parametrize(
    ("condition", "shares", "act"),
    [
        ("6g:tau=0.7,careful_nats=0.5", (0, 1, 0), Act("alone", 1)),
        ("6g:tau=0.7,careful_nats=0.5", (0.2, 0.8, 0), Act("careful", 0)),
        # it asks, and is careful where nobody is heard
        ("6g:tau=0.7,careful_nats=0.5", (0.1, 0.5, 0.4), Act("ask", 0)),
        ("6g:tau=0.7", (0.1, 0.5, 0.4), Act("ask", 1)),
        ("single-local:careful_nats=0.5", (0.1, 0.5, 0.4), Act("careful", 0)),
        ("6g:schedule=never", (0.1, 0.5, 0.4), Act("alone", 1)),
    ],
)
def test_entropy_says_how_to_act(small: Dataset, condition: str, shares: Any, act: Act) -> None:
    """Of entropies 0, .5 and .94 nats, whatever the order in which a client lists the actions."""
    acts = Acts(named_point(condition), small.scenario, TINY, {})
    assert acts.of(answer(small.actions, shares)).act == act
    turned = acts.of(answer(small.actions[::-1], shares[::-1])).act
    assert turned == Act(act.word, 2 - act.choice)
    of_others = answer(("yes", "no", "perhaps"), shares)
    assert acts.of(of_others) == of_others


@pytest.mark.slow
def test_a_served_answer_is_acted_on_as_in_an_episode(two_path: Path, tmp_path: Path) -> None:
    two = load(two_path)
    alone = ("single-local:careful_nats=0.9", "single-local:careful_nats=0.95")
    points = tuple(named_point(text) for text in (*alone, "6g:tau=0.8,careful_nats=0.9"))
    run(spec_of(two, points=points, seeds=(0,)), tmp_path / "run")
    played = read(tmp_path / "run")
    intents = {each.scene: each.intent for each in played.answers if each.role == "ego"}
    acts = {point.name: Acts(point, two.scenario, TINY, {}) for point in points}
    words = set()
    for row in played.decisions.records(0, len(played.decisions)):
        acted = acts[row.condition].of(answer(two.actions, intents[row.scene]))
        assert acted.act is not None
        words.add(acted.act.word)
        assert (acted.act.word == "ask") >= row.triggered
        if row.condition in alone:
            assert row.action == two.actions[acted.act.choice]
            assert tuple(row.fused) == (1.0, 0.0, 0.0) or acted.act.word == "alone"
    assert words == {"alone", "careful", "ask"}


class Unsure:
    """An engine that says of each question what it is told."""

    def __init__(self, shares: Sequence[float]) -> None:
        self.shares = shares

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        completions = []
        for request in requests:
            shares = dict(zip(request.actions, self.shares, strict=True))
            text = json.dumps({"action_distribution": shares})
            completions.append(Completion(request.id, text, 7, 0, "stop", None, 1))
        return completions

    def identity(self) -> dict[str, Any]:
        return {"engine": "unsure", "sha256": "a" * 64}


@pytest.fixture
def kept(project: Path, small: Dataset) -> Scenario:
    """The scenario of the promise `tiny`, of what is served."""
    question, weights = question_of(TINY.settings()), {"sha256": "a" * 64}
    tiny = replace(promise("p"), question=question, weights=weights)
    write(tiny, project / "promises/tiny.toml")
    return small.scenario


def test_a_promise_is_kept_by_both_wire_shapes(kept: Scenario) -> None:
    """It asks above .3 nats, and is careful from .9 on."""
    engine = Unsure((0.1, 0.45, 0.45))
    acts = Acts(named_point("6g:promise=tiny"), kept, TINY, engine.identity())
    service = Service(ServedModel(TINY, engine), acts=acts)
    client = TestClient(service.app(), base_url="http://127.0.0.1")
    criteria = dict.fromkeys(kept.actions)
    question = {"type": "choice", "instructions": "Go?", "criteria": criteria}
    asked: dict[str, Any] = {"state": "s", "questions": {"a": question}}
    said = client.post("/v1/systemone", json=asked).json()["answers"]["a"]
    assert (said["choice"], said["act"]) == ("SLOWER", "ask")
    assert said["probabilities"]["IDLE"] == 0.45
    choices = [{"value": action} for action in kept.actions]
    listed = [{"type": "choice", "instructions": "Go?", "choices": choices}]
    asked = {"input": "s", "questions": listed}
    [said] = client.post("/v1/decisions", json=asked).json()["answers"]
    assert (said["choice"], said["act"]) == ("SLOWER", "ask")


def test_what_a_promise_was_not_made_of_is_one_line(kept: Scenario) -> None:
    for name, identity, says in (
        ("p", {}, "condition 6g:promise=p: promise p was fitted with model.name proxy, not swarm"),
        ("tiny", {"sha256": "b" * 64}, "promise tiny was fitted on other weights (sha256 aaaa"),
    ):
        with pytest.raises(UserError) as error:
            Acts(named_point(f"6g:promise={name}"), kept, TINY, identity)
        assert says in str(error.value)
        assert "\n" not in str(error.value)
    write(replace(promise("tiny"), weights={}), Path("promises/plain.toml"))
    with pytest.raises(UserError, match="plain was made of a model without digests of weights"):
        Acts(named_point("6g:promise=plain"), kept, TINY, {"sha256": "a" * 64})
    other = scenarios.get("blind-merge")
    with pytest.raises(UserError, match="was fitted with scenario"):
        Acts(named_point("6g:promise=tiny"), other, TINY, {"sha256": "a" * 64})
    with pytest.raises(UserError, match="6g:schedule=always: schedule always has a threshold of"):
        Acts(named_point("6g:schedule=always"), kept, TINY, {})


def test_a_wording_that_is_searched_has_no_promise(
    kept: Scenario, project: Path, harness: Typed
) -> None:
    words = ("prompt", "optimize", "--model", "swarm-tiny", "--prompt", TINY.prompt.version)
    more = (
        "--answer",
        TINY.answer,
        "--condition",
        "6g:promise=tiny",
        "--budget",
        "9",
        "--out",
        "mine",
    )
    code, _, error = harness(*words, *more)
    assert (code, error.count("\n")) == (2, 1)
    assert f"prompt.version {TINY.prompt.version}, not mine; make one with" in error
    assert not (project / "reports").exists()


def test_a_condition_is_served_of_a_scenario(harness: Typed) -> None:
    for words in (("--condition", "6g"), ("--scenario", "blind-merge")):
        code, out, error = harness("serve", "--model", "swarm-tiny", *words)
        assert (code, out) == (2, "")
        assert error == "harness: --condition and --scenario: give both, or neither\n"


@pytest.mark.parametrize(
    ("condition", "says"),
    [
        ("6g:attack=liar", "it has what acts on messages alone"),
        ("6g:stream=cpm", "it has a stream"),
    ],
)
def test_a_condition_that_acts_on_messages_is_not_served(condition: str, says: str) -> None:
    pytest.importorskip("harness.extensions.trust")
    pytest.importorskip("harness.extensions.streams")
    with pytest.raises(UserError, match=f"{condition}: {says}"):
        Acts(named_point(condition), scenarios.get("occluded-intersection"), TINY, {})
