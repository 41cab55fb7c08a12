"""Distilling, played small: a real Qwen3 learns from a handful of real scenes, in seconds."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from harness import prompts, readout
from harness.cli import app
from harness.dataset.load import Dataset, load, shared
from harness.distill import teacher
from harness.distill.answers import answer, message
from harness.distill.distill import distill
from harness.distill.examples import alone, kl_nats, split, with_messages
from harness.distill.text import chat
from harness.distill.train import STAGES, Plan
from harness.errors import UserError
from harness.parse import parse

ACTIONS = ("SLOWER", "IDLE", "FASTER")
PLAN = Plan({"alone": 128, "messages": 64, "answers": 96}, batch=8)
VERSIONS = [prompts.load("v1"), prompts.load("v2")]


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def few(small_path: Path) -> Dataset:
    return load(small_path, limit=3)


@pytest.fixture(scope="module")
def student(few: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("distilled") / "student"
    distill(few, VERSIONS, PLAN, out, lambda stage, seen, loss: None, "cpu")
    return out


# -- the teacher ------------------------------------------------------------------------------------


def outcome(result: str, time_s: float = 5.0) -> dict[str, Any]:
    return {"result": result, "time_s": time_s}


def test_the_teacher_wants_what_turned_out_safe_and_least_late(few: Dataset) -> None:
    """SLOWER costs 0.5 s: exp(-2) beside 1 for IDLE and 0.3 for FASTER."""
    tables = [
        {"SLOWER": outcome("cleared", 5.5), "IDLE": outcome("cleared"), "FASTER": outcome("cleared")},
        {"SLOWER": outcome("cleared", 7.0), "IDLE": outcome("collision"), "FASTER": outcome("collision")},
        {a: outcome("collision") for a in ACTIONS},
    ]
    scenes = tuple(
        replace(s, record={**s.record, "outcomes": t}) for s, t in zip(few.scenes, tables, strict=False)
    )
    free, danger, lost = teacher.labels(replace(few, scenes=scenes))
    total = np.exp(-2.0) + 1.3
    assert free == pytest.approx([np.exp(-2.0) / total, 1 / total, 0.3 / total])
    assert danger.tolist() == [1.0, 0.0, 0.0]
    assert lost == pytest.approx([1 / 3] * 3)


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
        for graph in few.scenes[2].record["graphs"].values():
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
    for scene in few.scenes:
        for graph in scene.record["graphs"].values():
            assert len(message(graph, np.array([0.2, 0.5, 0.3]), ACTIONS)["evidence"].split()) <= 12


def test_the_ego_with_messages_reads_what_helpers_sent(few: Dataset) -> None:
    asked = list(alone(few, VERSIONS))
    intents = {q.key: np.array([0.91, 0.06, 0.03]) for q in asked}
    heard = list(with_messages(few, VERSIONS, intents))
    assert heard
    for q in heard:
        assert q.key.endswith("+m")
        assert q.graph["role"] == "ego"
        assert "0.90" in q.messages[-1]["content"]


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
    curve = json.loads((student / "training.json").read_text())["curves"]["answers"]
    assert curve[-1][1] < np.log(768), "a model that knows nothing has the entropy of its vocabulary"


def test_its_tokenizer_renders_the_chat_that_it_was_trained_on(student: Path, few: Dataset) -> None:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(student)
    for q in list(alone(few, VERSIONS))[:8]:
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
    monkeypatch.setattr("harness.distill.train.KEEP_S", 0.0)
    monkeypatch.setattr("harness.distill.train.LOG_STEPS", 4)
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

    with pytest.raises(UserError, match=r"exists; choose a new folder"):
        distill(few, VERSIONS, PLAN, student, stop, "cpu")
    with pytest.raises(Killed):
        distill(few, VERSIONS, PLAN, tmp_path / "m", stop, "cpu")
    with pytest.raises(UserError, match=r"begun with another dataset, prompt, seed or samples"):
        distill(few, VERSIONS, replace(PLAN, seed=1), tmp_path / "m", stop, "cpu")


def test_too_few_sequences_for_a_message_are_refused(few: Dataset, tmp_path: Path) -> None:
    plan = replace(PLAN, samples={**PLAN.samples, "alone": 8, "messages": 1})
    with pytest.raises(UserError, match=r"--samples: 1 sequences of the stage messages take too few scenes"):
        distill(few, VERSIONS, plan, tmp_path / "m", lambda stage, seen, loss: None, "cpu")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--samples", "1,2"], "--samples 1,2: give three whole numbers"),
        (["--samples", "a,b,c"], "--samples a,b,c: give three whole numbers"),
        (["--samples", "64,64,15"], "16 or more each"),
        (["--samples", "64,64,7", "--batch", "1"], "8 or more each"),  # four for each of two prompts
        (["--batch", "0"], "--batch 0: give 1 or more"),
        (["--samples", "64,64,64", "--batch", "100000"], "100000 or more each"),
        (["--threads", "0"], "--threads 0: give 1 or more"),
        (["--seed", "-1"], "--seed -1: give 0 or more"),
        (["--prompt", "v9"], "unknown prompt 'v9'"),
        (["--apart-from", "{data}"], "share 24 scenes; build the one with other seeds"),
    ],
)
def test_bad_input_writes_nothing(options: list[str], said: str, small_path: Path, tmp_path: Path) -> None:
    given = [option.format(data=small_path) for option in options]
    with pytest.raises(UserError) as caught:
        CliRunner().invoke(
            app,
            ["distill", str(small_path), "--out", str(tmp_path / "m"), *given],
            standalone_mode=False,
            catch_exceptions=False,
        )
    assert said in str(caught.value)
    assert list(tmp_path.iterdir()) == []


# -- data that stay apart ---------------------------------------------------------------------------


def test_held_out_episodes_are_in_neither_half_twice(few: Dataset) -> None:
    kept, apart = split(few, 1)
    assert len(kept.scenes) + len(apart.scenes) == len(few.scenes)
    assert {s.record["episode"] for s in apart.scenes} == {2}
    assert shared(kept, apart) == 0
    assert shared(kept, few) == len(kept.scenes)
