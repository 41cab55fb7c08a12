"""ego-prompt: the ego's model is asked once more, with the messages that arrived."""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from evaluating import (
    Scripted,
    Watched,
    all_scenes,
    asker_of,
    course,
    decisions,
    figure,
    run,
    same_decisions,
    same_scores,
    says,
    scenes_of,
    spec_of,
    sure,
)
from run_on_disk import UNTIMED, answers_of, configure
from tiers import some

from harness.backends.base import Completion, Request
from harness.coordination.exchange import exchange
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.sent import SentIntents
from harness.core.arrays import Ints
from harness.core.errors import UserError
from harness.core.files import digest
from harness.core.process import Stop
from harness.dataset.load import Dataset
from harness.evaluate import run as evaluation
from harness.evaluate import timing
from harness.evaluate.fusion import FusionAnswers, codes_of, heard_in
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.evaluate.walk import Due, heard_codes
from harness.prompts.versions import load as prompt
from harness.radio.channel import Draws
from harness.runs.records import Latency
from harness.studies.axes import Setting
from harness.studies.replayed_run import MORE, ReplayedRun

FUSION = named_point("6g:consensus=ego-prompt")
LANGUAGE_MODEL = "swarm-tiny"  # its card: answers come from a script, or from itself
DECLARED = Latency("declared", "for this test", 0.1, 0.2, 0.3)


def due(link: Any, jitter: Any) -> Due:
    """A decision in each of n moments, with these draws."""
    n = len(link)
    return Due(np.arange(n), np.arange(n), np.zeros(n, dtype=int), Draws(link, jitter))


def clear(n: int, helpers: int = 3) -> Due:
    """Every message crosses."""
    return due(np.full((n, helpers, 2), 0.9), np.zeros((n, helpers)))


def heard(due: dict[OperatingPoint, Due], intents: Intents) -> Ints:
    """The sets of messages that are heard where nobody attacks."""
    nobody = np.zeros(intents.valid.shape, dtype=bool)
    sent = {point: exchange(point, intents, of.draws) for point, of in due.items()}
    broadcasts = {point: SentIntents(intents, of.draws, nobody) for point, of in due.items()}
    return heard_codes(due, broadcasts, sent, len(intents.own))


def test_it_is_asked_with_the_messages_of_those_it_heard(small: Dataset) -> None:
    """v2 and v4 are heard, v3's reply is lost:
    two lines of messages, with intent, risk and evidence.
    """
    data = course(small, steps=1).of_episodes([0])
    [scene] = scenes_of(data)
    lines = {
        f"{scene.id}/v1": says((0.3, 0.4, 0.3)),
        f"{scene.id}/v2": says((0.8, 0.1, 0.1), "helper").replace("clear", "one comes fast"),
    }
    asker = asker_of(spec_of(data, LANGUAGE_MODEL, points=(FUSION,), seeds=(0,)), Scripted(lines))
    lossy = clear(1)
    lossy.draws.link[0, 1] = 0.0
    codes = heard({FUSION: lossy, POINTS["v2x"]: lossy}, asker([scene]))
    assert codes.tolist() == [0b101]
    [request] = asker.fusion_requests([scene], codes)
    assert request.id == f"{scene.id}/v1+v2+v4"
    assert request.role == "ego"
    text = request.messages[1]["content"]
    [_, told] = text.split("MESSAGES")
    assert "v2 low 0.80 0.10 0.10 one comes fast" in told
    assert "v4 low 0.00 1.00 0.00 clear" in told
    assert "v3" not in told


def test_each_set_of_messages_is_asked_once_whatever_delivers_it(small: Dataset) -> None:
    unsure = {f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in scenes_of(small)}
    intents = asker_of(spec_of(small, LANGUAGE_MODEL, points=(FUSION,)), Scripted(unsure))(
        scenes_of(small)
    )
    n = len(scenes_of(small))
    all_cross = clear(n)
    slow = named_point("v2x:consensus=ego-prompt,window_s=0.4")
    once = heard({FUSION: all_cross}, intents)
    assert len(once) == n
    assert heard({FUSION: all_cross, slow: all_cross}, intents).tolist() == once.tolist()
    nobody = due(np.zeros((n, 3, 2)), all_cross.draws.jitter)
    assert heard({FUSION: nobody}, intents).size == 0


def test_a_whole_run_makes_each_fusion_call_once(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Conditions and seeds that hear the same share a call;
    a step's calls are announced together.
    """
    backend = Scripted({f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in all_scenes(small)})
    monkeypatch.setattr(evaluation, "open_backend", lambda *_, **__: backend)
    slow = named_point("v2x:consensus=ego-prompt,window_s=0.4")
    spec = spec_of(small, LANGUAGE_MODEL, points=(FUSION, slow), latency="paper", seeds=(0, 1, 2))
    announced: list[int] = []
    answered: list[int] = []
    evaluate(spec, tmp_path / "run", answered.append, more=announced.append)
    calls = [name for name in backend.asked if "+" in name]
    assert set(Counter(calls).values()) == {1}
    steps = Counter(name.split("-")[1] for name in calls)
    assert announced[2::3] == [steps[step] for step in sorted(steps)], (
        "after each step's egos and helpers"
    )
    assert sum(announced) == sum(answered) == len(backend.asked)
    assert {a.id for a in answers_of(tmp_path / "run") if a.role == "merge"} == set(calls)


def test_who_was_heard_has_one_code_a_decision() -> None:
    heard = np.array([[False] * 3, [True, False, True], [True] * 3])
    codes = codes_of(heard, np.arange(3))
    assert codes.tolist() == [0, 8 + 5, 16 + 7]
    assert [heard_in(code, 3) for code in codes.tolist()] == [
        (0, [], []),
        (1, [0, 2], []),
        (2, [0, 1, 2], []),
    ]


def test_with_attackers_in_the_text_the_code_says_who_they_are() -> None:
    """Of those heard: an attacker whose message is lost changes no prompt."""
    heard = np.array([[True, False, True], [True, True, False]])
    attackers = np.array([[True, True, False], [False, False, True]])
    codes = codes_of(heard, np.array([4, 5]), attackers).tolist()
    assert [heard_in(code, 3, attacked=True) for code in codes] == [
        (4, [0, 2], [0]),
        (5, [0, 1], []),
    ]


def test_a_set_that_was_never_asked_about_is_no_guess() -> None:
    answers = FusionAnswers(np.array([5]), np.array([[1.0, 0.0, 0.0]]), np.array([0.1]))
    with pytest.raises(LookupError):
        answers.at(np.array([0]))(np.array([[True, True, False]]))


def test_its_answers_keep_their_place_and_a_failed_one_says_so(small: Dataset) -> None:
    scenes = scenes_of(small)[:6]
    one, other = f"{scenes[1].id}/v1+v3", f"{scenes[4].id}/v1+v2+v3+v4"
    slow = Completion(other, "no idea", None, None, "stop", 9.0, 1, slow_s=0.4)
    asker = asker_of(
        spec_of(small, LANGUAGE_MODEL), Scripted({one: sure("SLOWER"), other: slow}), DECLARED
    )
    codes = np.array([1 << 3 | 2, 4 << 3 | 7])
    heard = np.zeros((6, 3), dtype=bool)
    heard[1, 1] = heard[4] = True
    intents, seconds = asker.fusion_call(scenes, codes)(np.arange(6))(heard)
    assert intents[1].tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(intents[[0, 2, 3, 4, 5]]).all()
    assert seconds[[1, 4]].tolist() == pytest.approx([0.3, 0.7]), (
        "what is declared, not the 9 s it took"
    )
    assert [asker.answers[name].verdict for name in (one, other)] == ["strict", "failed"]


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        ("proxy", {}, "proxy is no language model and cannot fuse messages"),
        ("cruise", {}, "cruise is no language model"),
        (
            LANGUAGE_MODEL,
            {"answer": "readout"},
            "a readout gives no messages to fuse; use --answer json",
        ),
    ],
)
def test_who_can_merge_nothing_is_told_so(
    model: str, options: dict[str, Any], said: str, small: Dataset
) -> None:
    with pytest.raises(UserError, match=said):
        spec_of(small, model, points=(FUSION,), **options)


# -- with the model that ships ---------------------------------------------------------------------

CONDITIONS = (POINTS["single-local"], POINTS["6g"], FUSION)


@pytest.fixture(scope="module")
def two(small: Dataset) -> Dataset:
    """Layouts of which the model makes some other calls in each; a question takes it 30 ms."""
    return small.of_episodes([0, 1])


@pytest.fixture(scope="module")
def done(two: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    spec = spec_of(two, LANGUAGE_MODEL, points=CONDITIONS, latency="paper")
    return run(spec, tmp_path_factory.mktemp("fusion") / "run")


def test_it_pays_a_second_inference_where_it_heard_somebody(done: Evaluated) -> None:
    """The paper's 145 ms twice and the exchange between; the same where nobody was asked."""
    rules, calls = (
        {(d.scene, d.seed): d for d in decisions(done.out, name)} for name in ("6g", FUSION.name)
    )
    assert any(d.triggered for d in calls.values())
    both = rules.keys() & calls.keys()  # where fusion has led both to
    assert len(both) > len(rules) / 2
    for rule, again in ((rules[key], calls[key]) for key in both):
        heard = any(m.on_time for m in again.messages)
        fates, rule_fates = (
            [(m.sender, m.delivered, m.on_time, m.arrival_ms) for m in d.messages]
            for d in (again, rule)
        )
        assert fates == rule_fates
        assert not heard or {m.weight for m in again.messages} == {None}
        assert again.latency_ms == pytest.approx(rule.latency_ms + 145 * heard)
        if not heard:
            assert again.fused == rule.fused
    assert figure(done, FUSION.name, "fusion_ms").value > 0
    assert figure(done, "6g", "fusion_ms").value == 0


def test_the_policy_is_what_it_answered_and_the_record_has_it(
    done: Evaluated, two: Dataset
) -> None:
    answers = {answer.id: answer for answer in answers_of(done.out)}
    again = 0
    for d in decisions(done.out, FUSION.name):
        heard = [m.sender for m in d.messages if m.on_time]
        if heard:
            intent = answers[f"{d.scene}/{'+'.join(['v1', *heard])}"].intent
            assert d.fused == pytest.approx(intent, abs=1e-6)
            again += 1
    assert again > 10
    for said in answers.values():
        if said.heard:
            senders = [answers[f"{said.scene}/{viewer}"] for viewer in said.heard]
            told = [{"sender": a.viewer, "intent": list(a.intent), **a.message} for a in senders]
            graph = two.scene(said.scene).graphs["v1"]
            assert said.prompt_sha256 == digest(prompt("v2").render(graph, two.actions, told))


def test_a_scenes_answers_are_the_egos_the_helpers_and_the_fusion_calls(done: Evaluated) -> None:
    order = [(answer.scene, answer.role) for answer in answers_of(done.out)]
    rank = {"ego": 0, "helper": 1, "merge": 2}
    assert order == sorted(order, key=lambda place: (place[0], rank[place[1]]))
    assert [role for _, role in order].count("merge") > 5


def test_a_replay_scores_the_same_in_other_batches(
    done: Evaluated, two: Dataset, tmp_path: Path
) -> None:
    spec = spec_of(two, f"replay:{done.out}", points=CONDITIONS, latency="paper", batch_size=3)
    replayed = run(spec, tmp_path / "replay")
    assert same_scores(replayed, done)
    assert same_decisions(replayed.out, done.out)


def killed(spec: Spec, out: Path, how: str, after: int) -> None:
    """A run that dies when so many fusion calls are there, or as they are announced."""

    class Killed(Stop):
        pass

    called = False

    def more(count: int) -> None:
        nonlocal called
        called = True
        if how == "announced":
            raise Killed

    def progress(count: int) -> None:
        nonlocal after
        after -= count * called
        if called and after <= 0:
            raise Killed

    with pytest.raises(Killed):
        evaluate(spec, out, progress, more=more)


@pytest.mark.parametrize("how", some(["made"], exhaustive=["announced"]))
def test_killed_among_the_fusion_calls_it_goes_on(
    how: str, done: Evaluated, two: Dataset, tmp_path: Path
) -> None:
    spec = spec_of(two, LANGUAGE_MODEL, points=CONDITIONS, latency="paper")
    killed(spec, tmp_path / "run", how, after=1)
    run(spec, tmp_path / "run")
    assert same_decisions(tmp_path / "run", done.out)
    timeless = [
        [msgspec.structs.replace(answer, **UNTIMED) for answer in answers_of(out)]
        for out in (tmp_path / "run", done.out)
    ]
    assert timeless[0] == timeless[1], "but for the seconds of one that was asked alone"


def opens(backend: Scripted) -> Callable[..., Scripted]:
    return lambda *_, **__: backend


def unsure(small: Dataset) -> dict[str, str | Completion]:
    return {f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in scenes_of(small)}


def test_a_resumed_run_has_the_times_that_it_began_with(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They were measured; it resumes on a machine that is too busy and too slow to measure
    anything.
    """

    class Slower(Scripted):
        def complete(self, requests: Sequence[Request]) -> list[Completion]:
            return [replace(c, seconds=len(self.asked) / 1000) for c in super().complete(requests)]

    backend = Slower({f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in scenes_of(small)})
    monkeypatch.setattr(evaluation, "open_backend", lambda *_, **__: backend)
    monkeypatch.setattr(timing, "load_a_core", lambda: 0.0)
    spec = spec_of(small, LANGUAGE_MODEL, points=CONDITIONS, latency="measured")
    killed(spec, tmp_path / "run", "made", after=20)
    begun = json.loads((tmp_path / "run/.work/config.json").read_text())["latency"]
    monkeypatch.setattr(timing, "load_a_core", lambda: 9.0)
    resumed = run(spec, tmp_path / "run")
    assert json.loads(msgspec.json.encode(resumed.manifest.latency)) == begun
    assert 0 < begun["ego_s"] < begun["fusion_s"]
    fused = [
        d for d in decisions(tmp_path / "run", FUSION.name) if any(m.on_time for m in d.messages)
    ]
    rules = {(d.scene, d.seed): d.latency_ms for d in decisions(tmp_path / "run", "6g")}
    assert fused
    for d in fused:
        assert d.latency_ms == pytest.approx(
            rules[d.scene, d.seed] + 1000 * begun["fusion_s"], abs=2e-3
        )


# -- in a sweep ------------------------------------------------------------------------------------


def test_a_sweep_asks_what_the_run_has_not_and_asks_it_once(
    done: Evaluated, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(done.out, tmp_path / "run"))
    watched = Watched()
    source = ReplayedRun(folder, progress=watched)
    [[same]] = source.walked([Setting("6g", FUSION, 4)], source.seeds)
    assert watched.asked == [], "the run's own seeds delivered nothing else"
    assert same.ends["success_rate"].mean() == pytest.approx(
        figure(done, FUSION.name, "success_rate").value
    )
    [[fewer]] = source.walked([Setting("6g", FUSION, 2)], source.seeds)
    assert sum(watched.asked) > 0
    kept = (folder / MORE).read_bytes()
    source = ReplayedRun(folder)
    for vehicles, before in ((4, same), (2, fewer)):
        [[now]] = source.walked([Setting("6g", FUSION, vehicles)], source.seeds)
        assert np.array_equal(now.columns["latency_ms"], before.columns["latency_ms"])
    assert (folder / MORE).read_bytes() == kept


@pytest.mark.exhaustive
def test_what_another_process_has_asked_meanwhile_is_not_asked_again(
    done: Evaluated, tmp_path: Path
) -> None:
    """Both looked at the run before either asked."""
    folder = Path(shutil.copytree(done.out, tmp_path / "run"))
    one, other = ReplayedRun(folder), ReplayedRun(folder)
    [[first]] = one.walked([Setting("6g", FUSION, 2)], one.seeds)
    kept = (folder / MORE).read_bytes()
    with (folder / MORE).open("ab") as file:
        file.write(kept[:100])  # a third was killed
    [[second]] = other.walked([Setting("6g", FUSION, 2)], other.seeds)
    assert np.array_equal(first.columns["latency_ms"], second.columns["latency_ms"])
    [[_]] = other.walked([Setting("6g", FUSION, 3)], other.seeds)
    ids = [line.partition(b',"raw"')[0] for line in (folder / MORE).read_bytes().splitlines()]
    assert len(ids) == len(set(ids)) > len(kept.splitlines())


@pytest.mark.exhaustive
def test_points_that_are_walked_together_make_the_calls_of_each(
    done: Evaluated, tmp_path: Path
) -> None:
    """Each set of messages is asked about once, and answers are what each point has alone."""
    texts = ("loss=0", "loss=0.3", "loss=0.3,defence=quoted+schema", "attack=injection:share=1/3")
    points = [named_point(f"{FUSION.name},{text}") for text in texts]
    settings = [Setting(point.name, point, 4) for point in points]
    folder = Path(shutil.copytree(done.out, tmp_path / "run"))
    watched = Watched()
    together = list(ReplayedRun(folder, progress=watched).walked(settings, (0, 1, 2)))
    kept = (folder / MORE).read_text().splitlines()
    assert 0 < len(kept) == sum(watched.asked)
    alone = Path(shutil.copytree(done.out, tmp_path / "alone"))
    for setting, [walked] in zip(settings, together, strict=True):
        [[expected]] = ReplayedRun(alone).walked([setting], (0, 1, 2))
        assert np.array_equal(walked.ends["success_rate"], expected.ends["success_rate"])
        for name, values in expected.columns.items():
            assert np.array_equal(walked.columns[name], values, equal_nan=True), (setting, name)


def test_a_run_whose_prompt_has_changed_is_not_asked_more(done: Evaluated, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(done.out, tmp_path / "run"))
    configure(folder, prompt={**done.manifest.prompt, "sha256": "0" * 64})
    with pytest.raises(UserError, match=r"sources/prompts/v2 has another digest than prompt v2 in"):
        list(ReplayedRun(folder).walked([Setting("6g", FUSION, 3)], (0,)))
