"""Compute entropy, and the trigger: when a vehicle is unsure enough to ask the others."""

import numpy as np

from harness.core.arrays import Bools, Floats, summed


def entropy_nats(p: Floats) -> Floats:
    """Return the Shannon entropy of intents `(..., A)` in nats, `(...)`, with 0 log 0 = 0."""
    # p log p is never positive; abs() negates it, and also turns -0.0 into 0.0.
    return summed(np.abs(p * np.log(np.where(p > 0, p, 1.0))), axis=-1)


def normalised_entropy(p: Floats) -> Floats:
    """Return the entropy of intents `(..., A)` divided by ln A, `(...)`: 0 sure, 1 uniform.

    It is 0 if A is 1.
    """
    return entropy_nats(p) / (np.log(p.shape[-1]) if p.shape[-1] > 1 else 1.0)


def triggered(p: Floats, tau_nats: float) -> Bools:
    """Return whether the entropy of intents `(..., A)` is above `tau_nats`, `(...)` (Eq. 3)."""
    return entropy_nats(p) > tau_nats
