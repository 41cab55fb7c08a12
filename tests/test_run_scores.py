"""Scores of runs whose every answer and outcome is written down here,
so that they can be counted by hand.
"""

import json
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from evaluating import (
    Scripted,
    Walked,
    all_scenes,
    asker_of,
    course,
    failed,
    figure,
    says,
    scenes_of,
    spec_of,
    sure,
    walked,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.backends.base import Completion, Role
from harness.coordination.operating_point import OperatingPoint
from harness.core.statistics import wilson
from harness.dataset.load import Dataset
from harness.evaluate.answers import answer_of
from harness.evaluate.latency import inference_s
from harness.evaluate.requests import requests
from harness.runs.headline import PAIRED
from harness.runs.metric_values import of_decisions
from harness.runs.metrics import METRICS
from harness.runs.records import Answer, Latency, Score, Variant
from harness.runs.writer import csv_text

ALONE = OperatingPoint.of("single-local", None)
CLEAR = OperatingPoint.of("clear", "v2x", loss=0.0)  # nothing is lost, and no jitter
DEAF = OperatingPoint.of("deaf", "v2x", loss=1.0)

# Seconds until the intersection is cleared, or how it ends; what is not here leads to the next
# step.
OUTCOMES: dict[str, dict[str, float | str]] = {
    # Episode 0: nothing dangerous. The second SLOWER comes 1.0 s late, which is just allowed.
    "00000-0": {"FASTER": "collision"},
    "00000-1": {"SLOWER": 7.0, "IDLE": 6.0, "FASTER": 6.0},
    # Episode 1: only SLOWER is safe, and it is what the full-view driver does.
    "00001-0": {"IDLE": "time_out", "FASTER": "collision"},
    "00001-1": {"SLOWER": 5.6, "IDLE": 5.0, "FASTER": "collision"},
    # Episode 2: no collision anywhere, but each SLOWER puts off the end by 0.6 s.
    "00002-0": {"IDLE": 5.0, "FASTER": 5.0},
    "00002-1": {"SLOWER": 6.2, "IDLE": 5.6, "FASTER": 5.6},
    # Episode 3: nothing is ever safe, which fails and blames no decision.
    "00003-0": {"SLOWER": "collision", "IDLE": "collision", "FASTER": "collision"},
}
SAID = {
    "00000-1/v1": sure("SLOWER"),
    "00001-0/v1": says([0.3, 0.4, 0.3]),  # 1.09 nats: unsure, and left alone it keeps its speed
    "00002-0/v1": sure("SLOWER"),
    "00002-1/v1": sure("SLOWER"),
    **{f"00001-0/v{n}": sure("SLOWER", "helper") for n in (2, 3, 4)},
}  # fmt: skip


@pytest.fixture
def played(small: Dataset) -> Dataset:
    return course(small, 2, OUTCOMES, drives={"00001-0": "SLOWER"})


@pytest.fixture
def told(played: Dataset) -> Walked:
    """Three conditions, one seed, 0.1 s an answer."""
    return walked(
        spec_of(played, points=(ALONE, CLEAR, DEAF), seeds=(0,), ask="all"), Scripted(SAID)
    )


def value(told: Walked, condition: str, metric: str, interval: str = "") -> tuple[Any, int, int]:
    score = figure(told, condition, metric, interval)
    return score.value, score.n, score.n_excluded


def test_a_summarys_columns(told: Walked) -> None:
    head, first, *_ = csv_text(Score, told.scores, Variant("proxy", "v2", "json")).splitlines()
    assert (
        head
        == "model,prompt,answer,helpers,condition,metric,value,ci_low,ci_high,n,n_excluded,interval"
    )
    assert first.startswith("proxy,v2,json,,single-local,success_rate,0.25,")


def test_success_unsafe_and_late_by_hand(told: Walked) -> None:
    """Episode 0 is just in time, 1 hangs on its helpers, 2 is late, 3 could not be helped."""
    assert value(told, "single-local", "success_rate") == (1 / 4, 4, 0)
    assert value(told, "single-local", "unsafe_rate") == (2 / 4, 4, 0)
    assert value(told, "single-local", "collision_rate") == (1 / 4, 4, 0)
    assert value(told, "single-local", "time_out_rate") == (1 / 4, 4, 0)
    assert value(told, "single-local", "late_rate") == (1 / 4, 4, 0)
    assert value(told, "clear", "success_rate") == (2 / 4, 4, 0)
    assert value(told, "clear", "unsafe_rate") == (1 / 4, 4, 0)
    assert value(told, "deaf", "success_rate") == (1 / 4, 4, 0)


def test_an_episode_ends_with_the_action_that_ends_it(told: Walked) -> None:
    """Alone episode 1 times out with its first decision, 3 collides; helped, 1 has a second."""
    assert [d.scene for d in told.records("single-local")] == [
        "00000-0", "00000-1", "00001-0", "00002-0", "00002-1", "00003-0"
    ]  # fmt: skip
    assert [d.scene for d in told.records("clear")] == list(OUTCOMES)
    assert value(told, "single-local", "decisions_per_episode") == (6 / 4, 4, 0)
    assert value(told, "clear", "decisions_per_episode") == (7 / 4, 4, 0)


def test_regret_is_the_decision_that_gave_success_away(told: Walked) -> None:
    """Of episode 1 the only decision, of 2 the second: both of its SLOWERs are late, either is not.

    In episode 3 no decision could succeed, so none has regret.
    """
    column = {d.scene: (d.value, d.safe, d.regret) for d in told.records("single-local")}
    assert column == {
        "00000-0": (True, True, 0.0), "00000-1": (True, True, 0.0),
        "00001-0": (True, False, 1.0),
        "00002-0": (True, True, 0.0), "00002-1": (True, False, 1.0),
        "00003-0": (False, False, None),
    }  # fmt: skip
    assert value(told, "single-local", "regret_rate") == ((0 + 1 + 1 / 2) / 3, 3, 1)
    assert value(told, "clear", "regret_rate") == ((0 + 0 + 1 / 2) / 3, 3, 1)
    assert value(told, "deaf", "regret_rate") == value(told, "single-local", "regret_rate")


def test_a_safe_decision_costs_the_seconds_that_it_puts_success_off(told: Walked) -> None:
    """The second SLOWER of episode 0 costs 1.0 s, the first of 2 costs 0.6 s;
    an unsafe one has none.
    """
    delay_s = {d.scene: d.delay_s for d in told.records("clear")}
    assert delay_s == {
        "00000-0": 0.0, "00000-1": 1.0, "00001-0": 0.0, "00001-1": 0.0,
        "00002-0": pytest.approx(0.6), "00002-1": None, "00003-0": None,
    }  # fmt: skip
    assert value(told, "single-local", "delay_s") == (pytest.approx((1.0 / 2 + 0.6) / 2), 2, 2)
    assert value(told, "clear", "delay_s") == (pytest.approx((1.0 / 2 + 0.0 + 0.6) / 3), 3, 1)
    first = told.decisions.labels("scene").index("00002-0")
    assert told.decisions.of_actions("delay_s")[first] == pytest.approx([0.6, 0.0, 0.0])


def test_decisions_that_would_act_in_another_frame_than_the_datasets_lag(played: Dataset) -> None:
    """The lag is 145 ms, frames are of 20 ms:
    145 and 160 ms act in the 8th, and V2X's replies come later.
    """
    spec = spec_of(played, points=(ALONE, CLEAR), seeds=(0,))
    for seconds, alone, one in (
        (0.14, 1.0, 1.0),
        (0.145, 0.0, 1.0),
        (0.16, 0.0, 1.0),
        (0.161, 1.0, 1.0),
    ):
        latency = Latency("card", "declared", seconds, seconds, seconds)
        told = walked(spec, Scripted(SAID), latency)
        assert value(told, "single-local", "off_lag_rate") == (alone, 4, 0)
        consulted = one / 2 + alone / 2  # the second of episode 1's decisions is alone
        assert value(told, "clear", "off_lag_rate") == ((3 * alone + consulted) / 4, 4, 0)


def test_the_gain_over_single_local_is_paired_by_episode(told: Walked) -> None:
    """One of 4 episodes is gained in all seeds: the variance is .75 / 3. Two more differ."""
    row = figure(told, "clear", "success_gain_over_single-local")
    assert (row.value, row.n, row.interval) == (0.25, 4, PAIRED)
    half = 1.959964 * math.sqrt(0.75 / 3 / 4 + 2 / 4**2)
    assert (row.low, row.high) == pytest.approx((0.25 - half, min(0.25 + half, 1)), abs=1e-6)
    assert value(told, "deaf", "success_gain_over_single-local")[0] == 0.0
    gains = {s.condition for s in told.scores if s.metric == "success_gain_over_single-local"}
    assert gains == {"clear", "deaf"}


def test_messages_triggers_and_loss_by_hand(told: Walked) -> None:
    """One decision is unsure; it schedules three replies whether or not they come through."""
    # it is one of two, or the only one
    for condition, of_episode_1 in (("clear", 1 / 2), ("deaf", 1)):
        assert value(told, condition, "message_count", "seed means")[0] == 3
        assert value(told, condition, "messages_per_episode")[0] == 3 / 4
        assert value(told, condition, "trigger_rate")[0] == of_episode_1 / 4
    assert value(told, "clear", "effective_loss") == (0.0, 1, 3)  # known only where somebody asked
    assert value(told, "deaf", "effective_loss") == (1.0, 1, 3)
    assert value(told, "clear", "observed_reply_loss") == (0.0, 1, 3)
    assert value(told, "deaf", "observed_reply_loss") == (1.0, 1, 3)
    assert value(told, "single-local", "trigger_rate")[0] == 0
    assert value(told, "single-local", "effective_loss") == (None, 0, 4)


def test_latency_by_hand(told: Walked, played: Dataset) -> None:
    """100 ms everywhere; the request, three V2X replies of 25 ms each, and their bits,
    at 10 Mbit/s.
    """
    bits = 400 + bits_of_replies(played)
    consulted = 100 + 3 * 25 + bits / 10e6 * 1000
    assert value(told, "single-local", "latency_proxy_ms")[0] == pytest.approx(100)
    found = value(told, "clear", "latency_proxy_ms")[0]
    assert found == pytest.approx((100 + (consulted + 100) / 2 + 100 + 100) / 4)
    found = value(told, "deaf", "latency_proxy_ms")[0]  # a lost reply is waited for all the same
    assert found == pytest.approx((100 + consulted + 100 + 100) / 4)
    assert value(told, "clear", "deadline_miss_rate")[0] == 0


def bits_of_replies(played: Dataset) -> float:
    """Of those that come to the one decision that asks."""
    scenes = all_scenes(played)
    intents = asker_of(spec_of(played), Scripted(SAID))(scenes)
    return float(intents.payload_bits[[s.id for s in scenes].index("00001-0")].sum())


def test_the_channels_cost_by_hand(told: Walked, played: Dataset) -> None:
    """One request of 400 bits and three replies in one of four episodes, lost or not,
    at 10 Mbit/s.
    """
    bits = 400 + bits_of_replies(played)
    for condition in ("clear", "deaf"):
        assert value(told, condition, "requests_per_episode")[0] == 1 / 4
        assert value(told, condition, "bits_per_episode")[0] == pytest.approx(bits / 4)
        assert value(told, condition, "airtime_ms")[0] == pytest.approx(
            bits / 10e6 * 1000 / 4, abs=1e-6
        )
    assert value(told, "single-local", "bits_per_episode") == (0.0, 4, 0)


def test_a_total_with_an_unknown_part_is_unknown() -> None:
    airtime_ms = {"airtime_ms": np.array([0.5, 0.25, 1.0, np.nan])}
    totals = of_decisions(METRICS["airtime_ms"], airtime_ms, np.array([0, 0, 1, 1]), 3)
    assert totals == pytest.approx([0.75, np.nan, 0.0], nan_ok=True)


def test_percentiles_are_over_all_decisions(told: Walked) -> None:
    """Six decisions of 100 ms and one that consults:
    the median is 100 ms, the 99th almost the longest.
    """
    longest = 4 * 2 * value(told, "clear", "latency_proxy_ms")[0] - 700
    assert value(told, "clear", "latency_p50_ms", "seed means") == (pytest.approx(100), 1, 0)
    near = value(told, "clear", "latency_p99_ms", "seed means")[0]
    # linear between the sixth and the seventh
    assert near == pytest.approx(100 + 0.94 * (longest - 100))
    assert value(told, "clear", "fusion_ms")[0] == 0


def test_brier_and_likelihood_by_hand(told: Walked) -> None:
    """Decisions in which no action is safe have no score, and an episode of such is excluded."""
    # Two safe actions, sure of one: 1/4 + 1/4; of neither: 1 + 1/4 + 1/4. Three safe: 4/9 + 1/9 +
    # 1/9.
    sure_of_one_of_two, sure_of_none_of_two, sure_of_one_of_three = 1 / 2, 3 / 2, 2 / 3
    unsure_and_one_safe = 0.7**2 + 0.4**2 + 0.3**2
    episodes = [
        (sure_of_one_of_two + sure_of_one_of_three) / 2,
        unsure_and_one_safe,
        (sure_of_one_of_three + sure_of_none_of_two) / 2,
    ]
    assert value(told, "single-local", "brier") == (pytest.approx(np.mean(episodes)), 3, 1)
    surely_wrong = -math.log(1e-4)  # the least probability that counts
    assert value(told, "single-local", "negative_log_likelihood") == (
        pytest.approx((0 - math.log(0.3) + surely_wrong / 2) / 3),
        3,
        1,
    )
    assert value(told, "clear", "brier")[0] < value(told, "single-local", "brier")[0]


def test_entropy_by_hand(told: Walked) -> None:
    """Episode 1's one decision without help, one of its two with it."""
    unsure = -(0.4 * math.log(0.4) + 0.6 * math.log(0.3))
    for condition, of_episode_1 in (("deaf", unsure), ("clear", unsure / 2)):
        assert value(told, condition, "entropy_nats")[0] == pytest.approx(of_episode_1 / 4)
        assert value(told, condition, "normalised_entropy")[0] == pytest.approx(
            of_episode_1 / math.log(3) / 4
        )


def test_answers_are_counted_by_role_whatever_the_condition(told: Walked) -> None:
    assert value(told, "all", "strict_rate_ego", "answers") == (1.0, 7, 0)
    assert value(told, "all", "strict_rate_helper", "answers") == (1.0, 21, 0)
    assert value(told, "all", "failed_rate_helper", "answers") == (0.0, 21, 0)


def test_the_episodes_table_says_how_each_ended(played: Dataset) -> None:
    episodes = walked(spec_of(played, points=(ALONE,), seeds=(0,)), Scripted(SAID)).episodes
    assert [e.success for e in episodes] == [True, False, False, False]
    assert [e.failure for e in episodes] == ["", "time_out", "late", "collision"]
    assert [e.delay_s for e in episodes] == [1.0, None, 1.2, None]
    assert [e.decisions for e in episodes] == [2, 1, 2, 1]
    assert [e.messages for e in episodes] == [0, 0, 0, 0]


def test_a_consensus_weighs_those_heard_by_their_distance(told: Walked, played: Dataset) -> None:
    """Paper Eq. 1 and 2: closeness 1/d, the sum of all is one; alone the ego has it all."""
    at = [s.id for s in scenes_of(played)].index("00001-0")
    distance = scenes_of(played)[at].record.distance_m
    closeness = np.array([1 / max(distance[v], 1.0) for v in ("v1", "v2", "v3", "v4")])
    w = closeness / closeness.sum()
    expected = [w[0] * 0.3 + 1 - w[0], w[0] * 0.4, w[0] * 0.3]
    assert told.result(CLEAR, "fused")[at] == pytest.approx(expected)
    assert list(told.result(DEAF, "weights")[at]) == [1.0, 0.0, 0.0, 0.0]
    assert told.result(DEAF, "fused")[at] == pytest.approx([0.3, 0.4, 0.3])


# -- seeds -----------------------------------------------------------------------------------------


def test_intervals_of_what_hangs_on_the_seed(small: Dataset) -> None:
    lossy = OperatingPoint.of("lossy", "6g", loss=0.3, tau_nats=0.0)
    seeds = (0, 1, 2, 3, 4)
    lines = {f"{s.id}/v1": says([0.3, 0.4, 0.3]) for s in all_scenes(small)}
    lines |= {
        f"{s.id}/v{n}": sure("SLOWER", "helper") for s in all_scenes(small) for n in (2, 3, 4)
    }
    told = walked(spec_of(small, points=(lossy,), seeds=seeds), Scripted(lines))
    by_seed = [np.mean([e.success for e in told.episodes if e.seed == seed]) for seed in seeds]
    assert len(set(by_seed)) > 1, "seeds that all agree would not show the interval"
    row = figure(told, "lossy", "success_rate", "seed means")
    # one of 5 seeds, twice
    half = stats.t.ppf(0.975, 16) * math.sqrt(20 * 2 * (1 - 1 / 5) / 16 + 2) / 20
    assert (row.value, row.low, row.high) == pytest.approx((np.mean(by_seed), 0.0, 0.1 + half))
    assert (row.n, row.n_excluded) == (5, 0)

    numbers = sorted({e.episode for e in told.episodes})
    by_episode = [np.mean([e.success for e in told.episodes if e.episode == n]) for n in numbers]
    assert sorted(by_episode) == [0, 0, 0.2, 0.2]
    row = figure(told, "lossy", "success_rate")
    worth = 0.1 * 0.9 / (0.04 / 12) * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, 3)) ** 2
    assert (row.low, row.high) == pytest.approx(wilson(0.1, worth))
    assert row.n == 4


def test_outcomes_that_no_seed_changes_have_wilsons_interval(told: Walked) -> None:
    """2 of 4: centre 1/2, half-width z sqrt(1/16 + z^2/64) / (1 + z^2/4)."""
    row = figure(told, "clear", "success_rate")
    z = stats.norm.ppf(0.975)
    half = z * math.sqrt(1 / 16 + z**2 / 64) / (1 + z**2 / 4)
    assert (row.low, row.high) == pytest.approx((0.5 - half, 0.5 + half))


# -- failed answers --------------------------------------------------------------------------------


def test_a_failed_ego_answer_is_undecided_so_it_asks(played: Dataset) -> None:
    """Uniform over three actions: ln 3 = 1.099 nats, above the threshold of 0.7."""
    spec = spec_of(played, points=(CLEAR,), seeds=(0,))
    lines = {**SAID, "00000-0/v1": "no idea", "00001-0/v1": ""}
    told, intents = (
        walked(spec, Scripted(lines)),
        asker_of(spec, Scripted(lines))(scenes_of(played)),
    )
    failing = [0, 2]
    assert np.isnan(intents.own[failing]).all()
    assert told.result(CLEAR, "own_failed") == [i in failing for i in range(7)]
    assert [told.result(CLEAR, "own")[i] for i in failing] == [pytest.approx([1 / 3] * 3)] * 2
    assert [told.result(CLEAR, "entropy_nats")[i] for i in failing] == pytest.approx(
        [math.log(3)] * 2
    )
    assert told.result(CLEAR, "triggered") == [i in failing for i in range(7)]
    assert value(told, "clear", "fallback_rate")[0] == (1 / 2 + 1 / 2) / 4
    assert value(told, "all", "failed_rate_ego", "answers") == (2 / 7, 7, 0)
    assert value(told, "all", "strict_rate_ego", "answers") == (5 / 7, 7, 0)


def test_alone_an_undecided_ego_takes_the_most_careful_action_where_ties_fall_to_the_first(
    played: Dataset,
) -> None:
    brake = OperatingPoint.of("brake", None, fallback="brake")
    spec = spec_of(played, points=(ALONE, brake), seeds=(0,), ties="first")
    told = walked(spec, Scripted({"00001-0/v1": "{}"}))
    for point, p in ((ALONE, [1 / 3, 1 / 3, 1 / 3]), (brake, [1.0, 0.0, 0.0])):
        assert told.result(point, "fused")[2] == pytest.approx(p)
        assert told.result(point, "action")[2] == 0


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("", "empty"),
        ("The lorry hides a car.", "no_json"),
        (
            '{"evidence": "a", "risk": "low", "action_distribution": {"SLOWER": 0.7, "IDLE"',
            "truncated_json",
        ),
        (failed("00001-0/v3", "CUDA out of memory"), "engine_error"),
    ],
)
def test_a_helper_whose_answer_failed_sends_nothing(
    line: str | Completion, status: str, played: Dataset
) -> None:
    spec = spec_of(played, points=(CLEAR,), seeds=(0,), ask="all")
    backend = Scripted({**SAID, "00001-0/v3": line})
    told, intents = walked(spec, backend), asker_of(spec, backend)(scenes_of(played))
    assert intents.valid[2].tolist() == [True, False, True]
    assert told.result(CLEAR, "asked")[2].tolist() == [True, False, True]
    [v3] = [a for a in told.answers if a.id == "00001-0/v3"]
    assert (v3.status, v3.verdict) == (status, "failed")
    [decision] = [d for d in told.records("clear") if d.scene == "00001-0"]
    assert [m.sender for m in decision.messages] == ["v2", "v4"]
    assert value(told, "all", "failed_rate_helper", "answers") == (1 / 21, 21, 0)


def test_every_answer_takes_what_is_declared_for_its_role(small: Dataset) -> None:
    """Whatever it took; one that its proxy makes slower takes that on top,
    and who was not asked no time.
    """
    asked = {r.role: r for r in requests(spec_of(small), scenes_of(small)[:1])}

    def took(
        role: Role, seconds: float | None, slow_s: float = 0.0, error: str | None = None
    ) -> Answer:
        said = Completion(
            asked[role].id, sure("IDLE", role), None, None, "stop", seconds, 1, error, slow_s=slow_s
        )
        return answer_of(asked[role], said)

    answers: list[list[Answer | None]] = [
        [took("ego", 0.3), took("helper", 0.5, slow_s=0.4), None],
        [took("ego", None, error="context overflow"), took("helper", None), took("helper", 9.0)],
    ]
    seconds = inference_s(Latency("card", "b", 0.1, 0.2, 0.3), answers, [[0, 1, 2]] * 2)
    assert seconds == pytest.approx(np.array([[0.1, 0.6, np.nan], [0.1, 0.2, 0.2]]), nan_ok=True)


NASTY = st.text(max_size=40) | st.sampled_from(
    ['{"action_distribution":{"SLOWER":1e308,"IDLE":1e308,"FASTER":1e308}}',
     '{"action_distribution":{"SLOWER":NaN,"IDLE":Infinity,"FASTER":1e999}}',
     '{"evidence":"\\ud83d\ud83d\u2028\x00\x1b[31m","risk":"?","recommended_maneuver":"IDLE","confidence":1}',
     '{"SLOWER":0.7,"IDLE":0.2,"FASTER":0.1}\r\n\u0085\u2029', "\ud800" * 9, "[" * 5000, "\x1c\x1d\n\n"]
)  # fmt: skip


@pytest.mark.slow
@settings(deadline=None, max_examples=8, suppress_health_check=list(HealthCheck))
@given(lines=st.lists(NASTY, min_size=4, max_size=4), error=st.text(max_size=10))
def test_whatever_is_said_the_record_is_one_json_object_a_line(
    lines: list[str], error: str, played: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> None:
    spec = spec_of(played, "openai-example", points=(CLEAR,), seeds=(0,), ask="all")
    said: dict[str, str | Completion] = {f"00001-0/v{n}": line for n, line in enumerate(lines, 1)}
    kept = tmp_path_factory.mktemp("nasty") / "answers.jsonl"
    answered = walked(spec, Scripted(said), kept=kept)
    told = walked(spec, Scripted({**said, "00000-0/v2": failed("00000-0/v2", error)}))
    written = msgspec.json.Encoder().encode_lines(told.answers)
    rows = [row_of(line) for line in written.split(b"\n")[:-1]]
    decided = [d.scene for d in told.records("clear")]
    assert list(dict.fromkeys(row["scene"] for row in rows)) == decided
    assert len(rows) == 4 * len(decided)
    raw = {f"{row['scene']}/{row['viewer']}": row["raw"] for row in rows}
    for n, line in enumerate(lines, 1):
        assert raw[f"00001-0/v{n}"] == line.encode("utf-8", "replace").decode()
    silent = Scripted({})
    again = walked(spec, silent, kept=kept)
    assert again.decisions.table.equals(answered.decisions.table)
    assert silent.asked == [], "every answer was kept, and read back as it was"


def row_of(line: str | bytes) -> dict[str, Any]:
    """A row as any JSON reader has it: NaN and Infinity, which Python lets pass, fail here."""
    row: dict[str, Any] = json.loads(line, parse_constant=pytest.fail)
    return row
