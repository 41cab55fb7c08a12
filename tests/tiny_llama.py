"""A real Llama small enough for a test, as a GGUF file alone: random weights;
it splits text as SmolLM2.
"""

from pathlib import Path

import numpy as np
from gguf import GGMLQuantizationType, GGUFWriter, LlamaFileType, quants
from tokenizers.pre_tokenizers import ByteLevel

TEMPLATE = (
    "{% for message in messages %}{{'<|im_start|>' + message['role'] + '\n' + message['content']"
    " + '<|im_end|>' + '\n'}}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{% endif %}"
)
WIDTH, LAYERS, HEADS, SHARED, INNER = 64, 2, 4, 2, 96


def build(
    file: Path, kind: str = "F32", *, template: str | None = TEMPLATE, pre: str = "smollm",
    architecture: str = "llama", context: int = 512,
) -> Path:  # fmt: skip
    """Write a GGUF file whose matrices have a number format by its name in GGML, such as `Q4_1`."""
    tokens = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", *sorted(ByteLevel.alphabet())]
    tokens += ["Ġt", "he", "in", "ĠĠ", "er"]
    writer = GGUFWriter(file, architecture)
    writer.add_file_type(
        LlamaFileType.ALL_F32 if kind == "F32" else LlamaFileType[f"MOSTLY_{kind}"]
    )
    writer.add_name("Tiny Llama")
    writer.add_license("mit")
    writer.add_context_length(context)
    writer.add_embedding_length(WIDTH)
    writer.add_block_count(LAYERS)
    writer.add_feed_forward_length(INNER)
    writer.add_head_count(HEADS)
    writer.add_head_count_kv(SHARED)
    writer.add_layer_norm_rms_eps(1e-5)
    writer.add_rope_freq_base(10000.0)
    writer.add_rope_dimension_count(WIDTH // HEADS)
    writer.add_vocab_size(len(tokens))
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre(pre)
    writer.add_token_list(tokens)
    writer.add_token_types([3] * 3 + [1] * (len(tokens) - 3))
    writer.add_token_merges(["Ġ t", "h e", "i n", "Ġ Ġ", "e r"])
    writer.add_bos_token_id(1)
    writer.add_eos_token_id(2)
    writer.add_unk_token_id(0)
    writer.add_pad_token_id(2)
    writer.add_add_bos_token(False)
    if template:
        writer.add_chat_template(template)
    draws = np.random.default_rng(3)
    form = GGMLQuantizationType[kind]

    def matrix(name: str, rows: int, columns: int) -> None:
        data = draws.normal(0, 0.06, (rows, columns)).astype(np.float32)
        writer.add_tensor(f"{name}.weight", quants.quantize(data, form), raw_dtype=form)

    def ones(name: str) -> None:
        writer.add_tensor(f"{name}.weight", np.ones(WIDTH, np.float32))

    matrix("token_embd", len(tokens), WIDTH)
    shared = WIDTH // HEADS * SHARED
    for n in range(LAYERS):
        for name, rows, columns in (
            ("attn_q", WIDTH, WIDTH), ("attn_k", shared, WIDTH), ("attn_v", shared, WIDTH),
            ("attn_output", WIDTH, WIDTH), ("ffn_gate", INNER, WIDTH), ("ffn_up", INNER, WIDTH),
            ("ffn_down", WIDTH, INNER),
        ):  # fmt: skip
            matrix(f"blk.{n}.{name}", rows, columns)
        ones(f"blk.{n}.attn_norm")
        ones(f"blk.{n}.ffn_norm")
    ones("output_norm")
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return file
