"""Intents of a given entropy."""

from functools import lru_cache

import numpy as np

from harness.core.arrays import Floats, Ints

ACTIONS = 3
CUT = 2.45  # standard deviations either side; .70 to .946 nats for the ego


def peaked(nats: Floats, top: Ints) -> Floats:
    """Intents `(..., A)` of a given entropy: most on one action, the rest shared alike."""
    entropies, shares = _by_entropy()
    most = np.interp(nats, entropies, shares)[..., None]
    return np.where(np.asarray(top)[..., None] == np.arange(ACTIONS), most, (1 - most) / (ACTIONS - 1))


@lru_cache(maxsize=1)
def _by_entropy() -> tuple[Floats, Floats]:
    share = np.linspace(1.0, 1 / ACTIONS, 4001)[1:-1]
    rest = (1 - share) / (ACTIONS - 1)
    return -share * np.log(share) - (1 - share) * np.log(rest), share


def spread(mean: float, sd: float, uniforms: Floats) -> Floats:
    """Draws of a normal distribution, cut at `CUT` standard deviations either side, by its quantiles."""
    from scipy.special import ndtr, ndtri

    below = ndtr(-CUT)
    return np.asarray(mean + sd * ndtri(below + (1 - 2 * below) * uniforms))
