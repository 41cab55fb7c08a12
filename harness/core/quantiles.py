"""Distributions and quantiles that intervals need; SciPy, which has them, takes 140 MB."""

import math
from collections.abc import Callable
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from harness.core.arrays import Floats

DIGITS = 2.0**-51  # twice the relative distance of neighbouring floats
NEAR = 1e-8  # relative step after which Newton's next is below a float's digits
MOST_STEPS = 1000  # of what converges in some ten
LARGE = 50.0  # from here on, logarithms of the gamma function lose more digits than the series has
_INVERSE = np.frompyfunc(NormalDist().inv_cdf, 1, 1)
_ERFC = np.frompyfunc(math.erfc, 1, 1)


def logistic(x: Floats) -> Floats:
    """Return the logistic function 1 / (1 + exp(-x)) of an array, in its shape."""
    return np.asarray(np.exp(-np.logaddexp(0.0, -x)))


def normal_share(z: Floats | float) -> Floats:
    """Return the standard normal distribution function of an array or a number, in its shape."""
    return np.asarray(0.5 * np.asarray(_ERFC(np.asarray(z) * -math.sqrt(0.5)), dtype=float))


def normal_quantile(p: Floats | float) -> Floats:
    """Return the quantiles of the standard normal distribution for probabilities, in their shape.

    They are infinite for 0 and 1, and NaN outside.
    """
    shares = np.asarray(p, dtype=float)
    quantiles = np.where(shares == 0, -np.inf, np.where(shares == 1, np.inf, np.nan))
    inside = (shares > 0) & (shares < 1)
    quantiles[inside] = _INVERSE(shares[inside])
    return quantiles


@lru_cache(maxsize=4096)
def student_quantile(freedom: float, p: float) -> float:
    """Return the quantile of Student's t distribution for a probability from .5 to below 1.

    `freedom` is the number of degrees of freedom, 1 or more. It is found by Newton's method on the
    logarithms of t and of the probability above it, from the normal quantile on.
    """
    least = 1 - p
    if least >= 0.5:
        return 0.0
    t = float(normal_quantile(p))
    for _ in range(MOST_STEPS):
        tail, slope = _student(freedom, t)
        step = math.log(tail / least) * tail / slope
        t *= math.exp(step)
        if abs(step) <= NEAR:
            break
    return t


def _student(freedom: float, t: float) -> tuple[float, float]:
    """Return the probability of Student's t distribution above t > 0, and t times its density.

    The probability is half of the regularised incomplete beta function of f / (f + t^2) for f / 2
    and 1/2, f being the `freedom`. Its continued fraction converges fast below a bound, above which
    that of the complement does (DLMF 8.17.22 and 8.17.4).
    """
    a, square = freedom / 2, t * t
    x, rest = freedom / (freedom + square), square / (freedom + square)
    power = math.exp(-a * math.log1p(square / freedom))
    front = power * math.sqrt(rest / math.pi) * _gamma_ratio(a)
    if x < (a + 1) / (a + 2.5):
        return front * _fraction(a, 0.5, x) / freedom, front
    return 0.5 - front * _fraction(0.5, a, rest), front


def _gamma_ratio(a: float) -> float:
    """Return the gamma function of a + 1/2 divided by that of a; for large a by DLMF 5.11.13."""
    if a < LARGE:
        return math.exp(math.lgamma(a + 0.5) - math.lgamma(a))
    series = 1 - 1 / (8 * a) + 1 / (128 * a**2) + 5 / (1024 * a**3) - 21 / (32768 * a**4)
    return math.sqrt(a) * (series - 399 / (262144 * a**5) + 869 / (4194304 * a**6))


def _fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction DLMF 8.17.22 by the modified method of Lentz."""
    upper = 1.0
    value = lower = 1 / (1 - (a + b) * x / (a + 1))
    for m in range(1, MOST_STEPS):
        twice = a + 2 * m
        even = m * (b - m) * x / ((twice - 1) * twice)
        lower = 1 / (1 + even * lower)
        upper = 1 + even / upper
        value *= lower * upper
        odd = -(a + m) * (a + b + m) * x / (twice * (twice + 1))
        lower = 1 / (1 + odd * lower)
        upper = 1 + odd / upper
        value *= lower * upper
        if abs(lower * upper - 1) <= DIGITS:
            break
    return value


def root(function: Callable[[float], float], low: float, high: float, within: float) -> float:
    """Return where a function of one number is 0 between two at which its signs differ.

    It is found to `within`, or to the digits of a float, by the Illinois method (Dowell and
    Jarratt 1971).
    """
    at_low, at_high = function(low), function(high)
    if at_low == 0:
        return low
    while at_high != 0 and abs(high - low) > max(within, DIGITS * abs(high)):
        between = high - at_high * (high - low) / (at_high - at_low)
        at_between = function(between)
        if at_between * at_high < 0:
            low, at_low = high, at_high
        else:
            at_low /= 2
        high, at_high = between, at_between
    return high
