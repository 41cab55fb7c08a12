"""A LoRA adapter while it is trained, and its files: peft's format, and a GGUF file for llama.cpp.

Hu et al., "LoRA: low-rank adaptation of large language models" (2021): y = W x + alpha / r * B A x, with W
kept. Two matrices a layer are less than the package that trains them would bring.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from harness.backends.adapters import CONFIG, PREFIX, TENSORS, A, B
from harness.core.files import replacing, write_whole

SCALE = 2.0  # alpha / r
_PERMUTED = {"llama": {"q_proj": "num_attention_heads", "k_proj": "num_key_value_heads"}}
ARCHITECTURES = ("llama", "qwen2", "qwen3")  # those whose adapters are written for llama.cpp


class LowRank(torch.nn.Module):  # type: ignore[misc]
    """A linear layer (out, in) that stays, plus two matrices (rank, in) and (out, rank) that learn."""

    def __init__(self, kept: Any, rank: int, generator: Any) -> None:
        super().__init__()
        rows, columns = kept.weight.shape
        self.kept = kept
        start = torch.empty(rank, columns).uniform_(-1.0, 1.0, generator=generator) / math.sqrt(columns)
        self.a = torch.nn.Parameter(start)
        self.b = torch.nn.Parameter(torch.zeros(rows, rank))

    def forward(self, x: Any) -> Any:
        return self.kept(x) + (x @ self.a.T) @ (SCALE * self.b.T)


def widen(model: Any, rank: int, seed: int) -> None:
    """Put a `LowRank` around every linear layer of a model's blocks; nothing else of it learns."""
    model.requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    layers = [(n, m) for n, m in model.base_model.named_modules() if isinstance(m, torch.nn.Linear)]
    for name, linear in layers:
        parent, _, last = name.rpartition(".")
        setattr(model.base_model.get_submodule(parent), last, LowRank(linear, rank, generator))


def _layers(model: Any) -> Iterator[tuple[str, LowRank]]:
    return ((n, m) for n, m in model.named_modules() if isinstance(m, LowRank))


def write(model: Any, out: Path, base: str) -> None:
    """Write a widened model's adapter to a folder, F16: peft's two files, and a GGUF file where there is one.

    `base` is how the model is opened that it was trained on.
    """
    tensors, rank = {}, 0
    for name, layer in _layers(model):
        rank = len(layer.a)
        for end, matrix in ((A, layer.a), (B, layer.b)):
            tensors[f"{PREFIX}{name}{end}"] = matrix.detach().half().cpu().contiguous()
    config = {
        "peft_type": "LORA", "task_type": "CAUSAL_LM", "base_model_name_or_path": base, "r": rank,
        "lora_alpha": SCALE * rank, "lora_dropout": 0.0, "bias": "none", "inference_mode": True,
        "target_modules": sorted({name.rpartition(".")[2] for name, _ in _layers(model)}),
    }  # fmt: skip
    with replacing(out / TENSORS) as part:
        save_file(tensors, part, metadata={"format": "pt"})
    write_whole(out / CONFIG, json.dumps(config, indent=1) + "\n")
    if model.config.model_type in ARCHITECTURES:
        _write_gguf(model, out / f"{out.absolute().name}-lora-f16.gguf", SCALE * rank)


def _write_gguf(model: Any, file: Path, alpha: float) -> None:
    """Write what llama.cpp's `convert_lora_to_gguf.py` makes of such an adapter."""
    from gguf import MODEL_ARCH_NAMES, GGUFWriter, LlamaFileType, get_tensor_name_map

    config, kind = model.config, model.config.model_type
    [architecture] = [arch for arch, name in MODEL_ARCH_NAMES.items() if name == kind]
    names = get_tensor_name_map(architecture, config.num_hidden_layers)
    with replacing(file) as part:
        writer = GGUFWriter(part, kind)
        try:
            writer.add_type("adapter")
            writer.add_string("adapter.type", "lora")
            writer.add_float32("adapter.lora.alpha", alpha)
            writer.add_file_type(LlamaFileType.MOSTLY_F16)
            for name, layer in _layers(model):
                place, last = names.get_name(name), name.rpartition(".")[2]
                a, b = (m.detach().half().cpu().numpy() for m in (layer.a, layer.b))
                if heads := _PERMUTED.get(kind, {}).get(last):
                    b = _permuted(b, getattr(config, heads))
                writer.add_tensor(f"{place}.weight.lora_a", a)
                writer.add_tensor(f"{place}.weight.lora_b", b)
            writer.write_header_to_file()
            writer.write_kv_data_to_file()
            writer.write_tensors_to_file()
        finally:
            writer.close()


def _permuted(rows: Any, heads: int) -> Any:
    """Return rows (out, r) in the order in which llama.cpp turns the pairs of a head's positions."""
    halves = rows.reshape(heads, 2, len(rows) // heads // 2, -1)
    return np.ascontiguousarray(halves.swapaxes(1, 2).reshape(rows.shape))
