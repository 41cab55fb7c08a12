"""Every metric is whole: what a table, a page,
a comparison and a gate ask of it is in its entry.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
from evaluating import spec_of
from packaged import register
from run_on_disk import Row, made_up

from harness.core.errors import UserError
from harness.core.figures import Unit
from harness.core.plugins import say_once
from harness.dataset.load import load
from harness.evaluate.run import evaluate
from harness.report.compare.difference import compare
from harness.report.compare.gate import gate, judge
from harness.report.compare.pair import pair
from harness.report.compare.text import terminal
from harness.runs.built_in_metrics import BUILT_IN
from harness.runs.decisions import Decisions
from harness.runs.folder import Run, read
from harness.runs.metric import Metric
from harness.runs.metrics import METRICS, entry, metrics_of
from harness.runs.records import Score

GOLDEN = Path(__file__).parent / "golden_runs" / "data"
PACKAGE = """
from harness.core.figures import Unit
from harness.runs.metric import Metric

SURE = Metric("sure_rate", "share of decisions that are sure", Unit("%", 1, 100.0), "higher", "rate", 1.0,
              decisions=lambda d: (d["entropy_nats"] < 0.1).astype(float))
OTHER = Metric("other", "", Unit(), "lower", decisions=lambda d: d["entropy_nats"])
FIRST = Metric("first", "", Unit(), "lower", decisions=lambda d: d["entropy_nats"], primary=True)
NOTHING = Metric("nothing", "", Unit(), "lower")
UNITLESS = Metric("unitless", "", None, "lower", decisions=lambda d: d["entropy_nats"])
ENDLESS = Metric("endless", "", Unit("x", 1, float("inf")), "lower", decisions=lambda d: d["acted"])
SWAPPED = Metric("swapped", "", Unit(1, "", 2), "lower", decisions=lambda d: d["entropy_nats"])
SIDEWAYS = Metric("sideways", "", Unit(), "sideways", decisions=lambda d: d["entropy_nats"])
MOON = Metric("moon", "", Unit(), "lower", decisions=lambda d: d["entropy_nats"], world="moon")


def bad(name, values):
    return Metric(name, "", Unit(), "lower", decisions=values)


def writes(d):
    d["latency_ms"][:] = 0.0
    return d["latency_ms"]


RAISES = bad("raises", lambda d: d["no such column"])
EXITS = bad("exits", lambda d: exit(0))
SHORT = bad("short", lambda d: d["entropy_nats"][1:])
BELOW = bad("below", lambda d: d["entropy_nats"] - 1.0)
VAST = bad("vast", lambda d: d["entropy_nats"] * 0 + 1e300)
COMPLEX = bad("complex", lambda d: d["entropy_nats"] + 1j)
WRITES = bad("writes", writes)
WORDS = Metric("words", "", Unit(), "lower", episodes=lambda episode: "many")
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package with a metric that also wants the name of a built-in one."""
    plugged_in(tmp_path, monkeypatch, "sure_rate = by_hand:SURE\nsuccess_rate = by_hand:SURE\n")


def plugged_in(site: Path, monkeypatch: pytest.MonkeyPatch, entries: str) -> None:
    register(site / "site", f"[swarmdrive.metrics]\n{entries}", by_hand=PACKAGE)
    monkeypatch.syspath_prepend(site / "site")
    monkeypatch.setattr(METRICS, "_loaded", dict(METRICS.built_in))
    entry.cache_clear()


def run_of(folder: Path, closed_loop: bool = False) -> Run:
    def differ(row: Row) -> None:
        row["entropy_nats"] = 0.0 if row["episode"] % 2 else 0.5

    return read(made_up(folder, decision=differ, closed_loop=closed_loop))


@pytest.mark.parametrize("metric", BUILT_IN, ids=lambda metric: metric.name)
def test_an_entry_says_all_that_is_shown(metric: Metric) -> None:
    assert metric.label
    assert metric.meaning
    assert not metric.meaning.endswith(".")
    assert metric.most == 1.0 or metric.interval == "mean"
    assert metric.compared or not metric.primary
    ways = (metric.decisions, metric.episodes, metric.answers, metric.percentile, metric.pooled)
    assert sum(map(bool, ways)) <= 1
    assert metric.unit.name != "%" or metric.most == 1.0


@pytest.mark.parametrize("file", GOLDEN.glob("*/summary.csv"), ids=lambda file: file.parent.name)
def test_every_row_of_a_summary_has_an_entry(file: Path) -> None:
    with file.open() as rows:
        assert {row["metric"] for row in csv.DictReader(rows)} <= set(METRICS)


@pytest.mark.parametrize("closed_loop", [False, True])
@pytest.mark.usefixtures("installed")
def test_every_metric_of_decisions_and_episodes_keeps_its_range(
    tmp_path: Path, closed_loop: bool
) -> None:
    """And values of some decisions are those of all, since workers see parts."""
    run = run_of(tmp_path / "run", closed_loop)
    part = Decisions(run.decisions.table.slice(3, 7), run.actions, run.decisions.helpers)
    metrics = metrics_of(run.world)
    assert "sure_rate" in {metric.name for metric in metrics}
    for metric in metrics:
        if metric.decisions:
            values = np.asarray(metric.decisions(run.decisions), dtype=float)
            assert values.shape == (len(run.decisions.table),)
            np.testing.assert_array_equal(metric.decisions(part), values[3:10])
        else:
            assert metric.episodes
            ended = [metric.episodes(episode) for episode in run.episodes]
            values = np.array([np.nan if value is None else value for value in ended], dtype=float)
        assert np.nanmin([*values, 0.0]) >= 0, metric.name
        assert np.nanmax([*values, 0.0]) <= metric.most, metric.name


@pytest.mark.usefixtures("installed")
def test_a_package_adds_a_metric_and_replaces_none(tmp_path: Path) -> None:
    """It is in the summary, it is compared, and a gate takes it."""
    assert METRICS["success_rate"].primary
    scores = [score for score in run_of(tmp_path / "run").scores if score.metric == "sure_rate"]
    assert {(score.condition, score.value) for score in scores} == {
        ("single-local", 0.5),
        ("6g", 0.5),
    }
    made_up(tmp_path / "other", decision=lambda row: row.update(entropy_nats=0.0))
    comparison = compare(pair(tmp_path / "run", tmp_path / "other"))
    assert "sure_rate %" in terminal(comparison, [], 3, whole=True)
    assert judge(gate("6g:sure_rate > 0.1"), comparison).failed == (("6g", 0.5),)
    with pytest.raises(UserError, match="did you mean 'sure_rate'"):
        gate("6g:sur_rate > 0.1")


@pytest.mark.usefixtures("installed")
def test_another_metric_changes_no_corrected_p(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own is exploratory, and stands uncorrected."""

    def lose(row: Row) -> None:
        if row["episode"] < 3:
            row |= {"success": False, "failure": "collision"}

    run_of(tmp_path / "a")
    made_up(tmp_path / "b", episode=lose, decision=lambda row: row.update(entropy_nats=0.0))
    runs = tmp_path / "a", tmp_path / "b"
    more = compare(pair(*runs)).conditions[1].differences
    own = next(d for d in more if d.metric == "sure_rate")
    assert own.p_value is not None
    assert own.p_corrected is None
    monkeypatch.setattr(type(METRICS), "_entries", lambda self: {})
    fewer = compare(pair(*runs)).conditions[1].differences
    assert len(more) == len(fewer) + 1
    assert [d.p_corrected for d in more if d is not own] == [d.p_corrected for d in fewer]
    assert any(d.p_corrected is not None for d in fewer)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("gone = by_hand:GONE", "'gone' .*does not load"),
        ("odd = by_hand:PACKAGE", "'odd' .*does not load"),
        (
            "mine = by_hand:OTHER",
            "'mine' .* is the metric 'other' with 1 functions; give it the name of",
        ),
        ("first = by_hand:FIRST", "'first' .* with 1 functions, a primary one; .* is not primary"),
        ("swapped = by_hand:SWAPPED", "'swapped' .*: its unit is Unit.name=1, decimals=''"),
        ("endless = by_hand:ENDLESS", "factor=inf.; give a Unit with a name that terminals show"),
        ("unitless = by_hand:UNITLESS", "'unitless' .* has unit None; allowed: Unit; repair"),
        (
            "sideways = by_hand:SIDEWAYS",
            "has better 'sideways'; allowed: higher, lower, neither; repair",
        ),
        ("moon = by_hand:MOON", "has world 'moon'; allowed: None, frozen, closed-loop; repair"),
        ("nothing = by_hand:NOTHING", "'nothing' .* with 0 functions; give it .* one function"),
    ],
)
def test_a_metric_that_does_not_work_is_one_line(
    line: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged_in(tmp_path, monkeypatch, f"{line}\n")
    with pytest.raises(UserError, match=says) as error:
        metrics_of("frozen")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("raises", "no such column"),
        ("exits", "ends the program (SystemExit: 0 at "),
        ("short", "it has values of shape (31,), not (32,)"),
        ("below", "it has values beyond 0 to 1e+12"),
        ("vast", "it has values beyond 0 to 1e+12"),
        ("complex", "it has values of type complex128, not numbers"),
        ("writes", "read-only"),
        ("words", "could not convert string to float: 'many'"),
    ],
)
def test_a_metric_that_fails_costs_its_own_figure(
    name: str,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    say_once.cache_clear()
    before = run_of(tmp_path / "before")
    plugged_in(tmp_path, monkeypatch, f"{name} = by_hand:{name.upper()}\n")
    after = run_of(tmp_path / "after")
    out, error = capfd.readouterr()
    assert (out, error.count("\n")) == ("", 1)
    assert f"harness: metric {name} of a package: " in error
    assert says in error
    assert error.endswith("; its figure is unknown\n")
    own = [score for score in after.scores if score.metric == name]
    assert own
    assert {score.value for score in own} == {None}
    assert [score for score in after.scores if score.metric != name] == list(before.scores)


@pytest.mark.slow
def test_a_metric_that_does_not_load_is_known_before_the_first_question(
    small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged_in(tmp_path, monkeypatch, "gone = by_hand:GONE\n")
    asked = list[object]()
    spec = spec_of(load(small_path), seeds=(0,))
    with pytest.raises(UserError, match=r"'gone' .* does not load"):
        evaluate(
            spec, tmp_path / "run", asked.append, opens=lambda *card, **options: asked.append(card)
        )
    assert (asked, (tmp_path / "run").exists()) == ([], False)


def test_a_metric_that_nobody_knows_is_written_plainly() -> None:
    old = entry("old_rate")
    score = Score("6g", "old_rate", 0.25, 0.1, None, 4, 0, "episodes")
    assert (old.label, old.meaning, old.better, old.primary) == ("old rate", "", "neither", False)
    assert old.unit == Unit(decimals=3)
    assert old.unit.interval(score.value, score.low, score.high) == "0.250 [0.100, –]"
