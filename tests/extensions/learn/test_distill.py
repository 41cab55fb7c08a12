"""Distilling, played small: a real Qwen3 learns from a handful of real scenes, in seconds."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import former
import msgspec
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import torch
from hypothesis import given
from hypothesis import strategies as st
from teaching import PER_LEVEL, SEED, drawn_by, few_points
from typer.testing import CliRunner

from harness.backends import cards
from harness.cli import app
from harness.core.errors import UserError
from harness.core.resources import folder
from harness.dataset.load import load
from harness.evaluate.agent import Agent, in_mode
from harness.extensions.learn.training import lessons
from harness.extensions.learn.training.answers import answer, message
from harness.extensions.learn.training.distill import Curriculum, distill
from harness.extensions.learn.training.lessons import Lessons, draw, label
from harness.extensions.learn.training.model import chat
from harness.extensions.learn.training.muon import Muon, orthogonal
from harness.extensions.learn.training.questions import (
    Question,
    alone,
    excerpts,
    kl_nats,
    references,
    with_messages,
)
from harness.extensions.learn.training.train import STAGES, Plan, Sample, _batches
from harness.parsing.parse import parse
from harness.prompts import readout
from harness.prompts import versions as prompts
from harness.world.drivers import choose, constant
from harness.world.reference import drive, finish
from harness.world.world import World

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

PLAN = Plan({"excerpts": 16, "alone": 16, "messages": 16, "answers": 16}, batch=4)
CROSSING, PASSING = former.SCENARIO, former.scenes("do-not-pass")
LEARNT = {CROSSING: (prompts.load("v1"), prompts.load("v2")), PASSING: (prompts.load("v4"),)}
CURRICULUM = Curriculum(LEARNT, layouts=2, seed=SEED)


class Killed(Exception):
    pass


def silent(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def few(once: Any, tmp_path_factory: pytest.TempPathFactory) -> list[Lessons]:
    place = tmp_path_factory.mktemp("lessons")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lessons, "decision_points", drawn_by(once))
        return [
            draw(
                scenario,
                versions,
                CURRICULUM.layouts,
                CURRICULUM.seed,
                place / scenario.name,
                1,
                silent,
            )
            for scenario, versions in LEARNT.items()
        ]


@pytest.mark.exhaustive
def test_of_each_level_as_many_are_learnt_from_as_a_whole_tree_has():
    forest = load(folder("datasets") / "occluded-intersection-v2", 10).forest
    chosen = forest.drivers[lessons.TEACHER]

    def ends_well(at: int, action: int) -> bool:
        tree, (edge, child) = forest.tree[at], (forest.edge[at, action], forest.child[at, action])
        while child >= 0:
            edge, child = (of[child, chosen[child]] for of in (forest.edge, forest.child))
        return bool(forest.succeeds(edge, tree))

    # In this layout some can be saved though none of their parents can, by the driver that takes
    # the rest.
    in_tree = {
        name for name, at in forest.place.items()
        if forest.tree[at] == 9 and any(ends_well(at, action) for action in range(len(CROSSING.actions)))
    }  # fmt: skip
    points = [point.record for point in lessons.decision_points(CROSSING, 200_009, 9)]
    by_step = Counter(int(forest.step[forest.place[name]]) for name in in_tree)
    assert {point.scene for point in points} <= in_tree
    assert Counter(point.step for point in points) == {
        step: min(lessons.PER_LEVEL, n) for step, n in by_step.items()
    }


def test_the_levels_of_a_layout_weigh_alike(few: list[Lessons]) -> None:
    """In whatever an ego is asked."""
    for each in few:
        by_level: dict[tuple[int, int], list[float]] = {}
        egos = [q for q in alone(each) if q.graph.role == "ego" and q.prompt == each.prompts[0]]
        for scene, q in zip(each.scenes, egos, strict=True):
            by_level.setdefault((scene.record.episode, scene.record.step), []).append(q.weight)
        assert [sum(level) for level in by_level.values()] == pytest.approx([1.0] * len(by_level))
        assert max(map(len, by_level.values())) > 1


def test_a_sample_is_drawn_as_often_as_it_weighs() -> None:
    ids = np.zeros(3, dtype=np.int32)
    samples = [Sample(ids, 1, "", 2, None, weight) for weight in (1.0, 3.0)]
    drawn = np.bincount(_batches(samples, 16_000, replace(PLAN, batch=16)).ravel())
    assert drawn[1] / drawn.sum() == pytest.approx(0.75, abs=0.02)


@pytest.fixture(scope="module")
def asked(few: list[Lessons]) -> list[Question]:
    return [q for each in few for q in alone(each)]


@pytest.fixture
def drawn_before(once: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lessons, "decision_points", drawn_by(once))


@pytest.fixture(scope="module")
def student(once: Any) -> Path:
    def fill(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lessons, "decision_points", drawn_by(once))
            patch.setattr("harness.extensions.learn.training.train.LOG_STEPS", 2)
            distill(CURRICULUM, PLAN, out, silent, silent, "cpu")

    return once("student", fill)


# -- the teacher -----------------------------------------------------------------------------------


def test_the_teacher_wants_what_turned_out_safe_and_least_late() -> None:
    """SLOWER costs 0.5 s: exp(-2) beside 1 for IDLE and 0.3 for FASTER."""
    total = np.exp(-2.0) + 1.3
    free = label({"SLOWER": 5.5, "IDLE": 5.0, "FASTER": 5.0})
    assert free == pytest.approx([np.exp(-2.0) / total, 1 / total, 0.3 / total])
    danger = label({"SLOWER": 7.0, "IDLE": np.inf, "FASTER": np.inf})
    assert danger.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.exhaustive
def test_an_action_is_safe_where_who_sees_no_more_than_the_ego_still_succeeds(
    few: list[Lessons],
) -> None:
    """Played again in the simulator, action by action, from the start."""
    for each in few:
        scenario = each.scenario
        for scene in each.scenes:
            if scene.record.step == 0:
                seed = scene.record.episode_seed
                reference = drive(scenario, "full-view", seed)
                safe = []
                for action in scenario.actions:
                    world = World.start(scenario, seed)
                    world.act(action)
                    [outcome] = finish([world], ["local-view"])
                    safe.append(
                        outcome.judged(reference, world.layout.danger, scenario.parameters).success
                    )
                assert (each.labels[scene.id] > 0).tolist() == safe


def test_scenes_that_look_alike_are_best_answered_by_their_mean() -> None:
    labels = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    mean = np.broadcast_to(labels.mean(axis=0), labels.shape)
    mode = np.broadcast_to([0.02, 0.02, 0.96], labels.shape)
    assert kl_nats(labels, mean) < kl_nats(labels, mode)
    assert kl_nats(labels, labels) == 0.0


# -- what it learns to say -------------------------------------------------------------------------


@given(st.data(), st.booleans())
def test_every_text_it_learns_says_what_it_should(
    few: list[Lessons], data: st.DataObject, bare: bool
) -> None:
    for each in few:
        actions = each.scenario.actions
        weights = data.draw(
            st.lists(st.floats(0.001, 1), min_size=len(actions), max_size=len(actions))
        )
        intent = np.array(weights) / sum(weights)
        for prompt in each.prompts:
            for graph in each.scenes[2].graphs.values():
                text = answer(prompt, graph, intent, actions, bare=bare)
                said = parse(text, role=graph.role, actions=actions)
                reasons_first = prompt.helper_answer == "recommendation" and not bare
                assert said.verdict == ("recovered" if reasons_first else "strict")
                assert said.intent is not None
                if graph.role == "ego" or prompt.helper_answer == "distribution":
                    assert said.intent == pytest.approx(intent, abs=0.0501)
                else:
                    assert said.intent[int(np.argmax(intent))] == pytest.approx(
                        intent.max(), abs=0.0501
                    )


def test_a_helpers_evidence_keeps_to_twelve_words(asked: list[Question]) -> None:
    for q in asked:
        assert len(message(q.graph, q.label, q.actions)["evidence"].split()) <= 12


def test_the_ego_with_messages_reads_what_helpers_sent(
    few: list[Lessons], asked: list[Question]
) -> None:
    intents = {q.key: np.array([0.91, 0.06, 0.03, 0.0, 0.0])[: len(q.actions)] for q in asked}
    for each in few:
        heard = list(with_messages(each, each.scenes, intents))
        assert heard
        for q in heard:
            assert q.key.endswith("+m")
            assert q.graph.role == "ego"
            assert ("90 5" if q.prompt.version == "v4" else "0.90") in q.messages[-1]["content"]


def test_an_excerpt_shows_the_conflicts_alone_and_keeps_the_label(asked: list[Question]) -> None:
    whole = {q.key: q for q in asked}
    short = list(excerpts(asked))
    assert short
    for q in short:
        text = q.messages[-1]["content"]
        assert len(text) < len(whole[q.key].messages[-1]["content"])
        shown = min(q.graph.conflicts, key=lambda c: float(c.other.time_s or 1e9))
        assert shown.other.time_s is None or str(shown.other.time_s) in text
        assert np.array_equal(q.label, whole[q.key].label)


def test_a_read_out_asks_for_a_letter_alone_as_an_evaluation_does(
    few: list[Lessons], asked: list[Question]
) -> None:
    # its question is a block of its own, which a letter takes the place of
    version = prompts.load("v9")
    agent = Agent(cards.resolve("swarm-tiny"), version, "readout", letters="raw")
    for q in asked[:4]:
        words = q.scenario.prompt_words
        of = replace(q, prompt=version, messages=version.render(q.graph, q.actions, words=words))
        assert of.read_out == agent.chats(q.graph, q.actions, words)["messages"]
        assert "JSON" not in of.read_out[-1]["content"]
    intents = {q.key: np.array([0.91, 0.06, 0.03, 0.0, 0.0])[: len(q.actions)] for q in asked}
    for short in excerpts(asked):
        assert short.read_out == in_mode(
            "readout",
            short.prompt,
            short.messages,
            short.graph,
            short.actions,
            short.scenario.prompt_words,
        ), "where a question is no block, the letter follows it"
    told = next(with_messages(few[0], few[0].scenes, intents))
    assert "0.90" in told.read_out[-1]["content"], "the messages are there as well"


# -- its optimizer ---------------------------------------------------------------------------------


def test_muon_in_float32_goes_where_pytorchs_goes_in_bfloat16() -> None:
    torch.manual_seed(0)
    shapes = ((96, 96), (32, 96), (64, 24), (96, 96))
    ours = [torch.nn.Parameter(torch.randn(s)) for s in shapes]
    theirs = [torch.nn.Parameter(p.detach().clone()) for p in ours]
    start = [p.detach().clone() for p in ours]
    opts = (
        Muon(ours, lr=0.01, weight_decay=0.05),
        torch.optim.Muon(theirs, lr=0.01, weight_decay=0.05, adjust_lr_fn="match_rms_adamw"),
    )
    for _ in range(4):
        for p, q in zip(ours, theirs, strict=True):
            p.grad = torch.randn_like(p)
            q.grad = p.grad.clone()
        for opt in opts:
            opt.step()
    for p, q, s in zip(ours, theirs, start, strict=True):
        assert (p - q).norm() < 0.02 * (q - s).norm()


def test_an_orthogonal_factor_has_singular_values_near_one() -> None:
    torch.manual_seed(0)
    for shape in ((3, 8, 32), (2, 32, 8), (1, 16, 16)):
        values = torch.linalg.svdvals(orthogonal(torch.randn(shape)))
        assert values.min() > 0.3
        assert values.max() < 1.3


# -- a run -----------------------------------------------------------------------------------------


def test_it_writes_a_model_that_every_engine_can_take(student: Path) -> None:
    names = {p.name for p in student.iterdir()}
    assert names >= {
        "config.json",
        "model.safetensors",
        "tokenizer.json",
        "student-f16.gguf",
        "README.md",
    }
    assert ".work" not in names
    facts = json.loads((student / "training.json").read_text())
    assert set(facts["curves"]) == set(STAGES)
    assert 0.4e6 < facts["parameters"] < 2e6
    assert "imitate one planner in the scenarios below" in (student / "README.md").read_text()


def test_its_loss_falls(student: Path) -> None:
    for stage, curve in json.loads((student / "training.json").read_text())["curves"].items():
        assert curve[-1][1] < curve[0][1], stage


def test_its_tokenizer_renders_the_chat_that_it_was_trained_on(
    student: Path, asked: list[Question]
) -> None:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(student)
    for q in (*asked[:8], *asked[-8:]):
        sent = readout.letter_chat(q.messages, q.actions)
        rendered = tokenizer.apply_chat_template(
            [dict(m) for m in sent], tokenize=False, add_generation_prompt=True
        )
        assert rendered == "".join(chat(sent))
        assert "".join(tokenizer.batch_decode(tokenizer(rendered)["input_ids"])) == rendered
    assert len(tokenizer("307")["input_ids"]) == 3, "every digit stands alone"


@pytest.mark.exhaustive
def test_a_killed_run_goes_on_to_the_same_model(
    student: Path, drawn_before: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.extensions.learn.training.train.KEEP_S", 0.0)
    monkeypatch.setattr("harness.extensions.learn.training.train.LOG_STEPS", 2)
    out = tmp_path / "student"
    for kill in (("alone", 8), ("answers", 8)):

        def progress(stage: str, seen: int, loss: float, kill: tuple[str, int] = kill) -> None:
            if (stage, seen) == kill:
                raise Killed

        with pytest.raises(Killed):
            distill(CURRICULUM, PLAN, out, silent, progress, "cpu")
    distill(CURRICULUM, PLAN, out, silent, silent, "cpu")
    for name in ("model.safetensors", "tokenizer.json", "student-f16.gguf"):
        assert (out / name).read_bytes() == (student / name).read_bytes()


def test_a_run_is_not_continued_with_other_settings_and_never_overwritten(
    student: Path, drawn_before: None, tmp_path: Path
) -> None:
    def stop(stage: str, seen: int, loss: float) -> None:
        raise Killed

    with pytest.raises(
        UserError, match=r"already holds a finished model; choose another folder or delete it"
    ):
        distill(CURRICULUM, PLAN, student, silent, stop, "cpu")
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").touch()
    with pytest.raises(UserError, match=r"with other files in it; choose an empty or a new one"):
        distill(CURRICULUM, PLAN, tmp_path / "other", silent, stop, "cpu")
    with pytest.raises(Killed):
        distill(CURRICULUM, PLAN, tmp_path / "m", silent, stop, "cpu")
    with pytest.raises(UserError, match=r"was begun with another seed"):
        distill(CURRICULUM, replace(PLAN, seed=1), tmp_path / "m", silent, stop, "cpu")
    with pytest.raises(
        UserError, match=r"was begun with another scenarios/\S+, prompts/v1, prompts/v2;"
    ):
        distill(
            replace(CURRICULUM, prompts={PASSING: LEARNT[PASSING]}),
            PLAN,
            tmp_path / "m",
            silent,
            stop,
            "cpu",
        )
    work = tmp_path / "m/.work"
    for file in (work / "tokenizer.json", next(work.glob("lessons/**/00000.json"))):
        before = file.read_text()
        file.write_text("{}")
        with pytest.raises(UserError, match=rf"{file.name} is damaged \(.*; delete its folder and"):
            distill(CURRICULUM, PLAN, tmp_path / "m", silent, stop, "cpu")
        file.write_text(before)


@pytest.mark.exhaustive
def test_too_few_sequences_for_a_message_are_refused(drawn_before: None, tmp_path: Path) -> None:
    plan = replace(PLAN, samples={**PLAN.samples, "alone": 8, "messages": 1})
    with pytest.raises(
        UserError, match=r"--samples: 1 sequences of the stage messages take too few scenes"
    ):
        distill(CURRICULUM, plan, tmp_path / "m", silent, silent, "cpu")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--samples", "1,2"], "--samples 1,2: give four whole numbers"),
        (["--samples", "a,b,c,d"], "--samples a,b,c,d: give four whole numbers"),
        (["--samples", "64,64,64,15"], "16 or more each"),
        # four for each of two prompts
        (["--samples", "64,64,64,7", "--batch", "1"], "8 or more each"),
        (["--batch", "0"], "--batch 0: give 1 or more"),
        (["--samples", "64,64,64,64", "--batch", "100000"], "100000 or more each"),
        (["--threads", "0"], "--threads 0 is out of range; give 1 to 1024"),
        (["--seed", "-1"], "--seed -1 is out of range; give 0 to 2147483647"),
        (["--prompt", "v99"], "unknown prompt 'v99'"),
        (["--prompt", "v2", "do-not-pass"], "--prompt v2: none is for do-not-pass; give v4"),
        (
            ["--out", "swarm-tiny"],
            "swarm-tiny: its name is the model's, and swarm-tiny ships; give",
        ),
        (["--out", __file__], ".py is no folder; choose an empty or a new one"),
        (["no-such-road"], "unknown scenario 'no-such-road'"),
        (["occluded-intersection:witnesses=1"], "occluded-intersection is given twice, with other"),
        (
            ["--first-seed", "100"],
            "layout seeds 100 to 339 (tune); a model learns from train seeds alone",
        ),
    ],
)
def test_bad_input_writes_nothing(options: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        CliRunner().invoke(
            app,
            ["model", "distill", "occluded-intersection", "--out", str(tmp_path / "m"), *options],
            standalone_mode=False,
            catch_exceptions=False,
        )
    assert said in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# -- data that stay apart --------------------------------------------------------------------------


def test_held_out_layouts_are_in_neither_half_twice(few: list[Lessons]) -> None:
    for each in few:
        kept, apart = each.split(0.05)
        assert apart.episodes == each.episodes[-1:]
        assert (*kept.episodes, *apart.episodes) == each.episodes
        assert kept.scenes + apart.scenes == each.scenes


def test_references_are_worth_what_they_take(few: list[Lessons]) -> None:
    for each in few:
        questions, actions = list(alone(each)), each.scenario.actions
        labels = np.stack([question.label for question in questions])
        weights = [question.weight for question in questions]
        worth = labels > 0
        found = references(questions, labels, weights)
        assert found["uniform"] == pytest.approx(np.average(worth.mean(axis=1), weights=weights))
        always = actions.index(constant(each.scenario) or "")
        assert found["constant"] == pytest.approx(np.average(worth[:, always], weights=weights))
        planned = [
            actions.index(choose(each.scenario, "local-view", q.graph, None)) for q in questions
        ]
        taken = worth[np.arange(len(questions)), planned]
        assert found["local-view"] == pytest.approx(np.average(taken, weights=weights))


def test_it_learns_from_every_level_of_a_tree(few: list[Lessons]) -> None:
    """Not from one driver's course alone, and from no more scenes than it needs."""
    for each in few:
        for number in each.episodes:
            steps = [s.record.step for s in each.scenes if s.record.episode == number]
            assert set(steps) == set(range(min(steps), max(steps) + 1))
            assert max(steps) > 1
            assert all(steps.count(step) <= PER_LEVEL for step in steps)


@pytest.mark.exhaustive
def test_a_layout_teaches_the_same_wherever_it_is_drawn(few: list[Lessons]) -> None:
    again = msgspec.json.encode(few_points(PASSING, CURRICULUM.seed + 1, 1))
    assert msgspec.json.decode(again, type=list[lessons.Point]) == [
        lessons.Point(scene.record, few[1].labels[scene.id].tolist())
        for scene in few[1].scenes if scene.record.episode == 1
    ]  # fmt: skip
