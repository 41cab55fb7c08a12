"""An adapter as the GGUF file that llama.cpp reads, made once out of peft's files and kept."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.backends.adapters import PREFIX, A, B, find_adapter, find_tensors, foreign, read_config
from harness.backends.card import Card
from harness.backends.gguf import read_metadata
from harness.core import kept
from harness.core.errors import UserError, one_line, printable
from harness.core.files import bytes_of, digest, replacing, sha256_file

# Architectures whose adapters are understood, and the layers whose rows llama.cpp has in another
# order, by the key of how many heads they have.
_PERMUTED: Mapping[str, Mapping[str, str]] = {
    "llama": {"q_proj": "attention.head_count", "k_proj": "attention.head_count_kv"},
    "qwen2": {},
    "qwen3": {},
}


def find_adapter_gguf(card: Card, base: Path) -> Path | None:
    """Return the GGUF file of a model card's LoRA adapter; None if the card names none.

    `card` is the model card, the TOML file that describes a model, and `base` is the GGUF file of
    the model that it changes. The adapter's file is the one in its folder, or made of the
    safetensors file there and kept in the cache folder. Raises UserError if it cannot be made.
    """
    if (folder := find_adapter(card)) is None:
        return None
    if files := sorted(folder.glob("*.gguf")):
        if len(files) > 1:
            has = f"its adapter in {printable(folder)} has {len(files)} files *.gguf"
            raise UserError(f"{card.shown}: {has}; allowed: one")
        return files[0]
    tensors, config = find_tensors(folder, card.shown), read_config(folder, card.shown)
    try:
        values = read_metadata(base)
    except ValueError as error:
        subject = f"{card.shown} in {printable(base)}"
        raise UserError(
            f"{subject} does not load: {error}; copy or download the file again"
        ) from None
    architecture = str(values.get("general.architecture"))
    shape = [str(item) for item in values.items() if item[0].startswith(architecture)]
    made_by = kept.code_sha256("backends/llama_cpp/adapter.py")
    key = digest([sha256_file(tensors), json.dumps(config, sort_keys=True), shape, made_by])
    file = kept.folder() / "adapters" / f"{key[:16]}.gguf"
    if not file.is_file():
        try:
            layers = _layers(tensors, values)
        except Exception as error:  # a broken file surfaces as any of a dozen exception types
            raise foreign(card.shown, tensors, one_line(error)) from None
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            _write(file, architecture, float(config["lora_alpha"]), layers)
        except OSError as error:
            raise UserError(
                f"{card.shown}: its adapter cannot be written: {printable(error)}; "
                "SWARMDRIVE_CACHE names another folder"
            ) from None
    return file


def _layers(file: Path, values: Mapping[str, Any]) -> dict[str, NDArray[np.float16]]:
    """Return an adapter's matrices by llama.cpp's names for them.
    Raises ValueError if they are none.
    """
    from gguf import MODEL_ARCH_NAMES, get_tensor_name_map
    from safetensors.numpy import load

    architecture = values["general.architecture"]
    if architecture not in _PERMUTED:
        raise ValueError(
            f"adapters of {printable(architecture)} need llama.cpp's own .gguf file beside them"
        )
    [kind] = [kind for kind, name in MODEL_ARCH_NAMES.items() if name == architecture]
    names = get_tensor_name_map(kind, values[f"{architecture}.block_count"])
    matrices: dict[str, NDArray[np.float16]] = {}
    for name, matrix in load(bytes_of(file, "weights")).items():
        end = A if name.endswith(A) else B
        layer = name.removeprefix(PREFIX).removesuffix(end)
        if (place := names.get_name(layer)) is None or not np.isfinite(matrix).all():
            raise ValueError(f"{printable(name)} is no layer of it, or holds numbers that are none")
        if end == B and (heads := _PERMUTED[architecture].get(layer.rpartition(".")[2])):
            matrix = _permuted(matrix, values[f"{architecture}.{heads}"])
        matrices[f"{place}.weight.{'lora_a' if end == A else 'lora_b'}"] = matrix.astype(np.float16)
    if not matrices:
        raise ValueError("it has no tensors")
    return matrices


def _permuted(rows: NDArray[Any], heads: int) -> NDArray[Any]:
    """Return rows (out, r) in the order in which llama.cpp turns the pairs of a head's
    positions.
    """
    halves = rows.reshape(heads, 2, len(rows) // heads // 2, -1)
    return np.ascontiguousarray(halves.swapaxes(1, 2).reshape(rows.shape))


def _write(
    file: Path, architecture: str, alpha: float, layers: Mapping[str, NDArray[np.float16]]
) -> None:
    """Write what llama.cpp's `convert_lora_to_gguf.py` makes of such an adapter."""
    from gguf import GGUFWriter, LlamaFileType

    with replacing(file) as part:
        writer = GGUFWriter(part, architecture)
        try:
            writer.add_type("adapter")
            writer.add_string("adapter.type", "lora")
            writer.add_float32("adapter.lora.alpha", alpha)
            writer.add_file_type(LlamaFileType.MOSTLY_F16)
            for name, matrix in layers.items():
                writer.add_tensor(name, matrix)
            writer.write_header_to_file()
            writer.write_kv_data_to_file()
            writer.write_tensors_to_file()
        finally:
            writer.close()
