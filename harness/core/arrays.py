"""Types of the arrays that rules take and return. `(...)` in a docstring means any number of batch dims."""

from functools import reduce

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Texts = NDArray[np.str_]


def summed(values: Floats, axis: int) -> Floats:
    """Sum along a short axis, such as that of actions, several times as fast as `np.sum`."""
    total: Floats = reduce(np.add, np.moveaxis(values, axis, 0))
    return total
