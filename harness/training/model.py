"""The embedded model before it has learnt anything, and its language: a small BPE tokenizer with ChatML."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.backends.tokens import byte_level

CONTEXT_TOKENS = 2048
# 512 entries leave a prompt a third longer (371 tokens against 282, prompt v2, ego); merges end at 819.
VOCABULARY = 768
END, START, PAD = "<|im_end|>", "<|im_start|>", "<|endoftext|>"
TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


def new_model(vocabulary: int, eos: int, pad: int, seed: int) -> Any:
    """A `Qwen3ForCausalLM` of half a million random weights.

    They are normal with a deviation of 1/sqrt(fan-in), less on what adds to the residual stream.
    """
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


def train_tokenizer(texts: Iterable[str]) -> Any:
    """A byte-level BPE `tokenizers.Tokenizer` with Qwen2's pre-tokeniser: every digit stands alone."""
    from tokenizers import AddedToken, models, pre_tokenizers, trainers

    tokenizer = byte_level(models.BPE())
    special = [AddedToken(t, special=True, normalized=False) for t in (PAD, START, END)]
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY - len(special),
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(texts, trainer)
    tokenizer.add_special_tokens(special)
    return tokenizer


def chat(messages: Sequence[Mapping[str, str]]) -> tuple[str, str]:
    """A prompt as the chat template renders it: its system message, and the rest up to the answer."""
    parts = [f"{START}{m['role']}\n{m['content']}{END}\n" for m in messages]
    return parts[0], "".join(parts[1:]) + f"{START}assistant\n"


def save_tokenizer(tokenizer: Any, folder: Path) -> None:
    """Write it as transformers reads it, chat template included."""
    from transformers import PreTrainedTokenizerFast

    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, eos_token=END, pad_token=PAD, clean_up_tokenization_spaces=False
    )
    fast.chat_template = TEMPLATE
    fast.save_pretrained(folder)
