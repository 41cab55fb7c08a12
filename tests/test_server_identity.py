"""A server's statements are the model's identity:
other weights, template or context are another model.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from misbehaving import Asked, completion, serving

from harness.backends.base import Request, same_model, say_newly_stated
from harness.backends.cache import cached
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai.statements import Model, _flat, read_statement
from harness.backends.servers import Kind, Server
from harness.core.errors import UserError
from harness.core.files import canonical_json, digest

Paths = dict[str, Any]
LLAMA: Paths = {
    "/v1/models": {"object": "list", "data": [{
        "id": "/srv/models/tiny.gguf", "object": "model", "created": 1750000000, "owned_by": "llamacpp",
        "meta": {"vocab_type": 2, "n_vocab": 151936, "n_ctx_train": 40960, "n_embd": 2560,
                 "n_params": 4022468096, "size": 2491000000},
    }]},
    "/props": {
        "default_generation_settings": {"id": 0, "id_task": -1, "n_ctx": 4096, "is_processing": False,
                                        "params": {"seed": 4294967295, "dry_multiplier": 0.0}},
        "total_slots": 1, "model_path": "/srv/models/tiny.gguf", "chat_template": "{{ messages }}" * 20,
        "modalities": {"vision": False}, "media_marker": "<__media_1__>", "build_info": "b8681-abc",
        "bos_token": "<s>", "eos_token": "<|im_end|>", "is_sleeping": False,
    },
}  # fmt: skip
VLLM: Paths = {
    "/v1/models": {"object": "list", "data": [{
        "id": "m", "object": "model", "created": 1750000000, "owned_by": "vllm", "root": "lab/m",
        "parent": None, "max_model_len": 8192, "permission": [{"id": "modelperm-1", "created": 1750000000}],
    }]},
    "/version": {"version": "0.11.0"},
}  # fmt: skip
OLLAMA: Paths = {
    "/v1/models": {"object": "list", "data": [
        {"id": "m:latest", "object": "model", "created": 1750000000, "owned_by": "library"},
        {"id": "n:latest", "object": "model", "created": 1, "owned_by": "library"},
    ]},
    "/api/version": {"version": "0.12.3"},
    "/api/tags": {"models": [
        {"name": "m:latest", "modified_at": "2026-01-01", "size": 77, "digest": "9f43",
         "details": {"format": "gguf", "families": None, "quantization_level": "Q4_0"}},
        {"name": "n:latest", "digest": "fe93"},
    ]},
    "/api/show": {"template": 
        "{{ .Prompt }}", "parameters": "num_ctx 4096", "modified_at": "2026-01-01",
                  "details": {"parameter_size": "4B"}, "model_info": {"general.parameter_count": 4000}},
}  # fmt: skip
STUDIO: Paths = {
    "/v1/models": {"data": [{"id": "m", "object": "model", "owned_by": "organization_owner"}]},
    "/api/v0/models": {"data": [{"id": "m", "arch": "qwen3", "quantization": "Q4_K_M", "state": "loaded",
                                 "max_context_length": 32768, "loaded_context_length": 4096}]},
}  # fmt: skip
GENERIC: Paths = {
    "/v1/models": {"data": [{"id": "m", "created": 5, "owned_by": "me", "context_window": 8192,
                             "status": {"value": "loaded"}, "pricing": {"prompt": "0.1"}}]},
}  # fmt: skip
SERVERS: dict[Kind, Paths] = {
    "llama-server": LLAMA, "vllm": VLLM, "ollama": OLLAMA, "lm-studio": STUDIO, "generic": GENERIC,
    "llama-cpp-python": {"/v1/models": {"data": [{"id": "m", "owned_by": "me", "permissions": []}]}},
}  # fmt: skip


@pytest.fixture(autouse=True)
def local(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def answering(paths: Paths) -> Callable[[Asked], None]:
    def listed(asked: Asked) -> None:
        if asked.path in paths:
            asked.reply(paths[asked.path])
        else:
            asked.reply({"error": "no such path"}, 404)

    return listed


def changed(paths: Paths, path: str, *steps: Any, to: Any) -> Paths:
    made = json.loads(json.dumps(paths))
    at = made[path]
    for step in steps[:-1]:
        at = at[step]
    at[steps[-1]] = to
    return made


def opened(url: str, kind: Kind) -> openai_backend.OpenAIBackend:
    where = Server(url, kind, key_env="NO_KEY", timeout_s=20.0, retries=0)
    return openai_backend.open(
        Card("mine", "openai", "d", Latency("paper", None, "b"), "m", server=where)
    )


def identity(kind: Kind, paths: Paths) -> dict[str, Any]:
    with serving(lambda asked: None, answering(paths)) as there:
        return {k: v for k, v in opened(there.url, kind).identity().items() if k != "base_url"}


def test_a_llama_server_states_its_file_template_context_and_size() -> None:
    found = identity("llama-server", LLAMA)
    assert found["listed"] == {"id": "/srv/models/tiny.gguf", "owned_by": "llamacpp"}
    assert found["version"] == "b8681-abc"
    states = found["states"]
    assert states["chat_template"].startswith("sha256:")
    assert {k: v for k, v in states.items() if k not in ("chat_template", "sampling")} == {
        "bos_token": "<s>", "eos_token": "<|im_end|>", "file": "tiny.gguf", "meta.n_ctx_train": 40960,
        "meta.n_embd": 2560, "meta.n_params": 4022468096, "meta.n_vocab": 151936, "meta.size": 2491000000,
        "meta.vocab_type": 2, "modalities.vision": False, "n_ctx": 4096,
    }  # fmt: skip


def test_an_ollama_states_its_digest_template_and_parameters() -> None:
    found = identity("ollama", OLLAMA)
    assert (found["listed"], found["version"]) == (
        {"id": "m:latest", "owned_by": "library"},
        "0.12.3",
    )
    assert found["states"] == {
        "details.parameter_size": "4B", "digest": "9f43", "model_info": '{"general.parameter_count": 4000}',
        "parameters": "num_ctx 4096", "size": 77, "template": "{{ .Prompt }}",
    }  # fmt: skip


OTHER: list[tuple[Kind, tuple[Any, ...], Any]] = [
    ("llama-server", ("/v1/models", "data", 0, "meta", "size"), 4000),
    ("llama-server", ("/props", "model_path"), "/srv/models/other.gguf"),
    ("llama-server", ("/props", "chat_template"), "{{ messages }}" * 19 + "{{ messages[1:] }}"),
    ("llama-server", ("/props", "default_generation_settings", "n_ctx"), 2048),
    ("llama-server", ("/props", "default_generation_settings", "params", "dry_multiplier"), 0.8),
    ("llama-server", ("/props", "build_info"), "b8682-abd"),
    ("vllm", ("/v1/models", "data", 0, "root"), "lab/m-2"),
    ("vllm", ("/v1/models", "data", 0, "max_model_len"), 4096),
    ("vllm", ("/v1/models", "data", 0, "parent"), "lab/base"),
    ("vllm", ("/version", "version"), "0.12.0"),
    ("ollama", ("/api/tags", "models", 0, "digest"), "aaaa"),
    ("ollama", ("/api/show", "template"), "{{ .System }}"),
    ("ollama", ("/api/show", "parameters"), "num_ctx 2048"),
    ("lm-studio", ("/api/v0/models", "data", 0, "quantization"), "Q8_0"),
    ("generic", ("/v1/models", "data", 0, "context_window"), 4096),
]
ALIKE: list[tuple[Kind, tuple[Any, ...], Any]] = [
    ("llama-server", ("/v1/models", "data", 0, "created"), 1760000000),
    ("llama-server", ("/props", "model_path"), "/mnt/elsewhere/tiny.gguf"),
    ("llama-server", ("/props", "media_marker"), "<__media_2__>"),
    ("llama-server", ("/props", "total_slots"), 4),
    ("llama-server", ("/props", "default_generation_settings", "id_task"), 7),
    ("vllm", ("/v1/models", "data", 0, "created"), 1760000000),
    ("vllm", ("/v1/models", "data", 0, "permission", 0, "id"), "modelperm-2"),
    ("ollama", ("/api/tags", "models", 0, "modified_at"), "2026-02-02"),
    ("ollama", ("/api/tags", "models", 1, "digest"), "another model's"),
    ("lm-studio", ("/api/v0/models", "data", 0, "state"), "not-loaded"),
    ("generic", ("/v1/models", "data", 0, "status", "value"), "idle"),
]


@pytest.mark.parametrize(("kind", "steps", "to"), OTHER)
def test_what_is_served_otherwise_is_another_model(
    kind: Kind, steps: tuple[Any, ...], to: Any
) -> None:
    paths = SERVERS[kind]
    assert digest(identity(kind, paths)) != digest(identity(kind, changed(paths, *steps, to=to)))


@pytest.mark.parametrize(("kind", "steps", "to"), ALIKE)
def test_what_a_new_start_changes_is_the_same_model(
    kind: Kind, steps: tuple[Any, ...], to: Any
) -> None:
    paths = SERVERS[kind]
    assert identity(kind, paths) == identity(kind, changed(paths, *steps, to=to))


@pytest.mark.parametrize("kind", SERVERS)
def test_a_server_that_states_nothing_more_is_opened_all_the_same(kind: Kind) -> None:
    assert identity(kind, {"/v1/models": {"data": [{"id": "m"}]}})["listed"] == {"id": "m"}
    places = ("/props", "/version", "/api/version", "/api/tags", "/api/show", "/api/v0/models")
    odd: Paths = {path: [3] for path in places}
    assert "states" not in identity(kind, {"/v1/models": {"data": [{"id": "m"}]}, **odd})


def test_two_servers_with_other_templates_are_one_line_that_says_in_what_they_differ() -> None:
    other = changed(LLAMA, "/props", "chat_template", to="short")
    with (
        serving(lambda a: None, answering(LLAMA)) as one,
        serving(lambda a: None, answering(other)) as two,
    ):
        where = Server((one.url, two.url), "llama-server", key_env="NO_KEY")
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m", server=where)
        with pytest.raises(
            UserError, match=r"chat_template=sha256:\w+…?, and server .* chat_template=short; serve"
        ):
            openai_backend.open(card)


def test_a_run_of_an_earlier_version_is_of_the_same_model_as_far_as_it_says(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It did not store what a server states, which is no other model;
    what it stored must be the same.
    """
    now = identity("llama-server", LLAMA)
    before = {key: value for key, value in now.items() if key != "states"}
    other = {**now, "states": {**now["states"], "meta.size": 1}}
    assert same_model(before, now)
    assert same_model(now, now)
    assert not same_model(now, other)
    assert not same_model(now, before)
    assert not same_model(before, {**now, "version": "b1"})
    assert same_model({**before, "helpers": [before]}, {**now, "helpers": [now]})
    for stored, here in ((now, now), (before, now), ({"helpers": [before]}, {"helpers": [now]})):
        say_newly_stated(f"run {len(stored)}", stored, here)
        says_more = "its model states more now than then" in capsys.readouterr().err
        assert says_more == (stored != here)
    assert not same_model({**now, "helpers": [now]}, {**now, "helpers": [other]})
    assert not same_model({**before, "helpers": [before]}, now)
    assert not same_model({**before, "helpers": 3}, {**now, "helpers": [now]})


# -- the cache follows -----------------------------------------------------------------------------


def request(name: str = "s/v1") -> Request:
    return Request(name, "ego", ({"role": "user", "content": name},), ("A", "B"), 8)


def test_swapped_weights_are_asked_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    paths, texts = dict(LLAMA), ["one", "two"]

    def asked_once() -> tuple[str, bool]:
        backend = cached(opened(there.url, "llama-server"), card, tmp_path / "kept")
        [done] = backend.complete([request()])
        return done.text, done.cached

    with serving(
        lambda asked: asked.reply(completion(texts[0])), lambda a: answering(paths)(a)
    ) as there:
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m")
        assert asked_once() == ("one", False)
        assert asked_once() == ("one", True)
        texts.reverse()
        paths |= changed(LLAMA, "/v1/models", "data", 0, "meta", "size", to=4000)
        assert asked_once() == ("two", False)
    assert capfd.readouterr().err == "", "a server that tells its weights is not doubted"


@pytest.mark.parametrize("kind", ["generic", "vllm", "lm-studio", "llama-cpp-python"])
def test_a_server_that_cannot_tell_its_weights_is_doubted_once_and_where_it_matters(
    kind: Kind, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with serving(lambda asked: asked.reply(completion("one")), answering(SERVERS[kind])) as there:
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m")
        for name in ("a", "b"):
            cached(opened(there.url, kind), card, tmp_path / "kept").complete([request(name)])
        assert capfd.readouterr().err == "", "nothing came from the cache"
        for _ in range(2):
            cached(opened(there.url, kind), card, tmp_path / "kept").complete([request("a")])
    assert capfd.readouterr().err == (
        "harness: model 'mine': some answers come from the completion cache, and its server does "
        "not say which weights it has; if these have changed since, use --no-cache\n"
    )


# -- hostile servers -------------------------------------------------------------------------------

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


STATED = given(st.dictionaries(st.text(), json_values), st.sampled_from([*SERVERS]))


@pytest.mark.slow
@settings(max_examples=8)
@STATED
def test_whatever_is_stated_is_a_short_identity(facts: dict[str, Any], kind: Kind) -> None:
    is_short(facts, kind)


@pytest.mark.exhaustive
@STATED
def test_whatever_is_stated_of_more_is_a_short_identity(facts: dict[str, Any], kind: Kind) -> None:
    is_short(facts, kind)


def is_short(facts: dict[str, Any], kind: Kind) -> None:
    import asyncio

    from harness.backends.openai.http import Reply

    async def ask(path: str, content: bytes | None) -> Reply:
        return Reply(
            {**facts, "models": [facts], "data": [facts], "default_generation_settings": facts}
        )

    model = asyncio.run(read_statement(kind, "m", {"data": [{**facts, "id": "m"}]}, ask))
    text = canonical_json([model.listed, model.version, dict(model.states)])
    assert len(model.states) <= 64
    assert len(text) < 64 * 500
    assert json.loads(text) == [model.listed, model.version, dict(model.states)]


def test_a_length_beyond_any_number_is_text() -> None:
    listed = identity(
        "vllm", {"/v1/models": {"data": [{"id": "m", "max_model_len": 10**300, "root": {"a": 1}}]}}
    )
    assert listed["listed"]["max_model_len"].startswith("1000")
    assert listed["listed"]["root"] == "{'a': 1}"


def test_a_thousand_facts_are_few_and_none_is_lost() -> None:
    facts = {f"k{n}": n for n in range(1000)}
    assert len(_flat(facts)) == 64
    assert _flat(facts) != _flat({**facts, "k999": -1})
    deep: Any = 1
    for _ in range(50):
        deep = {"a": deep}
    assert [*_flat(deep)] == ["a.a.a.a"]
    assert _flat({"n": 10**400, "x": float("nan")}) == {"n": _flat({"n": 10**400})["n"], "x": "NaN"}


def test_a_server_that_is_still_loading_states_less() -> None:
    whole = Model({"id": "m"}, "1", {"n_ctx": 1})
    assert whole.covers(whole)
    assert Model({"id": "m"}, "2", {"n_ctx": 2, "file": "f"}).covers(whole)
    for part in (
        Model(None, "1", {"n_ctx": 1}),
        Model({"id": "m"}, None, {"n_ctx": 1}),
        Model({"id": "m"}, "1"),
    ):
        assert not part.covers(whole)
