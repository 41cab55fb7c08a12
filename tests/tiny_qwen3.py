"""A real Qwen3 small enough for a test:
random weights, a BPE that splits as Qwen2's, a thinking switch.

Nothing is downloaded. The weights are random, so tests speak of plumbing, never of what is said.
"""

import json
from pathlib import Path

IM_END, THINK = "<|im_end|>", "<think>"

# ChatML with the semantics of Qwen3's own template: `enable_thinking=False` closes an empty think
# block.
TEMPLATE = """\
{%- for message in messages %}
{{- '<|im_start|>' + message.role + '\\n' + message.content + '<|im_end|>' + '\\n' }}
{%- endfor %}
{%- if add_generation_prompt %}
{{- '<|im_start|>assistant\\n' }}
{%- if enable_thinking is defined and enable_thinking is false %}
{{- '<think>\\n\\n</think>\\n\\n' }}
{%- endif %}
{%- endif %}"""

_LINES = [
    "You drive the ego vehicle. Answer with one JSON object.",
    '{"action_distribution":{"SLOWER":0.70,"IDLE":0.20,"FASTER":0.10}}',
    "A truck on the west arm, 14 m away at 8 m/s, hides the crossing lane. system user assistant",
]


def build(folder: Path, *, template: str | None = TEMPLATE, context_tokens: int = 512) -> Path:
    """Write checkpoint and tokenizer to `folder` (200 kB);
    `template=None` leaves the chat template out.
    """
    import torch
    from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast, Qwen3Config, Qwen3ForCausalLM

    from harness.backends.tokens import QWEN2_SPLIT

    bpe = Tokenizer(models.BPE())
    bpe.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(QWEN2_SPLIT), "isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    bpe.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=384,
        special_tokens=["<|endoftext|>", "<|im_start|>", IM_END],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    bpe.train_from_iterator(_LINES, trainer)
    bpe.add_tokens([AddedToken(t, special=False, normalized=False) for t in (THINK, "</think>")])
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=bpe, eos_token=IM_END, pad_token="<|endoftext|>", chat_template=template
    )
    tokenizer.save_pretrained(folder)

    torch.manual_seed(2)  # some answers end, some think, some are cut off
    config = Qwen3Config(
        vocab_size=len(tokenizer),
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        head_dim=8,
        max_position_embeddings=context_tokens,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
        tie_word_embeddings=False,
        initializer_range=0.6,
        dtype="float32",
    )
    model = Qwen3ForCausalLM(config)
    # longer rows win the argmax more often, so that some answers end and some think
    with torch.no_grad():
        for token, factor in ((IM_END, 2.0), (THINK, 2.0)):
            model.lm_head.weight[tokenizer.convert_tokens_to_ids(token)] *= factor
    # As published: sampling defaults that greedy decoding has to leave behind, without a warning.
    model.generation_config.update(do_sample=True, temperature=0.6, top_p=0.95, top_k=20)
    model.save_pretrained(folder)
    assert json.loads((folder / "generation_config.json").read_text())["temperature"] == 0.6
    return folder


def spoil(folder: Path, value: float = float("nan")) -> Path:
    """Make the weights of a checkpoint's last norm no numbers, or others."""
    import torch
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    weights["model.norm.weight"] = torch.full_like(weights["model.norm.weight"], value)
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    return folder
