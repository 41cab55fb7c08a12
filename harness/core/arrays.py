"""Types of the arrays that rules take and return.
`(...)` in a docstring means any number of batch dims.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from functools import reduce
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Texts = NDArray[np.str_]
Pixels = NDArray[np.uint8]  # of a picture, (height, width, 3) red, green and blue

T = TypeVar("T")
# of a number from another package, in its unit: no sum of some is beyond what tables may hold
MOST = 1e12
ROUNDING = 1e-6  # by which the probabilities of a distribution may miss a sum of 1


def summed(values: Floats, axis: int) -> Floats:
    """Return the sum along a short axis, the last (-1) or the one before (-2), which is dropped.

    Several times as fast as `np.sum` if the axis is short, such as that of actions.
    """
    terms = values.swapaxes(axis, -1)
    total: Floats = reduce(np.add, [terms[..., k] for k in range(terms.shape[-1])])
    return total


def taken(values: Any, at: Any) -> Any:
    """Return the rows of an array, (n, ...), at indices or a mask of its leading axis.

    It is `values[at]`, in a tenth of the time where rows are short.
    """
    places = np.asarray(at)
    if not places.ndim:
        return values[at]
    return values.take(np.flatnonzero(places) if places.dtype == np.bool_ else places, axis=0)


def any_of(flags: Bools) -> Bools:
    """Return whether any flag is true along the last axis, which is dropped.

    It is `np.any` of `flags`, (..., n), with a result (...); faster if n is small, such as the
    number of helpers.
    """
    first = np.zeros(flags.shape[:-1], dtype=bool)
    result: Bools = reduce(np.logical_or, [flags[..., k] for k in range(flags.shape[-1])], first)
    return result


def count_of(flags: Bools) -> Ints:
    """Return how many flags are true along the last axis, which is dropped.

    It is `np.sum` of `flags`, (..., n), with a result (...); faster if n is small, such as the
    number of helpers.
    """
    none = np.zeros(flags.shape[:-1], dtype=np.int64)
    count: Ints = reduce(np.add, [flags[..., k] for k in range(flags.shape[-1])], none)
    return count


def least_of(values: Floats) -> Floats:
    """Return the least value along the last axis, which is dropped; faster than `np.min` if short.

    `values` are (..., n), with a result (...).
    """
    least: Floats = reduce(np.minimum, [values[..., k] for k in range(values.shape[-1])])
    return least


def length_of(vectors: Floats) -> Floats:
    """Return the Euclidean length of vectors of few numbers, (..., n), as an array (...).

    It is `np.linalg.norm` along the last axis, in a fraction of the time.
    """
    return np.asarray(np.sqrt(summed(vectors * vectors, axis=-1)))


def read_only(value: T) -> T:
    """Return arrays as views that cannot be written to, to give to code of another package.

    Such code then raises ValueError where it writes to its arguments, and changes nothing. `value`
    is an array, or a frozen dataclass or a mapping whose values are arrays; the result is of the
    same type.
    """
    given: Any = value
    if isinstance(given, np.ndarray):
        given = given.view()
        given.flags.writeable = False
    elif isinstance(given, Mapping):
        given = {name: read_only(each) for name, each in given.items()}
    elif is_dataclass(given) and not isinstance(given, type):
        parts = {field.name: read_only(getattr(given, field.name)) for field in fields(given)}
        given = replace(given, **parts)
    result: T = given
    return result


def check_shape(name: str, values: Any, *allowed: tuple[int, ...]) -> None:
    """Raise ValueError unless what another package gave is an array of an allowed shape.

    It must be a NumPy array, unmasked, of one of the `allowed` shapes. `name` names the values in
    the message.
    """
    if not isinstance(values, np.ndarray) or isinstance(values, np.ma.MaskedArray):
        raise ValueError(f"{name} of type {type(values).__name__}, not an array of numpy's")
    if values.shape not in allowed:
        raise ValueError(f"{name} of shape {values.shape}, not {' or '.join(map(str, allowed))}")


def numbers(name: str, values: Any, *allowed: tuple[int, ...]) -> Floats:
    """Return a copy, as floats, of an array that another package gave.

    Raises ValueError, which begins with `name`, unless `values` is an unmasked array of real
    numbers of one of the `allowed` shapes, each infinite or within `MOST`.
    """
    check_shape(name, values, *allowed)
    if values.dtype.kind not in "biuf":
        raise ValueError(f"{name} of type {values.dtype}, not numbers")
    copy = np.array(values, dtype=np.float64)
    vast = copy[np.isfinite(copy) & (np.abs(copy) > MOST)]
    if len(vast):
        raise ValueError(f"{name} with {vast[0]:g}; allowed: up to {MOST:g}")
    return copy


def check_distributions(name: str, values: Floats, where: Bools) -> None:
    """Raise ValueError unless the distributions `values`, (..., A), sum to 1 and have no negatives.

    The last axis has the probabilities of A actions. Only those where `where`, (...), is true are
    checked; `name` names them in the message.
    """
    rows = values[where]
    sums_to_one = np.abs(np.sum(rows, axis=-1) - 1.0) <= ROUNDING
    wrong = ~(sums_to_one & np.all(rows >= 0.0, axis=-1))
    if wrong.any():
        raise ValueError(f"{name} that are no distributions, such as {rows[wrong][0].tolist()}")


def check_shares(name: str, values: Floats, where: Bools) -> None:
    """Raise ValueError unless values are shares: from 0 to 1, or NaN, where `where` is true.

    Both arrays have the same shape, of any axes; `name` names the values in the message.
    """
    wrong = values[where & ((values < 0.0) | (values > 1.0 + ROUNDING))]
    if wrong.size:
        raise ValueError(f"{name} that are not from 0 to 1, such as {wrong[0]:g}")
