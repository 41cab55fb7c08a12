"""`harness plan`: as many layouts as it says find the difference, and it says what pilots show."""

import json
from collections.abc import Callable
from math import ceil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_on_disk import Row, made_up

from harness.core.power import Spread, variance
from harness.core.statistics import rate_difference
from harness.runs.success import Success

Harness = Callable[..., tuple[int, str, str]]
Z975, Z80 = 1.959964, 0.841621


def lost(
    *episodes: int, condition: str = "single-local", dangerous: int = 0
) -> Callable[[Row], None]:
    """These episodes fail under one condition; the first so many have a danger."""

    def change(row: Row) -> None:
        row["danger"] = "left" if row["episode"] < dangerous else "none"
        if row["condition"] == condition and row["episode"] in episodes:
            row |= {"success": False, "failure": "late"}

    return change


def test_two_episodes_that_agree_find_no_difference() -> None:
    assert np.isnan(Spread(np.ones(1), np.zeros((1, 1))).difference(2, 0.8)).all()


def test_as_many_layouts_as_planned_find_the_difference_as_often_as_planned() -> None:
    rng, gained, lost_share = np.random.default_rng(0), 0.16, 0.06
    spread = Spread(np.ones(1), np.array([gained + lost_share - (gained - lost_share) ** 2]))
    n = int(spread.episodes(gained - lost_share, 0.8))
    hits = 0
    for _ in range(250):
        kind = rng.random(n)
        a = (kind > gained) & (kind < 0.7)
        b = (kind < gained) | a & (kind > gained + lost_share)
        hits += rate_difference(b.astype(float), a.astype(float)).low > 0
    assert 0.74 < hits / 250 < 0.9  # of 250 studies at .82, 19 of 20 are between .77 and .87


def test_the_number_is_that_of_the_formula_worked_out_by_hand() -> None:
    spread = Spread(np.ones(1), np.array([0.2]))
    n = 640.0
    for _ in range(20):  # n = (z sqrt(v + 2 / n) + z' sqrt(v))² / d²
        n = (Z975 * (0.2 + 2 / n) ** 0.5 + Z80 * 0.2**0.5) ** 2 / 0.05**2
    assert spread.episodes(0.05, 0.8) == ceil(n)
    halves = Spread(np.array([0.5, 0.5]), np.array([0.2, 0.2]))
    assert halves.episodes(0.05, 0.8) == ceil(n), "halves that vary alike are one"


@given(st.floats(0, 1), st.floats(0.02, 0.5), st.floats(0.5, 0.95))
@pytest.mark.slow
def test_so_many_layouts_find_the_difference_that_they_were_planned_for(
    v: float, detect: float, power: float
) -> None:
    spread = Spread(np.array([0.3, 0.7]), np.array([v, v / 2]))
    n = float(spread.episodes(detect, power))
    assert spread.difference(n, power) <= detect + 1e-6
    assert not spread.difference(n - 1, power) <= detect - 1e-6


def test_pilots_that_agree_do_not_promise_that_few_layouts_are_enough() -> None:
    spread = Success(np.zeros(20, dtype=bool)).spread(
        np.ones((1, 20)), np.ones((1, 20)), np.ones(20, dtype=int)
    )
    assert spread.variances == 0.0
    assert spread.episodes(0.05, 0.8) >= (Z975 + Z80) ** 2 * 0.05 * 0.95 / 0.05**2


def test_the_variance_of_resampled_values_is_that_of_the_values_drawn() -> None:
    values, counts = np.array([0.0, 0.5, 1.0]), np.array([[1, 1, 1], [2, 0, 2]])
    assert variance(values, counts) == pytest.approx(
        [np.var(values, ddof=1), np.var([0, 0, 1, 1], ddof=1)]
    )
    assert variance(values[:1], np.ones(1, dtype=int)) == np.inf


def test_a_run_plans_the_gain_of_its_conditions_and_what_that_takes(
    tmp_path: Path, harness: Harness
) -> None:
    def timed(row: Row) -> None:
        row |= {"prompt_tokens": 90, "completion_tokens": 10, "seconds": 0.5}

    run = made_up(tmp_path / "run", episode=lost(0, 1, 5), answer=timed, episodes=12)
    code, out, err = harness("plan", run, "--detect", "10", "--json")
    assert (code, err) == (0, "")
    plan = json.loads(out)
    [row] = plan["conditions"]
    differences = np.array([1, 1, 0, 0, 0, 1] + [0] * 6)
    spread = Spread(np.ones(1), np.array([differences.var(ddof=1)]))
    layouts = row["layouts"]
    assert (row["condition"], layouts["value"], layouts["n"]) == (
        "6g",
        spread.episodes(0.1, 0.8),
        12,
    )
    assert layouts["low"] < layouts["value"] < layouts["high"]
    assert row["finds"] == pytest.approx(float(spread.difference(12, 0.8)))
    requests = 8 * layouts["value"]  # of two steps, four viewers each
    assert (row["requests"], row["tokens"]) == (requests, 100 * requests)
    assert row["minutes"] == pytest.approx(requests / 120)
    code, out, _ = harness("plan", run, "--detect", "10")
    assert "success, gain over single-local" in out
    assert "12 layouts × 2 seeds" in out
    assert max(map(len, out.splitlines())) <= 80


def test_two_runs_plan_their_difference_in_both_kinds_of_layouts(
    tmp_path: Path, harness: Harness
) -> None:
    pilots = [
        made_up(tmp_path / name, episode=lost(*episodes, condition="6g", dangerous=4), episodes=10)
        for name, episodes in (("a", (0, 1, 8)), ("b", (9,)))
    ]
    code, out, _ = harness("plan", *pilots, "--layouts", "300", "--json")
    plan = json.loads(out)
    assert (code, plan["difference"]) == (0, "balanced success, B - A")
    rows = {row["condition"]: row for row in plan["conditions"]}
    dangerous, harmless = (
        np.array([1, 1, 0, 0]).var(ddof=1),
        np.array([0, 0, 0, 0, 1, -1]).var(ddof=1),
    )
    spread = Spread(np.array([0.4, 0.6]), np.array([dangerous, harmless]))
    assert rows["6g"]["layouts"]["value"] == spread.episodes(0.05, 0.8)
    assert rows["6g"]["finds"] == pytest.approx(float(spread.difference(300, 0.8)))
    assert rows["single-local"]["layouts"]["value"] < rows["6g"]["layouts"]["value"]
    assert rows["6g"]["requests"] == 16 * rows["6g"]["layouts"]["value"]  # of both runs
    assert rows["6g"]["tokens"] is None is rows["6g"]["minutes"]


def test_a_stated_rate_plans_without_a_run(harness: Harness) -> None:
    code, out, _ = harness("plan", "--rate", "75", "--correlation", "0.5", "--json")
    [row] = json.loads(out)["conditions"]
    spread = Spread(np.ones(1), np.array([0.75 * 0.25]))
    assert (code, row["layouts"]["value"]) == (0, spread.episodes(0.05, 0.8))
    assert row["condition"] is None is row["requests"]
    assert "--dry-run" in harness("plan", "--rate", "75", "--layouts", "60")[1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "needs one or two finished runs as pilots, or --rate"),
        (("RUN", "--rate", "75"), "give one of both"),
        (("RUN", "RUN", "RUN"), "3 pilots; give one run, or the two"),
        (("--rate", "101"), "--rate 101 is out of range; give 0 to 100"),
        (("--rate", "nan"), "--rate nan is out of range"),
        (("RUN", "--correlation", "0.5"), "--correlation goes with --rate"),
        (("--rate", "75", "--correlation", "2"), "--correlation 2 is out of range; give 0 to 1"),
        (("RUN", "--detect", "0"), "--detect 0 is out of range; give 0.1 to 99"),
        (("RUN", "--power", "100"), "--power 100 is out of range; give 50 to 99"),
        (("RUN", "--layouts", "1"), "--layouts 1 is out of range"),
        (("nowhere",), "nowhere"),
        (("ONE",), "1 layout cannot show how far layouts differ"),
        (("ALONE",), "has not both single-local and another condition"),
    ],
)
def test_bad_input_is_one_line(
    words: tuple[str, ...], says: str, tmp_path: Path, harness: Harness
) -> None:
    from harness.coordination.named_points import POINTS

    runs: dict[str, dict[str, object]] = {
        "RUN": {}, "ONE": {"episodes": 1}, "ALONE": {"points": (POINTS["single-local"],)},
    }  # fmt: skip
    for name in runs.keys() & set(words):
        made_up(tmp_path / name, **runs[name])
    code, out, err = harness("plan", *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err
