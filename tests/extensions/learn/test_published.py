"""A published model is taught: small ones stand for it, a Qwen3 and a Llama."""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import former
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_llama
import torch
from msgspec import structs
from safetensors.torch import save_file
from teaching import SEED, drawn_by
from typer.testing import CliRunner

from harness.backends import adapters, cards
from harness.backends.base import Request, same_model
from harness.backends.card import Card
from harness.backends.registry import missing
from harness.backends.registry import open_backend as _open
from harness.cli import app
from harness.core.errors import UserError
from harness.dataset.load import Scene
from harness.dataset.schema import Danger
from harness.extensions.learn.training import lessons, low_rank
from harness.extensions.learn.training.distill import Curriculum, distill
from harness.extensions.learn.training.published import Adapt, Published
from harness.extensions.learn.training.questions import value
from harness.extensions.learn.training.train import Plan, fitting
from harness.prompts import versions as prompts
from harness.world.reference import drive, finish
from harness.world.world import World

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

BASE = cards.resolve("swarm-tiny", "transformers")
PLAN = Plan(
    {"excerpts": 0, "alone": 12, "messages": 0, "answers": 6},
    batch=2,
    adapt=Adapt(rank=4, rate=2e-2),
)
CROSSING, PASSING = former.SCENARIO, former.scenes("do-not-pass")
LEARNT = dict.fromkeys((CROSSING, PASSING), (prompts.load("v9"),))  # three actions, and five
CURRICULUM = Curriculum(LEARNT, layouts=2, seed=SEED, base=BASE)


class Killed(Exception):
    pass


def silent(*_: object) -> None:
    pass


@pytest.fixture(autouse=True)
def _quick(once: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(lessons, "decision_points", drawn_by(once))
    monkeypatch.setattr("harness.extensions.learn.training.train.LOG_STEPS", 2)
    monkeypatch.setattr("harness.extensions.learn.training.student.WATCHED", 8)
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def taught(once: Any) -> Path:
    def fill(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lessons, "decision_points", drawn_by(once))
            patch.setattr("harness.extensions.learn.training.train.LOG_STEPS", 2)
            patch.setattr("harness.extensions.learn.training.student.WATCHED", 8)
            distill(CURRICULUM, PLAN, out, silent, silent, "cpu")

    return once("pupil", fill)


def asked(n: int) -> Request:
    messages = (
        {"role": "system", "content": "You drive."},
        {"role": "user", "content": f"Speed 1{n} m/s"},
    )
    return Request(str(n), "ego", messages, ("SLOWER", "IDLE", "FASTER"), 12)


def open_backend(card: Card, **options: Any) -> Any:
    return _open(card, **options)


QUESTIONS = [asked(n) for n in range(3)]


# -- an adapter ------------------------------------------------------------------------------------


@pytest.fixture
def llama(tmp_path: Path) -> Card:
    return cards.resolve(str(tiny_llama.build(tmp_path / "tiny.gguf")), "transformers")


def adapter(card: Card, out: Path) -> Published:
    """Write an adapter of random numbers, and return the model that wears it."""
    model = Published(card, Adapt(rank=3, rate=1e-3), 0, "cpu")
    torch.manual_seed(1)
    out.mkdir()
    with torch.no_grad():
        for layer in (m for m in model.model.modules() if isinstance(m, low_rank.LowRank)):
            layer.a.copy_(layer.a.half())
            layer.b.copy_(torch.randn_like(layer.b).mul(0.1).half())
    model.write(out, {})
    return model


def test_an_adapter_is_one_model_on_every_engine(llama: Card, tmp_path: Path) -> None:
    """The rows of a Llama's queries and keys lie in another order in llama.cpp."""
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    worn = adapter(llama, tmp_path / "worn")
    ids = [worn.read(q.messages)[0].tolist() for q in QUESTIONS]
    with torch.no_grad():
        logits = torch.cat([worn.model(torch.tensor([each])).logits[:, -1] for each in ids])
    expected = torch.log_softmax(logits.double(), -1).numpy()
    rows = expected.shape[1]
    here, there = (
        open_backend(cards.resolve(str(tmp_path / "worn"), engine), device="cpu")
        for engine in ("transformers", "llama-cpp")
    )
    assert np.abs(here.next_log_probs(QUESTIONS, rows) - expected).max() < 1e-4
    assert np.abs(there.next_log_probs(QUESTIONS, rows) - expected).max() < 1e-3
    plain = open_backend(llama, device="cpu")
    assert np.abs(plain.next_log_probs(QUESTIONS, rows) - expected).max() > 0.1
    assert len(here.identity()["adapter_sha256"]) == len(there.identity()["adapter_sha256"]) == 64
    assert "adapter_sha256" not in plain.identity()
    assert len(here.identity()["adapter_config_sha256"]) == 64, "which says how it is scaled"
    older = {k: v for k, v in here.identity().items() if k != "adapter_config_sha256"}
    assert same_model(older, here.identity())


@pytest.mark.parametrize("engine", ["transformers", "llama-cpp"])
def test_an_adapter_of_another_model_is_refused_in_one_line(
    engine: str, llama: Card, tmp_path: Path
) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    adapter(llama, tmp_path / "worn")
    other = replace(cards.resolve("swarm-tiny", engine), adapter=str(tmp_path / "worn"))
    with pytest.raises(
        UserError, match=r"is no adapter of this model: .*; give the adapter that was"
    ) as told:
        open_backend(other, device="cpu")
    assert "\n" not in str(told.value)


def test_an_adapter_of_a_broken_base_is_refused_in_one_line(llama: Card, tmp_path: Path) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    adapter(llama, tmp_path / "worn")
    (tmp_path / "tiny.gguf").write_bytes(b"GGUF?")
    with pytest.raises(
        UserError, match=r"tiny\.gguf does not load: .*; copy or download the file again"
    ):
        open_backend(cards.resolve(str(tmp_path / "worn"), "llama-cpp"), device="cpu")


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"use_dora": True}, "its adapter has use_dora; allowed: plain LoRA of linear layers"),
        ({"peft_type": "IA3"}, "its adapter has peft_type IA3, r 3, bias none"),
        ({"r": "many"}, "cannot be read"),
        ({"r": float("inf")}, "cannot be read"),
        ({"lora_alpha": float("nan")}, "lora_alpha is nan"),
        ({"alora_invocation_tokens": [7]}, "its adapter has alora_invocation_tokens"),
        (
            {"base_model_name_or_path": "replay:."},
            "is an adapter of 'replay:.', which is no model with weights",
        ),
        ({"base_model_name_or_path": "no-such"}, "unknown model 'no-such'"),
        (
            {"base_model_name_or_path": "SELF"},
            "is an adapter of an adapter; give one of a whole model",
        ),
    ],
)
def test_what_is_no_plain_adapter_is_refused_in_one_line(
    config: dict[str, object], said: str, llama: Card, tmp_path: Path
) -> None:
    folder = tmp_path / "worn"
    adapter(llama, folder)
    file = folder / adapters.CONFIG
    changed = {key: str(folder) if value == "SELF" else value for key, value in config.items()}
    file.write_text(json.dumps({**json.loads(file.read_text()), **changed}))
    with pytest.raises(UserError) as told:
        cards.resolve(str(folder))
    assert said in str(told.value)
    assert "\n" not in str(told.value)


NORM, HEAD = f"{adapters.PREFIX}model.norm", f"{adapters.PREFIX}lm_head"
DOWN = f"{adapters.PREFIX}model.layers.0.mlp.down_proj"


@pytest.mark.parametrize(
    ("name", "rows", "columns", "fill", "said"),
    [
        (DOWN, 96, 320, float("nan"), "holds numbers that are none, or too large"),
        (NORM, 96, 1, 1.0, "is (96, 1), and (96,) in the model"),
        (HEAD, 4096, 96, 1.0, "lm_head shares its weights, and both uses would change"),
    ],
)
def test_an_adapter_that_would_spoil_its_model_is_refused(
    name: str, rows: int, columns: int, fill: float, said: str, tmp_path: Path
) -> None:
    matrices = {adapters.A: torch.full((3, columns), fill), adapters.B: torch.ones(rows, 3)}
    save_file({name + end: matrix for end, matrix in matrices.items()}, tmp_path / adapters.TENSORS)
    config = {"r": 3, "lora_alpha": 6.0, "peft_type": "LORA"}
    for rank, words in ((3, said), (64, said if name == HEAD else "has rank 3, and r is 64")):
        (tmp_path / adapters.CONFIG).write_text(json.dumps({**config, "r": rank}))
        with pytest.raises(UserError) as told:
            open_backend(replace(BASE, adapter=str(tmp_path)), device="cpu")
        assert words in str(told.value)
        assert "\n" not in str(told.value)


def test_a_pipe_in_an_adapters_folder_is_one_line_and_nobody_waits(tmp_path: Path) -> None:
    (tmp_path / adapters.CONFIG).write_text("{}")
    card = replace(BASE, adapter=str(tmp_path))
    for name in (adapters.TENSORS, "adapter.gguf"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(UserError, match=rf"adapter's .*{name} is no file, but .*give a file"):
            adapters.find_adapter(card)
        (tmp_path / name).unlink()


def test_a_card_without_its_adapter_lacks_weights() -> None:
    card = replace(BASE, adapter="no-such-folder")
    assert missing(card) == "weights"
    with pytest.raises(
        UserError, match=r"no adapter in .*no-such-folder .*put its folder beside the card"
    ):
        open_backend(card, device="cpu")
    assert "adapter" not in BASE.record()
    assert card.record()["adapter"] == "no-such-folder"


# -- a training ------------------------------------------------------------------------------------


def test_a_taught_model_is_its_base_and_an_adapter(taught: Path) -> None:
    names = {path.name for path in taught.iterdir()}
    assert names == {
        *("README.md", "adapter_config.json", "adapter_model.safetensors", "training.json"),
    }
    facts = json.loads((taught / "training.json").read_text())
    assert facts["base"] == "swarm-tiny"
    assert facts["curves"]["excerpts"] == facts["curves"]["messages"] == []
    assert [len(point) for point in facts["curves"]["alone"]] == [4] * 3
    assert facts["curves"]["answers"][-1][2] < facts["curves"]["alone"][0][2], "on layouts held out"
    for held_out, scenario in zip(facts["held_out"], LEARNT, strict=True):
        assert tuple(held_out["likeliest"]) == scenario.actions
        assert sum(held_out["likeliest"].values()) == pytest.approx(1.0)
        assert list(held_out["references"]) == ["uniform", "constant", "local-view"]
    text = (taught / "README.md").read_text()
    assert "A LoRA adapter of rank 4 for `swarm-tiny`" in text
    assert "| scenario | the model | `uniform` | `constant` | `local-view` |" in text
    assert "train seeds 100001 to 100002" in text
    card = cards.resolve(str(taught))
    assert (card.adapter, card.letters, card.weights) == (str(taught), "raw", "swarm-tiny")


@pytest.mark.exhaustive
def test_a_killed_teaching_goes_on_to_the_same_adapter(
    taught: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.extensions.learn.training.train.KEEP_S", 0.0)
    out = tmp_path / "pupil"
    for kill in (("alone", 8), ("answers", 4)):

        def progress(stage: str, seen: int, *_: float, kill: tuple[str, int] = kill) -> None:
            if (stage, seen) == kill:
                raise Killed

        with pytest.raises(Killed):
            distill(CURRICULUM, PLAN, out, silent, progress, "cpu")
    with pytest.raises(UserError, match="was begun with another adapt"):
        distill(CURRICULUM, replace(PLAN, adapt=Adapt(8, 2e-2)), out, silent, silent, "cpu")
    distill(CURRICULUM, PLAN, out, silent, silent, "cpu")
    name = "adapter_model.safetensors"
    assert (out / name).read_bytes() == (taught / name).read_bytes()


# -- what is learnt --------------------------------------------------------------------------------


def test_a_decisions_gradient_is_the_exact_policy_gradient() -> None:
    """By hand: SLOWER and FASTER succeed, so V = 0.5,
    and the loss falls as p rises by p (v - V).
    """
    p, labels = torch.tensor([[0.2, 0.5, 0.3]]), torch.tensor([[0.6, 0.0, 0.4]])
    logits = torch.log(p).requires_grad_()
    loss = fitting(logits, labels, "values")
    loss.backward()
    assert loss.item() == pytest.approx(0.5)
    assert logits.grad[0].tolist() == pytest.approx([-0.1, 0.25, -0.15])
    imitated = torch.log(p).requires_grad_()
    fitting(imitated, labels, "imitation").backward()
    assert imitated.grad[0].tolist() == pytest.approx([0.2 - 0.6, 0.5, 0.3 - 0.4])


@pytest.mark.exhaustive
def test_a_value_is_what_the_episode_comes_to_when_the_decision_is_played() -> None:
    """Played in the simulator from the start of a layout, action by action."""
    scenario = PASSING
    [first] = [p for p in lessons.decision_points(scenario, SEED, 1) if p.record.step == 0]
    reference, safe = drive(scenario, "full-view", SEED), []
    for action in scenario.actions:
        world = World.start(scenario, SEED)
        world.act(action)
        [outcome] = finish([world], [lessons.TEACHER])
        safe.append(outcome.judged(reference, world.layout.danger, scenario.parameters).success)
    assert (np.array(first.label) > 0).tolist() == safe
    uniform = np.full((1, len(safe)), 1 / len(safe))
    assert value(np.array([first.label]), uniform, [1.0]) == pytest.approx(sum(safe) / len(safe))


def test_layouts_with_a_danger_weigh_as_much_as_those_without() -> None:
    records = [p.record for n in range(2) for p in lessons.decision_points(CROSSING, SEED + n, n)]
    scenes = tuple(
        Scene(structs.replace(r, danger=Danger(*((None, None) if r.step > 2 else ("left", "v5")))))
        for r in records
    )
    plain = lessons.Lessons(CROSSING, (), scenes, {})
    halves = {scene.id: scene.record.danger.sector is not None for scene in scenes}

    def share(weights: Mapping[str, float]) -> float:
        return sum(w for name, w in weights.items() if halves[name]) / sum(weights.values())

    assert share(replace(plain, balanced=True).weights) == pytest.approx(0.5)
    assert share(plain.weights) != pytest.approx(0.5, abs=0.01)


@pytest.mark.exhaustive
def test_the_value_rises_where_it_is_what_is_learnt(tmp_path: Path) -> None:
    samples = {"excerpts": 0, "alone": 16, "messages": 8, "answers": 0}
    # At this rate the value rises by a fifth, far from what other hardware rounds.
    plan = replace(PLAN, samples=samples, objective="values", adapt=Adapt(rank=4, rate=1e-1))
    facts = distill(CURRICULUM, plan, tmp_path / "pupil", silent, silent, "cpu")
    assert facts["curves"]["messages"][-1][3] > facts["curves"]["alone"][0][3]
    assert len(facts["curves"]["messages"]) == 2
    assert (
        "- Objective: `values`, the probability of actions"
        in (tmp_path / "pupil/README.md").read_text()
    )


def test_a_training_that_was_begun_before_there_were_objectives_goes_on() -> None:
    assert "objective" not in PLAN.settings()
    assert replace(PLAN, objective="values").settings()["objective"] == "values"


@pytest.mark.exhaustive
def test_all_weights_of_a_base_can_learn(tmp_path: Path) -> None:
    plan = replace(
        PLAN,
        samples={**PLAN.samples, "alone": 16, "answers": 0},
        adapt=Adapt(None, 1e-3, "bfloat16"),
    )
    distill(CURRICULUM, plan, tmp_path / "whole", silent, silent, "cpu")
    assert not (tmp_path / "whole" / adapters.CONFIG).exists()
    answers = open_backend(cards.resolve(str(tmp_path / "whole")), device="cpu").complete(QUESTIONS)
    assert [answer.error for answer in answers] == [None] * 3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rank", "8"], "--rank 8 goes with --lora, which trains an adapter"),
        (["--lora"], "--lora, --rate, --dtype and --report go with --base, a published model"),
        (["--lora", "--base", "swarm-tiny", "--rank", "0"], "--rank 0: give more than 0"),
        (["--base", "swarm-tiny", "--rate", "nan"], "--rate nan: give more than 0"),
        (["--base", "swarm-tiny", "--report", "-1"], "--report -1: give 0 to 512"),
        (["--base", "swarm-tiny", "--dtype", "int8"], "unknown --dtype 'int8'"),
        (["--base", "no-such"], "unknown model 'no-such'"),
        (
            ["--base", "proxy"],
            "--base proxy: it runs on proxy alone and has no weights that can be taught; give",
        ),
        (["--base", "sparrow-robot", "--lora"], "it runs on sparrow alone and has no weights"),
        (
            ["--base", "swarm-tiny-vl", "--prompt", "v9"],
            "takes pictures; give a plain model of texts",
        ),
        (
            ["--base", "swarm-tiny", "--prompt", "v8"],
            "is taught texts alone; leave image prompts out",
        ),
        (["--objective", "value"], "unknown --objective 'value'; did you mean 'values'?"),
        (["--samples", "0,0,0,0"], "or 0 to leave a stage out"),
    ],
)
def test_bad_input_writes_nothing(options: list[str], said: str, tmp_path: Path) -> None:
    arguments = [
        "model",
        "distill",
        "occluded-intersection",
        "--layouts",
        "2",
        "--out",
        str(tmp_path / "m"),
    ]
    with pytest.raises(UserError) as told:
        CliRunner().invoke(
            app, [*arguments, *options], standalone_mode=False, catch_exceptions=False
        )
    assert said in str(told.value)
    assert not (tmp_path / "m").exists()
