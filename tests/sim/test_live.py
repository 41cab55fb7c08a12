"""Reference drivers in the simulator."""

import pytest
from former import SCENARIO

from harness.world.drivers import DRIVERS
from harness.world.outcome import Outcome
from harness.world.reference import check, drive_all, summary


def test_the_full_view_driver_clears_what_a_cruising_one_runs_into():
    outcomes = drive_all(SCENARIO, [6])[0]  # a danger from the left
    assert outcomes["cruise"].result == "collision"
    assert outcomes["full-view"].result == "cleared"
    assert outcomes["brake"].result == "time_out"


def test_who_clears_too_long_after_the_full_view_driver_is_late():
    outcomes = drive_all(SCENARIO, [13])[0]
    assert outcomes["local-view"].result == "late"
    assert outcomes["local-view"].time_s - outcomes["full-view"].time_s > 1.01


def test_a_summary_balances_success_over_danger_and_none():
    outcomes = [Outcome("cleared", 6.0), Outcome("collision", 3.0), Outcome("cleared", 5.0)]
    found = summary(outcomes, [True, True, False])
    rates = [found[half] for half in ("balanced", "dangerous", "harmless")]
    assert [(e.value, e.n) for e in rates] == [(0.75, 3), (0.5, 2), (1.0, 1)]
    for known in ((), [True] * 3, [False] * 3):
        assert {"balanced", "dangerous", "harmless"}.isdisjoint(summary(outcomes, known))


@pytest.mark.exhaustive
def test_a_check_is_the_same_for_any_number_of_workers():
    alone, together = (check(SCENARIO, 4, 5, workers, lambda n: None) for workers in (1, 2))
    assert together == alone


@pytest.mark.slow
def test_a_check_counts_every_episode_once():
    done = []
    alone = check(SCENARIO, 4, 5, 1, done.append)
    assert sum(done) == 4
    for driver in DRIVERS:
        ends = [
            alone[driver][end] for end in ("success", "collision", "late", "time_out", "off_road")
        ]
        assert sum(e.value for e in ends) == 1.0
        assert {e.n for e in ends} == {4}


def test_a_summary_counts_ends_faults_and_crashes_of_others():
    found = summary(
        [
            Outcome("cleared", 6.0),
            Outcome("late", 8.0, other_crashes=2),
            Outcome("collision", 3.0, "v5", "ego", "ego"),
            Outcome("collision", 3.0, "v5", "other", "other"),
        ]
    )
    rates = {
        end: found[end].value for end in ("success", "late", "collision", "time_out", "off_road")
    }
    assert rates == {
        "success": 0.25,
        "late": 0.25,
        "collision": 0.5,
        "time_out": 0.0,
        "off_road": 0.0,
    }
    assert (found["ego_at_fault"], found["other_at_fault"], found["other_crashes"]) == (1, 1, 2)
    assert 0.0 < found["success"].low < 0.25 < found["success"].high < 1.0
