"""Distilling, played small: a real Qwen3 learns from a handful of real scenes, in seconds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import torch
from evaluating import course, scenes_of
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from harness.cli import app
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.parsing.parse import parse
from harness.prompts import readout
from harness.prompts import versions as prompts
from harness.training.answers import answer, message
from harness.training.distill import distill
from harness.training.examples import alone, excerpts, kl_nats, labels, split, taught, with_messages
from harness.training.model import chat
from harness.training.muon import Muon, orthogonal
from harness.training.train import STAGES, Plan

ACTIONS = ("SLOWER", "IDLE", "FASTER")
PLAN = Plan({"excerpts": 128, "alone": 128, "messages": 64, "answers": 96}, batch=8)
VERSIONS = [prompts.load("v1"), prompts.load("v2")]


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def few(small_path: Path) -> Dataset:
    return load(small_path, limit=3)


@pytest.fixture(scope="module")
def student(few: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("distilled") / "student"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.training.train.LOG_STEPS", 4)
        distill(few, VERSIONS, PLAN, out, lambda stage, seen, loss: None, "cpu")
    return out


# -- the teacher ------------------------------------------------------------------------------------


def test_the_teacher_wants_what_turned_out_safe_and_least_late(few: Dataset) -> None:
    """SLOWER costs 0.5 s: exp(-2) beside 1 for IDLE and 0.3 for FASTER."""
    outcomes = {
        "00000-0": {"SLOWER": 5.5, "IDLE": 5.0, "FASTER": 5.0},
        "00001-0": {"SLOWER": 7.0, "IDLE": "collision", "FASTER": "collision"},
        "00002-0": dict.fromkeys(ACTIONS, "collision"),
    }
    free, danger, lost = labels(course(few, 1, outcomes))
    total = np.exp(-2.0) + 1.3
    assert free == pytest.approx([np.exp(-2.0) / total, 1 / total, 0.3 / total])
    assert danger.tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(lost).all()


def test_what_only_a_later_decision_could_save_is_not_safe(few: Dataset) -> None:
    """At the second step SLOWER would still do, but the driver that takes the rest holds its speed."""
    outcomes = {"00000-0": {}, "00000-1": {"SLOWER": 5.0, "IDLE": "collision", "FASTER": "collision"}}
    data = course(few, 2, outcomes)
    first, second = labels(data)
    assert np.isnan(first).all()
    assert second.tolist() == [1.0, 0.0, 0.0]
    assert [scene.id for scene in taught(data)] == ["00000-1"], "where nothing is safe nothing is taught"


def test_scenes_that_look_alike_are_best_answered_by_their_mean() -> None:
    labels = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    mean = np.broadcast_to(labels.mean(axis=0), labels.shape)
    mode = np.broadcast_to([0.02, 0.02, 0.96], labels.shape)
    assert kl_nats(labels, mean) < kl_nats(labels, mode)
    assert kl_nats(labels, labels) == 0.0


# -- what it learns to say --------------------------------------------------------------------------


@given(st.lists(st.floats(0.001, 1), min_size=3, max_size=3), st.booleans())
def test_every_text_it_learns_says_what_it_should(few: Dataset, weights: list[float], bare: bool) -> None:
    intent = np.array(weights) / sum(weights)
    for prompt in VERSIONS:
        for graph in scenes_of(few)[2].record["graphs"].values():
            text = answer(prompt, graph, intent, ACTIONS, bare=bare)
            said = parse(text, role=graph["role"], actions=ACTIONS)
            reasons_first = prompt.helper_answer == "recommendation" and not bare
            assert said.verdict == ("recovered" if reasons_first else "strict")
            assert said.intent is not None
            if graph["role"] == "ego" or prompt.helper_answer == "distribution":
                assert said.intent == pytest.approx(intent, abs=0.0501)
            else:
                assert said.intent[int(np.argmax(intent))] == pytest.approx(intent.max(), abs=0.0501)


def test_a_helpers_evidence_keeps_to_twelve_words(few: Dataset) -> None:
    for scene in scenes_of(few):
        for graph in scene.record["graphs"].values():
            assert len(message(graph, np.array([0.2, 0.5, 0.3]), ACTIONS)["evidence"].split()) <= 12


def test_the_ego_with_messages_reads_what_helpers_sent(few: Dataset) -> None:
    asked = list(alone(few, taught(few), VERSIONS))
    intents = {q.key: np.array([0.91, 0.06, 0.03]) for q in asked}
    heard = list(with_messages(few, taught(few), VERSIONS, intents))
    assert heard
    for q in heard:
        assert q.key.endswith("+m")
        assert q.graph["role"] == "ego"
        assert "0.90" in q.messages[-1]["content"]


def test_an_excerpt_shows_the_conflicts_alone_and_keeps_the_label(few: Dataset) -> None:
    asked = {q.key: q for q in alone(few, taught(few), VERSIONS)}
    short = list(excerpts(list(asked.values()), ACTIONS))
    assert short
    for q in short:
        text = q.messages[-1]["content"]
        assert len(text) < len(asked[q.key].messages[-1]["content"])
        assert all(str(c["other"]["time_s"]) in text for c in q.graph["conflicts"] if c["other"]["time_s"])
        assert np.array_equal(q.label, asked[q.key].label)


# -- its optimizer ----------------------------------------------------------------------------------


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


# -- a run ------------------------------------------------------------------------------------------


def test_it_writes_a_model_that_every_engine_can_take(student: Path) -> None:
    names = {p.name for p in student.iterdir()}
    assert names >= {"config.json", "model.safetensors", "tokenizer.json", "student-f16.gguf", "README.md"}
    assert ".work" not in names
    facts = json.loads((student / "training.json").read_text())
    assert set(facts["curves"]) == set(STAGES)
    assert 0.4e6 < facts["parameters"] < 2e6
    assert "imitate one planner in one scenario" in (student / "README.md").read_text()


def test_its_loss_falls(student: Path) -> None:
    for stage, curve in json.loads((student / "training.json").read_text())["curves"].items():
        assert curve[-1][1] < curve[0][1], stage


def test_its_tokenizer_renders_the_chat_that_it_was_trained_on(student: Path, few: Dataset) -> None:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(student)
    for q in list(alone(few, taught(few), VERSIONS))[:8]:
        asked = readout.asked(q.messages, ACTIONS)
        rendered = tokenizer.apply_chat_template(
            [dict(m) for m in asked], tokenize=False, add_generation_prompt=True
        )
        assert rendered == "".join(chat(asked))
        assert "".join(tokenizer.batch_decode(tokenizer(rendered)["input_ids"])) == rendered
    assert len(tokenizer("307")["input_ids"]) == 3, "every digit stands alone"


def test_a_killed_run_goes_on_to_the_same_model(
    student: Path, few: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.training.train.KEEP_S", 0.0)
    monkeypatch.setattr("harness.training.train.LOG_STEPS", 4)
    out = tmp_path / "student"
    for kill in (("alone", 96), ("answers", 64)):

        def progress(stage: str, seen: int, loss: float, kill: tuple[str, int] = kill) -> None:
            if (stage, seen) == kill:
                raise Killed

        with pytest.raises(Killed):
            distill(few, VERSIONS, PLAN, out, progress, "cpu")
    distill(few, VERSIONS, PLAN, out, lambda stage, seen, loss: None, "cpu")
    for name in ("model.safetensors", "tokenizer.json", "student-f16.gguf"):
        assert (out / name).read_bytes() == (student / name).read_bytes()


def test_a_run_is_not_continued_with_other_settings_and_never_overwritten(
    student: Path, few: Dataset, tmp_path: Path
) -> None:
    def stop(stage: str, seen: int, loss: float) -> None:
        raise Killed

    with pytest.raises(UserError, match=r"with other files in it; choose an empty or a new one"):
        distill(few, VERSIONS, PLAN, student, stop, "cpu")
    with pytest.raises(Killed):
        distill(few, VERSIONS, PLAN, tmp_path / "m", stop, "cpu")
    with pytest.raises(UserError, match=r"was begun with another seed"):
        distill(few, VERSIONS, replace(PLAN, seed=1), tmp_path / "m", stop, "cpu")


def test_too_few_sequences_for_a_message_are_refused(few: Dataset, tmp_path: Path) -> None:
    plan = replace(PLAN, samples={**PLAN.samples, "alone": 8, "messages": 1})
    with pytest.raises(UserError, match=r"--samples: 1 sequences of the stage messages take too few scenes"):
        distill(few, VERSIONS, plan, tmp_path / "m", lambda stage, seen, loss: None, "cpu")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--samples", "1,2"], "--samples 1,2: give four whole numbers"),
        (["--samples", "a,b,c,d"], "--samples a,b,c,d: give four whole numbers"),
        (["--samples", "64,64,64,15"], "16 or more each"),
        (["--samples", "64,64,64,7", "--batch", "1"], "8 or more each"),  # four for each of two prompts
        (["--batch", "0"], "--batch 0: give 1 or more"),
        (["--samples", "64,64,64,64", "--batch", "100000"], "100000 or more each"),
        (["--threads", "0"], "--threads 0: give 1 or more"),
        (["--seed", "-1"], "--seed -1: give 0 or more"),
        (["--prompt", "v9"], "unknown prompt 'v9'"),
        ([], "has layout seeds 100 to 103 (tune); a model learns from train seeds alone"),
    ],
)
def test_bad_input_writes_nothing(options: list[str], said: str, small_path: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        CliRunner().invoke(
            app,
            ["distill", str(small_path), "--out", str(tmp_path / "m"), *options],
            standalone_mode=False,
            catch_exceptions=False,
        )
    assert said in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# -- data that stay apart ---------------------------------------------------------------------------


def test_held_out_episodes_are_in_neither_half_twice(few: Dataset) -> None:
    kept, apart = split(few, 1)
    assert (kept.episodes, apart.episodes) == ((0, 1), (2,))


def test_it_learns_from_every_level_of_a_tree(few: Dataset) -> None:
    """Not from one driver's course alone, and from no more scenes than it needs."""
    scenes, forest = taught(few), few.forest
    safe = ~np.isnan(labels(few)).any(axis=1)
    for place, tree in enumerate(few.trees):
        steps = [s.record["step"] for s in scenes if s.record["episode"] == tree.episode]
        there = [int((safe & (forest.tree == place) & (forest.step == step)).sum()) for step in range(6)]
        assert [steps.count(step) for step in range(6)] == [min(6, n) for n in there]
        assert steps
    assert [s.id for s in taught(few)] == [s.id for s in scenes]
