"""Runs that stop when they have seen enough:
intervals hold at every look, and the record says when.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from evaluating import figure, live_spec_of, run, spec_of
from hypothesis import given, settings
from hypothesis import strategies as st
from run_on_disk import digested

from harness.backends.base import Backend
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.core.shards import Shard
from harness.core.statistics import paired_difference
from harness.dataset.load import Dataset
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.lifecycle import finished
from harness.evaluate.run import evaluate, evaluate_shard, finished_run
from harness.evaluate.spec import Spec
from harness.extensions.early_stop import rule
from harness.extensions.early_stop.rule import Until, interim_looks
from harness.extensions.early_stop.sequences import BETS, any_time, any_time_difference
from harness.report.caveats import stopped
from harness.report.compare.pair import pair
from harness.report.compare.words import caveats as of_pair
from harness.runs.folder import read
from harness.runs.headline import ANY_TIME
from harness.runs.stopping import InterimLooks

pytestmark = pytest.mark.slow

ALONE = {"points": (POINTS["single-local"],), "seeds": (0,)}
Typed = Callable[..., tuple[int, str, str]]


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of four layouts are looked at after two, three and four."""
    monkeypatch.setattr(rule, "FIRST", 2)


def until(spec: Spec, until: Until, limit: int | None = None) -> Spec:
    assert isinstance(spec.source, FrozenSource)
    source = FrozenSource(spec.source.dataset, limit)
    return replace(spec, source=source, stopping_rule=until)


def capital(values: list[float], mean: float) -> float:
    """One bet after the other, as the paper has it."""
    up, down = np.ones(len(BETS)), np.ones(len(BETS))
    for value in values:
        up *= 1 + BETS / mean * (value - mean)
        down *= 1 - BETS / (1 - mean) * (value - mean)
    return float(np.mean([up, down]))


@given(st.lists(st.sampled_from([0.0, 0.2, 0.6, 1.0]), min_size=1, max_size=40))
@settings(max_examples=20)
def test_the_interval_ends_where_capital_bet_in_turn_refutes_a_mean(values: list[float]) -> None:
    e = any_time([np.array(values)])
    assert e.low <= e.value <= e.high
    for outside, inside in ((e.low - 0.001, e.low + 0.002), (e.high + 0.001, e.high - 0.002)):
        assert not 0 < outside < 1 or capital(values, outside) >= 20
        assert not 0 < inside < 1 or capital(values, inside) <= 20 or e.high - e.low < 0.01


@given(st.integers(0, 6), st.integers(0, 9))
@settings(max_examples=8)
def test_of_two_parts_no_pair_of_means_outside_is_left(first: int, second: int) -> None:
    parts = [np.arange(6) < first, np.arange(9) < second]
    e = any_time([part.astype(float) for part in parts])
    means = np.arange(0.02, 1, 0.02)
    tables = [np.array([capital(part.tolist(), mean) for mean in means]) for part in parts]
    left = tables[0][:, None] * tables[1] < 20
    mean_of_means = (means[:, None] + means) / 2
    assert e.low <= mean_of_means[left].min() <= e.low + 0.021
    assert e.high - 0.021 <= mean_of_means[left].max() <= e.high


def test_an_interval_of_differences_at_every_look_is_half_as_wide_again_as_at_one() -> None:
    """At 100 episodes it is sqrt((1 + 1/9) (ln 10 - 2 ln .05)) = 3.035 standard errors,
    elsewhere more.
    """
    rng = np.random.default_rng(2)
    for n, errors in ((100, 3.035), (25, 3.219), (1000, 3.259)):
        differences = rng.choice([1.0, 0.0, -1.0], n, p=(0.3, 0.6, 0.1))
        parts = [differences[: n // 3], differences[n // 3 :]]
        once, always = paired_difference(parts), any_time_difference(parts)
        assert (always.value, always.n) == (once.value, n)
        wider = (always.high - once.value) / (once.high - once.value)
        assert wider == pytest.approx(errors / 1.959964, abs=1e-3)
    assert np.isnan(any_time_difference([np.array([]), differences]).low)


@pytest.mark.exhaustive
def test_the_truth_is_held_at_every_look_of_nearly_all_runs() -> None:
    rng, held = np.random.default_rng(1), 0
    for _ in range(60):
        values = (rng.random(150) < 0.8).astype(float)
        spans = [any_time([values[:n]]) for n in (20, 40, 60, 80, 110, 150)]
        held += all(span.low <= 0.8 <= span.high for span in spans)
    assert held >= 55  # 57 at a coverage of 95 %; it is simulated by benchmarks/interim_looks.py


def test_looks_are_a_quarter_more_each_and_end_with_all_layouts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    assert interim_looks(60) == [20, 25, 32, 40, 50, 60]
    assert interim_looks(7) == [7]


def test_a_run_stops_when_its_interval_is_narrow_and_says_so(
    small: Dataset, tmp_path: Path
) -> None:
    spec = until(spec_of(small, "constant", **ALONE), Until(width=0.999))
    done = run(spec, tmp_path / "run")
    looks = done.manifest.interim_looks
    assert looks is not None
    at = looks.at
    assert at == (2,)
    assert looks.is_enough
    assert done.manifest.world.episodes == at[-1]
    row = figure(done, "single-local", "success_rate", ANY_TIME)
    assert row.low is not None
    assert row.high is not None
    assert row.high - row.low <= 0.999
    assert read(tmp_path / "run").score("single-local", "success_rate") == row
    assert f"stopped after {at[-1]} of 4 layouts" in " ".join(stopped(read(done.out)))
    whole = run(
        spec_of(
            Dataset.of_episodes(small, frozenset(small.episodes[: at[-1]])), "constant", **ALONE
        ),
        tmp_path / "whole",
    )
    for name in ("episodes.csv", "answers.jsonl"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert whole.manifest.interim_looks is None


def test_a_run_that_is_never_sure_takes_all_layouts(small: Dataset, tmp_path: Path) -> None:
    done = run(until(spec_of(small, "constant", **ALONE), Until(width=0.1)), tmp_path / "run")
    assert done.manifest.interim_looks == InterimLooks(4, (2, 3, 4))
    assert done.manifest.world.episodes == 4
    assert "took all 4 layouts" in " ".join(stopped(read(done.out)))
    one = small.of_episodes(frozenset(small.episodes[:1]))
    done = run(until(spec_of(one, "constant", **ALONE), Until(width=0.1)), tmp_path / "one")
    [said] = stopped(read(done.out))
    assert said.startswith("It took the only layout, and still")
    assert "It was looked at 1 time: " in said


def test_a_run_stopped_by_force_goes_on_and_is_the_same(small: Dataset, tmp_path: Path) -> None:
    spec = until(spec_of(small, "constant", **ALONE), Until(width=0.999))
    asked = 0

    def breaks(*args: object, **options: object) -> Backend:
        backend = open_backend(*args, **options)  # type: ignore[arg-type]
        complete = backend.complete

        def once(*some: object, **more: object) -> object:
            nonlocal asked
            asked += 1
            if asked == 3:
                raise KeyboardInterrupt
            return complete(*some, **more)  # type: ignore[arg-type]

        backend.complete = once  # type: ignore[method-assign, assignment]
        return backend

    whole = run(spec, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        evaluate(spec, tmp_path / "run", lambda done: None, opens=breaks)
    assert not (tmp_path / "run" / "run.json").exists()
    evaluate(spec, tmp_path / "run", lambda done: None)
    again = evaluate(spec, tmp_path / "run", lambda done: None)  # its page was not written yet
    assert again.manifest.world == whole.manifest.world
    for name in ("episodes.csv", "answers.jsonl", "summary.csv", "decisions.parquet"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_driven_run_stops_as_well(tmp_path: Path) -> None:
    spec = live_spec_of("constant", 4, points=(POINTS["single-local"],), seeds=(0,))
    spec = replace(spec, stopping_rule=Until(width=0.999))
    done = run(spec, tmp_path / "run")
    assert done.manifest.world.episodes == 2
    assert "--episodes 4" in done.manifest.command
    assert "--until-width 99.9" in done.manifest.command
    with pytest.raises(UserError, match="has no shards"):
        evaluate_shard(spec, tmp_path / "shard", Shard(1, 2), lambda done: None)  # type: ignore[arg-type]


def test_a_run_stops_when_it_differs_from_another(small: Dataset, tmp_path: Path) -> None:
    run(spec_of(small, "constant", **ALONE), tmp_path / "base")
    against = Until(against=read(tmp_path / "base"), folder=tmp_path / "base")
    done = run(until(spec_of(small, "constant", **ALONE), against), tmp_path / "same")
    world = done.manifest.world
    assert world.interim_looks is not None
    assert world.interim_looks["against"] == "base"
    assert done.manifest.interim_looks == InterimLooks(4, (2, 3, 4))
    assert world.episodes == 4
    said = " ".join(of_pair(pair(tmp_path / "base", tmp_path / "same")))
    assert "B: It took all 4 layouts" in said
    assert "by an interval of every look" in said


@pytest.mark.slow
def test_a_driven_run_is_held_against_one_of_the_same_scenes(tmp_path: Path) -> None:
    spec = live_spec_of("constant", 2, points=(POINTS["single-local"],), seeds=(0,))
    run(spec, tmp_path / "base")
    against = Until(against=read(tmp_path / "base"), folder=tmp_path / "base")
    spec = replace(spec, stopping_rule=against)
    with pytest.raises(UserError, match="base is not of the same scenes"):
        replace(spec, source=replace(spec.source, first_seed=1))


@pytest.mark.parametrize(
    ("base", "spec", "says"),
    [
        ({"limit": 2}, {}, "lacks 2 of the 4 layouts;"),
        ({}, {"seeds": (0, 1)}, r"has the seeds \[0\]"),
        ({}, {"points": (POINTS["6g"],)}, "has no condition 6g"),
    ],
)
def test_what_another_run_lacks_is_one_line(
    base: dict[str, int], spec: dict[str, object], says: str, small: Dataset, tmp_path: Path
) -> None:
    few = small.of_episodes(frozenset(small.episodes[: base.get("limit")]))
    run(spec_of(few, "constant", **ALONE), tmp_path / "base")
    against = Until(against=read(tmp_path / "base"), folder=tmp_path / "base")
    with pytest.raises(UserError, match=says):
        until(spec_of(small, "constant", **{**ALONE, **spec}), against)


@pytest.mark.parametrize(
    ("forged", "says"),
    [
        (None, "its settings have until_width 99.9, and nothing beside them says what that came"),
        (
            {"width": 0.5},
            "by its episodes 2 layouts were not enough, and run.json says otherwise",
        ),
        ({"enough": False}, "by its episodes 2 layouts were enough, and run.json says other"),
        ({"at": [1, 2]}, "has looks after [1, 2] layouts, and its rule after"),
        ({"at": []}, "looks: at no layouts, at more than all, or not in their order"),
        ({"at": [3, 2]}, "looks: at no layouts, at more than all, or not in their order"),
        ({"at": [2, 5]}, "looks: at no layouts, at more than all, or not in their order"),
        ({"at": [2, 3]}, "looks: the last is not at all 2 layouts"),
        ({"width": None}, "looks: neither a width nor a run to differ from"),
        ({"width": "x"}, "got `str`"),
    ],
)
def test_a_forged_look_is_named(
    forged: dict[str, object] | None, says: str, small: Dataset, tmp_path: Path, harness: Typed
) -> None:
    run(until(spec_of(small, "constant", **ALONE), Until(width=0.999)), tmp_path / "run")
    stated = json.loads((tmp_path / "run/run.json").read_text())
    looks = stated["world"].pop("looks")
    if forged:
        stated["world"]["looks"] = looks | forged
    (tmp_path / "run/run.json").write_text(json.dumps(stated))
    digested(tmp_path / "run")
    code, out, err = harness("run", "check", tmp_path / "run")
    assert code == (2 if err else 1)
    assert says in " ".join((out + err).split())


def test_a_look_at_another_run_is_held_against_it_where_work_goes_on(
    small: Dataset, tmp_path: Path, harness: Typed
) -> None:
    """Else `run check` says that it is not checked."""
    run(spec_of(small, "brake", **ALONE), tmp_path / "base")
    against = Until(against=read(tmp_path / "base"), folder=tmp_path / "base")
    spec = until(spec_of(small, "constant", **ALONE), against)
    run(spec, tmp_path / "run")
    code, out, _ = harness("run", "check", tmp_path / "run")
    assert code == 0
    assert "Whether success differed from that of base at its looks is not checked." in out
    (tmp_path / "run/.work").mkdir()
    run(spec, tmp_path / "run")
    stated = json.loads((tmp_path / "run/run.json").read_text())
    looks = stated["world"]["looks"]
    looks["enough"] = not looks.get("enough", False)
    (tmp_path / "run/run.json").write_text(json.dumps(stated))
    digested(tmp_path / "run")
    (tmp_path / "run/.work").mkdir(exist_ok=True)
    with pytest.raises(UserError, match=r"and run\.json says otherwise; delete that folder"):
        run(spec, tmp_path / "run")


def test_a_finished_run_is_taken_for_no_run_by_another_rule(small: Dataset, tmp_path: Path) -> None:
    spec = until(spec_of(small, "constant", **ALONE), Until(width=0.999))
    run(spec, tmp_path / "run")
    done = finished_run(spec, tmp_path / "run")
    assert done.manifest.interim_looks == InterimLooks(4, (2,), True)
    three = small.of_episodes(frozenset(small.episodes[:3]))
    of_three = until(spec_of(three, "constant", **ALONE), Until(width=0.999))
    for other in (replace(spec, stopping_rule=Until(width=0.9)), of_three):
        with pytest.raises(UserError, match="was begun with"):
            finished(other, tmp_path / "run")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("eval", "--until-width", "0"), "--until-width 0 is out of range; give 0.1 to 99 points"),
        (("eval", "--until-width", "4", "--until-decided", "x"), "give one of them"),
        (("eval", "--until-decided", "nowhere"), "nowhere"),
        pytest.param(
            ("eval", "--until-width", "4", "--condition", "6g:messages=shuffled"),
            "6g:messages=shuffled: its ego hears helpers of other layouts, and a run that stops",
            marks=pytest.mark.skipif(not find_spec("harness.extensions.controls"), reason="gone"),
        ),
        pytest.param(
            ("eval", "--until-width", "4", "--dataset", "suite:v2v-safety-2"),
            "suite v2v-safety-2: runs that stop",
            marks=pytest.mark.exhaustive,
        ),
    ],
)
def test_bad_input_is_one_line(words: tuple[str, ...], says: str, harness: Typed) -> None:
    code, out, err = harness(*words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err


def test_typed_it_is_in_the_command_and_the_table(harness: Typed, small_path: Path) -> None:
    code, out, _ = harness(
        "eval", "--model", "constant", "--dataset", small_path, "--condition", "single-local",
        "--seeds", "0:1", "--until-width", "99", "--out", "run",
    )  # fmt: skip
    stated = json.loads(Path("run/run.json").read_text())
    n = stated["world"]["looks"]["at"][-1]
    assert code == 0
    assert ("It stopped after" if n < 4 else "It took all 4 layouts") in out
    assert f"n = {n} episodes" in out
    assert (
        "intervals of success and of its gain hold at every look"
        in Path("run/report.html").read_text()
    )
    assert "until_width = 99.0" in Path("run/run.toml").read_text()
