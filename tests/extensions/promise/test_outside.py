"""Where nothing is promised: what is said of roads that a promise is not of."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.coordination.named_points import named_point
from harness.core.statistics import Estimate
from harness.extensions.promise.outcomes import Level, Outcome, unable
from harness.extensions.promise.page import needs, outside, sentence, typed

POINT = named_point("6g")


def scored(name: str, harm: Estimate) -> Any:
    run = SimpleNamespace(dataset=SimpleNamespace(name=name), name="model")
    return SimpleNamespace(run=run, harm=lambda point: harm)


def result_of(harms: Mapping[str, Estimate], **more: Any) -> Any:
    """What a study has of it, in so far as these sentences read it."""
    elsewhere = [scored(name, harm) for name, harm in harms.items()]
    fields = {"harm": "unsafe", "delta": 0.05, "report": scored("report", None), **more}
    return SimpleNamespace(elsewhere=elsewhere, **fields)


LEVEL = Level(0.05, 59, 3, POINT, None)
FEW, MANY = Estimate(0.01, 0.001, 0.04, 100, 0), Estimate(0.95, 0.86, 0.98, 60, 0)
SOME = Estimate(0.06, 0.03, 0.12, 100, 0)


@pytest.mark.parametrize(
    ("harms", "says"),
    [
        ({}, ""),
        ({"near": FEW, "far": MANY}, "on far it is not kept, with 95.0 [86.0, 98.0] % harm."),
        ({"near": FEW, "far": SOME}, "on far it may be kept, with 6.0 [3.0, 12.0] % harm."),
    ],
)
def test_the_road_with_the_most_harm_is_named(harms: Mapping[str, Estimate], says: str) -> None:
    sentence = outside(result_of(harms), LEVEL)
    assert sentence.endswith(says)
    assert sentence.startswith("On other roads ≤ 5 % is no promise: ") or not says


def test_a_level_without_a_setting_has_none_elsewhere() -> None:
    assert outside(result_of({"far": MANY}), Level(0.01, 299, 0, None, None)) == ""


def test_too_few_layouts_are_no_fault_of_the_model() -> None:
    result = result_of({}, units=SimpleNamespace(shape=(1, 100)), levels=[LEVEL])
    assert unable(result, Level(0.01, 299, 0, None, None)) == (
        "unsafe episodes ≤ 1 %: too few tune layouts to promise it"
    )
    assert unable(result, Level(0.05, 59, 0, None, None)) == (
        "No setting of model can promise unsafe episodes ≤ 5 %"
    )
    assert needs(result) == (
        "To promise 5 % (delta = 5 %) takes 59 tune layouts without harm; here are 100."
    )


def test_a_setting_is_written_as_it_is_typed() -> None:
    for text in ("6g", "6g:max_helpers=1"):
        point = named_point(text).changed(tau_nats=0.35, careful_nats=0.5)
        assert named_point(typed(point)).changed(name=text) == point
    assert typed(POINT) == "6g:tau=0.7"
    for text in ("6g:tau=0.3", "6g:careful_nats=0.2,tau_nats=0.1"):
        assert typed(named_point(text).changed(tau_nats=0.35)).startswith("6g:tau=0.35")
    assert typed(named_point("6g:loss=0.1,tau=0.3")) == "6g:loss=0.1,tau=0.3"


@pytest.mark.parametrize(("harm", "kept"), [(FEW, True), (SOME, True), (MANY, False)])
def test_a_promise_that_report_layouts_contradict_is_said(harm: Estimate, kept: bool) -> None:
    outcome = Outcome(np.zeros((1, 4)), np.ones((1, 4)), {"requests": 0.0, "latency_ms": 0.0})
    rule = SimpleNamespace(difference=lambda after, before: FEW, words="success")
    report = SimpleNamespace(outcomes={POINT: outcome}, harm=lambda point: harm, success_rule=rule)
    said = sentence(result_of({}, report=report, conditions=[POINT]), LEVEL)
    assert ("% on report layouts, where it is not kept, by 6g" in said) == (not kept)
