"""The transformers engine, played on a real tiny Qwen3 with random weights."""

import json
import os
import pickle
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_qwen3
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.backends.base import Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.cards import load, resolve
from harness.backends.chat import HubTokenizer
from harness.backends.language_model import LanguageModel
from harness.backends.registry import missing, open_backend
from harness.backends.weights import find_checkpoint
from harness.core import cores
from harness.core.errors import UserError
from harness.core.plugins import say_once

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny-qwen3")


@pytest.fixture(scope="module")
def backend(tiny: Path) -> LanguageModel:
    return open_tiny(tiny)


def open_tiny(folder: Path, batch_size: int = 8, **options: str | None) -> LanguageModel:
    opened = open_backend(resolve(str(folder)), batch_size=batch_size, device="cpu", **options)
    assert isinstance(opened, LanguageModel)
    return opened


def ask(i: int, *, max_tokens: int = 24, thinking: bool = False, text: str = "") -> Request:
    """Scene i: the prompts differ in length, and the answers in where they stop."""
    messages = (
        {"role": "system", "content": "You drive."},
        {"role": "user", "content": text or f"Scene {i * 'x'}: truck {i * 7} m"},
    )
    return Request(
        f"s{i}/ego", "ego", messages, ("SLOWER", "IDLE", "FASTER"), max_tokens, thinking=thinking
    )


REQUESTS = [ask(i) for i in (9, 0, 5, 15, 3, 11, 1, 12, 7)]


def said(completions: list[Completion]) -> list[tuple[object, ...]]:
    return [
        (c.request_id, c.text, c.prompt_tokens, c.completion_tokens, c.finish_reason)
        for c in completions
    ]


# -- answers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "batch_size", [3, *(pytest.param(size, marks=pytest.mark.exhaustive) for size in (1, 8))]
)
def test_a_batch_says_what_each_request_alone_would_in_the_order_asked(
    tiny: Path, batch_size: int
) -> None:
    one = open_tiny(tiny, batch_size=1)
    alone = [one.complete([request])[0] for request in REQUESTS]
    together = open_tiny(tiny, batch_size=batch_size).complete(REQUESTS)
    assert [c.request_id for c in together] == [r.id for r in REQUESTS]
    assert said(together) == said(alone)
    assert len({c.text for c in alone}) > 5, "answers that are all alike would show no order"


@settings(max_examples=5, deadline=None)
@given(st.lists(st.builds(ask, st.integers(0, 15), max_tokens=st.integers(1, 12)), max_size=6))
def test_company_never_changes_an_answer(backend: LanguageModel, requests: list[Request]) -> None:
    alone = [backend.complete([request])[0] for request in requests]
    assert said(backend.complete(requests)) == said(alone)


def test_an_answer_ends_with_its_stop_token_or_is_cut_off(backend: LanguageModel) -> None:
    answers = backend.complete(REQUESTS)
    assert {c.finish_reason for c in answers} == {"stop", "length"}
    for c in answers:
        assert c.completion_tokens is not None
        if c.finish_reason == "length":
            assert c.completion_tokens == 24
        # The stop token counts, and is no part of the text.
        assert tiny_qwen3.IM_END not in c.text


def test_one_token_less_than_a_stopped_answer_needs_is_a_cut_off_answer(
    backend: LanguageModel,
) -> None:
    [whole] = backend.complete([ask(0)])
    assert whole.finish_reason == "stop"
    assert whole.completion_tokens is not None
    [exact, cut] = backend.complete(
        [ask(0, max_tokens=whole.completion_tokens), ask(0, max_tokens=whole.completion_tokens - 1)]
    )
    assert (exact.text, exact.finish_reason) == (whole.text, "stop")
    # All of the text was there; only the stop token was not.
    assert (cut.text, cut.finish_reason) == (whole.text, "length")


def test_tokens_in_are_the_rendered_prompts(backend: LanguageModel) -> None:
    [answer] = backend.complete([ask(4)])
    prompt = backend.chat.render(ask(4).messages, thinking=False)
    assert answer.prompt_tokens == len(backend.chat.encode(prompt))
    assert isinstance(backend.chat.tokenizer, HubTokenizer)
    assert backend.chat.tokenizer.hub.decode(backend.chat.encode(prompt)) == prompt


def test_think_tags_stay_in_the_text_and_special_tokens_do_not(backend: LanguageModel) -> None:
    assert any("<think>" in c.text for c in backend.complete(REQUESTS))
    ids = backend.chat.encode("<think>slow</think>IDLE<|im_end|>")
    assert backend.chat.decode(ids) == "<think>slow</think>IDLE"


def test_the_thinking_switch_alters_the_prompt(backend: LanguageModel) -> None:
    assert backend.chat.thinking == "switch"
    on = backend.chat.render(ask(0).messages, thinking=True)
    off = backend.chat.render(ask(0).messages, thinking=False)
    assert on.endswith("<|im_start|>assistant\n")
    assert off == on + "<think>\n\n</think>\n\n"
    [thought, plain] = backend.complete([ask(0, thinking=True), ask(0)])
    assert thought.prompt_tokens != plain.prompt_tokens
    assert thought.text != plain.text


def test_a_template_without_the_switch_is_rendered_as_it_is(tmp_path: Path) -> None:
    bare = tiny_qwen3.build(
        tmp_path / "bare", template="{{ messages | map(attribute='content') | join }}>"
    )
    opened = open_tiny(bare)
    assert opened.chat.thinking == "none"
    said = "".join(message["content"] for message in ask(0).messages)
    assert opened.chat.render(ask(0).messages, thinking=True) == f"{said}>"
    always = tiny_qwen3.build(tmp_path / "always", template="{{ messages[0].content }}<think>\n")
    assert open_tiny(always).chat.thinking == "always"


def test_seconds_belong_to_an_answer_that_was_asked_alone(tiny: Path) -> None:
    answers = open_tiny(tiny, batch_size=2).complete([ask(0), ask(1), ask(2)])
    assert sorted(c.batch_size for c in answers) == [1, 2, 2]
    for c in answers:
        if c.batch_size == 1:
            assert c.seconds is not None
            assert c.seconds > 0
        else:
            assert c.seconds is None


def test_no_requests_no_completions(backend: LanguageModel) -> None:
    assert backend.complete([]) == []


# -- failures that are data ------------------------------------------------------------------------


def test_a_prompt_that_leaves_no_room_is_an_error_and_its_neighbours_are_answered(
    backend: LanguageModel,
) -> None:
    long = ask(1, text="truck " * 600)
    first, over, last = backend.complete([ask(0), long, ask(2)])
    assert (over.request_id, over.text, over.finish_reason) == ("s1/ego", "", "error")
    assert over.prompt_tokens is not None
    assert over.error == (
        f"context overflow: {over.prompt_tokens + 24} tokens > 512 "
        f"({over.prompt_tokens} in the prompt, 24 for the answer)"
    )
    assert said([first, last]) == said(backend.complete([ask(0), ask(2)]))


def test_a_context_is_full_at_its_last_token_and_the_cards_bound_comes_first(tiny: Path) -> None:
    tokens = open_tiny(tiny).complete([ask(0)])[0].prompt_tokens
    assert tokens is not None
    card = replace(resolve(str(tiny)), context_tokens=tokens + 24)
    fits, over = open_backend(card, device="cpu").complete([ask(0), ask(0, max_tokens=25)])
    assert fits.error is None
    assert over.finish_reason == "error"
    assert f"{tokens + 25} tokens > {tokens + 24}" in str(over.error)


def test_a_request_that_breaks_the_engine_takes_nobody_with_it(tiny: Path) -> None:
    """A token past the last embedding row fails the batch;
    asked again alone, only its owner fails.
    """
    opened = open_tiny(tiny)
    assert isinstance(opened.chat.tokenizer, HubTokenizer)
    opened.chat.tokenizer.hub.add_tokens(["<boom>"])
    before, broken, after = opened.complete([ask(0), ask(1, text="<boom>"), ask(2)])
    assert (broken.text, broken.finish_reason, broken.seconds) == ("", "error", None)
    assert "IndexError" in str(broken.error)
    assert said([before, after]) == said(opened.complete([ask(0), ask(2)]))
    assert (before.batch_size, after.batch_size) == (1, 1)


def test_ctrl_c_is_no_engine_failure(tiny: Path) -> None:
    def press(*_: object) -> None:
        raise KeyboardInterrupt

    opened = open_tiny(tiny)
    engine: Any = opened.engine
    engine.model.register_forward_pre_hook(press)
    with pytest.raises(KeyboardInterrupt):
        opened.complete([ask(0)])


# -- what a user can get wrong ---------------------------------------------------------------------


def remove(pattern: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        for path in folder.glob(pattern):
            path.unlink()

    return act


def truncate(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:20_000])


def lose_a_layer(folder: Path) -> None:
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    del weights["model.layers.1.mlp.up_proj.weight"]
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})


def grow_the_vocabulary(folder: Path) -> None:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder)
    tokenizer.add_tokens(["<boom>"])
    tokenizer.save_pretrained(folder)


class Trap:
    """Code in a pickle."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("caught",)


def test_a_pickle_is_refused_in_one_line_and_runs_no_code(
    tiny: Path, tmp_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    folder = shutil.copytree(tiny, tmp_path / "pickled")
    remove("*.safetensors")(folder)
    (folder / "pytorch_model.bin").write_bytes(pickle.dumps(Trap()))
    code, out, err = harness("eval", "--model", folder, "--limit", 1, "--seeds", "0")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "has no weights (*.safetensors)" in err
    (folder / "adapter.safetensors").write_bytes(b"")  # which is no reason to read the pickle
    code, out, err = harness("eval", "--model", folder, "--limit", 1, "--seeds", "0")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "does not load" in err
    assert not list(tmp_path.rglob("caught"))


def own_config(folder: Path) -> None:
    """A configuration and a model of the checkpoint's own code."""
    change(folder / "config.json", auto_map={"AutoConfig": "own.Own"}, model_type="own")


def own_model(folder: Path) -> None:
    change(
        folder / "config.json", auto_map={"AutoModelForCausalLM": "own.Own"}, architectures=["Own"]
    )


def own_tokenizer(folder: Path) -> None:
    owned = {"AutoTokenizer": ["own.Own", "own.Own"]}
    change(folder / "tokenizer_config.json", auto_map=owned, tokenizer_class="Own")


def kernel_of_the_hub(folder: Path) -> None:
    change(folder / "config.json", attn_implementation="kernels-community/flash-attn")


def thousand_million_layers(folder: Path) -> None:
    change(folder / "config.json", num_hidden_layers=10**9)


def change(file: Path, **values: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (own_config, "does not load"),
        (own_model, ""),  # loaded by transformers' own class
        (own_tokenizer, ""),
        (
            kernel_of_the_hub,
            "names code of the hub, which is never run",
        ),
        (
            thousand_million_layers,
            "num_hidden_layers in its config.json is 1000000000, and at most 10000",
        ),
    ],
)
def test_no_code_of_a_checkpoint_is_run(
    tiny: Path, tmp_path: Path, changed: Callable[[Path], None], said: str
) -> None:
    folder = shutil.copytree(tiny, tmp_path / "with-code")
    changed(folder)
    (folder / "own.py").write_text(
        f"import os\nos.mkdir({str(tmp_path / 'caught')!r})\nclass Own: pass\n"
    )
    if said:
        with pytest.raises(UserError, match=said):
            open_tiny(folder)
    else:
        open_tiny(folder)
    assert not (tmp_path / "caught").exists()


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (remove("config.json"), ["has no config.json"]),
        (remove("*.safetensors"), ["has no weights", "*.safetensors"]),
        (remove("tokenizer*"), ["has no tokenizer", "tokenizer.json"]),
        (truncate, ["does not load", "incomplete metadata"]),
        (lose_a_layer, ["lacks 1 of its weights", "layers.1.mlp.up_proj"]),
        (grow_the_vocabulary, ["its tokenizer has", "one checkpoint"]),
        (remove("chat_template.jinja"), ["has no chat template", "instruct version"]),
        (
            lambda folder: (folder / "config.json").write_text("{"),
            ["does not load", "not a valid JSON"],
        ),
    ],
)
def test_a_spoilt_checkpoint_is_one_line_with_what_and_where(
    tiny: Path, tmp_path: Path, spoil: Callable[[Path], object], what: list[str]
) -> None:
    card = resolve(str(tiny))
    folder = tmp_path / "spoilt"
    shutil.copytree(tiny, folder)
    spoil(folder)
    with pytest.raises(UserError) as caught:
        open_backend(replace(card, name="spoilt", weights=str(folder)), device="cpu")
    message = str(caught.value)
    assert "\n" not in message
    for part in ["'spoilt'", str(folder), *what]:
        assert part in message


def test_weights_that_are_nowhere_say_where_they_were_looked_for_and_how_to_get_them() -> None:
    from huggingface_hub import constants

    card = replace(resolve("nobody/no-such-model"), revision="v9")
    with pytest.raises(UserError) as caught:
        open_backend(card)
    pull = "`harness model pull nobody/no-such-model`"
    for part in ("'nobody/no-such-model'", "'v9'", constants.HF_HUB_CACHE, pull):
        assert part in str(caught.value)
    assert missing(card) == "weights"


def test_a_directory_that_has_gone_is_said_so(tmp_path: Path) -> None:
    card = Card(
        "gone", "transformers", "d", Latency("paper", None, "b"), weights=str(tmp_path / "gone")
    )
    with pytest.raises(UserError, match=r"no directory .*gone'.*give another directory"):
        open_backend(card)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "tpu"}, "device 'tpu'; this machine has: cpu"),
        ({"dtype": "float8"}, "dtype 'float8'; allowed: float32, bfloat16, auto"),
        ({"batch_size": 0}, "batch size 0; allowed: 1 or more"),
    ],
)
def test_an_option_that_cannot_be_names_what_can(
    tiny: Path, options: dict[str, str], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        open_backend(resolve(str(tiny)), **options)  # type: ignore[arg-type]


def test_a_template_that_refuses_the_messages_is_the_users_to_know(tmp_path: Path) -> None:
    template = "{{ raise_exception('System role not supported') }}"
    with pytest.raises(UserError, match=r"refuses the messages \(System role not supported\)"):
        open_tiny(tiny_qwen3.build(tmp_path / "gruff", template=template)).complete([ask(0)])


# -- identity, place, quiet ------------------------------------------------------------------------


def test_a_local_checkpoint_is_known_by_its_files_whatever_else_lies_beside_them(
    tiny: Path, tmp_path: Path
) -> None:
    here = open_tiny(tiny).identity()
    shutil.copytree(tiny, tmp_path / "copy")
    (tmp_path / "copy" / "README.md").write_text("a copy")
    there = open_tiny(tmp_path / "copy").identity()
    assert here["files_sha256"] == there["files_sha256"]
    assert (here["engine"], here["dtype"], here["device"]) == ("transformers", "float32", "cpu")
    assert here["revision"] is None

    jinja = tmp_path / "copy" / "chat_template.jinja"
    jinja.write_text(jinja.read_text() + "{# changed #}")
    changed = open_tiny(tmp_path / "copy").identity()
    assert changed["files_sha256"] != here["files_sha256"]
    assert changed["chat_template_sha256"] != here["chat_template_sha256"]
    assert open_tiny(tiny, dtype="bfloat16").identity()["dtype"] == "bfloat16"


@pytest.mark.parametrize(
    ("processor", "typed", "dtype", "why"),
    [
        ("flags : fpu avx512_bf16 amx_bf16", None, "bfloat16", "multiplies in it (amx_bf16)"),
        ("flags : fpu avx512_bf16", "auto", "bfloat16", "multiplies in it (avx512_bf16)"),
        ("flags : fpu avx512f", None, "float32", "does not multiply in bfloat16"),
        (None, None, "float32", "does not multiply in bfloat16"),
        ("flags : fpu avx512_bf16", "float32", "float32", ""),
    ],
)
def test_a_card_without_a_number_format_takes_what_the_processor_multiplies_in_and_says_so(
    tiny: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    processor: str | None,
    typed: str | None,
    dtype: str,
    why: str,
) -> None:
    stated = tmp_path / "cpuinfo"
    if processor is not None:
        stated.write_text(processor)
    monkeypatch.setattr(cores, "CPU_INFO", stated)
    monkeypatch.setattr(cores, "BFLOAT16", ("amx_bf16", "avx512_bf16"))
    say_once.cache_clear()
    assert open_tiny(tiny, dtype=typed).identity()["dtype"] == dtype
    said = capsys.readouterr().err
    assert why in said
    assert said.count("\n") == bool(why)
    assert bool(why) == (f"dtype auto is {dtype} here" in said)


def split_into_folders(folder: Path) -> Path:
    """Split a checkpoint's weights: half of them into a folder of it. Return that half's file."""
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    (folder / "part").mkdir()
    files = ["model-1.safetensors", "part/model-2.safetensors"]
    weight_map = {name: files[number % 2] for number, name in enumerate(tensors)}
    for file in files:
        part = {name: tensor for name, tensor in tensors.items() if weight_map[name] == file}
        save_file(part, folder / file, {"format": "pt"})
    index = {"metadata": {}, "weight_map": weight_map}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    return folder / files[1]


def test_a_checkpoint_is_known_by_the_shards_in_its_folders_too(tiny: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder = shutil.copytree(tiny, tmp_path / "split")
    shard = split_into_folders(folder)
    whole = open_tiny(folder)
    digest = whole.identity()["files_sha256"]
    assert said(whole.complete(REQUESTS[:1])) == said(open_tiny(tiny).complete(REQUESTS[:1]))
    halved = {name: tensor / 2 for name, tensor in load_file(shard).items()}
    save_file(halved, shard, {"format": "pt"})
    assert open_tiny(folder).identity()["files_sha256"] != digest
    shard.unlink()
    os.mkfifo(shard)
    with pytest.raises(UserError, match=r"model-2\.safetensors cannot be read: it is no file"):
        open_tiny(folder)


def test_a_hub_checkpoint_is_found_in_the_cache_and_known_by_its_commit(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--tiny--qwen3"
    shutil.copytree(tiny, repository / "snapshots" / COMMIT)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    card = resolve("tiny/qwen3")
    assert missing(card) is None
    assert find_checkpoint(card) == repository / "snapshots" / COMMIT
    opened = open_backend(card, device="cpu")
    assert opened.identity()["revision"] == COMMIT
    assert opened.identity()["files_sha256"] is None
    assert said(opened.complete(REQUESTS)) == said(open_tiny(tiny).complete(REQUESTS))


def test_nothing_goes_over_the_network_and_nothing_is_said_on_stderr(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def shut(*_: object) -> None:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket.socket, "connect", shut)
    monkeypatch.setattr(socket, "getaddrinfo", shut)
    assert open_tiny(tiny).complete([ask(0)])[0].finish_reason == "stop"
    with pytest.raises(UserError, match="harness model pull"):
        open_backend(load("qwen3-4b"))
    assert capfd.readouterr() == ("", "")


def test_a_checkup_shows_the_prompt_its_tokens_and_one_answer_asked_alone(
    backend: LanguageModel,
) -> None:
    asked = ask(0)
    checkup = pytest.importorskip("harness.extensions.checkups.answers")
    seen = checkup.check(backend, [asked])
    assert seen.prompt == backend.chat.render(asked.messages, thinking=False)
    assert seen.tokens is not None
    assert [i for i, _ in seen.tokens] == backend.chat.encode(seen.prompt)
    assert "".join(piece for _, piece in seen.tokens) == seen.prompt
    assert (seen.thinking, seen.bos_tokens) == ("switch", 0)
    answer = seen.answers["json"]
    assert said([answer]) == said(backend.complete([asked]))
    assert answer.seconds is not None
    assert seen.identity == backend.identity()
