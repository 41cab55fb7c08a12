"""The price of caution: success balanced over danger and none, the four outcomes,
misses and false alarms.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluating import run, spec_of
from former import NAME
from msgspec import structs
from run_on_disk import Row, made_up
from tiers import some

from harness.coordination.named_points import POINTS
from harness.core.figures import interval_of
from harness.core.statistics import mean_of, paired_difference, rate_interval
from harness.dataset.load import Dataset, load
from harness.evaluate.live_world import LiveSource
from harness.report.caveats import saturated
from harness.report.compare.difference import compare
from harness.report.compare.gate import gate, judge
from harness.report.compare.pair import pair
from harness.report.matrix import BEST, WORSE, headline, lines
from harness.report.runs import Runs
from harness.report.words import headline as of_one
from harness.runs.folder import Run, read
from harness.runs.headline import BALANCED, SUCCESS, headline_of
from harness.runs.listing import runs
from harness.runs.metric_names import GAINS
from harness.runs.metric_values import of_ends
from harness.runs.metrics import METRICS
from harness.runs.success import Success, alike, half_difference
from harness.runs.suite import plays

HALVES = METRICS[BALANCED].halves
BY_DANGER = {name for name, metric in METRICS.items() if metric.half or metric.halves}
ALONE = POINTS["single-local"]


def lost(*episodes: int, failure: str = "collision", **more: object) -> Callable[[Row], None]:
    """Episodes 0 to 2 of 8 have a danger; of 6g's, these are lost."""

    def change(row: Row) -> None:
        row |= {
            "danger": "left" if row["episode"] < 3 else "none",
            "outcome": "success" if more.get("outcome") else None,
        }
        if row["episode"] in episodes and row["condition"] == "6g":
            row |= {"success": False, "failure": failure, **more}

    return change


def made(out: Path, *episodes: int, failure: str = "collision", **more: object) -> Run:
    return read(made_up(out, episode=lost(*episodes, failure=failure, **more), episodes=8))


def test_balanced_success_is_the_mean_of_both_halves_with_their_intervals(tmp_path: Path) -> None:
    done = made(tmp_path / "run", 0, 1, 7)
    dangerous, harmless = (
        rate_interval(np.array(success, dtype=float)) for success in ([0, 0, 1], [1, 1, 1, 1, 0])
    )
    halves = [done.score("6g", name) for name in HALVES]
    assert [(s.value, s.low, s.high, s.n) for s in halves if s] == [
        (e.value, e.low, e.high, e.n) for e in (dangerous, harmless)
    ]
    both, mean = done.score("6g", BALANCED), mean_of([dangerous, harmless])
    assert both is not None
    assert (both.value, both.low, both.high) == (mean.value, mean.low, mean.high)
    assert both.value == pytest.approx((1 / 3 + 4 / 5) / 2)
    assert (both.n, both.n_excluded, both.interval) == (8, 0, "episodes")
    # seeds first
    assert [s.n for s in done.scores if (s.condition, s.metric) == ("6g", BALANCED)] == [2, 8]
    plain = done.score("6g", "success_rate")
    assert plain is not None
    assert plain.value == 5 / 8


def test_the_gain_is_paired_by_episode_in_either_half(tmp_path: Path) -> None:
    gain = made(tmp_path / "run", 0, 1, 7).score("6g", GAINS[BALANCED])
    expected = paired_difference([np.array([-1.0, -1, 0]), np.array([0.0, 0, 0, 0, -1])])
    assert gain is not None
    assert (gain.value, gain.low, gain.high) == (expected.value, expected.low, expected.high)
    assert gain.n == 8


@pytest.mark.parametrize("danger", ["none", "left"])
def test_without_episodes_of_both_kinds_nothing_is_said_by_danger(
    tmp_path: Path, danger: str
) -> None:
    """Environments know no dangers: all of their episodes are without one."""
    done = read(made_up(tmp_path / "run", episode=lambda row: row.update(danger=danger)))
    assert BY_DANGER.isdisjoint({s.metric for s in done.scores})
    c = compare(pair(done.path, done.path)).conditions[0]
    assert BY_DANGER.isdisjoint({d.metric for d in c.differences})


def test_two_runs_are_compared_in_it_and_a_gate_takes_it(tmp_path: Path) -> None:
    made(tmp_path / "a", 0)
    made(tmp_path / "b", 0, 6, 7)
    comparison = compare(pair(tmp_path / "a", tmp_path / "b"))
    [of] = [d for d in comparison.conditions[1].differences if d.metric == BALANCED]
    assert (of.a, of.b) == (pytest.approx((2 / 3 + 1) / 2), pytest.approx((2 / 3 + 3 / 5) / 2))
    assert of.change == paired_difference([np.zeros(3), np.array([0.0, 0, 0, -1, -1])])
    assert of.primary
    assert of.p_value is not None
    assert 0 < of.p_value <= 1
    assert judge(gate(f"6g:{BALANCED} < -0.1"), comparison).failed == (("6g", pytest.approx(-0.2)),)


def test_what_counts_by_single_episodes_is_what_a_summary_states(tmp_path: Path) -> None:
    done = made(tmp_path / "run", 0, 1, 7)
    how = Success.of(done.episodes[:8], headline_of(done))
    alone, best = of_ends(METRICS[SUCCESS], done.grid, done.episodes)
    for e, metric in (
        (how.estimate(best), BALANCED),
        (how.difference(best, alone), GAINS[BALANCED]),
    ):
        stated = done.score("6g", metric)
        assert stated is not None
        assert (e.value, e.low, e.high, e.n) == (stated.value, stated.low, stated.high, stated.n)
    assert how.mean(best) == how.estimate(best).value
    counts = how.resampled(np.random.default_rng(0), 50)
    assert (counts[:, :3].sum(axis=1) == 3).all(), "each half is drawn for itself"
    assert np.allclose(how.weights(counts).sum(axis=1), 1)
    assert (how.weights(counts) @ best.mean(axis=0))[0] == pytest.approx(how.mean(best))
    only = Success(np.ones(8, dtype=bool))
    assert [each.metric for each in alike([how, only])] == [SUCCESS] * 2
    assert alike([how, how])[0].metric == BALANCED
    assert how.plain.estimate(best).value == 5 / 8


def test_the_best_of_several_runs_has_the_most_balanced_success(tmp_path: Path) -> None:
    """One loses all 8 dangers and the other 10 of 32 harmless ones:
    by plain success 80 and 75 %.
    """

    def change(*lost: int) -> Callable[[Row], None]:
        def end(row: Row) -> None:
            row["danger"] = "left" if row["episode"] < 8 else "none"
            if row["episode"] in lost:
                row |= {"success": False, "failure": "late"}

        return end

    for name, failed in (("plain", range(8)), ("fair", range(8, 18))):
        made_up(tmp_path / name, episode=change(*failed), episodes=40)
    both = [read(tmp_path / name) for name in ("plain", "fair")]
    found = lines(Runs(tuple(both), ("plain", "fair"), None))
    marks = {(line.name, line.mark) for line in found}
    assert marks == {("fair", BEST), ("plain", WORSE)}
    assert headline(found).startswith("Best by balanced success under ")
    [worse] = [line.behind for line in found if line.behind and line.condition == "6g"]
    assert worse.change.value == pytest.approx(1 / 2 - 27 / 32)
    assert [listed.success for listed in runs(tmp_path) if listed.name == "fair"] == [
        pytest.approx(27 / 32)
    ]


def test_who_is_stuck_is_unsafe_in_older_runs_only(tmp_path: Path) -> None:
    for limits, outcome in ((1, None), (2, "stuck")):
        done = made(tmp_path / str(limits), 0, failure="time_out", outcome=outcome)
        unsafe, stuck = (done.score("6g", name) for name in ("unsafe_rate", "stuck_rate"))
        assert unsafe is not None
        assert unsafe.value == (1 / 8 if limits == 1 else 0)
        assert (stuck.value if stuck else None) == (None if limits == 1 else 1 / 8)


def test_a_run_of_before_is_read(tmp_path: Path) -> None:
    done = made(tmp_path / "run", 0)
    file = done.path / "episodes.csv"
    added = ("outcome", "time_lost_s", "miss", "false_alarm")
    heads, *lines = (line.split(",") for line in file.read_text().splitlines())
    kept = [n for n, head in enumerate(heads) if head not in added]
    file.write_text("\n".join(",".join(row[n] for n in kept) for row in (heads, *lines)) + "\n")
    again = read(done.path).episodes
    assert [structs.replace(e, **dict.fromkeys(added)) for e in done.episodes] == list(again)


@pytest.mark.parametrize("model", some(["cruise"], exhaustive=["brake", "local-view"]))
def test_frozen_and_driven_come_to_the_same_under_either_limits(
    small: Dataset, tmp_path: Path, model: str
) -> None:
    small = load(small.path, 2)
    for limits in (1, 2):
        parameters = {**small.manifest.parameters, "limits": limits}
        dataset = replace(small, manifest=structs.replace(small.manifest, parameters=parameters))
        frozen = spec_of(dataset, model, points=(ALONE,), seeds=(0,))
        name = f"{NAME},limits={limits}"
        live = replace(frozen, source=LiveSource(small.manifest.seed, 2, name))
        ends = [
            read(run(spec, tmp_path / f"{kind}{limits}").out).episodes
            for kind, spec in (("frozen", frozen), ("live", live))
        ]
        assert [(e.success, e.failure, e.outcome) for e in ends[0]] == [
            (e.success, e.failure, e.outcome) for e in ends[1]
        ]
        for e in ends[0]:
            assert (e.outcome is None) == (limits == 1)
            assert (e.time_lost_s is None) == (e.failure not in ("", "late"))
            assert not e.miss or e.failure == "collision"
            assert not e.false_alarm or not e.success
        assert {(e.time_lost_s, e.miss, e.false_alarm) for e in ends[1]} == {(None, None, None)}


def test_the_headline_has_what_cooperation_does_where_there_is_a_danger_and_where_there_is_none(
    tmp_path: Path,
) -> None:
    """Alone all 20 dangers are lost, of which 6g loses 8, and 2 of 20 layouts without."""

    def end(row: Row) -> None:
        row["danger"] = "left" if row["episode"] < 20 else "none"
        lost = range(20) if row["condition"] == "single-local" else (*range(8), 20, 21)
        if row["episode"] in lost:
            row |= {"success": False, "failure": "late"}

    done = read(made_up(tmp_path / "run", episode=end, episodes=40))
    pairs = plays([done], BALANCED).pairs("6g", "single-local")
    danger, price = (
        interval_of(half_difference(pairs, dangerous), sign="+") for dangerous in (True, False)
    )
    assert danger.startswith("+60.0 [")
    assert price.startswith("-10.0 [")
    said = of_one(done)
    assert (
        f"succeeds in 60.0 % of the layouts with a danger, {danger} points against single-local, "
        f"and" in said
    )
    assert (
        f"and in 90.0 % of those without, {price} points; the mean of both is 75.0 %, +25.0 ["
        in said
    )
    assert said.endswith("points, a clear difference.")
    assert "With a danger, success" not in " ".join(saturated(done))
