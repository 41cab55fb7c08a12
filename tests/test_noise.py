"""Draws keyed by content: those of many keys at once are those of each."""

import pytest

from harness.core import noise


@pytest.mark.parametrize("count", [0, 1, noise.MANY - 1, noise.MANY, 300])
def test_many_keys_draw_what_each_draws(count):
    keys = [("sensors", 200_000 + n, n % 7, "v1", f"v{n}") for n in range(count)]
    drawn = 0
    for key, together in zip(keys, noise.generators(keys), strict=True):
        alone = noise.generator(*key)
        assert together.bit_generator.state == alone.bit_generator.state
        assert together.standard_normal(8).tolist() == alone.standard_normal(8).tolist()
        assert together.random() == alone.random()
        drawn += 1
    assert drawn == count
