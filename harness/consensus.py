"""How intents become one policy. Vehicle 0 is the ego and is always heard.

A new rule is one function of (p, weights) and one entry in `RULES`.
"""

from collections.abc import Callable

import numpy as np

from harness.arrays import Bools, Floats


def inverse_distance_weights(distance_m: Floats, heard: Bools, min_distance_m: float) -> Floats:
    """Weight of each vehicle, `(..., 1+H)`, summing to 1 (paper Eq. 2); 0 for a helper not heard.

    With no helper heard the ego's weight is exactly 1, which is the paper's fall-back to its own intent.

    Args:
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`.
        heard: which helpers' replies are fused, `(..., H)`.
        min_distance_m: lower bound of a distance, above 0: Eq. 2 has no value at 0 m, and a vehicle
            in the zone would otherwise outvote everybody.
    """
    fused = np.insert(heard, 0, True, axis=-1)
    closeness = np.where(fused, 1.0 / np.maximum(distance_m, min_distance_m), 0.0)
    total: Floats = np.sum(closeness, axis=-1, keepdims=True)
    return closeness / total


def linear_pool(p: Floats, weights: Floats) -> Floats:
    """Weighted mean of intents, `(..., A)` (paper Eq. 1; the linear opinion pool of Stone 1961).

    Args:
        p: intents, `(..., 1+H, A)`. Rows of weight 0 may hold anything, NaN included.
        weights: weight of each vehicle, `(..., 1+H)`, summing to 1.
    """
    row_weights = weights[..., None]
    pooled: Floats = np.sum(row_weights * np.where(row_weights > 0, p, 0.0), axis=-2)
    return pooled


RULES: dict[str, Callable[[Floats, Floats], Floats]] = {"linear": linear_pool}
