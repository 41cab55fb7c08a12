"""Agents tell each other what they are going to do:
plans, the rules that read them, and broken words.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluating import live_spec_of, run

from harness.coordination.consensus import Messages
from harness.coordination.coordinate import Coordination, FusionInputs, fuse
from harness.coordination.exchange import Exchange, exchange
from harness.coordination.intents import Intents
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.plans import Plans
from harness.coordination.rules import RULES
from harness.coordination.sent import SentIntents
from harness.core.errors import UserError
from harness.evaluate.live_world import LiveSource
from harness.extensions.plan.rounds import further_rounds
from harness.radio.channel import Draws
from harness.runs import folder

ALL = "all-way-crossing:agent_share=1"
CAREFUL, STEADY, BOLD = [0.6, 0.3, 0.1], [0.2, 0.7, 0.1], [0.1, 0.2, 0.7]
PLAN = "6g:tau=0,content=plan,consensus="


def decided(rule, intents, reaches_s, lost_s=(), heard=None, vehicle=None) -> list[float]:
    """The policy of an agent, the first row, which hears the others' plans."""
    n = len(intents)
    plans = Plans(
        np.arange(n - 1),
        np.array(vehicle or range(n)),
        np.array(reaches_s, dtype=float),
        np.array(lost_s or [0.0] * n),
    )
    there = np.array(heard if heard is not None else [True] * (n - 1))
    messages = Messages(
        np.array(intents),
        np.full(n, 1 / n),
        there,
        np.zeros(n - 1),
        np.ones(n),
        np.ones(n - 1),
        plans=plans,
    )
    return RULES[rule].fuse(messages, np.zeros(0)).policy.tolist()


def test_who_reaches_the_conflict_sooner_goes_on_and_the_other_waits():
    assert decided("yield-by-time", [BOLD, STEADY], [4.0, 3.0]) == [1, 0, 0]
    assert decided("yield-by-time", [BOLD, STEADY], [3.0, 4.0]) == BOLD
    assert decided("yield-by-time", [BOLD, STEADY], [3.0, 3.0]) == BOLD, (
        "the lower number goes first"
    )
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


@pytest.mark.exhaustive
def test_plans_of_agents_are_of_each_pair_and_no_helper_model_is_asked(tmp_path: Path) -> None:
    points = tuple(named_point(PLAN + rule) for rule in ("yield-by-time", "auction"))
    spec = replace(
        live_spec_of(prompt="v4", points=(named_point("6g"),), seeds=(0,)),
        source=LiveSource(50_000, 4, ALL),
    )
    run(replace(spec, points=points), tmp_path / "run")
    there = folder.read(tmp_path / "run")
    assert {answer.role for answer in there.answers} == {"ego"}
    table = there.decisions
    broken, episode = table["broke_word"], table.whole("episode")
    assert {0, 1} <= set(broken.tolist())
    rates = {
        score.condition: score.value for score in there.scores if score.metric == "broken_word_rate"
    }
    for point in points:
        here = np.array(table.labels("condition")) == point.name
        means = [np.nanmean(broken[here & (episode == e)]) for e in np.unique(episode[here])]
        assert rates[point.name] == pytest.approx(np.mean(means))


def test_an_ego_alone_has_nobody_whose_plan_it_hears() -> None:
    with pytest.raises(UserError, match="content plan needs several agents"):
        live_spec_of(points=(named_point(PLAN + "auction"),))


def three(point: OperatingPoint) -> tuple[SentIntents, Exchange]:
    """The first round of three agents that all want to go, 1.5 s apart;
    each is near the next one.
    """
    n, senders = 3, np.array([[1, 2], [0, 2], [0, 1]])
    own = Intents(
        own=np.array([BOLD, STEADY, STEADY]), helpers=np.full((n, 2, 3), np.nan), valid=np.ones((n, 2), bool),
        distance_m=np.full((n, 3), 20.0), range_m=np.full((n, 2), 30.0), payload_bits=np.zeros((n, 2)),
        inference_s=np.full((n, 3), 0.1), own_bits=np.full(n, 1000.0), own_text_bytes=np.zeros(n),
        plans=Plans(
            np.empty((n, 0), int), np.arange(n)[:, None], np.array([[3.0], [4.5], [6.0]]), np.zeros((n, 1))
        ),
    )  # fmt: skip
    intents, draws = own.planned(senders), Draws(np.full((n, 2, 2), 0.99), np.zeros((n, 2)))
    return SentIntents(intents, draws, np.zeros((n, 2), bool)), exchange(point, intents, draws)


def acted(point: OperatingPoint) -> Coordination:
    said, heard = further_rounds(
        point, *three(point), lambda heard, intents: fuse(point, heard, intents)
    )
    return fuse(point, heard, said.intents)


def test_in_a_second_round_one_goes_since_the_one_before_it_waits() -> None:
    point = named_point(PLAN + "yield-by-time,loss=0")
    once, twice = acted(point), acted(point.changed(rounds=2))
    assert once.action.tolist() == [2, 0, 0]
    assert twice.action.tolist() == [2, 0, 1], "the last one heard that the second waits"
    assert twice.messages.tolist() == [4, 4, 4]
    assert twice.reply_bits == pytest.approx(2 * once.reply_bits)
    assert twice.airtime_s == pytest.approx(2 * once.airtime_s)
    assert twice.latency_s - 0.1 == pytest.approx(2 * (once.latency_s - 0.1))
    assert acted(point.changed(rounds=3)).action.tolist() == [2, 0, 1]


def answered(point: OperatingPoint) -> Coordination:
    """The last decision of three agents, whose model takes 0.1 s and always answers the same."""

    def decided(heard, intents) -> Coordination:
        answer = np.tile([0.2, 0.7, 0.1], (3, 1)), np.full(3, 0.1)
        return fuse(point, heard, intents, FusionInputs(lambda on_time: answer))

    said, heard = further_rounds(point, *three(point), decided)
    return decided(heard, said.intents)


def test_each_round_waits_for_the_answer_before_it() -> None:
    once, twice, late = (
        answered(named_point(f"{PLAN}ego-prompt,loss=0,{more}"))
        for more in ("rounds=1", "rounds=2,window_s=0.6", "rounds=2")
    )
    exchange_s = once.exchange_s - 0.1
    assert once.latency_s == pytest.approx(0.1 + exchange_s + 0.1)
    assert twice.latency_s == pytest.approx(0.1 + 2 * (exchange_s + 0.1))
    assert twice.messages.tolist() == [4, 4, 4]
    assert late.latency_s == pytest.approx(once.latency_s), (
        "the window is over, so nobody is asked again"
    )


def test_a_round_that_ends_after_the_window_is_not_heard_and_none_begins_after_it() -> None:
    point = named_point(PLAN + "yield-by-time,loss=0")
    first_s = float(acted(point).latency_s[0])
    late = acted(point.changed(rounds=2, window_s=first_s + 0.001))
    assert late.action.tolist() == [2, 0, 0]
    assert late.deadline_missed.all()
    never = acted(point.changed(rounds=3, window_s=first_s))
    assert never.messages.tolist() == [2, 2, 2]
    assert never.latency_s == pytest.approx(first_s)
