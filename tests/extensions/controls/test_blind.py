"""The control `messages=blind`: what helpers say who are shown nothing."""

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluating import (
    Scripted,
    Walked,
    Watched,
    course,
    decisions,
    live_spec_of,
    run,
    same_decisions,
    same_scores,
    says,
    spec_of,
    sure,
    walked,
)
from reading import unpacked
from run_on_disk import answers_of

from harness.backends.base import Completion, Request
from harness.coordination.named_points import named_point
from harness.coordination.part_settings import questions
from harness.coordination.parts import PLAIN
from harness.core.errors import UserError
from harness.core.process import Stop
from harness.dataset.load import Dataset
from harness.evaluate import run as evaluation
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.requests import requests
from harness.evaluate.resolve import points
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.report.decisions import Decisions
from harness.report.runs import gather
from harness.runs import folder
from harness.studies.axes import Setting
from harness.studies.replayed_run import MORE, ReplayedRun

BLIND = named_point("6g:messages=blind")
CONDITIONS = points(["single-local", "6g:loss=0"], {"control": ["blind", "no-messages"]})


class Prior(Scripted):
    """Its ego would keep its speed; its helpers say SLOWER whatever they see."""

    def _say(self, request: Request) -> Completion:
        text = says((0.3, 0.4, 0.3)) if request.role == "ego" else self.helper(request)
        return Completion(request.id, text, None, None, "stop", None, 1)

    def helper(self, request: Request) -> str:
        return sure("SLOWER", "helper")


class Perceiving(Prior):
    """Its helpers say SLOWER where they see somebody, and else nothing in particular."""

    def helper(self, request: Request) -> str:
        assert request.view
        return sure("SLOWER", "helper") if request.view.nodes else says((0.3, 0.4, 0.3), "helper")


def success(told: Walked) -> dict[str, float | None]:
    return {s.condition: s.value for s in told.scores
            if (s.metric, s.interval) == ("success_rate", "episodes")}  # fmt: skip


@pytest.mark.parametrize(("who", "kept"), [(Prior, 1.0), (Perceiving, 0.0)])
def test_a_prior_keeps_its_gain_and_perception_loses_it(
    who: type[Scripted], kept: float, small: Dataset
) -> None:
    """Whoever does not brake at the first step collides; the ego alone keeps its speed.

    Three helpers that are sure of SLOWER turn it. A prior says the same with nothing to see, so its
    gain stays under `blind` and is gone with no messages; helpers that judge by what they see lose
    it under both.
    """
    crash = {f"{n:05d}-0": {"IDLE": "collision", "FASTER": "collision"} for n in range(4)}
    data = course(small, 1, crash)
    told = walked(
        spec_of(data, points=points(["single-local", "6g"], {"control": ["blind"]}), seeds=(0,)),
        who({}),
    )
    assert success(told) == {"single-local": 0.0, "6g": 1.0, "6g:messages=blind": kept}
    silent = walked(
        spec_of(data, points=points(["6g"], {"control": ["no-messages"]}), seeds=(0,)), who({})
    )
    assert success(silent) == {"6g": 1.0, "6g:loss=1": 0.0}


def test_a_blind_helper_knows_itself_and_the_beacon_and_sees_no_sector(small: Dataset) -> None:
    scenes = small.scenes(small.courses())
    spec = spec_of(small, "swarm-tiny", "v4")
    asked = list(requests(spec, scenes, questions()["blind"]))
    assert [r.id for r in asked] == [f"{s.id}/{v}~blind" for s in scenes for v in s.viewers[1:]]
    own = {request.id: request for request in requests(spec, scenes)}
    for request in asked:
        sees = own[request.id.removesuffix("~blind")]
        assert request.messages[0] == sees.messages[0]
        head, _, rest = request.messages[1]["content"].partition("REGIONS you see: ")
        assert head == sees.messages[1]["content"].partition("REGIONS")[0]
        assert rest.split("\n")[:3] == [
            "left 0%; right 0%; oncoming 0%", "OBJECTS id type ahead left speed lane light", "none"
        ]  # fmt: skip
        assert "none in sight" in rest


@pytest.fixture(scope="module")
def spec(small: Dataset) -> Spec:
    return spec_of(small, points=CONDITIONS)


@pytest.fixture(scope="module")
def done(spec: Spec, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    return run(spec, tmp_path_factory.mktemp("blind") / "run")


def test_each_helper_is_asked_once_where_a_blind_condition_asks(done: Evaluated) -> None:
    answers = answers_of(done.out)
    blind = decisions(done.out, "6g:loss=0,messages=blind")
    came = {d.scene for d in blind}
    assert came < {d.scene for d in decisions(done.out)}, "other conditions come to others"
    asked = {f"{d.scene}/{message.sender}~blind" for d in blind for message in d.messages}
    assert len({name.partition("/")[0] for name in asked}) < len(came), "a sure ego asks nobody"
    assert Counter(a.id for a in answers if a.role == "blind") == Counter(asked)
    rank = {"ego": 0, "helper": 1, "blind": 2}
    order = [(a.scene, rank[a.role]) for a in answers]
    assert order == sorted(order)
    assert {s.metric for s in done.scores} > {"strict_rate_helper", "strict_rate_blind"}


def test_other_conditions_are_the_same_without_it(
    done: Evaluated, small: Dataset, tmp_path: Path
) -> None:
    less = tuple(point for point in CONDITIONS if not point.question.name)
    without = run(spec_of(small, points=less), tmp_path / "less")
    assert not [a for a in answers_of(without.out) if a.role == "blind"]
    for point in less:
        assert decisions(without.out, point.name) == decisions(done.out, point.name)


@pytest.mark.parametrize("after", [1, 3])
def test_killed_among_the_blind_it_goes_on(
    after: int, spec: Spec, done: Evaluated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(Stop):
        pass

    calls = 0

    def more(count: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 2 * after:  # the second of each step announces the blind
            raise Killed

    with pytest.raises(Killed):
        evaluate(spec, tmp_path / "run", lambda done: None, more=more)
    run(spec, tmp_path / "run")
    assert same_decisions(tmp_path / "run", done.out)
    assert answers_of(tmp_path / "run") == answers_of(done.out)


@pytest.mark.exhaustive
def test_a_replay_has_its_blind_answers_and_asks_the_model_for_others(
    done: Evaluated, small: Dataset, tmp_path: Path
) -> None:
    same = run(spec_of(small, f"replay:{done.out}", points=CONDITIONS), tmp_path / "same")
    assert same_scores(same, done)
    assert same_decisions(same.out, done.out)
    less = tuple(point for point in CONDITIONS if not point.question.name)
    without = run(spec_of(small, points=less), tmp_path / "less")
    more = run(spec_of(small, f"replay:{without.out}", points=CONDITIONS), tmp_path / "more")
    assert same_decisions(more.out, done.out)


@pytest.mark.slow
def test_a_sweep_has_them_asks_for_them_or_says_that_it_lacks_them(
    done: Evaluated, small: Dataset, tmp_path: Path
) -> None:
    less = run(spec_of(small, points=CONDITIONS[:2]), tmp_path / "less").out
    point = CONDITIONS[2]
    assert point.question.name == "blind"
    blind = [Setting(point.name, point, 4)]
    with pytest.raises(
        UserError, match="lacks answers of helpers that are shown nothing, which messages=bl"
    ):
        list(ReplayedRun(less, asks=False).walked(blind, (0, 1)))
    watched = Watched()
    [[more]] = ReplayedRun(less, progress=watched).walked(blind, (0, 1))
    assert sum(watched.asked) > 0
    copied = Path(shutil.copytree(done.out, tmp_path / "run"))
    [[stored]] = ReplayedRun(copied, asks=False).walked(blind, (0, 1))
    assert np.array_equal(stored.ends["success_rate"], more.ends["success_rate"])
    kept = (less / MORE).read_bytes()
    list(ReplayedRun(less).walked(blind, (0, 1)))
    assert (less / MORE).read_bytes() == kept


class Counting(Perceiving):
    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        assert all(r.role == "helper" and r.view and not r.view.nodes for r in requests
                   if r.id.endswith("~blind"))  # fmt: skip
        return super().complete(requests)


@pytest.mark.slow
def test_the_closed_loop_has_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = Counting({})
    monkeypatch.setattr(evaluation, "_open_all", lambda spec: [backend])
    loop = live_spec_of(episodes=1, points=(named_point("6g:loss=0"), BLIND), seeds=(0,))
    evaluate(loop, tmp_path / "run", lambda done: None)
    answers = answers_of(tmp_path / "run")
    blind = {a.scene for a in answers if a.role == "blind"}
    assert blind == {d.scene for d in decisions(tmp_path / "run", BLIND.name)}
    assert all(a.intent == (0.3, 0.4, 0.3) for a in answers if a.role == "blind")
    assert folder.read(tmp_path / "run").scores


class Fusing(Prior):
    """Its blind helpers keep the speed; with messages its ego does as they say."""

    def _say(self, request: Request) -> Completion:
        text = says((0.3, 0.4, 0.3))
        if "+" in request.id:
            told = request.messages[1]["content"].partition("MESSAGES")[2]
            assert "~" not in told, "a model is not told who is blind"
            text = sure("SLOWER" if "1.00 0.00 0.00" in told else "FASTER")
        elif request.role == "helper":
            text = sure("IDLE" if request.id.endswith("~blind") else "SLOWER", "helper")
        return Completion(request.id, text, None, None, "stop", None, 1)


@pytest.mark.exhaustive
def test_a_fusion_call_has_the_blind_helpers_messages(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = points(["6g:consensus=ego-prompt,loss=0"], {"control": ["blind"]})
    with monkeypatch.context() as patched:
        patched.setattr(evaluation, "open_backend", lambda *_, **__: Fusing({}))
        done = run(spec_of(small, "swarm-tiny", points=both, latency="paper"), tmp_path / "run")
    own, blind = ({d.action for d in decisions(done.out, point.name)} for point in both)
    assert (own, blind) == ({"SLOWER"}, {"FASTER"})
    merges = [a for a in answers_of(done.out) if a.role == "merge"]
    assert {len({sender.endswith("~blind") for sender in a.heard}) for a in merges} == {1}
    assert len({a.id for a in merges}) == len(merges)
    replayed = spec_of(small, f"replay:{done.out}", points=both)
    assert same_decisions(run(replayed, tmp_path / "replay").out, done.out)
    details = unpacked(Decisions(gather([done.out])))
    assert all(
        answer["prompt"] is not None for d in details for answer in d["runs"][0]["answers"]
    ), "each as it was sent"


def test_only_a_point_with_a_channel_asks_the_blind() -> None:
    assert named_point("single-local:messages=blind").question == PLAIN
