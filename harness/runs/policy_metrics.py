"""The metrics of policies: how sure they are, and how good by the actions that are optimal."""

from collections.abc import Callable
from typing import Any

from harness.core.arrays import Floats
from harness.core.figures import PERCENT, Unit
from harness.core.statistics import brier, negative_log_likelihood, safe_target
from harness.runs import reliability
from harness.runs.metric import NATS, SCORE, Better, Metric, of_column
from harness.runs.metric_names import ONE_OPTIMAL


def _judged(
    name: str,
    meaning: str,
    unit: Unit,
    better: Better,
    score: Callable[[Floats, Any], Floats],
    **more: Any,
) -> Metric:
    """Build the metric of a score of fused policies by their optimal actions."""
    return Metric(
        name,
        meaning,
        unit,
        better,
        world="frozen",
        decisions=lambda d: score(d.of_actions("fused"), d.of_actions("safe") == 1.0),
        **more,
    )


POLICY_METRICS = (
    Metric(
        "entropy_nats",
        "entropy of the ego's own intent",
        NATS,
        "neither",
        label="entropy",
        decisions=of_column("entropy_nats"),
    ),
    Metric(
        "normalised_entropy",
        "entropy of the ego's own intent from 0 (sure) to 1 (undecided)",
        SCORE,
        "neither",
        decisions=of_column("normalised_entropy"),
    ),
    _judged(
        "optimal_action_rate",
        "share of decisions whose likeliest action is optimal; only those in "
        "which success was still possible",
        PERCENT,
        "higher",
        reliability.right,
        interval="rate",
        most=1.0,
    ),
    _judged(
        "optimal_brier",
        "Brier score of the optimal actions, taken as one event; 0 best, 2 worst",
        SCORE,
        "lower",
        reliability.brier,
        most=2.0,
        label="Brier",
    ),
    _judged(
        "optimal_nll_nats",
        "negative log-likelihood of the optimal actions together, whose probability "
        f"counts as {reliability.LEAST_P} at least",
        NATS,
        "lower",
        reliability.likelihood_nats,
        label="NLL",
    ),
    Metric(
        ONE_OPTIMAL,
        "number of decisions, of all seeds, in which exactly one action is optimal",
        Unit(decimals=0),
        "neither",
        world="frozen",
        pooled=reliability.decisions,
    ),
    Metric(
        "calibration_error_one_optimal",
        "expected calibration error of the likeliest action, in "
        f"{reliability.BINS} bins of equal mass, over all decisions in which exactly one action is "
        f"optimal; not known below {reliability.LEAST} of them",
        PERCENT,
        "lower",
        most=1.0,
        label="ECE",
        world="frozen",
        pooled=reliability.calibration_error,
    ),
    Metric(
        "coverage_at_5_risk_one_optimal",
        "greatest share, the surest first, of the decisions in which "
        "exactly one action is optimal, of which 5 % at most are not right; not known below "
        f"{reliability.LEAST} of them",
        PERCENT,
        "higher",
        most=1.0,
        label="coverage at 5 % risk",
        world="frozen",
        pooled=reliability.coverage,
    ),
    Metric(
        "calibration_error",
        "expected calibration error over all decisions, also those in which several "
        "actions are optimal; in older runs",
        PERCENT,
        "lower",
        most=1.0,
        world="frozen",
        superseded=True,
    ),
    Metric(
        "coverage_at_5_risk",
        "coverage at 5 % risk over all decisions, also those in which several "
        "actions are optimal; in older runs",
        PERCENT,
        "higher",
        most=1.0,
        world="frozen",
        superseded=True,
    ),
    Metric(
        "brier",
        "distance of the fused policy from the uniform one over the safe actions; 0 best, 2 worst",
        SCORE,
        "lower",
        world="frozen",
        superseded=True,
        decisions=lambda d: brier(d.of_actions("fused"), safe_target(d.of_actions("safe") == 1.0)),
    ),
    Metric(
        "negative_log_likelihood",
        "optimal_nll_nats with a least probability of 0.0001",
        SCORE,
        "lower",
        world="frozen",
        superseded=True,
        decisions=lambda d: negative_log_likelihood(
            d.of_actions("fused"), d.of_actions("safe") == 1.0
        ),
    ),
)
