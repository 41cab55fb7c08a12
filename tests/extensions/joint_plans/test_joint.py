"""Plans for all agents together, and the table of policies beside them."""

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from harness.core.arrays import Bools
from harness.extensions.joint_plans import joint, policies
from harness.extensions.joint_plans.joint import NEVER_S, Options, Search
from harness.extensions.joint_plans.policies import JOINT, Fate, best_of, summary
from harness.world import scenarios
from harness.world.scenario import Scenario

SCENES = [f"{name}:agent_share=1" for name in scenarios.names() if scenarios.get(name).seats]
TWO = "all-way-crossing:agent_share=1"
FEW = (TWO,)


@pytest.fixture(scope="module")
def able() -> dict[int, Options]:
    """Return what the two agents of a layout can do."""
    return joint.options(scenarios.get(TWO), [2])[2]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in FEW else pytest.mark.exhaustive)
        for name in SCENES
    ],
)
def test_what_a_plan_promises_the_simulator_does(name: str) -> None:
    scenario = scenarios.get(name)
    plans, unended = joint.plans(scenario, joint.options(scenario, [1]))
    plan, world = plans[1]
    assert not unended
    assert plan.exact
    assert {agent: j.outcome.time_s for agent, j in world.journeys.items()} == plan.arrives_s
    assert all(j.outcome.success for j in world.journeys.values())
    assert plan.sum_s == pytest.approx(sum(plan.arrives_s.values()))


@pytest.mark.slow
def test_options_are_ways_to_drive_the_soonest_to_arrive_first(able: dict[int, Options]) -> None:
    scenario = scenarios.get(TWO)
    for its in able.values():
        assert len(set(its.actions)) == len(its.actions)
        assert (np.diff(its.arrives_s) >= 0).all()
        assert its.poses.shape[2] == 1 + sum(
            spawn.part == "other" for spawn in scenario.layout(2, scenario.parameters).spawns
        )
        moved_m = np.hypot(*np.diff(its.poses[:, :, 0, :2], axis=1).T)
        assert moved_m.max() <= scenario.parameters.target_speeds_mps[-1] * 1.01 / its.hz


def of(costs_s: list[float]) -> Options:
    """Return options that cost this much."""
    never = np.array([np.inf if cost == NEVER_S else cost for cost in costs_s])
    poses = np.zeros((len(costs_s), 1, 1, 3))
    return Options([(str(n),) for n in range(len(costs_s))], never, poses, np.ones((1, 2)), 50)


@pytest.mark.parametrize("seed", range(8))
def test_branch_and_bound_finds_what_trying_all_finds(seed: int) -> None:
    draws = np.random.default_rng(seed)
    able = [of([*sorted(draws.uniform(3, 9, 5).tolist()), NEVER_S]) for _ in range(3)]
    rows: dict[tuple[int, int, int], Bools] = {
        (a, n, b): draws.random(6) < 0.4 for a, b in ((0, 1), (0, 2), (1, 2)) for n in range(6)
    }
    search = Search(able, rows=rows)
    search.run()
    fit = [
        choice for choice in product(range(6), repeat=3)
        if all(rows[a, choice[a], b][choice[b]] for a, b in ((0, 1), (0, 2), (1, 2)))
    ]  # fmt: skip
    costs_s = {c: sum(float(able[a].cost_s[n]) for a, n in enumerate(c)) for c in fit}
    assert search.cost_s == pytest.approx(min(costs_s.values(), default=np.inf))
    assert search.bound_s == pytest.approx(search.cost_s)
    if search.best:
        search.unfit.add(search.best)
        del costs_s[search.best]
        search.run()
        assert search.cost_s == pytest.approx(min(costs_s.values(), default=np.inf))


def test_a_search_that_stops_says_how_good_any_plan_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    able = [of([1.0, 2.0, 3.0])] * 2
    rows = {(0, n, 1): np.array([False, False, True]) for n in range(3)}
    exact = Search(able, rows=rows)
    exact.run()
    monkeypatch.setattr(joint, "MOST_NODES", 1)
    cut = Search(able, rows=rows)
    cut.run()
    assert (exact.cost_s, exact.bound_s) == (4.0, 4.0)
    assert cut.bound_s <= 4.0 <= cut.cost_s


@pytest.mark.slow
def test_agents_that_would_meet_do_not_go_together(able: dict[int, Options]) -> None:
    own, other = able.values()
    fits = joint.together(own, 0, other)
    assert 0 < fits.sum() < len(fits), "some of the other's options are in the way of driving on"
    again = [joint.together(other, n, own)[0] for n in range(len(fits))]
    assert again == fits.tolist(), "whoever is asked"


def test_the_price_of_anarchy_is_that_of_layouts_which_both_clear() -> None:
    def fate(trips_s: float) -> Fate:
        arrived = float(not np.isnan(trips_s))
        sum_s = trips_s if arrived else NEVER_S
        return Fate(arrived, not arrived, False, sum_s, trips_s - 1, trips_s - 2)

    best = [fate(10.0), fate(20.0), fate(np.nan), fate(8.0)]
    some = summary([fate(12.0), fate(np.nan), fate(9.0), fate(10.0)], best, "cruise")
    assert (some["anarchy"].value, some["anarchy"].n) == (pytest.approx(22 / 18), 2)
    assert some["success"].value == 0.75
    assert some["less_than_joint"].value == 0.0
    assert summary(best, best, JOINT)["anarchy"].low == 1.0


DRIVE_ALL, DRIVEN = policies.drive_all, dict[Any, list[dict[str, Fate]]]()


def remembered(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, Fate]]:
    """Drive a layout once, for all that is told of it."""
    key = scenario.name, tuple(seeds)
    if key not in DRIVEN:
        DRIVEN[key] = DRIVE_ALL(scenario, seeds)
    return DRIVEN[key]


@pytest.mark.exhaustive
def test_all_policies_drive_the_same_layouts_and_none_beats_the_plan() -> None:
    [by_policy] = remembered(scenarios.get(TWO), [2])
    assert tuple(by_policy) == policies.POLICIES
    assert by_policy[JOINT].success
    assert all(not each.trips_s < by_policy[JOINT].trips_s for each in by_policy.values())


@pytest.mark.exhaustive
def test_where_the_search_finds_nothing_the_plan_is_that_of_the_best_driver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(joint, "MOST_NODES", 0)
    layouts = policies.drive_all(scenarios.get(TWO), range(2, 4))
    assert any(of[JOINT].success for of in layouts), "a driver brings everybody to its goal in one"
    for of in layouts:
        assert not of[JOINT].exact
        assert of[JOINT].success == any(each.success for each in of.values())
        assert of[JOINT].sum_s == min(each.sum_s for each in of.values())


def test_a_driver_that_does_better_is_the_best_found_and_one_as_good_leaves_the_plan() -> None:
    plan = Fate(1.0, False, False, 20.0, 1.0, 1.0)
    worse, as_good = replace(plan, arrived=0.5, sum_s=NEVER_S + 5), replace(plan, lost_s=2.0)
    assert best_of({"cruise": worse, "full-view": as_good, JOINT: plan}) is plan
    better = replace(plan, sum_s=19.9)
    assert best_of({"cruise": worse, "full-view": better, JOINT: plan}) == replace(
        better, exact=False
    )
    assert best_of({"cruise": plan, JOINT: worse}).success


@pytest.mark.slow
def test_a_check_of_agents_states_figures_with_intervals_and_n(
    harness: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policies, "drive_all", remembered)
    command = (
        "dataset",
        "scenario",
        "drive",
        "all-way-crossing",
        "--agents",
        "all",
        "--episodes",
        1,
        "--seed",
        2,
    )
    # where it is slow, it says how far it is
    code, out, _ = harness(*command, "--workers", 1, "--json")
    found = json.loads(out)
    assert (code, found["scenario"]) == (0, "all-way-crossing:agent_share=1")
    assert (found["unsolved"], found["inexact"]) == ([], [])
    assert found["policies"].keys() == {*policies.POLICIES}
    assert found["policies"]["joint"]["success"]["value"] == 1.0
    code, out, _ = harness(*command, "--workers", 1)
    assert code == 0
    assert (
        "without a joint plan: 0\njoint is the best plan, searched to the end in all 1 episodes"
        in out
    )
    unproven = [
        of | {JOINT: replace(of[JOINT], exact=False)} for of in remembered(scenarios.get(TWO), [2])
    ]
    monkeypatch.setattr(policies, "drive_all", lambda *_: unproven)
    _, out, _ = harness(*command, "--workers", 1)
    assert "joint is the best found, and the best plan in 0 of 1 episodes" in out
    assert "1 (seeds 2)" in out


def test_agents_of_a_scenario_without_seats_are_refused_in_one_line(harness: Any) -> None:
    code, out, err = harness("dataset", "scenario", "drive", "blind-merge", "--agents", "all")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "only the ego has a goal" in err


def test_agents_with_clocks_of_their_own_have_no_joint_plan(harness: Any) -> None:
    command = ("dataset", "scenario", "drive", "all-way-crossing:clock=apart", "--agents", "all")
    code, out, err = harness(*command, "--episodes", 1)
    assert (code, out) == (2, "")
    assert "clock is apart, and a joint plan has one clock for all; leave it out" in err
    assert err.count("\n") == 1
