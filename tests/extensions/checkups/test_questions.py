"""The fixed questions that try a model out."""

from collections import Counter
from pathlib import Path

import pytest
from typer.testing import CliRunner

from harness.backends import cards
from harness.cli import app
from harness.core.seeds import purposes
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.extensions.checkups import questions
from harness.prompts import versions

AGENT = Agent(cards.resolve("swarm-tiny", None), versions.load("v4"), "readout")


def test_twelve_questions_of_twelve_tune_layouts_each_with_one_conflict() -> None:
    asked = questions.questions()
    assert len({q.layout_seed for q in asked}) == len(asked) == 12
    assert all(purposes(q.layout_seed, 1) == ["tune"] for q in asked)
    assert all(len(q.graphs["ego"].conflicts) == 1 for q in asked)
    for role in ("ego", "helper"):
        requests = questions.requests(AGENT, role)
        assert [r.role for r in requests] == [role] * 12
        assert len({str(request.messages) for request in requests}) == 12


@pytest.mark.exhaustive
def test_a_question_is_as_the_dataset_freezes_it(tmp_path: Path) -> None:
    built = [
        "dataset",
        "build",
        questions.SCENARIO,
        "--episodes",
        "1",
        "--seed",
        "1000",
        "--no-audit",
    ]
    assert CliRunner().invoke(app, [*built, "--out", str(tmp_path / "tune")]).exit_code == 0
    dataset = load.load(tmp_path / "tune")
    first = questions.questions()[0]
    seen = {graph for scene in dataset.scenes(dataset.courses()) for graph in scene.graphs.values()}
    assert seen >= set(first.graphs.values())


def test_a_pair_differs_in_one_line() -> None:
    pairs = [*questions.scene_pairs(AGENT), *questions.plain_pairs(AGENT)]
    assert {fact: sum(p.fact == fact for p in pairs) for fact in {p.fact for p in pairs}} == {
        "conflict": 4, "gap": 4, "danger": 4, "number": 4,
    }  # fmt: skip
    for pair in pairs:
        present, absent = (
            Counter("\n".join(m["content"] for m in half.messages).split("\n"))
            for half in (pair.present, pair.absent)
        )
        # What is in conflict is listed first: the objects' order may change, and nothing else.
        assert ((present - absent).total(), (absent - present).total()) == (1, 1), pair.fact
        assert pair.expected in pair.present.actions
