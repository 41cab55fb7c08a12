"""Models that decide and write nothing:
two wire shapes, by servers after their documents, and a real one.

llama.cpp's and OpenAI's own programs are not here. `sparrow-decider` is, and so is its server.
"""

import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import run, scenes_of, spec_of, with_ego
from misbehaving import Asked, Server, serving
from tiers import some

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.core.image import Image
from harness.dataset.load import Dataset, find, load
from harness.evaluate import flip
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.runs import folder
from harness.world import scenarios

WIRES = ("systemone", "decisions")
SHARES = {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}
DATASETS = (
    "occluded-intersection-v2", "blind-merge-v1", "do-not-pass-v1", "hard-brake-ahead-v1", "parking-exit-v1",
    "roundabout-entry-v1",
)  # fmt: skip


@pytest.fixture(scope="module")
def data(small_path: Path) -> Dataset:
    return load(small_path, limit=1)


@pytest.fixture(scope="module")
def asked(data: Dataset) -> list[Request]:
    spec = spec_of(data, "systemone-example", "v9", answer="decision")
    return list(requests(spec, scenes_of(data)[:1]))


def card_at(wire: str, url: str, **changes: Any) -> Card:
    card = cards.load(f"{wire}-example")
    assert card.server is not None
    return replace(card, server=replace(card.server, base_url=url, kind="generic", **changes))


def answer(wire: str, shares: Any = SHARES, kind: str = "choice", **usage: int) -> dict[str, Any]:
    """What the documents of a wire shape show as an answer."""
    if wire == "systemone":
        body: Any = {
            "action": {
                "type": kind,
                "choice": "SLOWER",
                "probabilities": shares,
                "confidence": 0.55,
            }
        }
    else:
        listed = [{"value": value, "probability": p} for value, p in dict(shares).items()]
        body = [{"type": kind, "name": "action", "choice": "SLOWER", "probabilities": listed}]
        body = [{"type": kind, "name": "action"}] if kind == "refusal" else body
    return {
        "model": "default",
        "answers": body,
        "usage": {"input_tokens": 90, "output_tokens": 0, **usage},
    }


@contextmanager
def opened(
    wire: str, play: Callable[[Asked], None], **changes: Any
) -> Iterator[tuple[Server, Backend]]:
    with serving(play) as there:
        yield there, open_backend(card_at(wire, there.url, **changes), batch_size=4)


@pytest.mark.parametrize("wire", WIRES)
def test_a_server_is_asked_as_its_document_says(wire: str, asked: list[Request]) -> None:
    with opened(wire, lambda got: got.reply(answer(wire))) as (there, backend):
        done = backend.complete(asked)
    assert [json.loads(c.text)["action_distribution"] for c in done] == [SHARES] * len(asked)
    assert {(c.prompt_tokens, c.completion_tokens, c.label_mass, c.error) for c in done} == {
        (90, 0, None, None)
    }
    assert answer_of(asked[0], done[0]).status == "strict"
    by_state = {request.question.state: request.question for request in asked if request.question}
    for got in there.asked:
        assert got.path == f"/v1/{wire}"
        if wire == "systemone":
            assert set(got.body) == {"model", "state", "questions"}
            question = by_state[got.body["state"]]
            assert got.body["questions"] == {
                "action": {
                    "type": "choice", "instructions": question.instructions, "criteria": question.meanings,
                }
            }  # fmt: skip
        else:
            assert set(got.body) == {"model", "input", "questions"}
            question = by_state[got.body["input"]]
            choices = [{"value": a, "description": m} for a, m in question.meanings.items()]
            assert got.body["questions"] == [
                {
                    "type": "choice", "name": "action", "instructions": question.instructions,
                    "choices": choices,
                }
            ]  # fmt: skip
    assert backend.identity()["engine"] == wire


@pytest.mark.parametrize("wire", WIRES)
def test_a_flipped_question_lists_its_options_in_reverse(wire: str, data: Dataset) -> None:
    spec = with_ego(spec_of(data, f"{wire}-example", "v9", answer="decision"), flip=True)
    question = next(requests(spec, scenes_of(data)[:1]))
    with opened(wire, lambda got: got.reply(answer(wire))) as (there, backend):
        [done] = backend.complete([question])
        [mirror] = backend.complete([flip.mirror_request(question)])
    listed = [
        list(got.body["questions"]["action"]["criteria"])
        if wire == "systemone"
        else [choice["value"] for choice in got.body["questions"][0]["choices"]]
        for got in there.asked
    ]
    assert listed == [list(question.actions), list(question.actions[::-1])]
    assert (
        flip.compared(
            answer_of(question, done), answer_of(flip.mirror_request(question), mirror)
        ).flipped
        is False
    )


@pytest.mark.parametrize("wire", WIRES)
def test_a_picture_goes_before_the_state_and_is_shown_by_its_digest(
    wire: str, asked: list[Request]
) -> None:
    seen = replace(asked[0], image=Image(np.zeros((2, 4, 3), dtype=np.uint8)))
    with opened(wire, lambda got: got.reply(answer(wire))) as (there, backend):
        assert backend.complete([seen])[0].error is None
        shown = backend.rendered([seen])[0]  # type: ignore[attr-defined]
    body = there.asked[0].body
    assert "sha256:" in shown
    assert "base64" not in shown
    if wire == "systemone":
        [url] = body["images"]
    else:
        [message] = body["input"]
        picture, text = message["content"]
        assert (message["role"], picture["type"], text["type"]) == (
            "user",
            "input_image",
            "input_text",
        )
        url = picture["image_url"]
    assert url.startswith("data:image/png;base64,")


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize(
    ("shares", "status"),
    [
        ({"SLOWER": 0.7, "IDLE": 0.2}, "missing_action"),
        ({**SHARES, "FASTER": 0.5}, "bad_sum"),
        ({**SHARES, "WAIT": 0.1}, "unknown_action"),
        ({**SHARES, "FASTER": float("nan")}, "non_finite"),
        ({**SHARES, "FASTER": "much"}, "non_numeric"),
        ({**SHARES, "FASTER": 0.1004}, "strict"),
    ],
)
def test_what_a_model_states_is_judged_as_it_stands(
    wire: str, shares: dict[str, Any], status: str, asked: list[Request]
) -> None:
    with opened(wire, lambda got: got.reply(answer(wire, shares))) as (_, backend):
        [done] = backend.complete(asked[:1])
    assert answer_of(asked[0], done).status == status


@pytest.mark.parametrize("wire", WIRES)
def test_a_question_may_be_refused(wire: str, asked: list[Request]) -> None:
    with opened(wire, lambda got: got.reply(answer(wire, kind="refusal"))) as (there, backend):
        [done] = backend.complete(asked[:1])
    assert (done.finish_reason, done.error, len(there.asked)) == ("refusal", None, 1)
    assert answer_of(asked[0], done).status == "refused"


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize(
    "body",
    [
        {},
        [],
        {"answers": None},
        {"answers": {"action": 1}},
        {"answers": [{"type": "choice"}]},
        "words",
    ],
)
def test_whatever_else_comes_is_an_error_in_one_line(
    wire: str, body: Any, asked: list[Request]
) -> None:
    with opened(wire, lambda got: got.reply(body)) as (_, backend):
        [done] = backend.complete(asked[:1])
    assert done.error == "the answer is no decision: it has no probabilities of the question"


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize(
    ("status", "said"),
    [
        (501, "HTTP 501: no head; its model is no decision model, or takes no pictures"),
        (400, "HTTP 400: no head; it does not take this question"),
        (404, "HTTP 404: no head; a card has engine ="),
    ],
)
def test_what_a_server_does_not_do_is_explained_and_not_asked_again(
    wire: str, status: int, said: str, asked: list[Request]
) -> None:
    def refuse(got: Asked) -> None:
        got.reply({"error": {"code": status, "message": "no head"}}, status)

    with opened(wire, refuse) as (there, backend):
        [done] = backend.complete(asked[:1])
    assert str(done.error).startswith(said)
    assert len(there.asked) == 1


def test_a_server_that_breaks_down_is_asked_again(
    asked: list[Request], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.backends.openai.pool.FIRST_WAIT_S", 0.01)

    def play(got: Asked) -> None:
        got.reply(answer("systemone"), 503 if got.number == 0 else 200)

    with opened("systemone", play) as (_, backend):
        [done] = backend.complete(asked[:1])
    assert (done.error, done.retries) == (None, 1)


def test_a_model_is_known_by_what_its_server_says_of_it() -> None:
    def listed(outputs: list[str]) -> Callable[[Asked], None]:
        entry = {"id": "default", "architecture": {"output_modalities": outputs}}
        return lambda got: got.reply({"data": [entry]})

    def play(got: Asked) -> None:
        raise AssertionError(got.path)

    with serving(play, listed(["decisions"])) as there:
        backend = open_backend(card_at("systemone", there.url))
        assert backend.identity()["states"]["architecture.output_modalities"] == '["decisions"]'
        chat = replace(card_at("systemone", there.url), engine="openai")
        with pytest.raises(
            UserError, match="is a decision model, which writes nothing; give a card with"
        ):
            open_backend(chat)
    with (
        serving(play, listed(["text"])) as there,
        pytest.raises(
            UserError, match='writes text and decides nothing; give a card with engine = "openai"'
        ),
    ):
        open_backend(card_at("systemone", there.url))


def test_a_gguf_file_of_a_decision_model_says_so(tmp_path: Path) -> None:
    def text(value: str) -> bytes:
        return struct.pack("<Q", len(value)) + value.encode()

    facts = {"general.architecture": "kev", "kev.decision.type": "kev"}
    pairs = b"".join(text(key) + struct.pack("<I", 8) + text(value) for key, value in facts.items())
    file = tmp_path / "kev.gguf"
    file.write_bytes(struct.pack("<4sIQQ", b"GGUF", 3, 0, len(facts)) + pairs)
    with pytest.raises(
        UserError, match=r"is a decision model \(kev\), which no engine opens here; serve it"
    ):
        cards.resolve(str(file))


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({}, "--answer json: systemone-example cannot answer so; use decision"),
        (
            {"answer": "decision", "letters": "cyclic"},
            "--letters cyclic: systemone-example reads no letters",
        ),
        ({"answer": "decision", "thinking": True}, "--thinking: systemone-example cannot think"),
    ],
)
def test_a_decision_model_does_nothing_else(how: dict[str, Any], reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        Agent(cards.load("systemone-example"), versions.load("v9"), **how)


# -- a real one ------------------------------------------------------------------------------------


def questions_of(name: str) -> tuple[Spec, list[Request]]:
    pytest.importorskip("sparrow_decider", reason="needs the sparrow extra")
    data = load(find(name), limit=1)
    spec = spec_of(data, "sparrow-general", "v9", answer="decision")
    return spec, list(requests(spec, data.scenes(data.forest.ids[:2])))


def test_every_family_is_tried() -> None:
    assert {load(find(name), limit=1).scenario.name for name in DATASETS} == set(
        scenarios.witnessed()
    )


def listening(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.parametrize("kind", some(["robot"], exhaustive=["general"]))
def test_a_real_model_answers_in_process_as_through_its_own_server(kind: str) -> None:
    """In all six families; both state probabilities to four digits."""
    pytest.importorskip("sparrow_decider", reason="needs the sparrow extra")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "sparrow_decider.cli", "--model", f"nano-{kind}"]
    server = subprocess.Popen(
        [*command, "serve", "--port", str(port)],
        stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s and not listening(port):
            time.sleep(0.05)
        card = cards.load(f"sparrow-{kind}")
        own = open_backend(card)
        url = f"http://127.0.0.1:{port}/v1"
        through = open_backend(replace(card_at("systemone", url), weights=card.weights))
        for name in DATASETS:
            _, asked = questions_of(name)
            here: list[Completion] = own.complete(asked)
            there: list[Completion] = through.complete(asked)
            assert [c.text for c in here] == [c.text for c in there]
            assert {answer_of(r, c).status for r, c in zip(asked, here, strict=True)} == {"strict"}
            assert all(c.seconds is not None for c in here)
    finally:
        server.terminate()
        server.wait(10)


@pytest.mark.slow
def test_a_real_model_drives_and_its_run_is_flipped_and_replayed(
    data: Dataset, tmp_path: Path
) -> None:
    pytest.importorskip("sparrow_decider", reason="needs the sparrow extra")
    points = tuple(map(named_point, ("single-local", "6g", "6g:loss=0,tau=0,content=objects")))
    spec = with_ego(
        spec_of(data, "sparrow-robot", "v9", answer="decision", points=points, seeds=(0,)),
        flip=True,
    )
    run(spec, tmp_path / "a")
    first = folder.read(tmp_path / "a")
    assert {a.status for a in first.answers} == {"strict"}
    assert any(a.heard for a in first.answers)
    assert {a.flipped for a in first.answers} <= {True, False}
    assert (first.manifest.identity["engine"], first.manifest.answer) == ("sparrow", "decision")
    assert len(first.manifest.identity["sha256"]) == 64
    run(with_ego(spec, card=cards.resolve(f"replay:{tmp_path / 'a'}")), tmp_path / "b")
    again = folder.read(tmp_path / "b")
    assert [(a.id, a.intent) for a in again.answers] == [(a.id, a.intent) for a in first.answers]


def test_weights_that_are_not_there_are_named() -> None:
    pytest.importorskip("sparrow_decider", reason="needs the sparrow extra")
    card = replace(cards.load("sparrow-general"), weights="sparrow-nano")
    with pytest.raises(UserError, match="did you mean one of sparrow-nano-general"):
        open_backend(card)
    with pytest.raises(UserError, match="is no file; give one that is there"):
        open_backend(replace(card, weights="mine.sparrow"))
