"""Random draws keyed by content.

A draw depends on its purpose (run seed, scene, link), never on when it is made, so order, batch
size, workers and a resume cannot change it, and two operating points share their draws.
"""

import hashlib

import numpy as np
from numpy.typing import NDArray


def generator(*key: object) -> np.random.Generator:
    """Return a random generator that is the same for equal keys, on every machine.

    So draws do not depend on their order. `key` has any values with a stable `repr`, such as a
    purpose and seeds. They are joined by their `repr`, so `1` and `"1"` differ.
    """
    seed = hashlib.sha256("\x1f".join(map(repr, key)).encode()).digest()[:16]
    # The words of the digest as a whole number, which NumPy would take apart at thrice the cost.
    words = np.frombuffer(seed[::-1], "<u4")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


def uniforms(shape: tuple[int, ...], *key: object) -> NDArray[np.float64]:
    """Return uniform draws in [0, 1) of this shape, the same for equal keys on every machine.

    `key` has any values with a stable `repr`, such as a purpose and seeds.
    """
    return generator(*key).random(shape)
