"""Agents tell each other what they are going to do: plans, the rules that read them, and broken words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluating import live_spec_of, run

from harness.coordination.consensus import Messages
from harness.coordination.operating_point import named_point
from harness.coordination.plans import Plans
from harness.coordination.rules import RULES
from harness.core.errors import UserError
from harness.evaluate.live_world import LiveSource
from harness.runs import folder

ALL = "all-way-crossing:agent_share=1"
CAREFUL, STEADY, BOLD = [0.6, 0.3, 0.1], [0.2, 0.7, 0.1], [0.1, 0.2, 0.7]
PLAN = "6g:schedule=always,content=plan,consensus="


def decided(rule, intents, reaches_s, lost_s=(), heard=None, vehicle=None) -> list[float]:
    """The policy of an agent, the first row, which hears the others' plans."""
    n = len(intents)
    plans = Plans(
        np.array(vehicle or range(n)), np.array(reaches_s, dtype=float), np.array(lost_s or [0.0] * n)
    )
    there = np.array(heard if heard is not None else [True] * (n - 1))
    messages = Messages(
        np.array(intents), np.full(n, 1 / n), there, np.zeros(n - 1), np.ones(n), np.ones(n - 1), plans=plans
    )
    return RULES[rule].fuse(messages, np.zeros(0)).policy.tolist()


def test_who_reaches_the_conflict_sooner_goes_on_and_the_other_waits():
    assert decided("yield-by-time", [BOLD, STEADY], [4.0, 3.0]) == [1, 0, 0]
    assert decided("yield-by-time", [BOLD, STEADY], [3.0, 4.0]) == BOLD
    assert decided("yield-by-time", [BOLD, STEADY], [3.0, 3.0]) == BOLD, "the lower number goes first"
    assert decided("yield-by-time", [BOLD, STEADY], [3.0, 3.0], vehicle=[2, 1]) == [1, 0, 0]


def test_nobody_waits_for_one_unheard_or_far_away_in_time():
    assert decided("yield-by-time", [BOLD, STEADY], [4.0, 3.0], heard=[False]) == BOLD
    assert decided("yield-by-time", [BOLD, STEADY], [9.0, 3.0]) == BOLD
    for gone in ([np.inf, 3.0], [3.0, np.inf], [np.inf, np.inf]):
        assert decided("auction", [BOLD, STEADY], gone, lost_s=[0.0, 1.0]) == BOLD


def test_nobody_waits_for_one_that_waits():
    assert decided("yield-by-time", [BOLD, CAREFUL, STEADY], [4.0, 3.0, 9.0]) == BOLD
    assert decided("yield-by-time", [BOLD, CAREFUL, STEADY], [4.0, 3.0, 3.5]) == [1, 0, 0]


def test_the_highest_bid_goes_first_and_a_number_decides_by_itself():
    assert decided("auction", [BOLD, STEADY], [4.0, 3.0], lost_s=[2.0, 0.5]) == BOLD
    assert decided("auction", [BOLD, STEADY], [3.0, 4.0], lost_s=[0.5, 2.0]) == [1, 0, 0]
    assert decided("yield-by-id", [BOLD, STEADY], [3.0, 4.0], vehicle=[3, 0]) == [1, 0, 0]


def test_plans_of_agents_are_of_each_pair_and_no_helper_model_is_asked(tmp_path: Path) -> None:
    points = tuple(named_point(PLAN + rule) for rule in ("yield-by-time", "auction"))
    spec = replace(
        live_spec_of(prompt="v4", points=(named_point("6g"),), seeds=(0,)), source=LiveSource(50_000, 4, ALL)
    )
    run(replace(spec, points=points), tmp_path / "run")
    there = folder.read(tmp_path / "run")
    assert {answer.role for answer in there.answers} == {"ego"}
    table = there.decisions
    broken, episode = table["broke_word"], table.whole("episode")
    assert {0, 1} <= set(broken.tolist())
    rates = {score.condition: score.value for score in there.scores if score.metric == "broken_word_rate"}
    for point in points:
        here = np.array(table.labels("condition")) == point.name
        means = [np.nanmean(broken[here & (episode == e)]) for e in np.unique(episode[here])]
        assert rates[point.name] == pytest.approx(np.mean(means))


@pytest.mark.parametrize(
    ("condition", "says"),
    [
        ("6g:content=plan", "consensus is 'linear'; it must be one of yield-by-time"),
        ("6g:consensus=auction", "content is 'intent'; it must be plan where consensus is auction"),
        (PLAN + "auction,on_demand=true", "on_demand is True"),
        (PLAN + "auction,messages=blind", "messages is 'blind'"),
    ],
)
def test_what_plans_go_without_is_refused_in_one_line(condition: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        named_point(condition)


def test_an_ego_alone_has_nobody_whose_plan_it_hears() -> None:
    with pytest.raises(UserError, match="content plan needs several agents"):
        live_spec_of(points=(named_point(PLAN + "auction"),))
