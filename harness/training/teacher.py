"""The teacher: what an outcome table says a vehicle should have intended.

Each safe action has the weight exp(-delay / 0.25 s), so that a needless SLOWER counts little; an unsafe one
has none. Where IDLE and FASTER come to the same (at the highest speed level) most goes to IDLE. A viewer that
cannot tell scenes apart is best served by the mean of their labels, so what it cannot see makes it unsure.
"""

import numpy as np

from harness.core.arrays import Floats
from harness.dataset.load import Dataset

SOFTNESS_S = 0.25
CALM = {"FASTER": 0.3}  # prior weight of an action, 1 if not named


def labels(dataset: Dataset) -> Floats:
    """Soft labels of every scene, (n, A); uniform where no action is safe."""
    safe, delay_s = dataset.outcome_arrays()
    prior = np.array([CALM.get(a, 1.0) for a in dataset.actions])
    weight = np.where(safe, prior * np.exp(-np.nan_to_num(delay_s) / SOFTNESS_S), 0.0)
    weight = np.where(safe.any(axis=1, keepdims=True), weight, 1.0)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
