"""Honest probabilities: figures of judged decisions, by hand and against plain loops."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.arrays import Floats
from harness.runs.reliability import (
    BINS,
    Judged,
    brier,
    calibration_error,
    coverage,
    difference,
    estimate,
    likelihood_nats,
    right,
)

ONE, TWO, NONE = [True, False, False], [True, True, False], [False, False, False]


@pytest.mark.parametrize(
    ("p", "optimal", "hit", "score", "nats"),
    [
        ([0.7, 0.2, 0.1], ONE, 1.0, 2 * 0.3**2, -math.log(0.7)),
        ([0.2, 0.7, 0.1], ONE, 0.0, 2 * 0.8**2, -math.log(0.2)),
        ([0.2, 0.7, 0.1], TWO, 1.0, 2 * 0.1**2, -math.log(0.9)),  # either of two; how they share is no matter
        ([0.4, 0.2, 0.4], ONE, 0.5, 2 * 0.6**2, -math.log(0.4)),  # one of two equally likely actions
        ([0.0, 1.0, 0.0], ONE, 0.0, 2.0, -math.log(0.005)),  # the least probability that counts
        ([0.0, 1.0, 0.0], NONE, math.nan, math.nan, math.nan),
    ],
)
def test_scores_of_one_decision_by_hand(
    p: list[float], optimal: list[bool], hit: float, score: float, nats: float
) -> None:
    policy, actions = np.array(p), np.array(optimal)
    found = [float(of(policy, actions)) for of in (right, brier, likelihood_nats)]
    assert found == pytest.approx([hit, score, nats], nan_ok=True)


def judged(sure: list[float], hits: list[float], episode: list[int] | None = None) -> Judged:
    places = list(range(len(sure))) if episode is None else episode
    return Judged(np.array(sure), np.array(hits), np.array(places))


def test_the_calibration_error_by_hand() -> None:
    """Thirty decisions make 15 bins of two; in each one is right, and they are as sure as listed."""
    sure = [0.4 + 0.02 * n for n in range(30)]
    pairs = [abs(0.5 - (sure[n] + sure[n + 1]) / 2) for n in range(0, 30, 2)]
    found = estimate(judged(sure, [0.0, 1.0] * 15), calibration_error, 30)
    assert found.value == pytest.approx(np.mean(pairs))
    assert found.low <= found.value
    assert (found.n, found.n_excluded) == (30, 0)


def test_equally_sure_decisions_are_in_one_bin() -> None:
    """So their order is no matter: .9 is right in half of the decisions, .6 in all."""
    hits = [1.0, 0.0] * 10 + [1.0] * 20
    for order in (np.arange(40), np.arange(40)[::-1]):
        decisions = judged(
            list(np.array([0.9] * 20 + [0.6] * 20)[order]), list(np.array(hits)[order]), list(order)
        )
        assert estimate(decisions, calibration_error, 40).value == pytest.approx((0.4 + 0.4) / 2)
        assert len(set(decisions.bins().tolist())) == 2


def test_coverage_by_hand() -> None:
    """Of the 40 surest two are wrong, which is 5 %; the next is wrong, and then 60 more would be needed."""
    hits = [1.0] * 38 + [0.0] * 3 + [1.0] * 9
    sure = [0.99 - 0.01 * n for n in range(50)]
    assert estimate(judged(sure, hits), coverage, 50).value == 40 / 50
    assert estimate(judged([0.9] * 50, hits), coverage, 50).value == 0.0  # all or nothing: 3 of 50 are wrong
    assert estimate(judged(sure, [1.0] * 50), coverage, 50).value == 1.0


DECISIONS = st.lists(
    st.tuples(st.sampled_from([0.4, 0.5, 0.7, 0.9, 1.0]), st.booleans(), st.integers(0, 5)),
    min_size=1, max_size=40,
)  # fmt: skip


@given(DECISIONS)
def test_figures_are_those_of_plain_loops(rows: list[tuple[float, bool, int]]) -> None:
    decisions = judged([r[0] for r in rows], [float(r[1]) for r in rows], [r[2] for r in rows])
    levels = sorted({r[0] for r in rows}, reverse=True)
    best, acted, wrong, gaps = 0.0, 0, 0, np.zeros(BINS)
    for level in levels:
        here = [r for r in rows if r[0] == level]
        gaps[min(int(BINS * (acted + len(here) / 2) / len(rows)), BINS - 1)] += sum(r[1] - r[0] for r in here)
        acted, wrong = acted + len(here), wrong + sum(not r[1] for r in here)
        best = acted / len(rows) if wrong <= 0.05 * acted else best
    assert estimate(decisions, coverage, 6).value == pytest.approx(best)
    error = estimate(decisions, calibration_error, 6)
    assert error.value == pytest.approx(np.abs(gaps).sum() / len(rows))
    assert error.n == len({r[2] for r in rows})


def test_parts_of_a_run_are_judged_as_the_whole() -> None:
    p = np.array([[0.6, 0.4], [0.2, 0.8], [0.7, 0.3], [0.9, 0.1]])
    optimal = np.array([[True, False], [True, False], [False, False], [True, True]])
    whole = Judged.of(p, optimal, np.array([0, 1, 2, 3]))
    parts = [Judged.of(p[:2], optimal[:2], np.array([0, 1])), Judged.of(p[2:], optimal[2:], np.array([0, 1]))]
    joined = Judged.joined(parts, [2, 2])
    assert joined.episode.tolist() == whole.episode.tolist() == [0, 1, 3]
    assert estimate(joined, calibration_error, 4) == estimate(whole, calibration_error, 4)


def test_differences_are_paired_and_calibrated_policies_have_a_small_error() -> None:
    draws = np.random.default_rng(0)
    sure = draws.uniform(0.4, 1.0, 3000)
    hits = (draws.random(3000) < sure).astype(float)
    episode = np.repeat(np.arange(300), 10)

    def of(p: Floats) -> Judged:
        return Judged(p, hits, episode)

    honest, boasting = of(sure), of((1.0 + sure) / 2)
    assert estimate(honest, calibration_error, 300).value < 0.04
    a, b, change = difference(honest, boasting, calibration_error, 300)
    assert b - a == pytest.approx(change.value)
    assert 0.08 < change.low < change.value < change.high < 0.2
    _, _, same = difference(honest, boasting, coverage, 300)  # the order of decisions is the same
    assert same.value == 0.0
    assert math.isnan(same.low)


def test_without_judged_decisions_nothing_is_known() -> None:
    nothing = estimate(judged([], []), coverage, 3)
    assert (nothing.n, nothing.n_excluded) == (0, 3)
    assert math.isnan(nothing.value)
    assert math.isnan(difference(judged([], []), judged([0.5], [1.0]), coverage, 3)[2].value)
