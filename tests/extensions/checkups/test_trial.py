"""What a model does with a prompt: the fixed questions asked in words,
and what the answers are like.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
from typer.testing import CliRunner

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.cli import app
from harness.core.errors import Unanswered
from harness.evaluate.agent import Agent
from harness.extensions.checkups.prompt import COUNT, Trial, try_out
from harness.prompts import versions

Finish = Literal["stop", "length"]
EXAMPLES = Agent(cards.resolve("swarm-tiny", None), versions.load("v10"))
FASTER = '{"maneuver":"FASTER","confidence":1.00}'
HELPER = '{"evidence":"clear","risk":"low","recommended_maneuver":"IDLE","confidence":0.8}'


class Model:
    """Answers as a rule says: `text` gives the answer to a request."""

    def __init__(self, text: Callable[[Request], str], finish: Finish = "stop") -> None:
        self.text, self.finish, self.asked = text, finish, 0

    def complete(self, requests: Any) -> list[Completion]:
        self.asked += len(requests)
        return [Completion(r.id, self.text(r), 9, 9, self.finish, 0.1, 1) for r in requests]


def tried(
    text: Callable[[Request], str], agent: Agent = EXAMPLES, finish: Finish = "stop"
) -> Trial:
    model = Model(text, finish)
    trial = try_out(model, agent)  # type: ignore[arg-type]
    assert model.asked == COUNT
    return trial


def test_a_model_that_repeats_the_last_example_is_said_to() -> None:
    trial = tried(lambda r: FASTER.replace(":", ": ") if r.role == "ego" else HELPER)
    ego, helper = trial.roles
    assert (ego.readable, ego.strict, ego.distinct, ego.example_copies) == (12, 12, 1, 12)
    assert list(ego.sentences()) == [
        "12 of 12 answers are word for word the answer of an example",
        "all 12 answers are the same text, whatever is asked",
    ]
    assert (helper.strict, helper.example_copies, helper.action, helper.action_count) == (
        12,
        0,
        "IDLE",
        12,
    )
    assert [(pair.fact, pair.n, pair.moved) for pair in trial.pairs] == [
        ("conflict", 4, 0),
        ("gap", 4, 0),
    ]


def test_a_model_that_reads_the_scene_moves() -> None:
    def brakes(request: Request) -> str:
        conflict = "No car in sight comes" not in request.messages[-1]["content"]
        return json.dumps({"maneuver": "SLOWER" if conflict else "FASTER", "confidence": 0.9})

    agent = Agent(cards.resolve("swarm-tiny", None), versions.load("v9"))
    listed = next(iter(tried(brakes, agent).pairs))
    sent = {"SLOWER": 0.9, "FASTER": 0.05}
    assert (listed.fact, listed.moved, listed.n) == ("conflict", 4, 4)
    assert listed.mean == pytest.approx(sent["SLOWER"] - sent["FASTER"])


def test_each_fault_is_counted_and_the_commonest_stands_first() -> None:
    halves = iter(range(COUNT))

    def text(request: Request) -> str:
        if request.role == "helper":
            return "The road is clear, I think."
        echo = next(halves) % 3 == 0
        return json.dumps(
            {"action_distribution": dict.fromkeys(request.actions, "p" if echo else 0.9)}
        )

    agent = Agent(cards.resolve("swarm-tiny", None), versions.load("v2"))
    trial = tried(text, agent, "length")
    ego, helper = trial.roles
    assert (ego.readable, ego.placeholder_copies, ego.bad_sums, ego.at_limit) == (0, 4, 8, 12)
    assert list(ego.sentences()) == [
        "12 of 12 answers run to the limit of tokens",
        "8 of 12 answers state numbers that do not sum to one",
        "4 of 12 answers copy a placeholder of the prompt",
    ]
    assert helper.faults == {"no_json": 12}
    assert "12 of 12 answers cannot be read: no_json" in helper.sentences()
    assert [pair.n for pair in trial.pairs] == [0, 0]  # none of them can be read


def test_a_question_without_an_answer_is_no_answer() -> None:
    class Broken(Model):
        def complete(self, requests: Any) -> list[Completion]:
            return [
                Completion(r.id, "", None, None, "error", None, 1, "out of memory")
                for r in requests
            ]

    with pytest.raises(Unanswered, match="out of memory: a fixed question got no answer"):
        try_out(Broken(lambda request: ""), EXAMPLES)  # type: ignore[arg-type]


@pytest.mark.exhaustive
def test_the_command_asks_a_real_model_and_says_what_it_did(small_path: Path) -> None:
    pytest.importorskip("torch")
    asked = ["prompt", "check", "v2", "--model", "swarm-tiny", "--engine", "transformers"]
    done = CliRunner().invoke(app, [*asked, "--dataset", str(small_path), "--json"])
    assert done.exit_code == 0, done.output[-300:]
    said = json.loads(done.stdout)
    ego, helper = said["trial"]["roles"]
    assert (ego["role"], ego["n"], helper["role"], helper["n"]) == ("ego", 12, "helper", 12)
    assert ego["readable"] == ego["strict"] == 12  # it was taught this prompt
    assert {pair["fact"]: pair["moved"] for pair in said["trial"]["pairs"]}["conflict"] > 0
    assert said["readout"]["n"] == 12
