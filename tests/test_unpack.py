"""A GGUF file of another architecture than Qwen's, opened by transformers as llama.cpp opens it."""

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import some

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_llama

from harness.backends import cards, weights
from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.registry import missing
from harness.backends.registry import open_backend as _open
from harness.backends.tokens import counter
from harness.core.errors import UserError
from harness.core.files import sha256_file

ACTIONS = ("SLOWER", "IDLE", "FASTER")
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "checkpoints"


def open_backend(card: Card, **options: Any) -> Any:
    return _open(card, **options)


def asked(n: int) -> Request:
    messages = ({"role": "system", "content": "You drive."},
                {"role": "user", "content": f"Speed  1{n} m/s,\n\n  4{n} m é{'x ' * n}"})  # fmt: skip
    return Request(str(n), "ego", messages, ACTIONS, 12)


@pytest.mark.parametrize("kind", some(["F32"], exhaustive=["Q8_0"]))
def test_both_engines_read_the_same_file(kind: str, tmp_path: Path, cache: Path) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    file = tiny_llama.build(tmp_path / "tiny.gguf", kind)
    here, there = (
        open_backend(cards.resolve(str(file), engine), device="cpu")
        for engine in ("transformers", "llama-cpp")
    )
    questions = [asked(n) for n in range(6)]
    assert here.rendered(questions) == there.rendered(questions)
    assert [here.tokens(q) for q in questions] == [
        there.chat.encode(p) for p in there.rendered(questions)
    ]
    rows = len(here.chat.tokenizer.hub)
    ours, theirs = (
        np.concatenate([b.next_log_probs([q], rows) for q in questions]) for b in (here, there)
    )
    # llama.cpp rounds what a quantised matrix is multiplied with.
    assert np.abs(ours - theirs).max() < {"F32": 1e-3, "Q8_0": 0.1}[kind]
    assert here.engine.stops == [2]
    assert here.engine.context_tokens == 512
    if kind == "F32":
        texts = [[answer.text for answer in b.complete(questions)] for b in (here, there)]
        assert texts[0] == texts[1]
    told = here.identity()
    assert (told["dtype"], told["gguf_sha256"]) == ("float32", sha256_file(file))
    assert [path.name for path in cache.iterdir() if not path.name.startswith(".")] == [
        here.engine.where.name
    ]


def test_it_is_unpacked_once_and_another_file_anew(tmp_path: Path, cache: Path) -> None:
    file = tiny_llama.build(tmp_path / "tiny.gguf")
    card = cards.resolve(str(file), "transformers")
    first = open_backend(card).engine.where
    written = (first / "model.safetensors").stat().st_mtime_ns
    assert open_backend(card).engine.where == first
    assert (first / "model.safetensors").stat().st_mtime_ns == written
    tiny_llama.build(file, "Q4_1")
    assert open_backend(card).engine.where != first


def test_what_a_killed_process_left_is_no_checkpoint(tmp_path: Path, cache: Path) -> None:
    card = cards.resolve(str(tiny_llama.build(tmp_path / "tiny.gguf")), "transformers")
    whole = open_backend(card).engine.where
    half = whole.with_name(f".{whole.name}.part")
    os.rename(whole, half)
    (half / "model.safetensors").unlink()
    assert open_backend(card).complete([asked(0)])[0].error is None
    assert not half.exists()


def test_the_card_says_what_the_file_says_of_itself(tmp_path: Path) -> None:
    file = tiny_llama.build(tmp_path / "tiny.gguf")
    for engine in (None, "transformers"):
        card = cards.resolve(str(file), engine)
        assert card.engine == (engine or "llama-cpp")
        assert (card.description, card.licence) == ("Local GGUF file: Tiny Llama", "mit")
        assert missing(card) is None
        assert counter(None, card)([{"content": "17  the"}]) == 5
    with pytest.raises(UserError, match="runs on llama-cpp; leave it out"):
        cards.resolve(str(file), "openai")


def test_the_digest_is_the_gguf_files(tmp_path: Path) -> None:
    file = tiny_llama.build(tmp_path / "tiny.gguf")
    card = replace(cards.resolve(str(file), "transformers"), sha256=sha256_file(file))
    assert open_backend(card).identity()["engine"] == "transformers"
    with pytest.raises(UserError, match=r"tiny\.gguf is not what its card says"):
        open_backend(replace(card, sha256="0" * 64))


@pytest.mark.parametrize(
    ("settings", "spoil", "said"),
    [
        ({"template": None}, None, 
            "has no chat template; give the GGUF "
            "file of its instruct version"),
        ({"pre": "of-my-own"}, None, "has the pre-tokeniser of-my-own, which is not known here"),
        ({"architecture": "odd"}, None, 
            "does not load with transformers: "
            ".*odd.*; run it on llama-cpp"),
        ({}, lambda data: data[:200], 
            "does not load: a text is longer than "
            "the file; copy or download"),
        ({}, lambda data: b"", "does not load: it ends before"),
        ({}, lambda data: data[:-4000], "does not load with transformers: "),
        (
            {}, lambda data: data.replace(b"blk.1.ffn_up.weight", b"blk.1.ffn_xx.weight"),
            "lacks 1 of its weights",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_unpacked_is_one_line_and_leaves_nothing(
    settings: dict[str, Any],
    spoil: Callable[[bytes], bytes] | None,
    said: str,
    tmp_path: Path,
    cache: Path,
) -> None:
    file = tiny_llama.build(tmp_path / "tiny.gguf", **settings)
    if spoil:
        file.write_bytes(spoil(file.read_bytes()))
    with pytest.raises(UserError) as caught:
        open_backend(cards.resolve(str(file), "transformers"))
    assert re.search(said, str(caught.value)), caught.value
    assert "\n" not in str(caught.value)
    assert not [path for path in cache.iterdir() if path.is_dir()]


def test_a_cache_that_cannot_be_written_is_one_line(tmp_path: Path, cache: Path) -> None:
    file = tiny_llama.build(tmp_path / "tiny.gguf")
    cache.parent.write_text("a file")
    with pytest.raises(
        UserError, match=r"its checkpoint cannot be written: .*SWARMDRIVE_CACHE names another"
    ):
        open_backend(cards.resolve(str(file), "transformers"))


def test_a_file_on_the_hub_may_run_on_transformers_too(tmp_path: Path) -> None:
    card = replace(cards.resolve("a/b"), file="m.gguf")
    with pytest.raises(UserError, match="harness model pull a/b"):
        weights.find_weights(card)
