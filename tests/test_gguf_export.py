"""A saved Qwen3 as a GGUF file: what is in it, and what is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_qwen3
from gguf import GGUFReader, TokenType

from harness.backends.gguf_export import export
from harness.backends.tokens import tokenizer
from harness.core.errors import UserError

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny-qwen3")


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    """A checkpoint to spoil."""
    return Path(shutil.copytree(tiny, tmp_path / "copy"))


def weights_of(folder: Path) -> dict[str, Any]:
    from safetensors.torch import load_file

    return dict(load_file(folder / "model.safetensors"))


def save_weights(folder: Path, weights: dict[str, Any]) -> None:
    from safetensors.torch import save_file

    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})


def edit(folder: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((folder / name).read_text())
    change(content)
    (folder / name).write_text(json.dumps(content))


def tensors(file: Path) -> dict[str, Any]:
    return {t.name: t.data for t in GGUFReader(file).tensors}


def texts(file: Path, key: str) -> Any:
    return GGUFReader(file).fields[f"tokenizer.ggml.{key}"].contents()


def test_every_weight_is_there_under_llama_cpps_name_to_the_bit(tiny: Path, tmp_path: Path) -> None:
    export(tiny, tmp_path / "tiny.gguf", "F32")
    theirs, ours = weights_of(tiny), tensors(tmp_path / "tiny.gguf")
    assert len(ours) == len(theirs)
    for name, theirs_name in {
        "token_embd": "model.embed_tokens",
        "output_norm": "model.norm",
        "output": "lm_head",
        "blk.1.attn_norm": "model.layers.1.input_layernorm",
        "blk.1.attn_q": "model.layers.1.self_attn.q_proj",
        "blk.0.attn_k_norm": "model.layers.0.self_attn.k_norm",
        "blk.0.attn_output": "model.layers.0.self_attn.o_proj",
        "blk.1.ffn_norm": "model.layers.1.post_attention_layernorm",
        "blk.1.ffn_down": "model.layers.1.mlp.down_proj",
    }.items():
        np.testing.assert_array_equal(
            ours[f"{name}.weight"], theirs[f"{theirs_name}.weight"].numpy()
        )


def test_f16_is_the_nearest_half_and_vectors_stay_whole(tiny: Path, tmp_path: Path) -> None:
    export(tiny, tmp_path / "tiny.gguf")
    theirs, ours = weights_of(tiny), tensors(tmp_path / "tiny.gguf")
    matrix = theirs["model.layers.0.mlp.up_proj.weight"].numpy()
    np.testing.assert_array_equal(ours["blk.0.ffn_up.weight"], matrix.astype(np.float16))
    vector = ours["blk.0.ffn_norm.weight"]
    assert (vector.dtype, vector.shape) == (np.float32, (32,))


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_a_checkpoint_of_half_the_bits_is_read_as_torch_reads_it(copy: Path, dtype: str) -> None:
    import torch

    halved = {name: tensor.to(getattr(torch, dtype)) for name, tensor in weights_of(copy).items()}
    save_weights(copy, halved)
    export(copy, copy / "tiny.gguf", "F32")
    np.testing.assert_array_equal(
        tensors(copy / "tiny.gguf")["output.weight"], halved["lm_head.weight"].float().numpy()
    )


def test_a_tied_head_is_left_out_and_llama_cpp_takes_the_embedding(copy: Path) -> None:
    edit(copy, "config.json", lambda c: c.update(tie_word_embeddings=True))
    save_weights(copy, {n: t for n, t in weights_of(copy).items() if n != "lm_head.weight"})
    export(copy, copy / "tiny.gguf")
    assert "output.weight" not in tensors(copy / "tiny.gguf")


def test_tokens_have_their_ids_and_kinds_and_rows_without_one_are_unused(copy: Path) -> None:
    import torch

    weights = weights_of(copy)
    for name in ("model.embed_tokens.weight", "lm_head.weight"):
        weights[name] = torch.cat([weights[name], torch.zeros(2, 32)])
    save_weights(copy, weights)
    rows = weights["lm_head.weight"].shape[0]
    edit(copy, "config.json", lambda c: c.update(vocab_size=rows))
    export(copy, copy / "tiny.gguf")
    tokens, types = texts(copy / "tiny.gguf", "tokens"), texts(copy / "tiny.gguf", "token_type")
    kinds = {t: TokenType(k).name for t, k in zip(tokens, types, strict=True)}
    assert kinds["<|im_end|>"] == kinds["<|endoftext|>"] == "CONTROL"
    assert kinds["<think>"] == kinds["</think>"] == "USER_DEFINED"
    assert kinds["x"] == "NORMAL"
    assert tokens[-2:] == [f"[PAD{rows - 2}]", f"[PAD{rows - 1}]"]
    assert kinds[tokens[-1]] == "UNUSED"
    assert texts(copy / "tiny.gguf", "eos_token_id") == tokens.index("<|im_end|>")
    assert texts(copy / "tiny.gguf", "padding_token_id") == tokens.index("<|endoftext|>")
    assert texts(copy / "tiny.gguf", "pre") == "qwen2"


def test_the_file_counts_tokens_as_the_folder_does(tiny: Path, tmp_path: Path) -> None:
    export(tiny, tmp_path / "tiny.gguf")
    text = "<|im_start|>system\nYou drive. <think>14 m, don't</think>\n\n 日本 é<|im_end|>\n"
    assert tokenizer(tmp_path / "tiny.gguf").encode(text).ids == tokenizer(tiny).encode(text).ids


def set_config(**values: Any) -> Callable[[Path], None]:
    return lambda folder: edit(folder, "config.json", lambda c: c.update(values))


def set_tokenizer(**values: Any) -> Callable[[Path], None]:
    return lambda folder: edit(folder, "tokenizer.json", lambda c: c.update(values))


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def truncate(folder: Path) -> None:
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-1000])


def lose_a_layer(folder: Path) -> None:
    weights = weights_of(folder)
    del weights["model.layers.1.mlp.up_proj.weight"]
    save_weights(folder, weights)


def grow_a_number(folder: Path) -> None:
    weights = weights_of(folder)
    weights["lm_head.weight"][3, 3] = 1e5
    save_weights(folder, weights)


def strip_spaces(folder: Path) -> None:
    edit(folder, "tokenizer.json", lambda t: t["added_tokens"][-1].update(rstrip=True))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (remove("config.json"), "has no config.json; give the folder"),
        (remove("model.safetensors"), "has no model.safetensors"),
        (remove("tokenizer.json"), "has no tokenizer.json"),
        (remove("chat_template.jinja"), "has no chat template; put a chat_template.jinja"),
        (
            set_config(architectures=["LlamaForCausalLM"]),
            "LlamaForCausalLM.*; only Qwen3ForCausalLM",
        ),
        (set_config(attention_bias=True), "attention_bias = True; only False"),
        (
            set_config(rope_parameters={"rope_type": "yarn", "rope_theta": 1e4}),
            "scales its rope .yarn.",
        ),
        (set_config(vocab_size=300), "its tokenizer has 375 tokens and the model only 300"),
        (
            set_tokenizer(pre_tokenizer={"type": "ByteLevel"}),
            "splits text otherwise than Qwen2's; llama.cpp",
        ),
        (set_tokenizer(pre_tokenizer=None), "splits text otherwise"),
        (set_tokenizer(normalizer={"type": "Lowercase"}), "normalises text otherwise"),
        (set_tokenizer(model={"type": "Unigram"}), "is no plain BPE"),
        (strip_spaces, "takes spaces or whole words with </think>"),
        (
            lambda folder: (folder / "config.json").write_text("{"),
            "cannot be exported: JSONDecodeError",
        ),
        (lambda folder: (folder / "config.json").write_text("[]"), "cannot be exported: TypeError"),
        (set_config(rms_norm_eps=None), "cannot be exported"),
        (truncate, "cannot be exported: ValueError: mmap length"),
        (lose_a_layer, "lacks model.layers.1.mlp.up_proj.weight"),
        (grow_a_number, "output.weight has numbers past the range of F16; export it as F32"),
    ],
)
def test_what_cannot_be_exported_is_one_line_and_the_old_file_stays(
    copy: Path, spoil: Callable[[Path], object], said: str
) -> None:
    spoil(copy)
    (copy / "old.gguf").write_text("old")
    with pytest.raises(UserError, match=said) as caught:
        export(copy, copy / "old.gguf")
    assert str(copy) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (copy / "old.gguf").read_text() == "old"
    assert not list(copy.glob(".*"))


def test_the_same_checkpoint_gives_the_same_bytes(tiny: Path, tmp_path: Path) -> None:
    export(tiny, tmp_path / "a.gguf")
    export(tiny, tmp_path / "b.gguf")
    assert (tmp_path / "a.gguf").read_bytes() == (tmp_path / "b.gguf").read_bytes()
