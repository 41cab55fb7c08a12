"""ego-prompt with plans: an agent's model is asked once more with what the others are going to
do.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from evaluating import A_TENTH, Scripted, live_spec_of, says

from harness.backends.base import Completion, Request
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.core.files import digest
from harness.dataset.load import Scene
from harness.evaluate.asking import Asker
from harness.evaluate.fusion import messages_of
from harness.evaluate.live_world import LiveSource, LiveWorld
from harness.evaluate.spec import Spec
from harness.evaluate.walk import Decided, walk
from harness.prompts import versions

ALL = "all-way-crossing:agent_share=1"
READS = "6g:tau=0,content=plan,consensus=ego-prompt"
Steps = list[Sequence[Decided[Scene]]]
TWICE = f"{READS},rounds=2,window_s=0.6"


class Polite(Scripted):
    """Wants to go; waits as soon as it reads that anybody else plans to.
    Fails after so many questions.
    """

    def __init__(self, questions: int = 1 << 30) -> None:
        super().__init__({})
        self.left = questions

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.left -= len(requests)
        if self.left < 0:
            raise KeyboardInterrupt
        return super().complete(requests)

    def _say(self, request: Request) -> Completion:
        text = request.messages[-1]["content"]
        p = (0.8, 0.1, 0.1) if " 70 / " in text else (0.1, 0.2, 0.7)
        return Completion(request.id, says(p), None, None, "stop", None, 1)


def spec(*conditions: str, prompt: str = "v13", **options) -> Spec:
    points = tuple(map(named_point, conditions))
    made = live_spec_of("swarm-tiny-six-v2", prompt=prompt, points=(named_point("6g"),), seeds=(0,))
    return replace(made, source=LiveSource(50_000, 2, ALL), points=points).changed(
        latency="paper", **options
    )


def driven(where: Spec, backend: Scripted, kept: Path | None = None) -> tuple[Steps, Asker]:
    """What was decided in the first steps of an episode, by step and condition, and who asked."""
    world = LiveWorld(where.scenario, 50_000, range(1), where.points, where.seeds, ego_alone=False)
    asker = Asker(where, lambda: backend, A_TENTH, kept)
    return list(islice(walk(world, where.points, asker, "first"), 4)), asker


def same(one: Steps, other: Steps) -> bool:
    """Whether the same was decided in each step."""
    parts = [
        (a.result, b.result)
        for x, y in zip(one, other, strict=True)
        for a, b in zip(x, y, strict=True)
    ]
    return all(
        np.array_equal(a.fused, b.fused) and np.array_equal(a.latency_s, b.latency_s)
        for a, b in parts
    )


def test_agents_are_asked_again_with_the_plans_of_others() -> None:
    """The first plans say 10, 20 and 70 %; those of the second round 80, 10 and 10."""
    where = spec("single-local", READS, TWICE, f"{READS},loss=1")
    steps, asker = driven(where, Polite())
    first = [part.result.action.tolist() for part in steps[0]]
    alone, reads, twice, unheard = (set(actions) for actions in first)
    assert alone == unheard == {2}
    assert reads == {0}, "all the others plan to go"
    assert twice == {2}, "all the others have said that they wait"
    calls = [answer for answer in asker.answers.values() if answer.role == "merge"]
    scenes = {scene.id: scene for step in steps for scene in step[0].decision_points}
    said = set()
    for answer in calls:
        heard, scene = messages_of({}, answer.heard, where.actions), scenes[answer.scene]
        said |= {tuple(plan["intent"]) for plan in heard}
        words = (scene.seat or where.scenario).prompt_words
        asked = versions.load("v13").render(
            scene.graphs[answer.viewer], where.actions, heard, words
        )
        assert digest(asked) == answer.prompt_sha256, "a page can show what was asked"
        assert "PLANS" in asked[-1]["content"]
    assert said == {(0.1, 0.2, 0.7), (0.8, 0.1, 0.1)}


def test_without_a_plan_it_is_the_answer_alone() -> None:
    steps, asker = driven(spec(f"{READS},loss=1", f"{TWICE},loss=1"), Polite())
    assert {answer.role for answer in asker.answers.values()} == {"ego"}
    for part in (part for step in steps for part in step):
        assert part.result.fused.tolist() == part.said.intents.own.tolist()
        assert (part.result.fusion_s == 0).all()


@pytest.mark.exhaustive
def test_batches_and_a_stop_change_nothing(tmp_path: Path) -> None:
    whole, asker = driven(spec(READS, TWICE), backend := Polite())
    assert same(whole, driven(spec(READS, TWICE, batch_size=1), Polite())[0])
    asked = backend.asked
    assert len(set(asked)) == len(asked) == len(asker.answers), "no question is asked twice"
    with pytest.raises(KeyboardInterrupt):
        driven(spec(READS, TWICE), Polite(len(asked) // 2), tmp_path / "kept.jsonl")
    rest = Polite()
    assert same(whole, driven(spec(READS, TWICE), rest, tmp_path / "kept.jsonl")[0])
    assert 0 < len(rest.asked) < len(asked)


def test_who_cannot_read_plans_is_refused() -> None:
    with pytest.raises(UserError, match="prompt v12 cannot show plans; use --prompt v13"):
        spec(READS, prompt="v12")
    with pytest.raises(UserError, match="proxy is no language model"):
        replace(spec("6g"), ego=live_spec_of(prompt="v13").ego, points=(named_point(READS),))
    with pytest.raises(UserError, match="cruise is no language model and cannot read plans"):
        replace(
            spec("6g"),
            helpers=(live_spec_of("cruise", prompt="v13").ego,),
            points=(named_point(READS),),
        )


@pytest.mark.parametrize("key", ["v2!plan", "v2!plan:1:a,b:3:0", "v2!plan:1:0.1:3"])
def test_a_strangers_plan_is_one_line(key: str) -> None:
    with pytest.raises(UserError, match="which is no plan; make the run again"):
        messages_of({}, [key], ("SLOWER",))
