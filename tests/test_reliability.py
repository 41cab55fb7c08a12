"""Honest probabilities: figures of judged decisions, by hand and against plain loops."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from run_on_disk import Row, digested, made_up

from harness.core.arrays import Bools, Floats, Ints
from harness.dataset.load import Dataset
from harness.report import contents, panels
from harness.report.compare.difference import compare
from harness.report.compare.pair import pair
from harness.report.runs import Runs
from harness.runs.contradictions import contradictions
from harness.runs.folder import read
from harness.runs.metric_names import ONE_OPTIMAL
from harness.runs.metrics import entry
from harness.runs.records import Score
from harness.runs.reliability import (
    BINS,
    LEAST,
    LEAST_EPISODES,
    Judged,
    brier,
    calibration_error,
    coverage,
    decisions,
    difference,
    estimate,
    likelihood_nats,
    mass,
    right,
)
from harness.runs.summary import Figures
from harness.runs.writer import csv_text

ONE, TWO, NONE = [True, False, False], [True, True, False], [False, False, False]


@pytest.mark.parametrize(
    ("p", "optimal", "hit", "score", "nats"),
    [
        ([0.7, 0.2, 0.1], ONE, 1.0, 2 * 0.3**2, -math.log(0.7)),
        ([0.2, 0.7, 0.1], ONE, 0.0, 2 * 0.8**2, -math.log(0.2)),
        # either of two; how they share is no matter
        ([0.2, 0.7, 0.1], TWO, 1.0, 2 * 0.1**2, -math.log(0.9)),
        # one of two equally likely actions
        ([0.4, 0.2, 0.4], ONE, 0.5, 2 * 0.6**2, -math.log(0.4)),
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
    """120 decisions make 15 bins of eight;
    in each four are right, and they are as sure as listed.
    """
    sure = [0.4 + 0.005 * n for n in range(120)]
    eights = [abs(0.5 - np.mean(sure[n : n + 8])) for n in range(0, 120, 8)]
    found = estimate(judged(sure, [0.0, 1.0] * 60), calibration_error, 120)
    assert found.value == pytest.approx(np.mean(eights))
    assert found.low <= found.value
    assert (found.n, found.n_excluded) == (120, 0)


def test_equally_sure_decisions_are_in_one_bin() -> None:
    """So their order is no matter: .9 is right in half of the decisions, .6 in all."""
    hits = [1.0, 0.0] * 30 + [1.0] * 60
    for order in (np.arange(120), np.arange(120)[::-1]):
        some = judged(
            list(np.array([0.9] * 60 + [0.6] * 60)[order]), list(np.array(hits)[order]), list(order)
        )
        assert estimate(some, calibration_error, 120).value == pytest.approx((0.4 + 0.4) / 2)
        assert len(set(some.bins().tolist())) == 2


def test_coverage_by_hand() -> None:
    """Of the 80 surest four are wrong, which is 5 %;
    the next three are, and then 60 more would be needed.
    """
    hits = [1.0] * 76 + [0.0] * 7 + [1.0] * 17
    sure = [0.99 - 0.005 * n for n in range(100)]
    assert estimate(judged(sure, hits), coverage, 100).value == 80 / 100
    # all or nothing: 7 are wrong
    assert estimate(judged([0.9] * 100, hits), coverage, 100).value == 0.0
    assert estimate(judged(sure, [1.0] * 100), coverage, 100).value == 1.0


DECISIONS = st.lists(
    st.tuples(st.sampled_from([0.4, 0.5, 0.7, 0.9, 1.0]), st.booleans()),
    min_size=LEAST, max_size=LEAST + 20,
)  # fmt: skip


@given(DECISIONS)
def test_figures_are_those_of_plain_loops(rows: list[tuple[float, bool]]) -> None:
    episodes = [n % LEAST_EPISODES for n in range(len(rows))]
    some = judged([r[0] for r in rows], [float(r[1]) for r in rows], episodes)
    levels = sorted({r[0] for r in rows}, reverse=True)
    best, acted, wrong, gaps = 0.0, 0, 0, np.zeros(BINS)
    for level in levels:
        here = [r for r in rows if r[0] == level]
        gaps[min(int(BINS * (acted + len(here) / 2) / len(rows)), BINS - 1)] += sum(
            r[1] - r[0] for r in here
        )
        acted, wrong = acted + len(here), wrong + sum(not r[1] for r in here)
        best = acted / len(rows) if wrong <= 0.05 * acted else best
    assert estimate(some, coverage, LEAST_EPISODES).value == pytest.approx(best)
    error = estimate(some, calibration_error, LEAST_EPISODES)
    assert error.value == pytest.approx(np.abs(gaps).sum() / len(rows))
    assert error.n == LEAST_EPISODES


def test_parts_of_a_run_are_judged_as_the_whole() -> None:
    """Decisions with no optimal action or with two are in no part."""
    p = np.tile([[0.6, 0.4], [0.2, 0.8], [0.7, 0.3], [0.9, 0.1]], (60, 1))
    optimal = np.tile([[True, False], [True, False], [False, False], [True, True]], (60, 1))
    episode = np.repeat(np.arange(60), 4)
    whole = Judged.of(p, optimal, episode)
    first = episode < 20
    parts = [Judged.of(p[first], optimal[first], episode[first]),
             Judged.of(p[~first], optimal[~first], episode[~first] - 20)]  # fmt: skip
    joined = Judged.joined(parts, [20, 40])
    assert (
        joined.episode.tolist() == whole.episode.tolist() == [n for n in range(60) for _ in (0, 1)]
    )
    assert estimate(joined, calibration_error, 60) == estimate(whole, calibration_error, 60)
    assert estimate(whole, decisions, 60).value == 120


@pytest.fixture(scope="session")
def trees(small: Dataset) -> tuple[Bools, Ints]:
    """The optimal actions of all decision points of real trees, as often as it takes,
    and their episodes.
    """
    forest = small.forest
    times = LEAST_EPISODES + 2 * LEAST // int((forest.safe.sum(axis=1) == 1).sum())
    # layouts that are alike, and not the same
    again = np.repeat(np.arange(times), len(forest.tree))
    return np.tile(forest.safe, (times, 1)), np.tile(forest.tree, times) + len(
        small.episodes
    ) * again


def error(p: Floats, trees: tuple[Bools, Ints]) -> float:
    optimal, episode = trees
    return estimate(Judged.of(p, optimal, episode), calibration_error, int(episode.max()) + 1).value


def test_a_policy_that_takes_any_optimal_action_has_no_error(trees: tuple[Bools, Ints]) -> None:
    """However it spreads its probability over them; where none is it may do as it likes."""
    optimal, _ = trees
    several = optimal.sum(axis=1) > 1
    assert several.sum() > (optimal.sum(axis=1) == 1).sum() > LEAST
    spread = optimal / np.maximum(optimal.sum(axis=1, keepdims=True), 1)
    assert error(spread, trees) == 0.0
    assert mass(spread[several], optimal[several]) == pytest.approx(1.0)


@pytest.mark.parametrize("action", range(3))
def test_a_constant_that_is_always_sure_has_what_it_is_wrong(
    action: int, trees: tuple[Bools, Ints]
) -> None:
    optimal, _ = trees
    one = optimal[optimal.sum(axis=1) == 1]
    assert error(np.eye(3)[np.full(len(optimal), action)], trees) == pytest.approx(
        1 - one[:, action].mean()
    )


def test_a_policy_that_is_as_sure_as_it_is_right_has_almost_none(trees: tuple[Bools, Ints]) -> None:
    """What is optimal is drawn by its probabilities, in as many decisions as there are."""
    draws = np.random.default_rng(0)
    p = draws.dirichlet([1.0, 1.0, 1.0], 5000)
    drawn = (draws.random((5000, 1)) > np.cumsum(p, axis=1)[:, :2]).sum(axis=1)
    assert error(p, (np.eye(3)[drawn] == 1, np.arange(5000) % 40)) < 0.03


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
    assert (same.low, same.high) == (-3 / 300, 3 / 300), (
        "what no resample shows may be in other episodes"
    )


@pytest.mark.parametrize("n", [LEAST - 1, LEAST])
def test_of_few_decisions_only_their_number_is_known(n: int) -> None:
    few, many = judged([0.9] * n, [1.0] * n), judged([0.8] * 2 * n, [1.0] * 2 * n)
    known = n == LEAST
    for figure in (calibration_error, coverage):
        found = estimate(few, figure, n)
        assert (found.n, found.n_excluded) == ((n, 0) if known else (0, n))
        assert math.isnan(found.value) is not known
        assert math.isnan(difference(few, many, figure, 2 * n)[2].value) is not known
    assert estimate(few, decisions, n).value == n


def test_many_decisions_of_few_layouts_are_few() -> None:
    """Other channel seeds repeat them where nobody is heard."""
    for layouts, known in ((LEAST_EPISODES - 1, False), (LEAST_EPISODES, True)):
        some = judged(
            [0.9] * 20 * layouts, [1.0] * 20 * layouts, [n % layouts for n in range(20 * layouts)]
        )
        found = estimate(some, calibration_error, layouts)
        assert math.isnan(found.value) is not known
    assert (found.low, found.high) == pytest.approx((0.1 - 3 / layouts, 0.1 + 3 / layouts))


def test_without_judged_decisions_nothing_is_known() -> None:
    nothing = estimate(judged([], []), coverage, 3)
    assert (nothing.n, nothing.n_excluded) == (0, 3)
    assert math.isnan(nothing.value)
    assert math.isnan(difference(judged([], []), judged([0.5], [1.0]), coverage, 3)[2].value)


ECE, COVERAGE = "calibration_error_one_optimal", "coverage_at_5_risk_one_optimal"
OLDER = "calibration_error", "coverage_at_5_risk"


def one_optimal_in_half(row: Row) -> None:
    """Make IDLE the one action that is optimal at the first of two steps,
    and all of them at the second.
    """
    row.update(dict.fromkeys(("safe_SLOWER", "safe_FASTER"), row["step"] == 1))
    row |= {"fused_SLOWER": 0.4, "fused_IDLE": 0.6}


@pytest.mark.parametrize(("layouts", "known"), [(49, False), (50, True)])
def test_a_run_says_of_how_many_decisions_its_figures_are(
    tmp_path: Path, layouts: int, known: bool
) -> None:
    """Alike in its summary, in what its page shows and in a comparison with another."""
    for name in ("a", "b"):
        made_up(tmp_path / name, decision=one_optimal_in_half, episodes=layouts)
    run = read(tmp_path / "a")
    found = {name: run.score("6g", name) for name in (ECE, COVERAGE, ONE_OPTIMAL)}
    values = [score and score.value for score in found.values()]
    assert values == [pytest.approx(0.4) if known else None, 1.0 if known else None, 2 * layouts]
    assert not {*OLDER} & {score.metric for score in run.scores}
    line = contents.probabilities(Runs((run,), ("a",), None))[1]
    assert [group["n"] for group in line["groups"]] == [4 * layouts, 2 * layouts]
    assert line["groups"][1]["scores"] == [found[ECE], found[COVERAGE]]
    drawn = panels.reliability(run)
    assert [(row["condition"], row["n"]) for row in drawn] == (
        [(name, 2 * layouts) for name in run.conditions] if known else []
    )
    compared = {
        d.metric: d.a
        for d in compare(pair(tmp_path / "a", tmp_path / "b")).conditions[1].differences
    }
    assert compared[ONE_OPTIMAL] == 2 * layouts
    assert (ECE in compared, COVERAGE in compared) == (known, known)


def test_figures_of_an_older_definition_are_read_and_not_shown(tmp_path: Path) -> None:
    """A run that was written with them keeps them in its table, and its page has neither."""
    made_up(tmp_path / "run")
    table = tmp_path / "run" / "summary.csv"
    line = next(line for line in table.read_text().splitlines() if ",optimal_brier," in line)
    older = "".join(line.replace("optimal_brier", name) + "\n" for name in OLDER)
    table.write_text(table.read_text() + older)
    run = read(tmp_path / "run")
    assert all(run.score("single-local", name) for name in OLDER)
    shown = {metric["meaning"] for metric in contents.summary(run)}
    assert not {entry(name).meaning for name in OLDER} & shown


@pytest.mark.slow
def test_a_run_by_older_rules_is_held_against_these(tmp_path: Path) -> None:
    """Version 1 knew a figure of twenty layouts,
    without an interval if all its decisions are alike.
    """
    run = read(
        made_up(tmp_path / "run", decision=one_optimal_in_half, episodes=20, seeds=tuple(range(5)))
    )
    assert run.score("6g", ECE) is None, "too few layouts by today's rules"
    stated = structs.replace(run.manifest, versions={"harness": "0"})
    figures = Figures.of(run.world, run.grid, run.decisions, run.episodes, list(run.answers))
    scores = figures.scores(older=True)
    [ece] = [score for score in scores if score.key == ("6g", ECE, "episodes")]
    assert (ece.value, ece.low, ece.high, ece.n) == (*[pytest.approx(0.4)] * 3, 20)
    for change, found in (
        ({}, 0),
        ({"low": None, "high": None}, 0),
        ({"value": 0.1}, 1),
        ({"low": 0.3}, 1),
    ):
        changed = [
            score if score is not ece else structs.replace(ece, **change) for score in scores
        ]
        (run.path / "run.json").write_bytes(msgspec.json.encode(stated))
        digested(run.path)
        (run.path / "summary.csv").write_text(csv_text(Score, changed, stated.variant))
        assert len(list(contradictions(read(run.path)))) == found
