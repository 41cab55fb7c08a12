"""LoRA adapters beside a card's weights: a folder in the format of the package peft.

It holds `adapter_config.json` and `adapter_model.safetensors`, by which a checkpoint's weights are
changed when they are loaded; for llama.cpp the same numbers become a GGUF file
(`llama_cpp.adapter`).
"""

import json
import math
from pathlib import Path
from typing import Any

from harness.backends.card import Card
from harness.core.errors import UserError, one_line, printable
from harness.core.files import BROKEN, bytes_of, text_of
from harness.core.resources import find

CONFIG, TENSORS = "adapter_config.json", "adapter_model.safetensors"
PREFIX = "base_model.model."  # of a tensor's name, before that of the module which it changes
A, B = ".lora_A.weight", ".lora_B.weight"
# Kinds of adapter that are more than W + alpha / r * B A, by their key in the config.
_MORE = (
    "use_dora",
    "use_rslora",
    "rank_pattern",
    "alpha_pattern",
    "modules_to_save",
    "fan_in_fan_out",
    "alora_invocation_tokens",
)


def read_config(folder: Path, subject: str) -> dict[str, Any]:
    """Return the configuration of a LoRA adapter, the dict of its `adapter_config.json`.

    An adapter is a small file that changes a model's weights; `folder` is where it lies, and
    `subject` names the model in messages. Raises UserError if the file cannot be read, or the
    adapter is more than plain LoRA of linear layers.
    """
    try:
        config: dict[str, Any] = json.loads(text_of(folder / CONFIG, "record"))
        rank, kind = int(config["r"]), config["peft_type"]
        if not math.isfinite(float(config["lora_alpha"])):
            raise ValueError(f"lora_alpha is {config['lora_alpha']}")
    except BROKEN as error:
        raise UserError(
            f"{subject}: {printable(folder / CONFIG)} cannot be read "
            f"({printable(repr(error), 120)}); give the "
            "folder of a LoRA adapter in peft's format"
        ) from None
    more = [key for key in _MORE if config.get(key)]
    if kind != "LORA" or rank < 1 or more or config.get("bias", "none") != "none":
        odd = (
            more[0]
            if more
            else f"peft_type {printable(kind)}, r {rank}, bias {printable(config.get('bias'))}"
        )
        raise UserError(
            f"{subject}: its adapter has {odd}; allowed: plain LoRA of linear layers, without "
            "biases"
        )
    return config


def find_adapter(card: Card) -> Path | None:
    """Return the folder of the LoRA adapter that a model card names; None if it names none.

    A model card is a TOML file that describes a model. The path in it is absolute, or else relative
    to the folder of the cards. Raises UserError if the folder is no adapter.
    """
    if card.adapter is None:
        return None
    folder = find("models", card.adapter)
    if not (folder / CONFIG).is_file():
        raise UserError(
            f"{card.shown}: no adapter in {printable(folder)} ({CONFIG}); put its folder beside "
            "the card, or leave adapter out"
        )
    for file in (folder / TENSORS, *sorted(folder.glob("*.gguf"))):
        if file.exists() and not file.is_file():
            raise UserError(
                f"{card.shown}: its adapter's {printable(file)} is no file, but a folder, pipe or "
                "device; give a file"
            )
    return folder


def find_tensors(folder: Path, subject: str) -> Path:
    """Return the safetensors file of an adapter's folder.

    `subject` names the model in messages. Raises UserError if there is none.
    """
    if not (file := folder / TENSORS).is_file():
        raise UserError(f"{subject}: its adapter in {printable(folder)} has no file {TENSORS}")
    return file


def foreign(subject: str, file: Path, reason: str) -> UserError:
    """Return the error for an adapter that does not fit its model.

    `file` is the adapter's file, `reason` says in words what does not fit, and `subject` names the
    model in messages.
    """
    return UserError(
        f"{subject}: {printable(file)} is no adapter of this model: {reason}; give the adapter "
        "that was trained on it"
    )


def merge(card: Card, model: Any) -> None:
    """Add the LoRA adapter that a model card names to weights: W + alpha / r * B A, in float32.

    `model` is a loaded model of the package transformers, which is changed in place; A, B, alpha
    and r are the adapter's matrices, scale and rank. `card` is the model card, the TOML file that
    describes a model; nothing is done if it names no adapter. Raises UserError if the adapter is of
    another model, or its file is not whole.
    """
    if (folder := find_adapter(card)) is None:
        return
    import torch
    from safetensors.torch import load

    file, config = find_tensors(folder, card.shown), read_config(folder, card.shown)
    rank = int(config["r"])
    scale = float(config["lora_alpha"]) / rank
    output = model.get_output_embeddings()
    tied = output is not None and output.weight is model.get_input_embeddings().weight
    try:
        tensors = load(bytes_of(file, "weights"))
        names = [name.removesuffix(A) for name in tensors if name.endswith(A)]
        if not names or 2 * len(names) != len(tensors):
            raise ValueError(f"{len(tensors)} tensors, of which {len(names)} are {A}")
        changes = {}
        for name in names:
            module = model.get_submodule(name.removeprefix(PREFIX))
            if tied and module in (output, model.get_input_embeddings()):
                raise ValueError(f"{name} shares its weights, and both uses would change")
            if len(tensors[name + A]) != rank:
                raise ValueError(f"{name} has rank {len(tensors[name + A])}, and r is {rank}")
            weight, change = module.weight, tensors[name + B].float() @ tensors[name + A].float()
            if change.shape != weight.shape:
                raise ValueError(
                    f"{name} is {tuple(change.shape)}, and {tuple(weight.shape)} in the model"
                )
            if not change.isfinite().all():
                raise ValueError(f"{name} holds numbers that are none, or too large")
            changes[name] = weight, change
    except Exception as error:  # a broken file surfaces as any of a dozen exception types
        raise foreign(card.shown, file, one_line(error)) from None
    with torch.no_grad():
        for weight, change in changes.values():
            weight.copy_(weight.float() + scale * change.to(weight.device))
