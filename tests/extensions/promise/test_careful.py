"""A careful ego, and the promise that says when it is: the settings of a condition."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evaluating import live_spec_of, run, spec_of
from hypothesis import given
from hypothesis import strategies as st

from harness.coordination.named_points import misnamed, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.trigger import entropy_nats
from harness.core.errors import UserError
from harness.core.resources import find
from harness.dataset.load import Dataset, load
from harness.extensions.promise.part import Careful
from harness.extensions.promise.promises import opened_of, promise, settings_of
from harness.extensions.promise.study import usual
from harness.runs.decisions import Decisions
from harness.runs.fit import write
from harness.runs.folder import Run, read
from harness.studies.axes import AXES, refusal

pytestmark = pytest.mark.usefixtures("svg_alone")

Typed = Callable[..., tuple[int, str, str]]


@given(
    st.lists(st.floats(0.01, 1.0), min_size=4, max_size=4),
    st.none() | st.floats(0, 1.5),
)
def test_an_unsure_ego_is_careful_and_a_sure_one_decides(p, careful_nats):
    policy = np.array([p, [0, 0, 0, 1]]) / [[sum(p)], [1]]
    part = Careful(careful_nats=careful_nats)
    acted = part.after_fusion(policy)
    together = part.after_fusion(np.stack([policy[::-1], policy]))
    assert together.tolist() == [acted[::-1].tolist(), acted.tolist()]
    for before, after, nats in zip(policy, acted, entropy_nats(policy), strict=True):
        careful = careful_nats is not None and nats >= careful_nats
        assert after.tolist() == ([1, 0, 0, 0] if careful else before.tolist())


@pytest.mark.slow
def test_always_careful_is_a_model_that_brakes_and_never_is_the_model(
    small: Dataset, tmp_path: Path
) -> None:
    """Episode by episode; whom the ego asks and hears, and how late it is, stays."""
    texts = ("6g", "6g:careful_nats=0", "6g:careful_nats=40")
    points = tuple(named_point(text) for text in texts)
    run(spec_of(small, points=points, seeds=(0,)), tmp_path / "run")
    run(spec_of(small, model="brake", points=points[:1], seeds=(0,)), tmp_path / "brake")
    played, brakes = read(tmp_path / "run"), read(tmp_path / "brake")
    ends = {text: ends_of(played, text) for text in texts}
    assert ends["6g:careful_nats=0"] == ends_of(brakes, "6g") != ends["6g"]
    assert ends["6g:careful_nats=40"] == ends["6g"]
    condition = np.array(played.decisions.labels("condition"))
    step, latency_ms = played.decisions["step"], played.decisions["latency_ms"]
    at_first = [latency_ms[(condition == text) & (step == 0)].tolist() for text in texts]
    assert at_first[0] == at_first[1] == at_first[2] != []


def ends_of(played: Run, condition: str) -> list[tuple[Any, ...]]:
    of_condition = [each for each in played.episodes if each.condition == condition]
    return [(each.episode, each.success, each.failure, each.time_s) for each in of_condition]


def test_a_promise_is_its_thresholds(project: Path) -> None:
    point = named_point("6g:promise=p")
    assert point.name == "6g:promise=p"
    record = point.record()
    assert (record["promise"], record["tau_nats"], record["careful_nats"]) == ("p", 0.3, 0.9)
    assert misnamed(record) == []
    assert misnamed({**record, "tau_nats": 0.7}) == ["tau_nats"]
    assert OperatingPoint.from_dict(record) == point
    assert named_point("6g:promise=p,tau=0.3,careful_nats=0.9") == replace(
        point, name="6g:promise=p,tau=0.3,careful_nats=0.9"
    )
    kept: Any = SimpleNamespace(
        points={name: named_point(name) for name in ("single-local", "6g", "6g:promise=p")}
    )
    assert usual(kept) == ["6g"]
    assert named_point("6g:promise=never").setting("careful_nats") is None
    assert point.changed(promise="never").setting("careful_nats") is None
    asks_more = point.changed(promise="", tau_nats=0.1)
    assert asks_more.setting("careful_nats") == 0.9


def rewrite(project: Path, old: str, new: str) -> None:
    """Have the promise `p` state something else."""
    file = project / "promises/p.toml"
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "6g:promise=p,tau=0.7",
            "tau_nats is 0.7; it must be left out, or 0.3, where promise is p",
        ),
        ("6g:promise=p,careful_nats=1", "careful_nats is 1.0; it must be left out, or 0.9, where"),
        (
            "6g:promise=never,careful_nats=1",
            "careful_nats is 1.0; it must be left out where promise is n",
        ),
        ("v2x:promise=p", "profile is 'v2x'; it must be 6g where promise is p, which was made so"),
        ("6g:promise=p,max_helpers=1", "max_helpers is 1; it must be 3 where promise is p"),
        ("6g:promise=p,loss=0.5", "loss is 0.5; it must be left out where promise is p"),
        ("6g:promise=p,loss=0.5", "; to vary it without what is promised, give tau_nats=0.3,"),
        ("6g:promise=p,loss=0.5", ",careful_nats=0.9 in place of the promise"),
        ("single-local:promise=p", "profile is None; it must be 6g where promise is p"),
        ("6g:promise=q", "unknown promise 'q'; known: never, p; `harness study promise"),
        ("6g:careful_nats=-1", "careful_nats is -1.0; it must be nats, 0 or more"),
    ],
)
def test_what_a_promise_does_not_hold_for_is_refused(project: Path, text: str, says: str) -> None:
    with pytest.raises(UserError) as error:
        named_point(text)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_sweep_of_what_a_promise_fixes_says_what_to_type(project: Path) -> None:
    said = refusal(AXES["consensus"], named_point("6g:promise=p"))
    assert "where promise is p, which was made so; to vary it" in said
    assert said.endswith("give tau_nats=0.3,careful_nats=0.9 in place of the promise")
    assert not refusal(AXES["consensus"], named_point("6g:tau_nats=0.3,careful_nats=0.9"))


@pytest.mark.parametrize("text", ["6g:promise=p,congestion=adaptive", "6g:promise=p,stream=cam"])
def test_the_setting_that_is_typed_is_named_not_its_parts_first(project: Path, text: str) -> None:
    pytest.importorskip("harness.extensions.streams")
    key, value = text.rpartition(",")[2].split("=")
    with pytest.raises(UserError) as error:
        named_point(text)
    said = f"{key} is {value!r}; it must be none where promise is p, which was made so"
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("units = 100", "units = 58", "on 58 layouts promises no 0.05 (p = 0.051, above delta"),
        ("mean_harm = 0.0", "mean_harm = 0.05", "a mean harm of 0.05 on 100 layouts promises no"),
        ("mean_harm = 0.0", "mean_harm = 0.02", "needed: 59 layouts, all without harm, or more)"),
        ("units = 100", "units = 101", "101 layouts are more than 100 layout seeds"),
        ("at_most = 0.05", "at_most = 1e-320", "shares between 1e-06 and 1"),
        ("delta = 0.05", "delta = 1e-320", "shares between 1e-06 and 1"),
        ("channel_seeds = [0]", "channel_seeds = []", "channel_seeds are (); allowed: different"),
        ("channel_seeds = [0]", "channel_seeds = [1, 1]", "channel_seeds are (1, 1); allowed"),
        ("channel_seeds = [0]", "channel_seeds = [-1]", "channel_seeds are (-1,); allowed"),
        ("last_seed = 99", "last_seed = 200001", "a promise is fitted on tune seeds"),
        ("delta = 0.05", "delta = 1.0", "at_most and delta are shares between 1e-06 and 1"),
        ("tau_nats = 0.3", "tau_nats = -0.3", "tau_nats"),
        ('harm = "unsafe"', 'harm = "none"', "harm"),
        ("[parameters]", "[parameter]", "it has no [parameters], without which a promise says not"),
        ('"profile" = "6g"', '"profile" = ["6g"]', "settings"),
    ],
)
def test_a_file_that_promises_nothing_is_refused(
    project: Path, old: str, new: str, says: str
) -> None:
    rewrite(project, old, new)
    with pytest.raises(UserError) as error:
        named_point("6g:promise=p")
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("--ties first", "was made with ties drawn, not first; make one with `harness study"),
        (
            "--prompt v3",
            "was fitted with prompt.version v2, not v3; make one with `harness study "
            "promise`, of runs of this model with --prompt v3",
        ),
        ("--latency ego=0.3", 'was made with latency {"ego_s":0.145,'),
    ],
)
def test_a_run_that_decides_otherwise_is_refused(
    project: Path, small_path: Path, harness: Typed, more: str, says: str
) -> None:
    words = ("eval", "--dataset", small_path, "--seeds", "0", "--quiet", "--no-cache")
    code, _, error = harness(*words, "--condition", "6g:promise=p", *more.split(), "--out", "r")
    assert (code, error.count("\n")) == (2, 1)
    assert f"condition 6g:promise=p: promise p {says}" in error
    assert not (project / "r/run.json").exists()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"flip" = "False"', '"flip" = "True"', "was made with flip True, not False"),
        ('"ties" = "drawn"', '"tie" = "drawn"', "was made with ties nothing, not drawn"),
        ('"temperature" = "0.0"', '"temperature" = "0.5"', "with temperature 0.5, not 0.0"),
        ('"decision_lag_s" = "0.145"', '"decision_lag_s" = "0.6"', "decision_lag_s 0.6, not 0.145"),
    ],
)
def test_a_promise_of_another_setup_is_refused(
    project: Path, small: Dataset, old: str, new: str, says: str
) -> None:
    rewrite(project, old, new)
    with pytest.raises(UserError) as error:
        spec_of(small, points=(named_point("6g:promise=p"),))
    assert says in str(error.value)


def test_a_radio_that_has_changed_has_no_promise(project: Path, small: Dataset) -> None:
    text = find("channels", "6g.toml").read_text()
    (project / "channels").mkdir()
    radio = project / "channels/mine.toml"
    radio.write_text(text)
    point = named_point("mine")
    made: dict[str, Any] = {"settings": settings_of(point), "opened": opened_of(point)}
    write(replace(promise("p"), **made), project / "promises/mine.toml")
    kept = named_point("mine:promise=mine")
    assert spec_of(small, points=(kept,)).points == (kept,)
    radio.write_text(text.replace("loss = 0.012", "loss = 0.5"))
    with pytest.raises(UserError, match="was made with channels mine "):
        spec_of(small, points=(kept,))


@pytest.mark.slow
def test_a_careful_ego_decides_driven_as_frozen(two_path: Path, tmp_path: Path) -> None:
    """Alone it is as late as frozen scenes assume: the same policies, scene by scene, careful at
    one threshold and not at the other.
    """
    two = load(two_path)
    points = tuple(named_point(f"single-local:careful_nats={nats}") for nats in (0.9, 0.95))
    run(spec_of(two, points=points, seeds=(0,)), tmp_path / "frozen")
    live = live_spec_of(episodes=2, first_seed=two.manifest.seed, points=points, seeds=(0,))
    run(live, tmp_path / "driven")
    expected = policies(read(tmp_path / "frozen").decisions)
    assert policies(read(tmp_path / "driven").decisions) == expected
    assert {fused == (1.0, 0.0, 0.0) for fused in expected.values()} == {True, False}


def policies(decisions: Decisions) -> dict[tuple[str, str], tuple[float, ...]]:
    records = decisions.records(0, len(decisions))
    return {(row.condition, row.scene): tuple(row.fused) for row in records}


@pytest.mark.slow
def test_a_run_is_played_by_a_promise_and_keeps_it(
    project: Path, small_path: Path, harness: Typed
) -> None:
    """As by its thresholds typed; another model, prompt or number of egos has no such promise."""
    evaluated = ("eval", "--dataset", small_path, "--seeds", "0", "--quiet", "--no-cache")
    typed = "6g:tau=0.3,careful_nats=0.9"
    code, _, error = harness(
        *evaluated, "--condition", "6g:promise=p", "--condition", typed, "--out", "run"
    )
    assert (code, error) == (0, "")
    played = read(project / "run")
    assert ends_of(played, "6g:promise=p") == ends_of(played, typed)
    assert list(played.manifest.kept["promises"]) == ["p"]
    assert (project / "run/sources/promises/p.toml").exists()
    file = project / "promises/p.toml"
    text = file.read_text()
    file.write_text(text.replace("careful_nats = 0.9", "careful_nats = 0.8"))
    assert harness("report", "run", "--out", "run.html")[0] == 0
    swept = ("study", "sweep", "run", "--over", "tau", "--grid", "0", "--quiet")
    remedy = "copy run/sources/promises/p.toml to promises/, or run again\n"
    assert harness(*swept)[2] == f"harness: run: promise p has changed since; {remedy}"
    file.unlink()
    for words in (swept, ("compare", "run", "run")):
        assert harness(*words)[2] == f"harness: run: promise p is not here; {remedy}"
    in_words = re.sub("(?m)^fitted_on = .*$", 'fitted_on = "in other words"', text)
    assert in_words != text
    file.write_text(in_words)
    for words in (swept, ("compare", "run", "run"), ("run", "check", "run")):
        code, out, error = harness(*words, "--quiet" if words[0] == "run" else "--json")
        assert (code, error) == (0, ""), out
    file.write_text(text)
    condition = ("--condition", "6g:promise=p")
    for more, says in (
        (("--model", "uniform"), "promise p was fitted with model.name proxy, not uniform"),
        (("--prompt", "v4"), "promise p was fitted with prompt.version v2, not v4"),
    ):
        code, _, error = harness(*evaluated, *condition, *more, "--out", "other")
        assert code == 2
        assert says in error
        assert error.count("\n") == 1
    facts: Any = SimpleNamespace(several_decide=True)
    reason = Careful(promise="p").obstacle(named_point("6g:promise=p"), facts)
    assert reason == "promise p is of one ego; leave out --agents"
