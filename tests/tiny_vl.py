"""Models that see, small enough for a test:
random weights in the shapes of Qwen3-VL, Qwen2.5-VL and SmolVLM.

Nothing is downloaded. The weights are random, so tests speak of plumbing, never of what is seen.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

FAMILIES = ("qwen3-vl", "qwen2.5-vl", "smolvlm")
QWEN_MARKS = ("<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>")
IDEFICS_MARKS = ("<fake_token_around_image>", "<global-img>", "<image>")

# With the semantics of the published templates: contents are texts, or lists of parts.
QWEN_TEMPLATE = """\
{%- for message in messages %}
{{- '<|im_start|>' + message.role + '\\n' }}
{%- if message.content is string %}
{{- message.content }}
{%- else %}
{%- for part in message.content %}
{{- '<|vision_start|><|image_pad|><|vision_end|>' if part.type == 'image' else part.text }}
{%- endfor %}
{%- endif %}
{{- '<|im_end|>\\n' }}
{%- endfor %}
{%- if add_generation_prompt %}
{{- '<|im_start|>assistant\\n' }}
{%- endif %}"""
# SmolVLM's takes lists alone.
IDEFICS_TEMPLATE = """\
{%- for message in messages %}
{{- '<|im_start|>' + message.role | capitalize }}
{{- ':' if message.content[0].type == 'image' else ': ' }}
{%- for part in message.content %}
{{- '<image>' if part.type == 'image' else part.text }}
{%- endfor %}
{{- '<|im_end|>\\n' }}
{%- endfor %}
{%- if add_generation_prompt %}
{{- 'Assistant:' }}
{%- endif %}"""
_LINES = [
    "You drive the ego vehicle.",
    '{"action_distribution":{"SLOWER":0.70,"IDLE":0.20,"FASTER":0.10}}',
]
TEXT = {
    "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4,
    "num_key_value_heads": 2, "max_position_embeddings": 1024, "initializer_range": 0.3,
    "tie_word_embeddings": False,
}  # fmt: skip


def build(folder: Path, family: str = "qwen3-vl", deepstack: Sequence[int] = (0,)) -> Path:
    """Write checkpoint, tokenizer and image processor of a family.

    Args:
        folder: where to.
        family: one of `FAMILIES`.
        deepstack: layers of Qwen3-VL's vision encoder whose features go into the first layers of
            its texts.
    """
    import torch
    from tokenizers import models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    from harness.backends.tokens import byte_level

    bpe = byte_level(models.BPE())
    marks = IDEFICS_MARKS if family == "smolvlm" else QWEN_MARKS
    bpe.train_from_iterator(
        _LINES,
        trainers.BpeTrainer(
            vocab_size=384, special_tokens=["<|endoftext|>", "<|im_start|>", "<|im_end|>", *marks],
            initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False,
        ),
    )  # fmt: skip
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=bpe, eos_token="<|im_end|>", pad_token="<|endoftext|>",
        chat_template=IDEFICS_TEMPLATE if family == "smolvlm" else QWEN_TEMPLATE,
    )  # fmt: skip
    tokenizer.save_pretrained(folder)
    torch.manual_seed(2)
    model, processor = (_idefics if family == "smolvlm" else _qwen)(tokenizer, family, deepstack)
    # biases begin as zeros and norms as ones, which would hide one in another's place
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim == 1:
                parameter += 0.2 * torch.randn_like(parameter)
    processor.save_pretrained(folder)
    model.generation_config.eos_token_id = tokenizer.eos_token_id
    model.save_pretrained(folder)
    return folder


def _qwen(tokenizer: Any, family: str, deepstack: Sequence[int]) -> tuple[Any, Any]:
    import transformers
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    start, end, image, video = map(tokenizer.convert_tokens_to_ids, QWEN_MARKS)
    ids = {"vision_start_token_id": start, "vision_end_token_id": end, "image_token_id": image,
           "video_token_id": video}  # fmt: skip
    text = {**TEXT, "vocab_size": len(tokenizer), "eos_token_id": tokenizer.eos_token_id}
    if family == "qwen3-vl":
        text |= {"head_dim": 16, "rope_parameters": {
            "rope_type": "default", "rope_theta": 10000.0, "mrope_section": [3, 3, 2],
            "mrope_interleaved": True,
        }}  # fmt: skip
        vision = {
            "depth": 2, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 32,
            "patch_size": 16, "deepstack_visual_indexes": list(deepstack), "num_position_embeddings": 64,
            "initializer_range": 0.3,
        }  # fmt: skip
        config = transformers.Qwen3VLConfig(text_config=text, vision_config=vision, **ids)
        model = transformers.Qwen3VLForConditionalGeneration(config)
        limits = {"shortest_edge": 65536, "longest_edge": 16777216}
        return model, Qwen2VLImageProcessorPil(patch_size=16, size=limits)
    text["rope_parameters"] = {
        "rope_type": "default",
        "rope_theta": 10000.0,
        "mrope_section": [2, 1, 1],
    }
    vision = {
        "depth": 2, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 32,
        "patch_size": 14, "window_size": 112, "fullatt_block_indexes": [1], "initializer_range": 0.3,
    }  # fmt: skip
    config = transformers.Qwen2_5_VLConfig(text_config=text, vision_config=vision, **ids)
    limits = {"shortest_edge": 3136, "longest_edge": 12845056}
    return transformers.Qwen2_5_VLForConditionalGeneration(config), Qwen2VLImageProcessorPil(
        size=limits
    )


def _idefics(tokenizer: Any, family: str, deepstack: Sequence[int]) -> tuple[Any, Any]:
    import transformers
    from transformers.models.smolvlm.image_processing_pil_smolvlm import SmolVLMImageProcessorPil

    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2,
              "image_size": 128, "patch_size": 8, "initializer_range": 0.3}  # fmt: skip
    text = {**TEXT, "model_type": "llama", "vocab_size": len(tokenizer), "pad_token_id": 0}
    config = transformers.SmolVLMConfig(
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"), vision_config=vision, text_config=text,
        scale_factor=4, pad_token_id=0,
    )  # fmt: skip
    side = {"longest_edge": 128}
    return (
        transformers.SmolVLMForConditionalGeneration(config),
        SmolVLMImageProcessorPil(size={"longest_edge": 512}, max_image_size=side),
    )
