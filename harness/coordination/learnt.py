"""A learnt schedule: what asking a helper is worth, by a small network, from what the ego knows before."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from harness.coordination.scheduling import Known
from harness.core.arrays import Floats
from harness.core.errors import UserError

FAR_S, FAR_M = 6.0, 100.0  # beyond, farther is all the same
INPUTS = (
    "entropy", "margin", "most careful", "least careful", "unseen, most", "unseen, mean", "added, most",
    "added, mean", "range", "helper to zone", "ego to zone", "seconds to zone", "others nearer", "others",
)  # fmt: skip


@dataclass(frozen=True)
class Network:
    """One hidden layer; F inputs, J units.

    Attributes:
        centre: of each input, (F,).
        scale: by which it is divided, (F,).
        into: weights into the units, (F, J).
        bias: of the units, (J,).
        out: their weights in the output, (J,).
        base: of the output.
    """

    centre: Floats
    scale: Floats
    into: Floats
    bias: Floats
    out: Floats
    base: float

    def __call__(self, inputs: Floats) -> Floats:
        """The output `(...)` for inputs `(..., F)`."""
        units = np.tanh(((inputs - self.centre) / self.scale) @ self.into + self.bias)
        return np.asarray(units @ self.out + self.base)


@dataclass(frozen=True)
class Learnt:
    """By how much asking the helper, and nobody else, is expected to raise the probability of success."""

    network: Network
    threshold: float
    needs: ClassVar[tuple[str, ...]] = ("outlook",)

    def worth(self, known: Known) -> Floats:
        """What the network says of each helper, `(..., H)`."""
        return np.where(known.may_ask, self.network(inputs(known)), np.nan)


@dataclass(frozen=True)
class Weights:
    """A `Network` as a file has it."""

    centre: tuple[float, ...]
    scale: tuple[float, ...]
    into: tuple[tuple[float, ...], ...]
    bias: tuple[float, ...]
    out: tuple[float, ...]
    base: float


@dataclass(frozen=True)
class Stated:
    """What a file of `schedules/` says.

    Attributes:
        description: one sentence.
        command: which made it.
        learnt_from: the runs, with their layout seeds.
        tuned_on: the runs on which the threshold was chosen, with their layout seeds.
        condition: the operating point that it was learnt under.
        threshold: its own.
        inputs: what the network looks at, `INPUTS`.
        network: its weights.
    """

    description: str
    command: str
    learnt_from: tuple[str, ...]
    tuned_on: tuple[str, ...]
    condition: str
    threshold: float
    inputs: tuple[str, ...]
    network: Weights

    def schedule(self, where: str) -> Learnt:
        """The schedule. Raises UserError where inputs are others, or weights do not go together."""
        arrays: dict[str, Any] = {name: np.array(value) for name, value in asdict(self.network).items()}
        f, j = len(INPUTS), len(self.network.bias)
        shapes = {"centre": (f,), "scale": (f,), "into": (f, j), "bias": (j,), "out": (j,), "base": ()}
        if self.inputs != INPUTS or any(arrays[name].shape != shape for name, shape in shapes.items()):
            raise UserError(f"{where} has other inputs or sizes than the program; learn it again")
        return Learnt(Network(**arrays), self.threshold)


def inputs(known: Known) -> Floats:
    """`INPUTS` of each helper, `(..., H, F)`; anything for one that may not be asked."""
    seen, may_ask = known.outlook, known.may_ask
    assert seen is not None
    ranked = np.sort(known.own, axis=-1)
    regions = max(seen.unseen.shape[-1], 1)
    range_m = np.where(may_ask, known.range_m, np.inf)
    nearer = (range_m[..., None, :] < range_m[..., :, None]).sum(axis=-1)
    of_ego = (
        known.entropy_nats, 1.0 - ranked[..., -1] + ranked[..., -2:-1].sum(axis=-1), known.own[..., 0],
        known.own[..., -1], seen.unseen.max(axis=-1, initial=0.0), seen.unseen.sum(axis=-1) / regions,
        known.distance_m[..., 0] / FAR_M, np.minimum(seen.to_zone_s, FAR_S) / FAR_S,
        may_ask.sum(axis=-1) - 1.0,
    )  # fmt: skip
    entropy, margin, careful, bold, unseen_most, unseen, ego_m, to_zone, others = (
        np.broadcast_to(of[..., None], may_ask.shape) for of in of_ego
    )
    columns = (
        entropy, margin, careful, bold, unseen_most, unseen, seen.added.max(axis=-1, initial=0.0),
        seen.added.sum(axis=-1) / regions, known.range_m / FAR_M, known.distance_m[..., 1:] / FAR_M, ego_m,
        to_zone, nearer, others,
    )  # fmt: skip
    return np.stack(columns, axis=-1)
