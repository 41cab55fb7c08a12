"""The embedded models before they have learnt anything, and their language:
a small BPE with ChatML.

One reads texts, a Qwen3; one sees as well, a Qwen3-VL whose text part is the same.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.backends.tokens import byte_level
from harness.backends.tokens import tokenizer as tokenizer_of
from harness.backends.vision import Vision
from harness.core.errors import UserError, printable

CONTEXT_TOKENS = 2048
# 512 entries leave a prompt a third longer (371 tokens against 282, prompt v2, ego); merges end at
# 819.
VOCABULARY = 768
END, START, PAD = "<|im_end|>", "<|im_start|>", "<|endoftext|>"
PICTURE, VIDEO, BEGINS, ENDS = (
    "<|image_pad|>",
    "<|video_pad|>",
    "<|vision_start|>",
    "<|vision_end|>",
)
MARKS = (PICTURE, VIDEO, BEGINS, ENDS)
WEIGHTS = "model.safetensors"
TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
SEEING_TEMPLATE = TEMPLATE.replace(
    "{{ m.content }}",
    f"{{% if m.content is string %}}{{{{ m.content }}}}{{% else %}}{{% for part in m.content "
    f"%}}{{% if part.type == 'image' %}}{BEGINS}{PICTURE}{ENDS}{{% else %}}{{{{ part.text }}}}{{% "
    f"endif %}}{{% endfor %}}{{% endif %}}",
)
VISION = Vision(512, 256, patch_px=16, merge=2)  # as Qwen3-VL's
LAYERS, HIDDEN, HEADS, HEAD = 4, 96, 3, 32
EYES = {  # its vision encoder: a quarter of the weights
    "depth": 2,
    "hidden_size": 48,
    "intermediate_size": 96,
    "num_heads": 3,
    "out_hidden_size": HIDDEN,
    "patch_size": VISION.patch_px,
    "spatial_merge_size": VISION.merge,
    "deepstack_visual_indexes": [],
    "num_position_embeddings": 256,
}


def new_model(tokenizer: Any, seed: int, sees: bool = False) -> Any:
    """Make a `Qwen3ForCausalLM` with about half a million random weights.

    With `sees`, make a `Qwen3VLForConditionalGeneration`, which also takes pictures. `tokenizer` is
    a `tokenizers.Tokenizer` that has the special tokens of `train_tokenizer`. Matrices are drawn
    from `seed`, normal with a deviation of 1/sqrt(fan-in), and less where they write to the
    residual stream.
    """
    import torch
    import transformers

    torch.manual_seed(seed)
    ids = tokenizer.token_to_id
    text = {
        "vocab_size": tokenizer.get_vocab_size(),
        "hidden_size": HIDDEN,
        "intermediate_size": 320,
        "num_hidden_layers": LAYERS,
        "num_attention_heads": HEADS,
        "num_key_value_heads": 1,
        "head_dim": HEAD,
        "max_position_embeddings": CONTEXT_TOKENS,
        "eos_token_id": ids(END),
        "pad_token_id": ids(PAD),
        "bos_token_id": None,
    }
    if sees:
        # A third of the frequencies each for time, height and width, in turn.
        shares = [-(-(HEAD // 2 - axis) // 3) for axis in range(3)]
        rope = {
            "rope_type": "default",
            "rope_theta": 10000.0,
            "mrope_section": shares,
            "mrope_interleaved": True,
        }
        model = transformers.Qwen3VLForConditionalGeneration(
            transformers.Qwen3VLConfig(
                text_config={**text, "rope_parameters": rope},
                vision_config=EYES,
                tie_word_embeddings=True,
                image_token_id=ids(PICTURE),
                video_token_id=ids(VIDEO),
                vision_start_token_id=ids(BEGINS),
                vision_end_token_id=ids(ENDS),
            )
        )
        model.generation_config.update(eos_token_id=ids(END), pad_token_id=ids(PAD))
        embed = model.model.visual.patch_embed
        # A convolution whose stride is its size is a product of matrices, and takes many times as
        # long.
        embed.forward = lambda patches: torch.nn.functional.linear(
            patches, embed.proj.weight.flatten(1), embed.proj.bias
        )
    else:
        model = transformers.Qwen3ForCausalLM(
            transformers.Qwen3Config(**text, tie_word_embeddings=True)
        )
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.ndim == 2:
                std = 0.04 if "embed" in name else 1 / math.sqrt(p.shape[1])
                residual = (
                    "o_proj" in name or "down_proj" in name or "attn.proj" in name or "fc2" in name
                )
                p.normal_(0.0, std / (math.sqrt(2 * LAYERS) if residual else 1.0))
    return model


def take_over(model: Any, base: Path) -> None:
    """Copy the weights of a trained text model into `model`, which may have more tokens.

    `model` is made by `new_model`, and changed in place; it may also take pictures, which adds
    tokens. `base` is the folder of a text model that `harness model distill` made; its vocabulary
    is the beginning of the model's. Raises UserError if the folder has no such weights, or those of
    another size.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    file, state = base / WEIGHTS, model.state_dict()
    within = "model.language_model." if hasattr(model.config, "vision_config") else "model."
    try:
        weights = load_file(file)
        for name, values in weights.items():
            place = state[name.replace("model.", within, 1)]
            if place.shape[1:] != values.shape[1:] or len(place) < len(values):
                raise ValueError(f"{name} is {tuple(values.shape)}, and {tuple(place.shape)} here")
            place[: len(values)] = values
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise UserError(
            f"--base {printable(base)}: {printable(str(error), 160)}; give the folder of a model "
            "that `harness model distill` made of text prompts"
        ) from None


@lru_cache(maxsize=1)
def image_processor() -> Any:
    """Return the transformers image processor that cuts pictures into the patches of the model."""
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    pixels = {"shortest_edge": 1 << 12, "longest_edge": 1 << 20}
    return Qwen2VLImageProcessorPil(
        patch_size=VISION.patch_px, merge_size=VISION.merge, size=pixels
    )


def read_tokenizer(base: Path, sees: bool) -> Any:
    """Read the `tokenizers.Tokenizer` of the model in the folder `base`.

    With `sees`, the special tokens that mark a picture are added behind its vocabulary.
    """
    from tokenizers import Tokenizer

    # of its own: that one is kept for others
    built = Tokenizer.from_str(tokenizer_of(base).to_str())
    if sees:
        built.add_special_tokens(_special(MARKS))
    return built


def train_tokenizer(texts: Iterable[str], sees: bool = False) -> Any:
    """Train a byte-level BPE `tokenizers.Tokenizer` of 768 entries on texts.

    It splits text as Qwen2's does, so that every digit is a token of its own. With `sees`, it also
    has the special tokens that mark a picture.
    """
    from tokenizers import models, pre_tokenizers, trainers

    tokenizer = byte_level(models.BPE())
    special = _special((PAD, START, END, *(MARKS if sees else ())))
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY - len(special),
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(texts, trainer)
    tokenizer.add_special_tokens(special)
    return tokenizer


def _special(texts: Sequence[str]) -> list[Any]:
    from tokenizers import AddedToken

    return [AddedToken(text, special=True, normalized=False) for text in texts]


def chat(messages: Sequence[Mapping[str, str]]) -> tuple[str, str]:
    """Return a chat in ChatML as two texts: the system message, and the rest up to the answer.

    ChatML is the format in which the model reads chats. `messages` have `role` and `content`; one
    with the key `image` begins with its picture: one mark for each token of the picture.
    """
    picture = f"{BEGINS}{PICTURE * VISION.tokens}{ENDS}"
    parts = [
        f"{START}{m['role']}\n{picture * ('image' in m)}{m['content']}{END}\n" for m in messages
    ]
    return parts[0], "".join(parts[1:]) + f"{START}assistant\n"


def save_tokenizer(tokenizer: Any, folder: Path) -> None:
    """Write a `tokenizers.Tokenizer` and its chat template to a folder, as transformers reads them.

    If it has the tokens of pictures, the settings of the image processor are written, too.
    """
    from transformers import PreTrainedTokenizerFast

    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, eos_token=END, pad_token=PAD, clean_up_tokenization_spaces=False
    )
    sees = tokenizer.token_to_id(PICTURE) is not None
    fast.chat_template = SEEING_TEMPLATE if sees else TEMPLATE
    fast.save_pretrained(folder)
    if sees:
        image_processor().save_pretrained(folder)
