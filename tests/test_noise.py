"""Keyed draws."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from harness.core import noise

KEYS = st.lists(st.tuples(st.text(max_size=5), st.integers(), st.integers(0, 9)), max_size=20)


@given(KEYS, st.integers(0, 12))
def test_normals_of_many_keys_are_those_of_each_keys_generator(keys, n):
    drawn = noise.normals(n, keys)
    assert drawn.shape == (len(keys), n)
    for key, row in zip(keys, drawn, strict=True):
        assert np.array_equal(row, noise.generator(*key).standard_normal(n))
