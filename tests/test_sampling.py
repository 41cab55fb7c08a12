"""Answers that are drawn at a temperature: from which distribution, and what moves one."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import run, same_decisions, scenes_of, spec_of
from hypothesis import given
from hypothesis import strategies as st
from tiers import some

from harness.backends.base import AnswerMode, Request
from harness.backends.card import Card, Latency
from harness.backends.cards import resolve
from harness.backends.decoding import drawn
from harness.backends.registry import open_backend
from harness.backends.servers import Server
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.agent import Agent
from harness.evaluate.requests import requests
from harness.parsing.parse import parse
from harness.prompts import versions
from harness.runs.folder import read

ACTIONS = ("SLOWER", "IDLE", "FASTER")
LOG_P = np.log([0.1, 0.2, 0.3, 0.4])
logits = st.lists(
    st.integers(-800, 800).map(lambda n: n / 100), min_size=1, max_size=9, unique=True
)
shares = st.floats(0, 1, exclude_max=True)


# -- one token, by hand ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("u", "token"),
    [(0.0, 0), (0.0999, 0), (0.1001, 1), (0.2999, 1), (0.3001, 2), (0.6001, 3), (0.9999, 3)],
)
def test_tokens_have_their_share_of_the_draws(u: float, token: int) -> None:
    assert drawn(LOG_P, None, 1.0, u) == token


def test_a_temperature_of_a_half_squares_the_shares() -> None:
    """1 : 4 : 9 : 16 of 30."""
    ends = [
        drawn(LOG_P, None, 0.5, u)
        for u in (0.9 / 30, 1.1 / 30, 4.9 / 30, 5.1 / 30, 13.9 / 30, 14.1 / 30)
    ]
    assert ends == [0, 1, 1, 2, 2, 3]


def test_only_allowed_tokens_are_drawn_by_their_shares_among_themselves() -> None:
    """0.1 and 0.3 are a quarter and three quarters."""
    assert [drawn(LOG_P, [2, 0], 1.0, u) for u in (0.0, 0.249, 0.251, 0.999)] == [0, 0, 2, 2]


@given(logits, shares)
def test_the_colder_the_more_greedy(values: list[float], u: float) -> None:
    assert drawn(np.array(values), None, 1e-6, u) == int(np.argmax(values))


@given(logits, shares, st.floats(0.01, 2), st.data())
def test_a_draw_is_allowed_and_possible(
    values: list[float], u: float, heat: float, data: Any
) -> None:
    some = data.draw(st.lists(st.integers(0, len(values) - 1), min_size=1, unique=True))
    barred = np.array([*values, -np.inf])
    assert drawn(barred, some, heat, u) in some
    assert drawn(barred, None, heat, u) < len(values)


# -- a real tiny model -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    import tiny_qwen3

    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny", context_tokens=2048)


@pytest.fixture(
    scope="module", params=["transformers", pytest.param("llama-cpp", marks=pytest.mark.slow)]
)
def card(request: pytest.FixtureRequest, tiny: Path) -> Card:
    if request.param == "transformers":
        return resolve(str(tiny))
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    from harness.backends.gguf_export import export

    export(tiny, tiny.parent / "tiny.gguf", "F32")
    return resolve(str(tiny.parent / "tiny.gguf"))


def ask(i: int, answer: AnswerMode = "json", **options: Any) -> Request:
    messages = ({"role": "user", "content": f"Scene {i * 'x'}: truck {i * 7} m"},)
    return Request(
        f"s{i}/v1", "ego", messages, ACTIONS, answer=answer,
        **{"max_tokens": 12 if answer == "json" else 80, **options},
    )  # fmt: skip


opened = cache(open_backend)  # a process of llama.cpp takes longer to start than to answer


def said(card: Card, requests: Sequence[Request], batch_size: int = 4) -> list[str]:
    completions = opened(card, batch_size=batch_size, device="cpu").complete(requests)
    assert not any(c.error for c in completions)
    return [c.text for c in completions]


@pytest.mark.parametrize("answer", some(["constrained"], exhaustive=["json"]))
def test_nothing_but_the_seed_moves_an_answer(card: Card, answer: AnswerMode) -> None:
    asked = [ask(i, answer, temperature=1.0, sample=s) for s in (0, 1) for i in range(4)]
    texts = said(card, asked)
    assert said(card, asked, batch_size=1) == texts
    assert said(card, asked[::-1], batch_size=3) == texts[::-1]
    assert said(card, [replace(r, id=f"another-{r.id}") for r in asked]) == texts
    assert texts[:4] != texts[4:]


@pytest.mark.parametrize("answer", ["json", "constrained"])
def test_a_cold_answer_is_the_greedy_one(card: Card, answer: AnswerMode) -> None:
    cold = said(card, [ask(i, answer, temperature=1e-5, sample=i) for i in range(6)])
    assert cold == said(card, [ask(i, answer) for i in range(6)])


def test_a_drawn_constrained_answer_is_read(card: Card) -> None:
    texts = said(card, [ask(1, "constrained", temperature=2.0, sample=s) for s in range(12)])
    assert len(set(texts)) > 6
    assert None not in {
        parse(text, role="ego", actions=ACTIONS, divides=True).intent for text in texts
    }


def test_greedy_and_drawn_answers_share_a_batch(card: Card) -> None:
    mixed = [ask(i, temperature=float(i % 2), sample=i) for i in range(4)]
    assert said(card, mixed) == [text for request in mixed for text in said(card, [request])]


def test_tokens_come_as_often_as_the_model_says(tiny: Path) -> None:
    """The first token of 200 answers to one question:
    the likeliest ones' shares within 4 standard errors.
    """
    import torch

    from harness.backends.language_model import LanguageModel
    from harness.backends.transformers.engine import TransformersEngine

    hot = open_backend(resolve(str(tiny)), batch_size=64, device="cpu")
    assert isinstance(hot, LanguageModel)
    assert isinstance(hot.engine, TransformersEngine)
    ids = hot.chat.encode(hot.chat.render(ask(2).messages, thinking=False))
    with torch.inference_mode():
        row = hot.engine.model(torch.tensor([ids])).logits[0, -1].double() / 1.5
    p = row.softmax(-1).numpy()
    n = 200
    texts = [
        c.text
        for c in hot.complete([ask(2, max_tokens=1, temperature=1.5, sample=s) for s in range(n)])
    ]
    for token in np.argsort(p)[::-1][:4].tolist():
        text = "" if token in hot.engine.stops else hot.chat.decode([token])
        expected = (
            sum(float(p[t]) for t in range(len(p)) if hot.chat.decode([t]) == text)
            if text
            else p[token]
        )
        assert abs(texts.count(text) / n - expected) < 4 * (expected * (1 - expected) / n) ** 0.5


# -- what a server is sent -------------------------------------------------------------------------


def test_a_server_is_sent_temperature_and_seed() -> None:
    from harness.backends.openai.shapes import body

    server = Server("http://localhost:1/v1", kind="vllm")
    card = Card("m", "openai", "d", Latency("paper", None, "b"), weights="m", server=server)
    hot = body(card, server, ask(1, temperature=0.7, sample=3))
    assert {k: hot[k] for k in ("temperature", "seed", "top_p", "top_k", "min_p")} == {
        "temperature": 0.7, "seed": 3, "top_p": 1, "top_k": -1, "min_p": 0,
    }  # fmt: skip
    greedy = body(card, server, ask(1))
    assert hot.keys() - greedy.keys() == {"top_p", "top_k", "min_p"}
    assert (greedy["temperature"], greedy["seed"]) == (0, 0)


# -- a run -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_is_drawn_by_its_sampling_seed(small: Dataset, tiny: Path, tmp_path: Path) -> None:
    alone = (POINTS["single-local"],)
    spec = spec_of(
        small,
        str(tiny),
        answer="constrained",
        temperature=1.0,
        sampling_seed=1,
        limit=1,
        points=alone,
    )
    one, again = (run(spec.changed(batch_size=n), tmp_path / str(n)) for n in (8, 3))
    assert same_decisions(one.out, again.out)
    other = run(spec.changed(sampling_seed=2), tmp_path / "other")
    texts = [[a.raw for a in read(done.out).answers] for done in (one, again, other)]
    assert texts[0] == texts[1] != texts[2]
    assert (one.manifest.settings.temperature, one.manifest.settings.sampling_seed) == (1.0, 1)
    assert "--temperature 1.0 --sampling-seed 1" in one.manifest.command


def test_in_a_mix_the_half_that_writes_is_drawn(small: Dataset, tiny: Path) -> None:
    rule, asked = spec_of(small).ego, {"temperature": 0.7, "sampling_seed": 3}
    for spec, drawn_role in (
        (spec_of(small, str(tiny), helpers=(rule,), **asked), "ego"),
        (
            replace(spec_of(small, str(tiny), **asked), ego=rule, helpers=(agent_of(tiny),)),
            "helper",
        ),
        (replace(spec_of(small, str(tiny), **asked), helpers=(agent_of(tiny, "readout"),)), "ego"),
    ):
        found = {(r.role, r.temperature, r.sample) for r in requests(spec, scenes_of(small)[:1])}
        other = "helper" if drawn_role == "ego" else "ego"
        assert found == {(drawn_role, 0.7, 3), (other, 0.0, 0)}


def agent_of(model: Path, answer: AnswerMode = "json") -> Agent:
    return Agent(resolve(str(model)), versions.load("v2"), answer)


@pytest.mark.exhaustive
def test_a_replay_asks_on_as_the_run_was_asked(
    small: Dataset, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another condition leads to decision points that the run did not come to."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models/tiny.toml").write_text(
        f'engine = "transformers"\ndescription = "tiny"\nweights = "{tiny}"\n'
        f'thinking = "{resolve(str(tiny)).thinking}"\n'
        '[latency]\nsource = "paper"\nbasis = "none"\n'
    )
    alone, both = (POINTS["single-local"],), (POINTS["single-local"], POINTS["6g"])
    spec = spec_of(
        small,
        str(tiny),
        answer="constrained",
        temperature=1.0,
        sampling_seed=1,
        limit=1,
        points=both,
    )
    stored = run(replace(spec, points=alone), tmp_path / "stored")
    replayed = spec_of(small, f"replay:{stored.out}", answer="constrained", limit=1, points=both)
    again, whole = run(replayed, tmp_path / "again"), run(spec, tmp_path / "whole")
    assert same_decisions(again.out, whole.out)
    assert len(read(again.out).answers) > len(read(stored.out).answers)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"temperature": 0.7}, "--temperature 0.7: proxy has nothing to sample; leave it out"),
        (
            {"temperature": -1.0},
            "--temperature -1: give 0, which takes the likeliest token each time, to 2",
        ),
        ({"temperature": float("nan")}, "--temperature nan: give 0"),
        ({"sampling_seed": -1}, "--sampling-seed -1 is out of range; give 0 to 2147483647"),
        ({"sampling_seed": 2}, "--sampling-seed 2: give a --temperature above 0 with it: greedy"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    small: Dataset, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        spec_of(small, **options)


def test_a_read_out_is_not_drawn(small: Dataset, tiny: Path) -> None:
    with pytest.raises(
        UserError, match=r"--temperature 0.7: a readout is a distribution already; use"
    ):
        spec_of(small, str(tiny), answer="readout", temperature=0.7)
