"""Two runs held against each other:
differences that can be counted by hand, and what is refused.
"""

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from changing import SEEDS, ends
from evaluating import live_spec_of, spec_of
from evaluating import run as evaluate
from run_on_disk import Row, answers_of, change, configure, damage, made_up, rows_of
from scipy.stats import norm

from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.core.multiplicity import holm
from harness.dataset.load import Dataset, load
from harness.report.compare import words
from harness.report.compare.difference import Comparison, Difference, Flip, compare
from harness.report.compare.pair import ORDER, SETTINGS, pair
from harness.report.runs import parameters_apart
from harness.runs.headline import BALANCED
from harness.runs.metric_names import ONE_OPTIMAL
from harness.runs.metrics import METRICS
from harness.runs.records import ClosedLoop

Said = tuple[int, str, str]
WITNESSED = {name for name in METRICS if name.startswith("success_dangerous_rate_")}
BY_DANGER = {name for name, metric in METRICS.items() if metric.half} - WITNESSED
CONFLICTS = {
    "least_ttc_s",
    "short_ttc_rate",
    "short_ttc_decision_rate",
    "least_pet_s",
    "short_pet_rate",
}
# Which not every episode has.
SOME = {
    "time_to_clear_s", "regret_rate", "delay_s", "time_lost_s", "least_ttc_s", "least_pet_s", ONE_OPTIMAL,
    *BY_DANGER,
}  # fmt: skip
OPTIONAL = {name for name, metric in METRICS.items() if metric.optional} - {
    "time_lost_s", *BY_DANGER, *CONFLICTS,
}  # fmt: skip
NAMES = {name for name, metric in METRICS.items() if metric.compared}
# Of which there are too few decisions here.
FEW = {name for name, metric in METRICS.items() if metric.pooled} - {ONE_OPTIMAL}
LIVE = {name for name, metric in METRICS.items() if metric.world == "closed-loop"}


def found(runs: tuple[Path, Path]) -> Comparison:
    return compare(pair(*runs))


def differences(c: Comparison, condition: str) -> Mapping[str, Difference]:
    [of] = [of for of in c.conditions if of.condition == condition]
    return {d.metric: d for d in of.differences}


def test_a_run_against_itself_differs_by_nothing(runs: tuple[Path, Path]) -> None:
    c = found(runs)
    assert (c.settings, c.answers) == ((), ())
    assert (c.held.same, c.held.other, c.held.changed) == (len(answers_of(runs[0])), 0, ())
    scenes = len({answer.scene for answer in answers_of(runs[0])})
    assert c.answers_in_both == {"ego": scenes, "helper": 3 * scenes}
    for of in c.conditions:
        silent = (
            {"effective_loss", "observed_reply_loss"} if of.condition == "single-local" else set()
        )
        always = set(NAMES) - LIVE - OPTIONAL - FEW - {"merge_failed_rate"}
        assert {d.metric for d in of.differences} == always - silent
        for d in of.differences:
            assert d.change.value == 0
            if d.metric == BALANCED or (d.metric in BY_DANGER and d.change.n == 1):
                assert d.change.low != d.change.low, "one of the four has no danger"
            elif d.metric.endswith(("_rate", "_reply_loss")):
                assert d.change.low == -d.change.high < 0, (
                    "what all episodes agree in, others may not"
                )
            else:
                assert d.change.low != d.change.low
            known = 4 if d.metric not in SOME else d.change.n
            assert (d.a, d.change.n, d.change.n_excluded) == (d.b, known, 4 - known)
        assert (of.gained, of.lost) == ((), ())


def test_the_means_are_those_of_the_runs_own_summary(runs: tuple[Path, Path]) -> None:
    with (runs[0] / "summary.csv").open() as file:
        own = {
            (row["condition"], row["metric"]): float(row["value"])
            for row in csv.DictReader(file)
            if row["value"] and (row["interval"] == "episodes" or row["metric"].startswith("latency_p"))
        }  # fmt: skip
    c = found(runs)
    for of in c.conditions:
        for d in of.differences:
            assert d.a == pytest.approx(
                own[of.condition, d.metric], abs=1e-3 if "_ms" in d.metric else 1e-6
            )


def test_success_and_its_test_by_hand(runs: tuple[Path, Path]) -> None:
    """Alone two of 4 gained and one lost, from .5 to .75:
    squares deviate by 2.75 from their mean, over 3.

    Two more differ, each by a quarter.
    """
    ends(runs[0], "single-local", [["late", "collision", "", ""]] * 2)
    ends(runs[1], "single-local", [["", "", "", "time_out"]] * 2)
    ends(runs[0], "6g", [["late"] * 4] * 2)
    ends(runs[1], "6g", [[""] * 4] * 2)
    c = found(runs)
    alone = differences(c, "single-local")
    change = alone["success_rate"].change
    assert (alone["success_rate"].a, alone["success_rate"].b, change.value, change.n) == (
        0.5,
        0.75,
        0.25,
        4,
    )
    error = math.sqrt(2.75 / 3 / 4 + 2 / 4**2)
    half = 1.959964 * error
    assert (change.low, change.high) == pytest.approx((0.25 - half, min(0.25 + half, 1)), abs=1e-6)
    assert alone["unsafe_rate"].change.value == 0, "a collision less, and a time out more"
    assert alone["late_rate"].change.value == -0.25
    assert c.conditions[0].gained == (Flip(0, SEEDS, "late", "success"),
                                      Flip(1, SEEDS, "collision", "success"))  # fmt: skip
    assert c.conditions[0].lost == (Flip(3, SEEDS, "success", "time_out"),)
    assert alone["success_rate"].p_value == pytest.approx(2 * norm.sf(0.25 / error), abs=1e-6)


def test_success_that_hangs_on_the_seed_has_an_interval_over_episodes(
    runs: tuple[Path, Path],
) -> None:
    """Episodes go from 0, 1, 0, 0 to 0.5, 1, 0, 0.5:
    differences of 0.5, 0, 0, 0.5, of mean square 1/8.

    The two more differ by a quarter of .5 each, or, since few differ, rather by a quarter.
    """
    ends(runs[0], "6g", [["late", "", "late", "late"], ["", "", "late", ""]])
    ends(runs[1], "6g", [["", "", "late", ""], ["", "", "late", ""]])
    c = found(runs)
    change = differences(c, "6g")["success_rate"].change
    rare = math.exp(-2 / 6)
    added = 2 * (0.125**2 * (1 - rare) + 0.25**2 * rare)
    half = 1.959964 * math.sqrt(0.25 / 3 / 4 + added)
    assert (change.value, change.low, change.high) == pytest.approx(
        (0.25, 0.25 - half, 0.25 + half), abs=1e-6
    )
    assert c.conditions[1].gained == (
        Flip(0, (0,), "late", "success"),
        Flip(3, (0,), "late", "success"),
    )


def test_holm_counts_the_primary_metrics_in_every_condition(runs: tuple[Path, Path]) -> None:
    """Four successes of four gained under 6g: the least p, times all primary differences."""
    ends(runs[0], "6g", [["late"] * 4] * 2)
    ends(runs[1], "6g", [[""] * 4] * 2)
    c = found(runs)
    every = [d for of in c.conditions for d in of.differences]
    primary = [d for d in every if METRICS[d.metric].primary and d.p_value is not None]
    p_values = [d.p_value for d in primary if d.p_value is not None]
    assert [d.p_corrected for d in primary] == holm(p_values)
    assert {d.metric for d in every if d.p_corrected is not None} == {"success_rate", "unsafe_rate"}
    gained = differences(c, "6g")["success_rate"]
    assert gained.change.low > 0
    assert gained.p_value is not None
    assert gained.p_value == pytest.approx(min(p_values))
    assert gained.p_corrected == pytest.approx(len(p_values) * gained.p_value)
    assert differences(c, "6g")["late_rate"].p_value == pytest.approx(gained.p_value), (
        "its mirror image"
    )
    unchanged = differences(c, "single-local")["success_rate"]
    assert (unchanged.p_value, unchanged.p_corrected) == (1.0, 1.0)


def test_steps_and_seeds_of_an_episode_count_as_one(runs: tuple[Path, Path]) -> None:
    """10 ms more in episode 0 and one seed of two is 5 ms;
    episode 1 is unknown in B, and so left out.
    """

    def slower(row: Row) -> None:
        row["latency_ms"] = 100.0
        if row["episode"] == 0 and row["seed"] == 0:
            row["latency_ms"] = 110.0
        if row["episode"] == 1:
            row["latency_ms"] = None

    def steady(row: Row) -> None:
        row["latency_ms"] = 900.0 if row["episode"] == 1 else 100.0

    change(runs[0], decision=steady)
    change(runs[1], decision=slower)
    d = differences(found(runs), "6g")["latency_proxy_ms"]
    assert (d.a, d.b) == pytest.approx((100, 100 + 5 / 3))
    assert d.change.value == pytest.approx(5 / 3)
    assert d.change.low == pytest.approx(5 / 3 - 4.3027 * 5 / 3, abs=1e-3), (
        "t(2), standard error 5/3"
    )
    assert (d.change.n, d.change.n_excluded) == (3, 1)


def test_lost_replies_by_hand(runs: tuple[Path, Path]) -> None:
    """Episodes 0 and 1 ask two helpers at every decision.
    In B one of the replies is lost in episode 0.
    """

    def heard(lost: float, loss: float) -> Callable[[Row], None]:
        def heard(row: Row) -> None:
            asked = row["condition"] == "6g" and row["episode"] < 2
            observed = lost if row["episode"] == 0 else 0.0
            row |= {
                "observed_loss": observed if asked else None,
                "effective_loss": loss if asked else None,
            }

        return heard

    change(runs[0], decision=heard(0.0, 0.012))
    change(runs[1], decision=heard(0.5, 0.112))
    told = differences(found(runs), "6g")
    lost = told["observed_reply_loss"]
    assert (lost.a, lost.b, lost.change.value) == (0, 0.25, 0.25), (
        "of episodes 0 and 1, half and nothing"
    )
    assert (lost.change.n, lost.change.n_excluded) == (2, 2)
    assert told["effective_loss"].change.value == pytest.approx(0.1)
    change(runs[1], decision=lambda row: row.update(effective_loss=None))
    assert "effective_loss" not in differences(found(runs), "6g"), (
        "one of the runs does not know it"
    )


def test_latency_percentiles_are_of_all_decisions_and_resampled_by_episode(
    runs: tuple[Path, Path],
) -> None:
    """A takes 100 ms. In B episode 3 takes 200 ms in seed 0: a quarter of that seed's decisions."""

    def slow(row: Row) -> None:
        row["latency_ms"] = 200.0 if row["episode"] == 3 and row["seed"] == 0 else 100.0

    change(runs[0], decision=lambda row: row.update(latency_ms=100.0))
    change(runs[1], decision=slow)
    told = differences(found(runs), "6g")
    half, most = told["latency_p50_ms"], told["latency_p95_ms"]
    assert (half.a, half.b, half.change.value) == (100, 100, 0)
    assert (most.a, most.b, most.change.value) == (100, 150, 50), "a mean over two seeds"
    assert (most.change.low, most.change.high) == (0, 50), "a third of resamples have no episode 3"
    assert (most.change.n, most.change.n_excluded) == (4, 0)
    assert half.change.high == 50, "twice and more often in a quarter of resamples"


def test_what_only_driving_shows_by_hand(tmp_path: Path) -> None:
    """Two episodes and one seed, ended by hand."""
    columns = ("success", "failure", "time_s", "fault", "least_gap_m", "hard_brakings", "skipped")
    for name, ended in (
        ("a", [(True, "", 4.0, None, 9.0, 0, 1), (False, "collision", 2.0, "ego", 0.0, 1, 0)]),
        ("b", [(False, "late", 7.0, None, 5.0, 2, 1), (False, "time_out", 10.0, None, 3.0, 3, 2)]),
    ):

        def end(row: Row, ended: Sequence[Any] = ended) -> None:
            row |= dict(zip(columns, ended[row["episode"]], strict=True)) | {"other_crashes": 0}

        made_up(tmp_path / name, episode=end, closed_loop=True, episodes=2, steps=5, seeds=(0,))
    told = differences(found((tmp_path / "a", tmp_path / "b")), "single-local")
    by_hand = {
        "collision_rate": (0.5, 0), "at_fault_rate": (0.5, 0), "time_out_rate": (0, 0.5),
        "off_road_rate": (0, 0), "time_to_clear_s": (4, 7), "least_gap_m": (4.5, 4),
        "hard_brakings_per_episode": (0.5, 2.5), "other_crashes_per_episode": (0, 0),
        "decisions_per_episode": (5, 5), "skipped_per_episode": (0.5, 1.5),
        "never_acted_per_episode": (0, 0),
    }  # fmt: skip
    assert {name: (told[name].a, told[name].b) for name in by_hand} == by_hand
    assert by_hand.keys() >= LIVE
    assert told["time_to_clear_s"].change.n_excluded == 1, "the one that cleared in neither run"
    assert told["least_gap_m"].change.value == -0.5


def test_answers_that_are_read_otherwise_are_told_by_role(
    runs: tuple[Path, Path], small: Dataset
) -> None:
    """B replays A, with one ego's answer and two helpers' made unreadable or a little broken.

    The ego's and one helper's are at the last decision of an episode,
    so that all go where they went.
    """
    over_6g = rows_of(runs[0], "6g")
    last = max((row["step"], row["scene"]) for row in over_6g if row["episode"] == 0)[1]
    other = next(row["scene"] for row in over_6g if row["episode"] == 1)
    said = {f"{last}/v1": "no idea", f"{last}/v2": "no idea", f"{other}/v3": "fence"}

    def spoil(row: Row) -> None:
        how = said.get(f"{row['scene']}/{row['viewer']}")
        row["raw"] = f"```json\n{row['raw']}\n```" if how == "fence" else how or row["raw"]

    change(runs[1], answer=spoil)
    points = (POINTS["single-local"], POINTS["6g"])
    replayed = evaluate(
        spec_of(small, f"replay:{runs[1]}", points=points, seeds=SEEDS), Path(runs[1], "new")
    )
    c = found((runs[0], replayed.out))
    turned = {(t.role, t.a, t.b): t.requests for t in c.answers}
    assert turned == {
        ("ego", "strict", "failed"): (f"{last}/v1",),
        ("helper", "strict", "failed"): (f"{last}/v2",),
        ("helper", "strict", "recovered"): (f"{other}/v3",),
    }
    mine = [
        [r["scene"] == last for r in over_6g if (r["episode"], r["seed"]) == (0, s)] for s in SEEDS
    ]
    texts = {each.request: each for each in c.held.changed}
    assert texts.keys() == {request for requests in turned.values() for request in requests}
    assert (c.held.same, c.held.other) == (sum(c.answers_in_both.values()), 0)
    assert (texts[f"{last}/v1"].b, texts[f"{last}/v1"].verdicts) == (
        "no idea",
        ("strict", "failed"),
    )
    share = sum(sum(of) / len(of) for of in mine) / len(SEEDS)
    assert differences(c, "6g")["fallback_rate"].change.value == pytest.approx(share / 4)
    assert "model.name" in {name for name, _, _ in c.settings}


def test_settings_in_which_runs_differ_are_told(runs: tuple[Path, Path]) -> None:
    config = json.loads((runs[1] / "run.json").read_text())
    config["conditions"][1]["name"] = "mine"

    def renamed(row: Row) -> None:
        if row["condition"] == "6g":
            row["condition"] = "mine"

    for run in runs:
        change(run, decision=renamed, episode=renamed, conditions=config["conditions"])
    conditions = [{k: v for k, v in c.items() if k != "on_demand"} for c in config["conditions"]]
    conditions[1]["tau_nats"] = 0.5
    configure(
        runs[1], conditions=conditions, answer="constrained", prompt=config["prompt"] | {"version": "v3"},
        identity=config["identity"] | {"build": "b2"}, versions=config["versions"] | {"numpy": "9"},
    )  # fmt: skip
    told = {name: (a, b) for name, a, b in found(runs).settings}
    assert told == {
        "prompt.version": ("v2", "v3"),
        "answer": ("json", "constrained"),
        "identity.build": (None, "b2"),
        "versions.numpy": (config["versions"]["numpy"], "9"),
        "condition.mine.tau_nats": ("0.7", "0.5"),
    }, "a setting that an older run does not have is what it was then"


def test_settings_are_told_in_their_order() -> None:
    others = ("extensions", "identity", "versions")
    assert (*ORDER, *others) == SETTINGS


def test_a_setting_of_an_extension_in_which_runs_differ_is_told(runs: tuple[Path, Path]) -> None:
    config = json.loads((runs[1] / "run.json").read_text())
    configure(runs[1], settings=config["settings"] | {"extensions": {"level": 2}})
    assert found(runs).settings == (("extensions.level", None, "2"),)


def test_runs_of_other_lengths_and_conditions_are_compared_where_they_meet(
    runs: tuple[Path, Path], small_path: Path
) -> None:
    short = evaluate(
        spec_of(load(small_path, 3), points=(POINTS["6g"], POINTS["v2x"])), runs[1] / "short"
    )
    c = found((runs[0], short.out))
    assert (c.pair.conditions, c.pair.episodes) == (("6g",), (0, 1, 2))
    assert c.settings == ()
    assert all(
        d.change.n == 3 or d.metric in {*BY_DANGER, ONE_OPTIMAL}
        for d in c.conditions[0].differences
    )
    assert all(d.change.value == 0 for d in c.conditions[0].differences)


def test_one_episode_has_differences_and_no_interval(small_path: Path, tmp_path: Path) -> None:
    one = evaluate(spec_of(load(small_path, 1), seeds=SEEDS), tmp_path / "one").out
    for condition in found((one, one)).conditions:
        for d in condition.differences:
            assert d.change.value == 0
            assert d.change.low != d.change.low


@pytest.mark.exhaustive
def test_live_runs_are_compared_with_live_runs(
    runs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    points = (POINTS["6g"],)
    for model in ("cruise", "local-view"):
        evaluate(live_spec_of(model, points=points), Path(model))
    evaluate(live_spec_of("cruise", points=points, first_seed=7), Path("other"))
    c = found((Path("cruise"), Path("local-view")))
    with Path("local-view/summary.csv").open() as file:
        own = {
            r["metric"]: r["value"] for r in csv.DictReader(file)
            if r["condition"] == "6g" and r["interval"] in ("episodes", "seed means")
        }  # fmt: skip
    told = differences(c, "6g")
    unheard = {"effective_loss", "observed_reply_loss", "merge_failed_rate"}
    frozen = {name for name in NAMES if METRICS[name].world == "frozen"}
    by_tree = {
        f"{what}_{half}_rate"
        for what in ("miss", "false_alarm")
        for half in ("dangerous", "harmless")
    }
    assert set(NAMES) - set(told) == frozen | unheard | by_tree | OPTIONAL
    for name, d in told.items():
        if not d.change.n_excluded:  # a summary leaves nothing out for another run's sake
            assert d.b == pytest.approx(float(own[name]), abs=1e-3)
    assert not any(d.change.value for d in differences(found((Path("cruise"),) * 2), "6g").values())
    for other, said in ((runs[0], "one was made by"), (Path("other"), "not of the same scenes")):
        with pytest.raises(UserError, match=said):
            pair(Path("cruise"), other)


def test_what_two_worlds_differ_in_is_named() -> None:
    def driven(**parameters: object) -> Any:
        scenario = {"name": "street", "parameters": {"lanes": 2, **parameters}}
        world = ClosedLoop(scenario=scenario, first_seed=0, episodes=1, late_against="nobody")
        return SimpleNamespace(manifest=SimpleNamespace(world=world))

    one = driven(react=True, beacon_loss=0.1)
    assert parameters_apart(one, driven(react=True, beacon_loss=0.2)) == ""
    said = parameters_apart(one, driven(react=False, beacon_loss=0.2))
    assert said == ", react true and false"


@pytest.mark.slow
def test_what_cannot_be_compared_is_refused(
    runs: tuple[Path, Path],
    small: Dataset,
    two_run: Path,
    tmp_path: Path,
    harness: Callable[..., Said],
) -> None:
    points = (POINTS["6g"],)
    luck = evaluate(spec_of(small, points=points, seeds=(0, 2)), tmp_path / "luck").out
    v2x = evaluate(spec_of(small, points=(POINTS["v2x"],), seeds=SEEDS), tmp_path / "v2x").out
    for run, said in (
        (two_run, "not of the same scenes (small "),
        (luck, "have different seeds ([0, 1] and [0, 2])"),
        (v2x, "have no condition in common (single-local, 6g and v2x)"),
        (tmp_path / "nowhere", "is no finished run: there is no such folder"),
        (tmp_path, "is a folder of 4 runs; give one, such as "),
    ):
        code, out, err = harness("compare", runs[0], run)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert said in err


@pytest.mark.parametrize(
    "damage",
    [
        lambda run: (run / "episodes.csv").write_text("model,prompt\n"),
        lambda run: (run / "episodes.csv").unlink(),
        lambda run: (run / "decisions.parquet").write_text("PAR1"),
        lambda run: (run / "answers.jsonl").write_bytes(b"\xff"),
        lambda run: configure(run, world="small"),
        lambda run: configure(run, seeds=["x"]),
        lambda run: configure(run, conditions=[{"name": "6g", "wheels": 4}]),
        lambda run: configure(run, format="swarmdrive-run/1"),
        lambda run: damage(run, decision=lambda row: row.update(latency_ms=float("inf"))),
        lambda run: damage(run, answer=lambda row: row.update(verdict="good")),
    ],
)
def test_a_damaged_run_is_one_line(
    damage: Callable[[Path], object], runs: tuple[Path, Path], harness: Callable[..., Said]
) -> None:
    damage(runs[1])
    code, out, err = harness("compare", *runs, "--html", "page.html")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert not Path("page.html").exists()


def test_where_nothing_could_be_tested_that_is_said(runs: tuple[Path, Path]) -> None:
    """Such as of runs of one episode, whose differences have no interval."""
    assert words.many(replace(found(runs), conditions=())).startswith(
        "no difference has a p: too few episodes"
    )
