"""Compute entropy, and the trigger: when a vehicle is unsure enough to ask the others."""

import numpy as np

from harness.core.arrays import Bools, Floats, summed


def entropy_nats(p: Floats) -> Floats:
    """Return how unsure intents are: their Shannon entropy in nats, `(...)`, with 0 log 0 = 0.

    `p` are intents, probabilities of A actions, `(..., A)`.
    """
    # p log p is never positive; abs() negates it, and also turns -0.0 into 0.0.
    return summed(np.abs(p * np.log(np.where(p > 0, p, 1.0))), axis=-1)


def normalised_entropy(p: Floats) -> Floats:
    """Return the entropy of intents divided by ln A, `(...)`, from 0 (sure) to 1 (uniform).

    `p` are intents, probabilities of A actions, `(..., A)`. It is 0 if A is 1.
    """
    return entropy_nats(p) / (np.log(p.shape[-1]) if p.shape[-1] > 1 else 1.0)


def triggered(p: Floats, tau_nats: float) -> Bools:
    """Return whether intents are unsure enough to ask helpers: entropy above `tau_nats`, `(...)`.

    It is Eq. 3 of the paper that this harness follows. `p` are intents, probabilities of A actions,
    `(..., A)`.
    """
    return entropy_nats(p) > tau_nats
