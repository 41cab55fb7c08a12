"""A LoRA adapter while it is trained, and its files, in peft's format.

Hu et al., "LoRA: low-rank adaptation of large language models" (2021): y = W x + alpha / r * B A x,
with W kept. Two matrices a layer are less than the package that trains them would bring.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from harness.backends.adapters import CONFIG, PREFIX, TENSORS, A, B
from harness.core.files import replacing, write_whole

SCALE = 2.0  # alpha / r


class LowRank(torch.nn.Module):  # type: ignore[misc]
    """Add a trainable low-rank update to a linear layer with weights (out, in), which are kept.

    This is LoRA: the update is the product of matrices (out, rank) and (rank, in), scaled by alpha
    / r = 2.
    """

    def __init__(self, kept: Any, rank: int, generator: Any) -> None:
        super().__init__()
        rows, columns = kept.weight.shape
        self.kept = kept
        start = torch.empty(rank, columns).uniform_(-1.0, 1.0, generator=generator) / math.sqrt(
            columns
        )
        self.a = torch.nn.Parameter(start)
        self.b = torch.nn.Parameter(torch.zeros(rows, rank))

    def forward(self, x: Any) -> Any:
        return self.kept(x) + (x @ self.a.T) @ (SCALE * self.b.T)


def widen(model: Any, rank: int, seed: int) -> None:
    """Replace every linear layer of a model's blocks by a `LowRank` around it, and freeze all else.

    `model` is a transformers model, which is changed in place, `rank` the rank of each update, and
    `seed` draws the initial matrices.
    """
    model.requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    layers = [(n, m) for n, m in model.base_model.named_modules() if isinstance(m, torch.nn.Linear)]
    for name, linear in layers:
        parent, _, last = name.rpartition(".")
        setattr(model.base_model.get_submodule(parent), last, LowRank(linear, rank, generator))


def _layers(model: Any) -> Iterator[tuple[str, LowRank]]:
    return ((n, m) for n, m in model.named_modules() if isinstance(m, LowRank))


def write(model: Any, out: Path, base: str) -> None:
    """Write the LoRA adapter of a widened model to a folder, in F16, as peft's two files.

    The model is one that `widen` changed; `base` is the path or id of the model that it was trained
    on.
    """
    tensors, rank = {}, 0
    for name, layer in _layers(model):
        rank = len(layer.a)
        for end, matrix in ((A, layer.a), (B, layer.b)):
            tensors[f"{PREFIX}{name}{end}"] = matrix.detach().half().cpu().contiguous()
    config = {
        "peft_type": "LORA",
        "task_type": "CAUSAL_LM",
        "base_model_name_or_path": base,
        "r": rank,
        "lora_alpha": SCALE * rank,
        "lora_dropout": 0.0,
        "bias": "none",
        "inference_mode": True,
        "target_modules": sorted({name.rpartition(".")[2] for name, _ in _layers(model)}),
    }
    with replacing(out / TENSORS) as part:
        save_file(tensors, part, metadata={"format": "pt"})
    write_whole(out / CONFIG, json.dumps(config, indent=1) + "\n")
