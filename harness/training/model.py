"""The embedded model: a `Qwen3ForCausalLM` of half a million parameters, before it has learnt anything."""

import math
from typing import Any

CONTEXT_TOKENS = 2048


def new_model(vocabulary: int, eos: int, pad: int, seed: int) -> Any:
    """Random weights: normal with a deviation of 1/sqrt(fan-in), less on what adds to the residual stream."""
    import torch
    from transformers import Qwen3Config, Qwen3ForCausalLM

    torch.manual_seed(seed)
    config = Qwen3Config(
        vocab_size=vocabulary, hidden_size=96, intermediate_size=320, num_hidden_layers=4,
        num_attention_heads=3, num_key_value_heads=1, head_dim=32, tie_word_embeddings=True,
        max_position_embeddings=CONTEXT_TOKENS, eos_token_id=eos, pad_token_id=pad, bos_token_id=None,
    )  # fmt: skip
    model = Qwen3ForCausalLM(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.ndim == 2:
                std = 0.04 if "embed" in name else 1 / math.sqrt(p.shape[1])
                residual = "o_proj" in name or "down_proj" in name
                p.normal_(0.0, std / (math.sqrt(2 * config.num_hidden_layers) if residual else 1.0))
    return model
