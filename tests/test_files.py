"""The canonical text of a value is the standard library's to the byte: digests and keys are made of it."""

import enum
import hashlib
import json
import math
from datetime import date
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from harness.core.files import canonical_json, digest


class Colour(enum.StrEnum):
    RED = "red"


class Name(str):
    __slots__ = ()


TEXT = st.text(st.characters(exclude_categories=()))  # lone surrogates too
NUMBERS = st.floats() | st.floats(-1e-3, 1e-3) | st.floats(1e15, 1e17) | st.integers() | st.floats(0, 1)
ODD = st.sampled_from([Colour.RED, Name("n"), np.float64(0.1)])
LEAVES = st.none() | st.booleans() | NUMBERS | TEXT | ODD
KEYS = TEXT | st.sampled_from([Colour.RED, Name("k")])
ANY_KEYS = KEYS | st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False)
JSON = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(KEYS, inner)
    | st.dictionaries(ANY_KEYS, inner, max_size=2),
    max_leaves=20,
)  # fmt: skip


def of_the_standard_library(value: Any) -> str | None:
    """The text that the standard library writes, or None where it refuses."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError):
        return None


@pytest.mark.slow
@given(JSON)
@example([1e-5, -1e-5, 9.999e-5, 1e-4, 1e16, 9999999999999998.0, 5e-324, -0.0, 2**64, -(2**63) - 1])
@example({"\ud83d": '\x7f\u2028\x00\x1f\b\f\n\r\t"\\/', "\ue000": 1, "\U0001f600": 2})
@example({10: 1, 9: 2})
def test_the_text_and_the_digest_are_the_standard_librarys(value: Any) -> None:
    expected = of_the_standard_library(value)
    if expected is None:
        with pytest.raises((TypeError, ValueError)):
            canonical_json(value)
    else:
        assert canonical_json(value) == expected
        if expected.isascii():
            assert digest(value) == hashlib.sha256(expected.encode()).hexdigest()


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused_however_deep_it_stands(number: float) -> None:
    for value in (number, [1.0, number], {"a": [{"b": (None, number)}]}):
        with pytest.raises(ValueError, match="not JSON compliant"):
            canonical_json(value)


@pytest.mark.parametrize("value", [b"bytes", {1, 2}, date(2026, 1, 1), 1j, object()])
def test_a_type_that_json_lacks_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="not JSON serializable"):
        canonical_json({"in": [value]})
