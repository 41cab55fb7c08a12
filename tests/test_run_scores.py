"""Scores of runs whose every answer and outcome is written down here, so that they can be counted by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import Scripted, ask, failed, says, scored, spec_of, sure, with_outcomes
from harness.evaluate.scoring import draw, score, statuses
from harness.evaluate.timing import inference_s, measure
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.backends.cards import Latency
from harness.coordination.operating_point import OperatingPoint
from harness.dataset.load import Dataset
from harness.evaluate.success import table
from harness.runs import record
from harness.runs.summary import COLUMNS, summary

ALONE = OperatingPoint("single-local", None)
CLEAR = OperatingPoint("clear", "v2x", loss=0.0)  # nothing is lost, and no jitter
DEAF = OperatingPoint("deaf", "v2x", loss=1.0)

# Seconds until the intersection is cleared, or how it ends.
OUTCOMES = {
    # Episode 0: nothing dangerous. The second SLOWER comes 1.0 s late, which is just allowed.
    "00000-0": {"SLOWER": 6.0, "IDLE": 5.0, "FASTER": "collision"},
    "00000-1": {"SLOWER": 7.0, "IDLE": 6.0, "FASTER": 6.0},
    # Episode 1: only SLOWER is safe; then nothing is, which blames nobody.
    "00001-0": {"SLOWER": 5.0, "IDLE": "time_out", "FASTER": "collision"},
    "00001-1": {"SLOWER": "collision", "IDLE": "collision", "FASTER": "collision"},
    # Episode 2: safe throughout, and 0.6 s + 0.6 s late.
    "00002-0": {"SLOWER": 5.6, "IDLE": 5.0, "FASTER": 5.0},
    "00002-1": {"SLOWER": 5.6, "IDLE": 5.0, "FASTER": 5.0},
    # Episode 3: nothing is ever safe.
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
    return with_outcomes(small, 2, OUTCOMES)


@pytest.fixture
def told(played: Dataset, tmp_path: Path) -> Any:
    """The summary of three conditions, one seed, 0.1 s an answer."""
    spec = spec_of(played, points=(ALONE, CLEAR, DEAF), seeds=(0,))
    known = ask(spec, Scripted(SAID), tmp_path)
    runs = [scored(spec, known, point)[1] for point in spec.points]
    table = summary(spec, scored(spec, known, ALONE)[0], known, runs)
    assert tuple(table.columns) == COLUMNS
    return table.set_index(["condition", "metric", "interval"])


def value(told: Any, condition: str, metric: str, interval: str = "episodes") -> tuple[float, int, int]:
    row = told.loc[(condition, metric, interval)]
    return float(row.value), int(row.n), int(row.n_excluded)


def test_success_unsafe_and_late_by_hand(told: Any) -> None:
    """Episode 0 is just in time, 1 hangs on its helpers, 2 is late, 3 could not be helped."""
    assert value(told, "single-local", "success_rate") == (2 / 4, 4, 0)
    assert value(told, "single-local", "unsafe_rate") == (1 / 4, 4, 0)
    assert value(told, "single-local", "late_rate") == (1 / 4, 4, 0)
    assert value(told, "clear", "success_rate") == (3 / 4, 4, 0)
    assert value(told, "clear", "unsafe_rate") == (0.0, 4, 0)
    assert value(told, "deaf", "success_rate") == (2 / 4, 4, 0)


def test_the_gain_over_single_local_is_paired_by_episode(told: Any) -> None:
    """Differences 0, 1, 0, 0: mean 0.25, standard error 0.25, times t(3) = 3.182."""
    row = told.loc[("clear", "success_gain_over_single-local", "episodes")]
    assert (row.value, row.n) == (0.25, 4)
    assert (row.ci_low, row.ci_high) == pytest.approx((0.25 - 0.7956, 0.25 + 0.7956), abs=1e-4)
    assert value(told, "deaf", "success_gain_over_single-local")[0] == 0.0
    assert ("single-local", "success_gain_over_single-local", "episodes") not in told.index


def test_messages_triggers_and_loss_by_hand(told: Any) -> None:
    """One decision of seven is unsure; it schedules three replies whether or not they come through."""
    for condition in ("clear", "deaf"):
        assert value(told, condition, "message_count", "seed means")[0] == 3
        assert value(told, condition, "messages_per_episode")[0] == 3 / 4
        assert value(told, condition, "trigger_rate")[0] == (1 / 2) / 4  # half of episode 1's decisions
    assert value(told, "clear", "effective_loss") == (0.0, 1, 3)  # known only where somebody asked
    assert value(told, "deaf", "effective_loss") == (1.0, 1, 3)
    assert value(told, "clear", "observed_reply_loss") == (0.0, 1, 3)
    assert value(told, "deaf", "observed_reply_loss") == (1.0, 1, 3)
    assert value(told, "single-local", "trigger_rate")[0] == 0
    unknown = told.loc[("single-local", "effective_loss", "episodes")]
    assert math.isnan(unknown.value)
    assert (unknown.n, unknown.n_excluded) == (0, 4)


def test_latency_by_hand(told: Any, played: Dataset, tmp_path: Path) -> None:
    """100 ms everywhere; three V2X replies add 25 ms each, and their bits at 10 Mbit/s."""
    spec = spec_of(played)
    known = ask(spec, Scripted(SAID), tmp_path)
    asked = [s.id for s in played.scenes].index("00001-0")
    consulted = 100 + 3 * 25 + known.payload_bits[asked].sum() / 10e6 * 1000
    assert value(told, "single-local", "latency_proxy_ms")[0] == pytest.approx(100)
    for condition in ("clear", "deaf"):  # a lost reply is waited for all the same
        found = value(told, condition, "latency_proxy_ms")[0]
        assert found == pytest.approx((100 + (consulted + 100) / 2 + 100 + 100) / 4)
    assert value(told, "clear", "deadline_miss_rate")[0] == 0


def test_percentiles_are_over_all_decisions(told: Any) -> None:
    """Seven decisions of 100 ms, one of which consults: the median is 100 ms, the 99th almost the longest."""
    longest = 4 * 2 * value(told, "clear", "latency_proxy_ms")[0] - 700
    assert value(told, "clear", "latency_p50_ms", "seed means") == (pytest.approx(100), 1, 0)
    near = value(told, "clear", "latency_p99_ms", "seed means")[0]
    assert near == pytest.approx(100 + 0.94 * (longest - 100))  # linear between the sixth and the seventh
    assert value(told, "clear", "fusion_ms")[0] == 0


def test_brier_and_likelihood_by_hand(told: Any) -> None:
    """Decisions in which no action is safe have no score, and an episode of such is excluded."""
    # Two safe actions, sure of one: 1/4 + 1/4. Three safe, sure of one: 4/9 + 1/9 + 1/9.
    sure_of_one_of_two, sure_of_one_of_three = 1 / 2, 2 / 3
    unsure_and_one_safe = 0.7**2 + 0.4**2 + 0.3**2
    episodes = [(sure_of_one_of_two + sure_of_one_of_three) / 2, unsure_and_one_safe, sure_of_one_of_three]
    assert value(told, "single-local", "brier") == (pytest.approx(np.mean(episodes)), 3, 1)
    assert value(told, "single-local", "negative_log_likelihood") == (
        pytest.approx(-math.log(0.3) / 3),
        3,
        1,
    )
    assert value(told, "clear", "brier")[0] < value(told, "single-local", "brier")[0]


def test_entropy_by_hand(told: Any) -> None:
    unsure = -(0.4 * math.log(0.4) + 0.6 * math.log(0.3))
    assert value(told, "deaf", "entropy_nats")[0] == pytest.approx(unsure / 2 / 4)
    assert value(told, "deaf", "normalised_entropy")[0] == pytest.approx(unsure / math.log(3) / 2 / 4)


def test_answers_are_counted_by_role_whatever_the_condition(told: Any) -> None:
    assert value(told, "all", "strict_rate_ego", "answers") == (1.0, 7, 0)
    assert value(told, "all", "strict_rate_helper", "answers") == (1.0, 21, 0)
    assert value(told, "all", "failed_rate_helper", "answers") == (0.0, 21, 0)


def test_the_episodes_table_says_how_each_ended(played: Dataset, tmp_path: Path) -> None:
    spec = spec_of(played, points=(ALONE,), seeds=(0,))
    laid, result = scored(spec, ask(spec, Scripted(SAID), tmp_path), ALONE)
    table = record.episodes(spec, laid, [result])
    assert list(table.success) == [True, False, False, True]
    assert list(table.failure) == ["", "time_out", "late", ""]
    assert list(table.delay_s) == pytest.approx([1.0, 0.0, 1.2, 0.0])
    assert list(table.messages) == [0, 0, 0, 0]


def test_a_consensus_weighs_those_heard_by_their_distance(played: Dataset, tmp_path: Path) -> None:
    """Paper Eq. 1 and 2: closeness 1/d, the sum of all is one; alone the ego has it all."""
    spec = spec_of(played)
    known = ask(spec, Scripted(SAID), tmp_path)
    at = [s.id for s in played.scenes].index("00001-0")
    distance = played.scenes[at].record["distance_m"]
    closeness = np.array([1 / max(distance[v], 1.0) for v in ("v1", "v2", "v3", "v4")])
    w = closeness / closeness.sum()
    clear, deaf = (scored(spec, known, point)[1].coordination for point in (CLEAR, DEAF))
    assert clear.fused[at] == pytest.approx([w[0] * 0.3 + 1 - w[0], w[0] * 0.4, w[0] * 0.3])
    assert list(deaf.weights[at]) == [1.0, 0.0, 0.0, 0.0]
    assert deaf.fused[at] == pytest.approx([0.3, 0.4, 0.3])


# -- seeds ------------------------------------------------------------------------------------------------


def test_the_interval_over_seeds_is_students_t_of_their_means(small: Dataset, tmp_path: Path) -> None:
    lossy = OperatingPoint("lossy", "6g", loss=0.4, tau_nats=0.0)
    seeds = (0, 1, 2, 3, 4)
    lines = {f"{s.id}/v1": says([0.3, 0.4, 0.3]) for s in small.scenes}
    lines |= {f"{s.id}/v{n}": sure("SLOWER", "helper") for s in small.scenes for n in (2, 3, 4)}
    spec = spec_of(small, points=(lossy,), seeds=seeds)
    known = ask(spec, Scripted(lines), tmp_path)
    runs = [scored(spec, known, lossy, seed)[1] for seed in seeds]
    laid = scored(spec, known, lossy)[0]
    told: Any = summary(spec, laid, known, runs).set_index(["condition", "metric", "interval"])
    table = record.episodes(spec, laid, runs)
    by_seed = table.groupby("seed").success.mean().to_numpy()
    assert len(set(by_seed)) > 1, "seeds that all agree would not show the interval"
    row = told.loc[("lossy", "success_rate", "seed means")]
    low, high = stats.t.interval(0.95, len(seeds) - 1, loc=by_seed.mean(), scale=stats.sem(by_seed))
    assert low < 0 < high < 1  # a share ends at 0, which t does not know
    assert (row.value, row.ci_low, row.ci_high) == pytest.approx((by_seed.mean(), 0.0, high))
    assert (row.n, row.n_excluded) == (5, 0)

    by_episode = table.groupby("episode").success.mean().to_numpy()
    row = told.loc[("lossy", "success_rate", "episodes")]
    low, high = stats.t.interval(0.95, 3, loc=by_episode.mean(), scale=stats.sem(by_episode))
    assert low < 0, "a share of episodes ends at 0, whatever Student says"
    assert (row.ci_low, row.ci_high, row.n) == (0.0, pytest.approx(high), 4)


def test_outcomes_that_no_seed_changes_have_wilsons_interval(told: Any) -> None:
    """2 of 4: centre 1/2, half-width z sqrt(1/16 + z^2/64) / (1 + z^2/4)."""
    row = told.loc[("single-local", "success_rate", "episodes")]
    z = stats.norm.ppf(0.975)
    half = z * math.sqrt(1 / 16 + z**2 / 64) / (1 + z**2 / 4)
    assert (row.ci_low, row.ci_high) == pytest.approx((0.5 - half, 0.5 + half))


# -- failed answers ---------------------------------------------------------------------------------------


def test_a_failed_ego_answer_is_undecided_so_it_asks(played: Dataset, tmp_path: Path) -> None:
    """Uniform over three actions: ln 3 = 1.099 nats, above the threshold of 0.7."""
    spec = spec_of(played, points=(CLEAR,), seeds=(0,))
    known = ask(spec, Scripted({**SAID, "00000-0/v1": "no idea", "00001-0/v1": ""}), tmp_path)
    laid, result = scored(spec, known, CLEAR)
    c = result.coordination
    failing = [0, 2]
    assert np.isnan(known.own[failing]).all()
    assert c.own_failed.tolist() == [i in failing for i in range(7)]
    assert c.own[failing] == pytest.approx(1 / 3)
    assert c.entropy_nats[failing] == pytest.approx(math.log(3))
    assert c.triggered.tolist() == [i in failing for i in range(7)]
    told: Any = summary(spec, laid, known, [result]).set_index(["condition", "metric", "interval"])
    assert value(told, "clear", "fallback_rate")[0] == (1 / 2 + 1 / 2) / 4
    assert value(told, "all", "failed_rate_ego", "answers") == (2 / 7, 7, 0)
    assert value(told, "all", "strict_rate_ego", "answers") == (5 / 7, 7, 0)


def test_alone_an_undecided_ego_takes_the_most_conservative_action(played: Dataset, tmp_path: Path) -> None:
    spec = spec_of(played)
    known = ask(spec, Scripted({"00001-0/v1": "{}"}), tmp_path)
    brake = OperatingPoint("brake", None, fallback="brake")
    for point, p in ((ALONE, [1 / 3, 1 / 3, 1 / 3]), (brake, [1.0, 0.0, 0.0])):
        c = scored(spec, known, point)[1].coordination
        assert c.fused[2] == pytest.approx(p)
        assert c.action[2] == 0


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("", "empty"),
        ("The lorry hides a car.", "no_json"),
        ('{"evidence": "a", "risk": "low", "action_distribution": {"SLOWER": 0.7, "IDLE"', "truncated_json"),
        (failed("00001-0/v3", "CUDA out of memory"), "engine_error"),
    ],
)
def test_a_helper_whose_answer_failed_sends_nothing(
    line: str | Completion, status: str, played: Dataset, tmp_path: Path
) -> None:
    spec = spec_of(played, points=(CLEAR,), seeds=(0,))
    known = ask(spec, Scripted({**SAID, "00001-0/v3": line}), tmp_path)
    laid, result = scored(spec, known, CLEAR)
    assert known.valid[2].tolist() == [True, False, True]
    assert result.coordination.asked[2].tolist() == [True, False, True]
    [row] = [r for r in map(row_of, record.rows(spec, laid, known, [result])) if r["scene"] == "00001-0"]
    assert row["answers"]["v3"]["status"] == status
    assert [m["from"] for m in row["decisions"][0]["messages"]] == ["v2", "v4"]
    assert statuses(known)["helper"].count("failed") == 1


def row_of(line: str | bytes) -> dict[str, Any]:
    """A row as any JSON reader has it: NaN and Infinity, which Python lets pass, fail here."""
    row: dict[str, Any] = json.loads(line, parse_constant=pytest.fail)
    return row


def test_an_unknown_time_is_null_and_never_zero(played: Dataset, tmp_path: Path) -> None:
    """Every ego answer failed before anything could be timed."""
    spec = spec_of(played, points=(ALONE, CLEAR), seeds=(0,))
    lines = {f"{s.id}/v1": failed(f"{s.id}/v1", "context overflow") for s in played.scenes}
    known = ask(spec, Scripted({**SAID, **lines}), tmp_path)
    known = replace(known, inference_s=inference_s({"inference_s": None}, known.answers))
    assert np.isnan(known.inference_s[:, 0]).all()
    laid = table(spec.dataset)
    drawn = draw(laid, 0, known.valid.shape)
    runs = [score(laid, known, point, 0, drawn) for point in spec.points]
    told: Any = summary(spec, laid, known, runs).set_index(["condition", "metric", "interval"])
    for metric in ("latency_proxy_ms", "deadline_miss_rate"):
        row = told.loc[("single-local", metric, "episodes")]
        assert math.isnan(row.value)
        assert (row.n, row.n_excluded) == (0, 4)
    for scene in map(row_of, record.rows(spec, laid, known, runs)):
        assert all(d["latency_ms"] is None and d["deadline_missed"] is None for d in scene["decisions"])
    assert record.episodes(spec, laid, runs).latency_ms.isna().all()


def test_an_answer_without_a_time_takes_its_roles_median() -> None:
    def took(seconds: float | None, slow_s: float = 0.0) -> dict[str, float | None]:
        return {"seconds": seconds, "slow_s": slow_s}

    answers = [
        [took(0.1), took(0.5), None],
        [took(None), took(0.7), None],
        [took(0.3), took(None), took(0.6)],
    ]
    seconds = inference_s({"inference_s": None}, answers)
    expected = [[0.1, 0.5, np.nan], [0.2, 0.7, np.nan], [0.3, 0.6, 0.6]]
    assert seconds == pytest.approx(np.array(expected), nan_ok=True)
    answers[0][1] = took(0.5, slow_s=0.4)
    declared = inference_s({"inference_s": {"ego": 0.1, "helper": 0.2}}, answers)
    expected = [[0.1, 0.6, np.nan], [0.1, 0.2, np.nan], [0.1, 0.2, 0.2]]
    assert declared == pytest.approx(np.array(expected), nan_ok=True)


def test_an_answer_that_failed_is_no_sample_of_a_models_latency(small: Dataset, tmp_path: Path) -> None:
    """A server that refuses at once would look fast: of five egos' answers, one fails after no time."""

    class Timed(Scripted):
        def _say(self, request: Request) -> Completion:
            first = request.id == "00000-0/v1"
            return replace(super()._say(request), seconds=0.0 if first else 0.3, error="x" if first else None)

    card = replace(cards.load("proxy"), latency=Latency("measured", None, "this test"))
    latency = measure(replace(spec_of(small), card=card), Timed({}), tmp_path / "latency.json")
    assert latency["inference_s"] == {"ego": 0.3, "helper": 0.3}
    assert latency["n"]["ego"] == 4


NASTY = st.text(max_size=40) | st.sampled_from(
    ['{"action_distribution":{"SLOWER":1e308,"IDLE":1e308,"FASTER":1e308}}',
     '{"action_distribution":{"SLOWER":NaN,"IDLE":Infinity,"FASTER":1e999}}',
     '{"evidence":"\\ud83d\ud83d\u2028\x00\x1b[31m","risk":"?","recommended_maneuver":"IDLE","confidence":1}',
     '{"SLOWER":0.7,"IDLE":0.2,"FASTER":0.1}\r\n\u0085\u2029', "\ud800" * 9, "[" * 5000, "\x1c\x1d\n\n"]
)  # fmt: skip


@settings(deadline=None, max_examples=30, suppress_health_check=list(HealthCheck))
@given(lines=st.lists(NASTY, min_size=4, max_size=4), error=st.text(max_size=10))
def test_whatever_is_said_the_record_is_one_json_object_a_line(
    lines: list[str], error: str, played: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> None:
    spec = spec_of(played, points=(CLEAR,), seeds=(0,))
    said: dict[str, str | Completion] = {f"00001-0/v{n}": line for n, line in enumerate(lines, 1)}
    said["00000-0/v2"] = failed("00000-0/v2", error)
    folder = tmp_path_factory.mktemp("nasty")
    known = ask(spec, Scripted(said), folder)
    laid, result = scored(spec, known, CLEAR)
    written = "".join(record.rows(spec, laid, known, [result])).encode()
    rows = [row_of(line) for line in written.split(b"\n")[:-1]]
    assert [r["scene"] for r in rows] == list(OUTCOMES)
    for n, line in enumerate(lines, 1):
        assert rows[2]["answers"][f"v{n}"]["raw"] == line.encode("utf-8", "replace").decode()
    kept = Scripted({})
    assert ask(spec, kept, folder).own == pytest.approx(known.own, nan_ok=True)
    assert kept.asked == [], "every answer was kept, and read back as it was"
