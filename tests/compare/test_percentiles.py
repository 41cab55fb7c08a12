"""Percentiles of resampled episodes: each is what it would be of the decisions written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.statistics import known_mean
from harness.runs.percentiles import PERCENTILES, Decided, differences

DECISIONS = st.lists(
    st.tuples(st.integers(0, 3), st.sampled_from([0.0, 20.5, 21.0, 145.0, float("nan")])),
    max_size=12,
)
SEEDS = st.integers(1, 3)


def laid(made: list[tuple[int, float]]) -> Decided:
    return np.array([place for place, _ in made], dtype=np.int64), np.array(
        [v for _, v in made], dtype=float
    )


@given(st.data(), SEEDS)
def test_the_difference_is_that_of_all_decisions_of_episodes_that_both_know(
    data: st.DataObject, n: int
) -> None:
    first, second = sides = [[laid(data.draw(DECISIONS)) for _ in range(n)] for _ in "ab"]
    found = list(differences(first, second, 4))
    by_seed, met = [], set()
    for one, other in zip(*sides, strict=True):
        known = [{int(p) for p, v in zip(*side, strict=True) if v == v} for side in (one, other)]
        met |= (both := known[0] & known[1])
        kept = [
            [v for p, v in zip(*side, strict=True) if p in both and v == v] for side in (one, other)
        ]
        by_seed.append([np.percentile(v, PERCENTILES) if v else np.full(3, np.nan) for v in kept])
    if not met:
        assert found == []
        return
    expected = known_mean(np.array(by_seed), 0)
    for i, (percent, a, b, change) in enumerate(found):
        assert percent == PERCENTILES[i]
        wanted = [*expected[:, i], expected[1, i] - expected[0, i]]
        np.testing.assert_allclose(
            [a, b, change.value], wanted, atol=1e-9
        )  # a change of 0 has rounding alone
        assert (change.n, change.n_excluded) == (len(met), 4 - len(met))
        assert change.low < change.high or np.isnan([change.low, change.high]).all()
        assert len(met) > 1 or np.isnan(change.low)


@pytest.mark.slow
def test_the_interval_has_the_width_that_theory_gives_a_median() -> None:
    """The median of n normal values has a standard error of 1.2533 sigma / sqrt(n);
    mean of 30 widths.
    """
    rng, place, widths = np.random.default_rng(7), np.arange(400), []
    for _ in range(30):
        b = (place, rng.normal(100, 10, 400))
        [(_, _, _, median), *_] = differences([(place, np.zeros(400))], [b], 400)
        widths.append(median.high - median.low)
    assert abs(np.mean(widths) / (2 * 1.96 * 1.2533 * 10 / 20) - 1) < 0.1
