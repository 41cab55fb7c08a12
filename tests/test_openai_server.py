"""The openai backend against a real server:
llama_cpp.server with a GGUF of the tests' tiny Qwen3.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from evaluating import FILES, run, scenes_of, spec_of, with_ego
from run_on_disk import answers_of
from served import llama_cpp_server

from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.registry import open_backend
from harness.backends.servers import Server
from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.evaluate.latency import PAPER
from harness.evaluate.requests import requests
from harness.parsing.parse import parse

NEEDED = ("torch", "transformers", "llama_cpp", "fastapi", "uvicorn", "starlette_context", "sse_starlette",
          "pydantic_settings")  # fmt: skip
if lacking := [name for name in NEEDED if find_spec(name) is None]:
    pytest.skip(f"needs {', '.join(lacking)}", allow_module_level=True)

KEY = "sk-real-server-5ecret"
pytestmark = pytest.mark.exhaustive


@pytest.fixture(scope="module")
def gguf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny model, whose A and B are likely where its K is,
    since random weights know no letters.
    """
    import tiny_qwen3
    from safetensors.torch import load_file, save_file
    from tokenizers import Tokenizer

    from harness.backends.gguf_export import export

    folder = tiny_qwen3.build(tmp_path_factory.mktemp("served") / "tiny", context_tokens=2048)
    ids = Tokenizer.from_file(str(folder / "tokenizer.json"))
    weights = load_file(folder / "model.safetensors")
    head = weights["lm_head.weight"]
    for letter, factor in (("A", 1.0), ("B", 0.9)):
        head[ids.token_to_id(letter)] = factor * head[ids.token_to_id("K")]
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    export(folder, folder / "tiny.gguf", "F32")
    return folder / "tiny.gguf"


@pytest.fixture(scope="module")
def url(gguf: Path) -> Iterator[str]:
    """A server of its own process, which asks for a key."""
    options = {"model_alias": "tiny", "api_key": KEY, "n_ctx": "2048", "logits_all": "true"}
    with llama_cpp_server(gguf, gguf.with_name("server.log"), **options) as url:
        yield url


@pytest.fixture
def card(url: str, monkeypatch: pytest.MonkeyPatch) -> Card:
    monkeypatch.setenv("TINY_LLAMA_KEY", KEY)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    server = Server(url, "llama-cpp-python", key_env="TINY_LLAMA_KEY", retries=0)
    return Card("served", "openai", "d", Latency("paper", None, "b"), "tiny", server=server)


@pytest.fixture
def data(small_path: Path) -> Dataset:
    return load(small_path, limit=1)


def some(
    data: Dataset, answer: AnswerMode, prompt: str = "v2", max_tokens: int = 24
) -> list[Request]:
    spec = spec_of(data, "openai-example", prompt=prompt, answer=answer)
    asked = list(requests(spec, scenes_of(data)))[:8]
    # The server tells its template nothing about thinking, which opens no thought and closes none.
    return [replace(r, max_tokens=max_tokens, thinking=True, orders=()) for r in asked]


def in_process(gguf: Path, asked: list[Request]) -> list[Completion]:
    made = Card("tiny", "llama-cpp", "d", Latency("paper", None, "b"), str(gguf))
    return open_backend(made, batch_size=1).complete(asked)


def test_a_server_says_what_its_model_says_in_process(
    card: Card, gguf: Path, data: Dataset
) -> None:
    asked = some(data, "json")
    served = openai_backend.open(card, batch_size=1).complete(asked)
    for there, here in zip(served, in_process(gguf, asked), strict=True):
        # The server leaves out what is no UTF-8, and goes on for a while where the end would be
        # none.
        assert there.text.startswith(here.text.replace("\ufffd", ""))
        assert (there.finish_reason, there.prompt_tokens) == (
            here.finish_reason,
            here.prompt_tokens,
        )
        assert there.error is None
        assert there.seconds is not None
    assert len({c.text for c in served}) > 3, "answers that are all alike would show nothing"


def test_several_at_a_time_are_answered_as_one_by_one(card: Card, data: Dataset) -> None:
    asked = some(data, "json")
    alone = openai_backend.open(card, batch_size=1).complete(asked)
    together = openai_backend.open(card, batch_size=4).complete(asked)
    assert [(c.request_id, c.text) for c in together] == [(c.request_id, c.text) for c in alone]


def test_a_read_out_of_a_server_is_that_of_its_model_in_process(
    card: Card, gguf: Path, data: Dataset
) -> None:
    """C is not among the likeliest tokens: the server's share of it is an upper bound."""
    asked = some(data, "readout")
    served = openai_backend.open(card, batch_size=1).complete(asked)
    read = 0
    for there, here in zip(served, in_process(gguf, asked), strict=True):
        if there.error:
            assert there.error.startswith("none of the letters ABC is among the ")
            continue
        read += 1
        assert there.label_mass is not None
        assert here.label_mass is not None
        mine, theirs = (json.loads(c.text)["action_distribution"] for c in (here, there))
        listed = mine["SLOWER"] + mine["IDLE"]
        assert there.label_mass == pytest.approx(here.label_mass * listed, rel=0.01)
        assert theirs["SLOWER"] / theirs["IDLE"] == pytest.approx(
            mine["SLOWER"] / mine["IDLE"], rel=0.01
        )
        assert theirs["FASTER"] >= mine["FASTER"] - 1e-3
        assert parse(there.text, role="ego", actions=data.actions).status == "strict"
    assert read > 3


@pytest.mark.parametrize("prompt", ["v1", "v2"])
def test_a_constrained_answer_of_a_server_keeps_to_the_form(
    prompt: str, card: Card, data: Dataset
) -> None:
    """The numbers need not sum to 1, which no grammar can say; nothing else may be wrong."""
    asked = some(data, "constrained", prompt, max_tokens=120)
    assert {r.role for r in asked} == {"ego", "helper"}
    for request, there in zip(
        asked, openai_backend.open(card, batch_size=1).complete(asked), strict=True
    ):
        parsed = parse(there.text, role=request.role, actions=request.actions)
        assert parsed.status in ("strict", "bad_sum"), there.text
        assert (there.error, there.finish_reason) == (None, "stop")


def test_a_whole_run_holds_the_answers_and_not_the_key(
    card: Card, data: Dataset, tmp_path: Path
) -> None:
    spec = with_ego(
        spec_of(data, batch_size=1), card=replace(card, max_new_tokens=120), answer="constrained"
    )
    done = run(spec, tmp_path / "run")
    answers = answers_of(tmp_path / "run")
    assert {a.error for a in answers} == {None}
    assert {a.status for a in answers} <= {"strict", "recovered", "bad_sum"}
    assert {repair for a in answers for repair in a.repairs} <= {"renormalised", "divided"}
    assert all(a.mass == 0 for a in answers if a.status == "bad_sum")
    assert all(a.seconds > 0 and a.prompt_tokens > 0 and a.completion_tokens > 0 for a in answers)
    assert done.manifest.latency == PAPER
    assert done.manifest.answer_times["ego"].n == len({a.scene for a in answers})
    assert done.manifest.identity["listed"] == {"id": "tiny", "owned_by": "me"}
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert {path.name for path in files} >= {*FILES, "run.json", "servers.jsonl"}
    assert not any(KEY.encode() in path.read_bytes() for path in files)


def test_a_wrong_key_is_one_line_at_opening(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in ("sk-of-somebody-else", ""):
        monkeypatch.setenv("TINY_LLAMA_KEY", wrong)
        with pytest.raises(
            UserError, match=r"refuses the key \(HTTP 401: .*\); set TINY_LLAMA_KEY"
        ):
            openai_backend.open(card, batch_size=1)


def test_a_server_is_told_what_it_cannot_do(card: Card, data: Dataset) -> None:
    """OpenAI's own way to ask for a schema is none that llama_cpp.server knows."""
    assert card.server is not None
    generic = replace(card, server=replace(card.server, kind="generic"))
    [asked, *_] = some(data, "constrained")
    [done] = openai_backend.open(generic, batch_size=1).complete([asked])
    assert done.finish_reason == "error"
    assert re.match(r"HTTP \d+: ", done.error or "")
