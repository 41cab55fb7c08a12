"""Muon in float32, for CPUs: matrices move along the orthogonal factor of their momentum.

After Jordan et al., "Muon: an optimizer for hidden layers in neural networks" (2024), with the step
size of Liu et al., "Muon is scalable for LLM training" (2025). PyTorch's own computes in bfloat16,
which a CPU without such arithmetic emulates: much of a training step goes there.
"""

from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Any

import torch

# Jordan et al.: steepest at zero, singular values end in 0.7 to 1.2
QUINTIC = (3.4445, -4.7750, 2.0315)
STEPS = 5


class Muon(torch.optim.Optimizer):  # type: ignore[misc]
    """Optimise weight matrices with Muon: steps of Nesterov momentum 0.95, orthogonalised.

    It is a PyTorch optimiser. Matrices of one shape are orthogonalised as one batch.
    """

    def __init__(self, matrices: Iterable[Any], lr: float, weight_decay: float) -> None:
        super().__init__(matrices, {"lr": lr, "weight_decay": weight_decay, "momentum": 0.95})

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def step(self, closure: Callable[[], float] | None = None) -> None:
        for group in self.param_groups:
            lr, momentum = group["lr"], group["momentum"]
            matrices = [p for p in group["params"] if p.grad is not None]
            for (rows, columns), alike in groupby(sorted(matrices, key=_shape), key=_shape):
                same = list(alike)
                for p in same:
                    state = self.state[p]
                    state.setdefault("momentum", torch.zeros_like(p)).lerp_(p.grad, 1 - momentum)
                ahead = [p.grad.lerp(self.state[p]["momentum"], momentum) for p in same]
                size = 0.2 * max(rows, columns) ** 0.5  # the root mean square of AdamW's step
                for p, move in zip(same, orthogonal(torch.stack(ahead)), strict=True):
                    p.mul_(1 - lr * group["weight_decay"]).add_(move, alpha=-lr * size)


def _shape(p: Any) -> tuple[int, int]:
    return tuple(p.shape)


def orthogonal(m: Any) -> Any:
    """Return matrices (n, rows, columns) with their singular values moved near 1.

    The optimiser Muon does so with its steps. This is Newton and Schulz's iteration, five steps of
    a quintic polynomial.
    """
    if m.shape[1] > m.shape[2]:
        return orthogonal(m.mT).mT
    x = m / m.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    a, b, c = QUINTIC
    for _ in range(STEPS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x
