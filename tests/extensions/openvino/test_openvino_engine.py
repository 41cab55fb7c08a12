"""The engine openvino: what it refuses, and that it computes what the GGUF file says."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.registry import missing, open_backend
from harness.core.errors import UserError

CARD = """engine = "openvino"
description = "A model in a GGUF file"
weights = "{weights}"
[latency]
source = "paper"
basis = "none declared"
"""


def card_of(weights: Path) -> Card:
    card = cards.load("smollm2-135m:llama-cpp")
    return replace(card, engine="openvino", weights=str(weights), revision=None, sha256=None)


def test_a_gguf_file_is_opened_by_the_engine_that_is_typed(tmp_path: Path) -> None:
    (tmp_path / "mine.gguf").touch()
    engines = [
        cards.resolve(str(tmp_path / "mine.gguf"), name).engine for name in (None, "openvino")
    ]
    assert engines == ["llama-cpp", "openvino"]


def test_without_the_package_one_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harness: Callable[..., tuple[int, str, str]]
) -> None:
    spec = importlib.util.find_spec
    monkeypatch.setattr(
        "harness.backends.registry.find_spec",
        lambda name: None if name == "openvino_genai" else spec(name),
    )
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "mine.toml").write_text(CARD.format(weights=tmp_path / "a.gguf"))
    monkeypatch.chdir(tmp_path)
    code, _, err = harness("model", "check", "mine")
    assert (code, err.count("\n")) == (2, 1)
    assert "needs openvino-genai" in err
    assert "swarmdrive-harness[openvino]" in err


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"device": "gpu"}, "device 'gpu'; the engine openvino has: cpu"),
        ({"dtype": "float16"}, "dtype 'float16'; allowed: float32, bfloat16, auto"),
    ],
)
def test_an_option_that_it_does_not_have_is_refused(options: dict[str, Any], error: str) -> None:
    pytest.importorskip("openvino_genai", reason="needs the openvino extra")
    with pytest.raises(UserError, match=error):
        open_backend(card_of(Path("a.gguf")), **options)


@pytest.mark.exhaustive
def test_weights_that_are_not_read_exactly_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("openvino_genai", reason="needs the openvino extra")
    from gguf import GGMLQuantizationType, GGUFWriter

    writer = GGUFWriter(tmp_path / "a.gguf", "llama")
    kind = GGMLQuantizationType.Q4_K
    writer.add_tensor("output.weight", np.zeros((1, 144), np.uint8), raw_dtype=kind)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    with pytest.raises(UserError, match="in Q4_K; read exactly are F16, Q8_0, Q4_1; run it on"):
        open_backend(card_of(tmp_path / "a.gguf"))


@pytest.mark.exhaustive
def test_a_published_file_gives_the_distribution_that_transformers_gives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("openvino_genai", reason="needs the openvino extra")
    monkeypatch.delenv("SWARMDRIVE_CACHE")  # the weights are where `harness model pull` put them
    exact = cards.load("smollm2-135m")
    if lacking := missing(exact):
        pytest.skip(f"needs {lacking}; run `harness model pull smollm2-135m`")
    card = replace(cards.load("smollm2-135m:llama-cpp"), engine="openvino", dtype="float32")
    chats = [[{"role": "user", "content": text}] for text in ("Hi.", "Name a colour of the sky.")]
    asked = [Request(str(n), "ego", tuple(chat), ("A", "B"), 9) for n, chat in enumerate(chats)]
    log_p = []
    for one in (exact, card):
        backend = open_backend(one, device="cpu")
        log_p.append(backend.next_log_probs(asked, 49_152))  # type: ignore[attr-defined]
        assert all(completion.error is None for completion in backend.complete(asked))
    assert np.abs(log_p[0] - log_p[1]).max() < 1e-3
    assert {"dtype": "f32", "kv_cache": "f32", "int8_activations": "0"}.items() <= (
        backend.identity().items()
    )
