"""A read-out over cyclic orders of its letters:
the average, what follows the letter, and each engine's.
"""

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiers import some

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.backends.orders import average_orders
from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.evaluate.agent import Agent
from harness.prompts import readout, versions

questions = pytest.importorskip("harness.extensions.checkups.questions")
ACTIONS = ("SLOWER", "IDLE", "FASTER")
SHARES = st.lists(st.floats(0.01, 1.0), min_size=3, max_size=3)


def shares(text: str) -> list[float]:
    said = json.loads(text)["action_distribution"]
    return [said[action] for action in ACTIONS]


def letters_p(of_action: list[float], of_letter: list[float]) -> list[list[float]]:
    """What a model says of its letters, whose preferences for actions and for letters multiply."""
    rows = [
        [of_letter[place] * of_action[ACTIONS.index(action)] for place, action in enumerate(order)]
        for order in readout.cyclic(ACTIONS)
    ]
    return [[p / (2 * sum(row)) for p in row] for row in rows]


@given(SHARES, SHARES)
def test_a_preference_for_letters_cancels(of_action: list[float], of_letter: list[float]) -> None:
    read = average_orders(ACTIONS, letters_p(of_action, of_letter))
    assert shares(read.text) == pytest.approx([p / sum(of_action) for p in of_action], abs=2e-6)
    assert read.label_mass == pytest.approx(0.5)
    spread = [float(np.var(np.log(p))) for p in (of_letter, of_action)]
    if sum(spread) > 1e-9:
        assert read.letter_share == pytest.approx(spread[0] / sum(spread), abs=1e-5)


def test_what_follows_the_letter_and_what_follows_the_action() -> None:
    letter = average_orders(ACTIONS, letters_p([1.0, 1.0, 1.0], [0.7, 0.2, 0.1]))
    assert (letter.letter_share, letter.follows_letter) == (1.0, True)
    action = average_orders(ACTIONS, letters_p([0.7, 0.2, 0.1], [1.0, 1.0, 1.0]))
    assert (action.letter_share, action.follows_letter) == (0.0, False)
    nothing = average_orders(ACTIONS, [[0.1, 0.1, 0.1]] * 3)
    assert (nothing.letter_share, shares(nothing.text)) == (
        0.0,
        pytest.approx([1 / 3] * 3, abs=1e-6),
    )


def test_a_letter_that_a_server_leaves_nothing_still_has_a_logarithm() -> None:
    assert all(p > 0 for p in shares(average_orders(ACTIONS, [[0.9, 0.1, 0.0]] * 3).text))


def agent(engine: str, letters: Any = "cyclic") -> Agent:
    return Agent(
        cards.resolve("swarm-tiny", engine), versions.load("v4"), "readout", letters=letters
    )


def test_the_letters_are_read_as_the_card_says_unless_told_otherwise() -> None:
    assert agent("llama-cpp", None).letters == "raw"
    assert agent("llama-cpp", None).settings()["letters"] == "raw"
    assert agent("llama-cpp").settings()["letters"] == "cyclic"
    assert Agent(cards.resolve("qwen3-4b"), versions.load("v4"), "readout").letters == "cyclic"
    assert Agent(cards.resolve("qwen3-4b"), versions.load("v4"), "json").letters == "raw"
    assert Agent(cards.resolve("proxy"), versions.load("v4")).letters == "raw"
    with pytest.raises(UserError, match="--letters cyclic: proxy answers in json; leave it out"):
        Agent(cards.resolve("proxy"), versions.load("v4"), letters="cyclic")
    with pytest.raises(UserError, match="letters"):
        agent("llama-cpp", "sideways")


def by_hand(backend: Any, request: Request) -> list[float]:
    """The average of what the model says of each order, asked as a question of its own."""
    logs = []
    for order, messages in zip(
        readout.cyclic(request.actions), (request.messages, *request.orders), strict=True
    ):
        [said] = backend.complete([request.alike(messages=messages, orders=(), actions=order)])
        logs.append([math.log(p) for p in shares(said.text)])
    weights = np.exp(np.mean(logs, axis=0))
    return list(weights / weights.sum())


@pytest.mark.parametrize("engine", some(["transformers"], exhaustive=["llama-cpp"]))
def test_an_engine_averages_what_it_says_of_each_order_alone_or_in_a_batch(engine: str) -> None:
    pytest.importorskip({"llama-cpp": "llama_cpp", "transformers": "torch"}[engine])
    near = {"llama-cpp": 5e-4, "transformers": 2e-5}[engine]  # F16 keys and values, float32 weights
    asked = [*questions.requests(agent(engine))[:2], questions.requests(agent(engine), "helper")[0]]
    batches = open_backend(agent(engine).card, batch_size=2)
    single = open_backend(agent(engine).card, batch_size=1)
    together, alone = batches.complete(asked), single.complete(asked)
    for one, other in zip(together, alone, strict=True):
        assert shares(one.text) == pytest.approx(shares(other.text), abs=near)
        assert one.follows_letter == other.follows_letter
        assert one.letter_share == pytest.approx(other.letter_share, abs=1e-4)
        assert one.label_mass == pytest.approx(other.label_mass, abs=1e-4)
        assert one.prompt_tokens == other.prompt_tokens
    assert shares(alone[0].text) == pytest.approx(by_hand(single, asked[0]), abs=1e-3)
    # Raw questions between the orders are read as ever.
    plain = [request.alike(orders=()) for request in asked]
    mixed = batches.complete([asked[0], plain[0], asked[1], plain[1]])
    raw = batches.complete(plain[:2])
    assert [mixed[1].letter_share, mixed[3].letter_share] == [None, None]
    for one, other in ((mixed[1], raw[0]), (mixed[3], raw[1]), (mixed[0], together[0])):
        assert shares(one.text) == pytest.approx(shares(other.text), abs=near)


@pytest.mark.slow
def test_both_engines_average_alike() -> None:
    pytest.importorskip("llama_cpp")
    pytest.importorskip("torch")
    answers: list[list[Completion]] = []
    for engine in ("llama-cpp", "transformers"):
        backend = open_backend(agent(engine).card, batch_size=2)
        answers.append(backend.complete(questions.requests(agent(engine))[:2]))
    for one, other in zip(*answers, strict=True):
        assert shares(one.text) == pytest.approx(shares(other.text), abs=0.005)
