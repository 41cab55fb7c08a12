"""A saved Qwen3 or Qwen3-VL checkpoint, read from its files without torch or transformers.

What llama.cpp would take otherwise than the checkpoint means it, without a word, is refused:
another pre-tokeniser, another rope, a bias, another vision encoder.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.backends.tokens import QWEN2_SPLIT
from harness.core.errors import UserError, printable
from harness.core.files import text_of

# Where a file may say otherwise, and llama.cpp would not hear it. Its Unicode normalisation is
# none; NFC is what Qwen's tokenizer does, and nothing to text that is composed already.
_ONE_VALUE = {"attention_bias": False, "use_sliding_window": False, "hidden_act": "silu"}
_SEEN = {
    "temporal_patch_size": 2,
    "spatial_merge_size": 2,
    "in_channels": 3,
    "hidden_act": "gelu_pytorch_tanh",
}
_NORMALIZERS = (None, {"type": "NFC"})
_PIXELS = "preprocessor_config.json"
_SPLIT = {
    "type": "Split",
    "pattern": {"Regex": QWEN2_SPLIT},
    "behavior": "Isolated",
    "invert": False,
}
_BYTES = {"type": "ByteLevel", "add_prefix_space": False, "use_regex": False}


class Saved(NamedTuple):
    """Hold what the small files of a saved Qwen3 checkpoint say: all but its weights.

    `config` is that of the text part, `tokenizer` the content of tokenizer.json, and `template` the
    chat template. `vision` is the config of the vision encoder with its processor's means and
    deviations; None if the model reads text only.
    """

    config: dict[str, Any]  # of the text part
    tokenizer: dict[str, Any]  # whole
    template: str  # of a chat
    # config of the vision encoder, and its processor's `image_mean` and `image_std`; None if the
    # model reads text only
    vision: dict[str, Any] | None = None


def read(checkpoint: Path, subject: str) -> Saved:
    """Return what the small files of a Qwen3 or Qwen3-VL checkpoint say.

    `checkpoint` is its folder, and `subject` names it in messages. Raises UserError if a file is
    missing, or says something that llama.cpp would understand otherwise.
    """
    texts = {
        name: text_of(checkpoint / name, "record")
        for name in (
            "config.json",
            "tokenizer.json",
            "tokenizer_config.json",
            "chat_template.jinja",
            _PIXELS,
        )
        if (checkpoint / name).is_file()
    }
    for name in ("config.json", "tokenizer.json", "model.safetensors"):
        if not (checkpoint / name).is_file():
            raise UserError(
                f"{subject} has no {name}; give the folder of a saved model with its tokenizer"
            )
    config, tokenizer = json.loads(texts["config.json"]), json.loads(texts["tokenizer.json"])
    template = texts.get("chat_template.jinja") or json.loads(
        texts.get("tokenizer_config.json", "{}")
    ).get("chat_template")
    if not isinstance(template, str):
        raise UserError(
            f"{subject} has no chat template; put a chat_template.jinja beside its config.json"
        )
    vision = None
    if config["architectures"] == ["Qwen3VLForConditionalGeneration"]:
        if _PIXELS not in texts:
            raise UserError(f"{subject} has no {_PIXELS}; save its image processor as well")
        processor = json.loads(texts[_PIXELS])
        vision = config["vision_config"] | {
            key: processor[key] for key in ("image_mean", "image_std")
        }
        config = {**config["text_config"], "tie_word_embeddings": config["tie_word_embeddings"]}
        _check(vision, _SEEN, f"{subject} [vision_config]")
        sections, half = rope(config)["mrope_section"], config["head_dim"] // 2
        # Frequencies go to time, height and width in turn. One past its turn is time's to
        # transformers, and not turned at all by llama.cpp.
        if any(i >= 3 * sections[i % 3] for i in range(half)):
            whole = [-(-(half - axis) // 3) for axis in range(3)]
            raise UserError(
                f"{subject}: mrope_section = {printable(sections)}; only {whole} can be exported"
            )
    elif config["architectures"] != ["Qwen3ForCausalLM"]:
        given = printable(config["architectures"])
        raise UserError(
            f"{subject} is a {given}; only Qwen3ForCausalLM and Qwen3VLForConditionalGeneration "
            "can be exported"
        )
    _check(config, _ONE_VALUE, subject)
    scaling = rope(config).get("rope_type", "default")
    if scaling != "default" or config.get("rope_scaling"):
        raise UserError(
            f"{subject} scales its rope ({printable(scaling)}); only the default can be exported"
        )
    _check_tokenizer(tokenizer, subject)
    return Saved(config, tokenizer, template, vision)


def _check(config: Mapping[str, Any], only: Mapping[str, Any], subject: str) -> None:
    for key, value in only.items():
        if config.get(key, value) != value:
            raise UserError(
                f"{subject}: {key} = {printable(config[key])}; only {value} can be exported"
            )


def rope(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a config's parameters of rotary position embeddings, by name, such as `rope_theta`.

    Newer config files have them in a table, others among all keys.
    """
    parameters: Mapping[str, Any] = config.get("rope_parameters") or config
    return parameters


def _check_tokenizer(tokenizer: Mapping[str, Any], subject: str) -> None:
    """Raise UserError unless llama.cpp would read the same tokens by a GGUF file's tokenizer."""
    model, pre = tokenizer["model"], tokenizer["pre_tokenizer"] or {}
    steps = pre.get("pretokenizers", ())
    known_parts = []
    for step, known_part in zip(steps, (_SPLIT, _BYTES), strict=False):
        known_parts.append({key: step.get(key) for key in known_part})
    odd = [
        token["content"]
        for token in tokenizer["added_tokens"]
        if token["lstrip"] or token["rstrip"] or token["single_word"]
    ]
    if model["type"] != "BPE" or model.get("ignore_merges") or model.get("byte_fallback"):
        what = "is no plain BPE"
    elif known_parts != [_SPLIT, _BYTES] or len(steps) != 2:
        what = "splits text otherwise than Qwen2's"
    elif tokenizer["normalizer"] not in _NORMALIZERS:
        what = "normalises text otherwise than Qwen2's"
    elif odd:
        what = f"takes spaces or whole words with {printable(odd[0])}"
    else:
        return
    raise UserError(f"{subject}: its tokenizer {what}; llama.cpp would silently read other tokens")


def numbers(tensor: Any) -> NDArray[np.float32]:
    """Return a tensor of `gguf.utility.SafetensorsLocal` as a float32 array of its shape."""
    data = tensor.mmap_bytes()
    if tensor.dtype == "BF16":  # which numpy has not; its bits are float32's upper half
        values = (data.view("<u2").astype(np.uint32) << 16).view(np.float32)
    else:
        values = data.view({"F32": "<f4", "F16": "<f2"}[tensor.dtype]).astype(np.float32)
    shaped: NDArray[np.float32] = values.reshape(tensor.shape)
    return shaped
