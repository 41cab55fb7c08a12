"""Checkpoints with random weights in the shapes of published models:
for speed, never for what they say.
"""

from pathlib import Path
from typing import Any

from harness.backends import tokens

# Hidden, feed-forward, layers, heads, tied: config.json of Qwen3-0.6B and -4B; 8 key-value heads of
# 128.
SHAPES = {"0.6b": (1024, 3072, 28, 16, True), "4b": (2560, 9728, 36, 32, True)}
TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n"
    "{% if enable_thinking is defined and not enable_thinking %}<think>\n\n</think>\n\n{% endif "
    "%}{% endif %}"
)


def build(shape: str, tokenizer: Path, folder: Path) -> Path:
    """Write a Qwen3 of a shape in bfloat16,
    with a tokenizer of its vocabulary (tokenizer.json or GGUF).
    """
    import torch
    from transformers import PreTrainedTokenizerFast, Qwen3Config, Qwen3ForCausalLM

    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokens.tokenizer(tokenizer),
        eos_token="<|im_end|>",
        pad_token="<|endoftext|>",
        chat_template=TEMPLATE,
    )
    hidden, forward, layers, heads, tied = SHAPES[shape]
    config = Qwen3Config(
        vocab_size=151936,
        hidden_size=hidden,
        intermediate_size=forward,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        num_key_value_heads=8,
        head_dim=128,
        tie_word_embeddings=tied,
        max_position_embeddings=40960,
        rope_theta=1e6,
        eos_token_id=fast.eos_token_id,
        pad_token_id=fast.pad_token_id,
        bos_token_id=None,
        dtype="bfloat16",
    )
    torch.manual_seed(0)
    with torch.device("meta"):
        model = Qwen3ForCausalLM(config).to(torch.bfloat16)
    model.to_empty(device="cpu")
    for name, weights in model.named_parameters():
        fill(name, weights)
    model.save_pretrained(folder)
    fast.save_pretrained(folder)
    return folder


def fill(name: str, weights: Any) -> None:
    """Ones for norms; for matrices a random block, repeated:
    billions of fresh numbers would take minutes.
    """
    import torch

    with torch.no_grad():
        if weights.ndim == 1:
            weights.fill_(1.0)
            return
        block = torch.randn(1009, dtype=torch.float32).mul_(0.02).to(weights.dtype)
        flat = weights.view(-1)
        whole = len(flat) // 1009 * 1009
        flat[:whole].view(-1, 1009).copy_(block)
        flat[whole:].copy_(block[: len(flat) - whole])
