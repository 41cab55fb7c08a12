"""Distributions and quantiles are those of SciPy."""

import math

import numpy as np
import pytest
from scipy import special
from scipy.stats import t as student

from harness.core.quantiles import (
    logistic,
    normal_quantile,
    normal_share,
    root,
    student_quantile,
)


def test_the_normal_distribution_and_the_logistic_are_scipys() -> None:
    z = np.linspace(-37, 9, 1001).reshape(7, 143)
    assert normal_share(z) == pytest.approx(special.ndtr(z), rel=1e-12, abs=0)
    p = np.array([0, 1e-300, 1e-9, 0.02, 0.5, 0.975, 1 - 1e-9, 1, 1.5, math.nan])
    assert normal_quantile(p) == pytest.approx(special.ndtri(p), rel=1e-13, nan_ok=True)
    x = np.linspace(-700, 700, 101)
    assert logistic(x) == pytest.approx(special.expit(x), rel=1e-13, abs=0)


@pytest.mark.parametrize("freedom", [1, 1.5, 2, 4, 49.9, 50, 99, 101, 1e3, 1e5])
def test_students_quantile_is_scipys(freedom: float) -> None:
    for p in (0.5, 0.5005, 0.75, 0.975, 0.9995, 1 - 1e-9, 1 - 5e-13):
        expected = student.isf(1 - p, freedom)
        assert student_quantile(freedom, p) == pytest.approx(expected, rel=1e-11, abs=1e-12)


def test_a_root_is_found_from_either_side() -> None:
    for low, high in ((0.0, 2.0), (2.0, 0.0), (-9.0, 1.5)):
        assert root(lambda x: x**3 - 2, low, high, 1e-12) == pytest.approx(2 ** (1 / 3), abs=1e-11)
    assert root(lambda x: x, 0.0, 1.0, 1e-9) == 0
