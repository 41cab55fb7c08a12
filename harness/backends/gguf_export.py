"""A saved Qwen3 checkpoint as a GGUF file, which llama.cpp reads; a Qwen3-VL's as two.

The second is its projector: the vision encoder, and what leads into the text part. Keys and names
there are those of llama.cpp's `conversion/qwen3vl.py` and `tools/mtmd/clip-impl.h`.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from harness.backends.cards import PROJECTOR
from harness.backends.saved_qwen3 import Saved, numbers, read, rope
from harness.core.errors import UserError, printable
from harness.core.files import replacing

Dtype = Literal["F16", "F32"]
_ENDS = {"embed_tokens": "token_embd", "norm": "output_norm"}
_BLOCK = {
    "input_layernorm": "attn_norm",
    "self_attn.q_proj": "attn_q",
    "self_attn.k_proj": "attn_k",
    "self_attn.v_proj": "attn_v",
    "self_attn.o_proj": "attn_output",
    "self_attn.q_norm": "attn_q_norm",
    "self_attn.k_norm": "attn_k_norm",
    "post_attention_layernorm": "ffn_norm",
    "mlp.gate_proj": "ffn_gate",
    "mlp.up_proj": "ffn_up",
    "mlp.down_proj": "ffn_down",
}
_FULL = "v.position_embd.weight"  # which llama.cpp interpolates as F32 only
_VISION_BLOCK = {
    "norm1": "ln1",
    "attn.qkv": "attn_qkv",
    "attn.proj": "attn_out",
    "norm2": "ln2",
    "mlp.linear_fc1": "ffn_up",
    "mlp.linear_fc2": "ffn_down",
}
_MERGER = {"norm": "v.post_ln", "linear_fc1": "mm.0", "linear_fc2": "mm.2"}
_DEEPSTACK = {"norm": "norm", "linear_fc1": "fc1", "linear_fc2": "fc2"}


def export(checkpoint: Path, out: Path, dtype: Dtype = "F16") -> None:
    """Write a saved Qwen3 or Qwen3-VL checkpoint as a GGUF file, whole or not at all.

    The folder `checkpoint` has config.json, model.safetensors (float32, float16 or bfloat16),
    tokenizer.json, a chat template and, of a Qwen3-VL, preprocessor_config.json. Its vision encoder
    becomes a file beside `out`, named `mmproj-` and the name of `out`. `dtype` is the number format
    of matrices in the file; vectors are always F32. Raises UserError for another architecture or
    tokenizer, and for files that are not whole.
    """
    subject = f"checkpoint {printable(checkpoint)}"
    try:
        saved = read(checkpoint, subject)
        name = checkpoint.resolve().name
        with ExitStack() as files:
            part = files.enter_context(replacing(out))
            architecture = "qwen3vl" if saved.vision else "qwen3"
            describe = partial(_describe, saved, name, subject)
            _write(part, checkpoint, _names(saved), dtype, subject, architecture, describe)
            if saved.vision:
                part = files.enter_context(replacing(projector_of(out)))
                describe = partial(_describe_projector, saved.vision, name)
                _write(
                    part,
                    checkpoint,
                    _projector_names(saved.vision),
                    dtype,
                    subject,
                    "clip",
                    describe,
                )
    except UserError:
        raise
    except Exception as error:  # a broken file surfaces as any of a dozen exception types
        reason = printable(f"{type(error).__name__}: {error}", 200)
        raise UserError(f"{subject} cannot be exported: {reason}; save or copy it again") from error


def projector_of(out: Path) -> Path:
    """Return the path of the vision encoder's GGUF file that goes with the file `out`."""
    return out.with_name(f"{PROJECTOR}{out.name}")


def _write(
    part: Path,
    checkpoint: Path,
    names: Mapping[str, str],
    dtype: Dtype,
    subject: str,
    architecture: str,
    describe: Callable[[Any, int], None],
) -> None:
    """Write a GGUF file of a checkpoint's tensors, whose names in it are those of `names`.

    `describe` gets the writer and the file's type, and writes what else is in the file. Raises
    UserError for a number past the range of `dtype`.
    """
    from gguf import GGUFWriter, LlamaFileType

    writer = GGUFWriter(part, architecture)
    try:
        describe(writer, LlamaFileType.MOSTLY_F16 if dtype == "F16" else LlamaFileType.ALL_F32)
        # Announced first and written in turn: no more than one matrix is in memory.
        tensors = list(_tensors(checkpoint, names, dtype, subject))
        for name, tensor, kind in tensors:
            shape = _frame(name, np.broadcast_to(np.float32(0), tensor.shape)).shape
            writer.add_tensor_info(name, shape, kind, int(np.prod(shape)) * kind.itemsize)
        writer.write_header_to_file()
        writer.write_kv_data_to_file()
        writer.write_ti_data_to_file()
        for name, tensor, kind in tensors:
            with np.errstate(over="ignore"):
                converted = _frame(name, numbers(tensor)).astype(kind)
            if not np.isfinite(converted).all():
                raise UserError(
                    f"{subject}: {name} has numbers past the range of {dtype}; export it as F32"
                )
            writer.write_tensor_data(converted)
    finally:
        writer.close()


def _describe(saved: Saved, name: str, subject: str, writer: Any, file_type: int) -> None:
    """Write what llama.cpp must know of a language model besides the weights."""
    config, tokenizer = saved.config, saved.tokenizer
    writer.add_name(name)
    writer.add_file_type(file_type)
    writer.add_vocab_size(config["vocab_size"])
    writer.add_context_length(config["max_position_embeddings"])
    writer.add_embedding_length(config["hidden_size"])
    writer.add_block_count(config["num_hidden_layers"])
    writer.add_feed_forward_length(config["intermediate_size"])
    writer.add_head_count(config["num_attention_heads"])
    writer.add_head_count_kv(config["num_key_value_heads"])
    writer.add_key_length(config["head_dim"])
    writer.add_value_length(config["head_dim"])
    writer.add_layer_norm_rms_eps(config["rms_norm_eps"])
    writer.add_rope_freq_base(rope(config)["rope_theta"])
    if saved.vision:
        writer.add_rope_dimension_sections([*rope(config)["mrope_section"], 0])
        writer.add_num_deepstack_layers(len(saved.vision["deepstack_visual_indexes"]))
    tokens, types = _vocabulary(tokenizer, config["vocab_size"], subject)
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("qwen2")
    writer.add_token_list(tokens)
    writer.add_token_types(types)
    # Pairs in newer files, "left right" in older ones.
    merges = tokenizer["model"]["merges"]
    writer.add_token_merges([m if isinstance(m, str) else " ".join(m) for m in merges])
    listed = config["eos_token_id"]
    eos = listed[0] if isinstance(listed, list) else listed
    pad = eos if config.get("pad_token_id") is None else config["pad_token_id"]
    bos = pad if config.get("bos_token_id") is None else config["bos_token_id"]
    writer.add_eos_token_id(eos)
    writer.add_pad_token_id(pad)
    writer.add_bos_token_id(bos)  # unsaid, it would be GPT-2's
    writer.add_add_bos_token(False)
    writer.add_chat_template(saved.template)


def _vocabulary(
    tokenizer: Mapping[str, Any], rows: int, subject: str
) -> tuple[list[str], list[int]]:
    """Return texts and types of all tokens, by id;
    rows of the embedding without a token are unused.
    """
    from gguf import TokenType

    tokens = {i: (text, TokenType.NORMAL) for text, i in tokenizer["model"]["vocab"].items()}
    for token in tokenizer["added_tokens"]:
        kind = TokenType.CONTROL if token["special"] else TokenType.USER_DEFINED
        tokens[token["id"]] = (token["content"], kind)
    if max(tokens) >= rows:
        raise UserError(
            f"{subject}: its tokenizer has {max(tokens) + 1} tokens and the model only {rows}"
        )
    by_row = [tokens.get(i, (f"[PAD{i}]", TokenType.UNUSED)) for i in range(rows)]
    return [text for text, _ in by_row], [int(kind) for _, kind in by_row]


def _names(saved: Saved) -> dict[str, str]:
    """Return the name of each tensor of the text part in the GGUF, and in the checkpoint."""
    within = "model.language_model" if saved.vision else "model"
    names = {gguf: f"{within}.{name}" for name, gguf in _ENDS.items()}
    if not saved.config["tie_word_embeddings"]:  # else llama.cpp takes the embedding for it
        names["output"] = "lm_head"
    for i in range(saved.config["num_hidden_layers"]):
        for name, gguf in _BLOCK.items():
            names[f"blk.{i}.{gguf}"] = f"{within}.layers.{i}.{name}"
    return {f"{gguf}.weight": f"{name}.weight" for gguf, name in names.items()}


def _describe_projector(vision: Mapping[str, Any], name: str, writer: Any, file_type: int) -> None:
    """Write what llama.cpp must know besides the weights."""
    from gguf import GGUFType, VisionProjectorType

    writer.add_type(GGUFType.MMPROJ)
    writer.add_name(name)
    writer.add_file_type(file_type)
    writer.add_clip_has_vision_encoder(True)
    writer.add_clip_projector_type(VisionProjectorType.QWEN3VL)
    writer.add_vision_projection_dim(vision["out_hidden_size"])
    writer.add_vision_image_size(
        math.isqrt(vision["num_position_embeddings"]) * vision["patch_size"]
    )
    writer.add_vision_patch_size(vision["patch_size"])
    writer.add_vision_spatial_merge_size(vision["spatial_merge_size"])
    writer.add_vision_embedding_length(vision["hidden_size"])
    writer.add_vision_feed_forward_length(vision["intermediate_size"])
    writer.add_vision_block_count(vision["depth"])
    writer.add_vision_head_count(vision["num_heads"])
    writer.add_vision_attention_layernorm_eps(1e-6)  # fixed in transformers
    writer.add_vision_use_gelu(True)
    writer.add_vision_image_mean(vision["image_mean"])
    writer.add_vision_image_std(vision["image_std"])
    stacked = vision["deepstack_visual_indexes"]
    writer.add_vision_is_deepstack_layers([i in stacked for i in range(vision["depth"])])


def _projector_names(vision: Mapping[str, Any]) -> dict[str, str]:
    """Return each tensor's name in the projector, and in the checkpoint."""
    layers: dict[str, str] = {}
    for i in range(vision["depth"]):
        for name, gguf in _VISION_BLOCK.items():
            layers[f"v.blk.{i}.{gguf}"] = f"blocks.{i}.{name}"
    for name, gguf in _MERGER.items():
        layers[gguf] = f"merger.{name}"
    for place, layer in enumerate(vision["deepstack_visual_indexes"]):
        for name, gguf in _DEEPSTACK.items():
            layers[f"v.deepstack.{layer}.{gguf}"] = f"deepstack_merger_list.{place}.{name}"
    layers["v.patch_embd"] = "patch_embed.proj"
    tensors: dict[str, str] = {}
    for gguf, name in layers.items():
        tensors[f"{gguf}.weight"] = f"{name}.weight"
        tensors[f"{gguf}.bias"] = f"{name}.bias"
    # A picture is a video of two equal frames, whose weights llama.cpp has apart.
    tensors["v.patch_embd.weight.1"] = tensors["v.patch_embd.weight"]
    tensors["v.position_embd.weight"] = "pos_embed.weight"
    return {gguf: f"model.visual.{name}" for gguf, name in tensors.items()}


def _tensors(
    checkpoint: Path, names: Mapping[str, str], dtype: Dtype, subject: str
) -> Iterator[tuple[str, Any, np.dtype[Any]]]:
    """Yield each tensor's name in the GGUF, its place in the checkpoint and its number format."""
    from gguf.utility import SafetensorsLocal

    tensors = SafetensorsLocal(checkpoint / "model.safetensors").tensors
    for gguf, name in names.items():
        tensor = tensors.get(name)
        if tensor is None:
            raise UserError(f"{subject} lacks {name}; save or copy it again")
        full = dtype == "F32" or len(tensor.shape) == 1 or gguf == _FULL
        yield gguf, tensor, np.dtype(np.float32 if full else np.float16)


def _frame(name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weights as they are; of those of a video's two frames, (out, in, 2, y, x),
    the name's frame.
    """
    return values[:, :, int(name.endswith(".1"))] if values.ndim == 5 else values
