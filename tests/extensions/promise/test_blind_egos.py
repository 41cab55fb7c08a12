"""Egos that look at nothing: what may be promised without a model."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.coordination.named_points import named_point
from harness.dataset.forest import Forest
from harness.dataset.load import Dataset
from harness.extensions.promise.blind import blind_outcomes
from harness.extensions.promise.outcomes import Level, Outcome
from harness.extensions.promise.page import sentence
from harness.extensions.promise.study import choose

SIX_G = named_point("6g")


def expected(forest: Forest, worth: Any, shares: Any, at: int) -> float:
    """The mean of what courses from a decision point are worth, course by course."""
    total = 0.0
    for action, share in enumerate(shares):
        if share and forest.child[at, action] >= 0:
            total += share * expected(forest, worth, shares, forest.child[at, action])
        elif share:
            total += share * worth[forest.edge[at, action]]
    return total


@pytest.mark.parametrize("harm", ["unsafe", "failed"])
def test_a_blind_ego_does_as_the_trees_have_it_course_by_course(small: Dataset, harm: Any) -> None:
    forest, limits = small.forest, small.scenario.parameters.limits
    edges = np.arange(len(forest.edges))
    outcomes = blind_outcomes(small, harm)
    policies = {f"always {a}": np.eye(3)[n] for n, a in enumerate(forest.actions)}
    policies["uniform"] = np.full(3, 1 / 3)
    assert outcomes.keys() - policies.keys() <= {"open-loop"}
    for name, shares in policies.items():
        for tree, root in enumerate(forest.root.tolist()):
            success = expected(forest, forest.succeeds(edges, edges * 0 + tree), shares, root)
            unsafe = expected(forest, forest.unsafe(edges, limits), shares, root)
            assert outcomes[name].success[0, tree] == pytest.approx(success)
            assert outcomes[name].harm[0, tree] == pytest.approx(
                unsafe if harm == "unsafe" else 1 - success
            )


def result_of(blind: dict[str, tuple[float, float]]) -> Any:
    """A study of one setting that harms nobody, on 100 layouts, with blind egos of these shares of
    harm and success.
    """
    outcomes: dict[Any, Outcome] = {SIX_G: outcome(0.0, 1.0)}
    for name, shares in blind.items():
        outcomes[name] = outcome(*shares)
    rule = SimpleNamespace(mean=np.mean)
    played = SimpleNamespace(
        run=SimpleNamespace(clusters=None), outcomes=outcomes, blind=list(blind), success_rule=rule
    )
    order = SimpleNamespace(certified=lambda p, delta: p <= delta)
    grid = SimpleNamespace(points=[SIX_G], order=order)
    units = np.zeros((1, 100))
    return SimpleNamespace(
        tune=played, grid=grid, units=units, delta=0.05, seeds=(0,), harm="unsafe"
    )


def outcome(harm: float, success: float) -> Outcome:
    layouts = np.arange(100)[None]
    return Outcome(
        (layouts < 100 * harm).astype(float),
        (layouts < 100 * success).astype(float),
        {"requests": 0.0},
    )


@pytest.mark.parametrize(
    ("blind", "best"),
    [
        ({"stands": (0.0, 0.0), "goes": (0.5, 0.9)}, "stands"),
        ({"stands": (0.0, 0.0), "creeps": (0.0, 0.3), "goes": (0.5, 0.9)}, "creeps"),
        # .95^100 is .0059, below .05 and .05 / 2, and not below .05 / 9
        ({"stands": (0.0, 0.0), **{f"creeps {n}": (0.0, 0.3) for n in range(2)}}, "creeps 0"),
        ({"stands": (0.0, 0.0), **{f"creeps {n}": (0.0, 0.3) for n in range(9)}}, "stands"),
        # what is tested first fails
        ({"goes": (0.5, 0.9), "stands": (0.0, 0.0)}, None),
    ],
)
def test_the_best_blind_ego_that_passes_is_named(blind: Any, best: str | None) -> None:
    assert choose(result_of(blind), 0.05, 59).blind == best


def test_what_nobody_can_promise_no_blind_ego_may() -> None:
    report = SimpleNamespace(run=SimpleNamespace(name="model"), success=lambda name: None)
    result: Any = SimpleNamespace(harm="unsafe", units=np.zeros((1, 100)), report=report)
    assert sentence(result, Level(0.05, 59, 0, None, None)) == (
        "No setting of model can promise unsafe episodes ≤ 5 %; no blind ego can promise it."
    )
