"""The projector of a Qwen3-VL, as llama.cpp has it: the vision encoder, and what leads into the text part.

Keys and names are those of llama.cpp's `conversion/qwen3vl.py` and `tools/mtmd/clip-impl.h`.
"""

import math
from collections.abc import Mapping
from typing import Any

FULL = ("v.position_embd.weight",)  # which llama.cpp interpolates as F32 only
_BLOCK = {
    "norm1": "ln1",
    "attn.qkv": "attn_qkv",
    "attn.proj": "attn_out",
    "norm2": "ln2",
    "mlp.linear_fc1": "ffn_up",
    "mlp.linear_fc2": "ffn_down",
}
_MERGER = {"norm": "v.post_ln", "linear_fc1": "mm.0", "linear_fc2": "mm.2"}
_DEEPSTACK = {"norm": "norm", "linear_fc1": "fc1", "linear_fc2": "fc2"}


def describe(vision: Mapping[str, Any], name: str, writer: Any, file_type: int) -> None:
    """Write what llama.cpp must know besides the weights."""
    from gguf import GGUFType, VisionProjectorType

    writer.add_type(GGUFType.MMPROJ)
    writer.add_name(name)
    writer.add_file_type(file_type)
    writer.add_clip_has_vision_encoder(True)
    writer.add_clip_projector_type(VisionProjectorType.QWEN3VL)
    writer.add_vision_projection_dim(vision["out_hidden_size"])
    writer.add_vision_image_size(math.isqrt(vision["num_position_embeddings"]) * vision["patch_size"])
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


def names(vision: Mapping[str, Any]) -> dict[str, str]:
    """Return each tensor's name in the projector, and in the checkpoint."""
    pairs = {
        f"v.blk.{i}.{ours}": f"blocks.{i}.{theirs}"
        for i in range(vision["depth"])
        for theirs, ours in _BLOCK.items()
    }
    pairs |= {ours: f"merger.{theirs}" for theirs, ours in _MERGER.items()}
    for place, layer in enumerate(vision["deepstack_visual_indexes"]):
        pairs |= {
            f"v.deepstack.{layer}.{ours}": f"deepstack_merger_list.{place}.{theirs}"
            for theirs, ours in _DEEPSTACK.items()
        }
    pairs["v.patch_embd"] = "patch_embed.proj"
    tensors = {f"{a}.{end}": f"{b}.{end}" for a, b in pairs.items() for end in ("weight", "bias")}
    # A picture is a video of two equal frames, whose weights llama.cpp has apart.
    tensors["v.patch_embd.weight.1"] = tensors["v.patch_embd.weight"]
    tensors["v.position_embd.weight"] = "pos_embed.weight"
    return {ours: f"model.visual.{theirs}" for ours, theirs in tensors.items()}
