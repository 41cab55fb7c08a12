"""Plan a study of success: how many layouts find a difference,
by what pilots show or by a stated rate.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.figures import amount, number_or_none
from harness.core.power import Spread
from harness.core.statistics import Estimate, resampled_estimate
from harness.report.compare.pair import pair
from harness.runs.contradictions import sound
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS, headline_of
from harness.runs.metric_names import BASELINE
from harness.runs.metric_values import of_ends
from harness.runs.metrics import METRICS
from harness.runs.records import Answer
from harness.runs.success import Success

RESAMPLES = 999


@dataclass(frozen=True)
class Cost:
    """Hold the requests, tokens and minutes that some layouts take; None where unknown.

    A layout is one drawn start situation of a scenario, which one episode starts from. Tokens are
    those of prompts and answers, minutes those of all answers one after the other.
    """

    requests: float  # number of requests to the model
    tokens: float | None  # of prompts and answers
    # of all answers, one after the other; known where some were asked alone, with `--batch-size 1`
    minutes: float | None

    def times(self, layouts: float) -> "Cost":
        """Return the cost of this many layouts, where `self` is that of one.

        A layout is one start situation of a scenario.
        """
        tokens = self.tokens and self.tokens * layouts
        minutes = self.minutes and self.minutes * layouts
        return Cost(self.requests * layouts, tokens, minutes)


@dataclass(frozen=True)
class Planned:
    """Hold the sample size for one condition: the layouts needed to find a difference.

    A layout is one drawn start situation, with one episode; a condition is a named set of settings
    of the radio, of asking helpers and of fusing their messages; a pilot is a run before the study.
    `layouts` is the number needed, with an interval over other pilots, `finds` the smallest
    difference (0 to 1) that the asked number of layouts finds, NaN if none; `cost` is what the
    needed layouts take, None without pilots.
    """

    condition: str  # the condition's name; empty for a stated rate
    layouts: Estimate  # how many find it; the interval is over other pilots of as many layouts
    finds: float  # the difference that as many layouts find as are asked about; NaN if none up to 1
    # what so many layouts take under all conditions of the pilots; None for a stated rate
    cost: Cost | None


@dataclass(frozen=True)
class Plan:
    """Hold how many episodes a difference in success needs, one row for each condition.

    It is the result of a power analysis. `difference` says in words what is compared, `basis` what
    must hold for it. `layouts` is the number of start situations (one an episode) for which the
    smallest difference that is found is stated.
    """

    difference: str  # whose of what, in words
    basis: str  # what must hold for it, in words
    rows: tuple[Planned, ...]  # one for each condition
    layouts: int | None  # those of which `finds` is


def from_rate(
    rate: float, correlation: float, detect: float, power: float, layouts: int | None
) -> Plan:
    """Return the power analysis of a difference between two runs with success near an assumed rate.

    A layout is one start situation of a scenario.

    Args:
        rate: success of both, from 0 to 1.
        correlation: between the two runs' outcomes over layouts, with one channel seed.
        detect: the difference to find, from 0 to 1.
        power: the probability to find it.
        layouts: also compute the difference that so many layouts find; None for not.
    """
    variance = 2 * rate * (1 - rate) * (1 - correlation)
    spread = Spread(np.ones(1), np.array([variance]))
    needed = float(spread.episodes(detect, power))
    finds = float(spread.difference(layouts, power)) if layouts else np.nan
    row = Planned("", Estimate(needed, np.nan, np.nan, 0, 0), finds, None)
    basis = f"both successes are near {100 * rate:g} %, correlated by {correlation:g} over layouts"
    return Plan("success, B - A", basis, (row,), layouts)


def from_pilots(pilots: Sequence[Path], detect: float, power: float, layouts: int | None) -> Plan:
    """Return the power analysis by the variance in pilot runs, one row for each condition.

    Of one pilot it is for the gain over the condition without a radio, of two for their difference.
    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages. A layout is one start situation of a scenario.

    Args:
        pilots: folders of one or two runs made before the study.
        detect: the difference to find, from 0 to 1.
        power: the probability to find it.
        layouts: also compute the difference that so many layouts find; None takes the pilots' own
            number.

    Raises UserError for runs that cannot be compared, one without the baseline or with no other
    condition, or pilots of fewer than two layouts of a kind.
    """
    sides = _difference(*pilots) if len(pilots) > 1 else _gains(pilots[0])
    success, n = sides.success, sides.success.dangerous.size
    if success.clusters is not None:
        raise UserError(
            f"{sides.names}: {amount(n, 'layout')} are of "
            f"{amount(len(np.unique(success.clusters)), 'recording')}, and a plan counts layouts "
            "that are drawn on their own; give pilots of such"
        )
    counts = success.resampled(noise.generator("plan"), RESAMPLES)
    rows = []
    for condition, (a, b) in sides.values.items():
        spread = success.spread(a, b, counts)
        needed = spread.episodes(detect, power)
        if np.isinf(needed[0]):
            kinds = " with a danger, and without" * (success.metric != SUCCESS)
            raise UserError(
                f"{sides.names}: {amount(n, 'layout')} cannot show how far layouts differ; give "
                f"pilots of two or more{kinds}"
            )
        finds = float(spread.difference(layouts or n, power)[0])
        cost = sides.cost.times(needed[0])
        rows.append(Planned(condition, resampled_estimate(needed, n), finds, cost))
    seeds = len(next(iter(sides.values.values()))[0])
    basis = f"layouts differ as in the pilots, {amount(n, 'layout')} × {amount(seeds, 'seed')}"
    return Plan(f"{success.words}, {sides.whose}", basis, tuple(rows), layouts or n)


@dataclass(frozen=True)
class _Sides:
    names: str  # the pilots, for an error
    whose: str  # difference it is, in words
    success: Success
    values: dict[str, tuple[Floats, Floats]]  # successes (S, E) of both sides by condition
    cost: Cost  # of one layout


def _gains(path: Path) -> _Sides:
    run = sound(path)
    if BASELINE not in run.conditions or len(run.conditions) < 2:
        raise UserError(
            f"{printable(path)} has not both {BASELINE} and another condition, so that it shows no "
            "gain; give a second run, of another model or prompt, or a run with both"
        )
    successes = of_ends(METRICS[SUCCESS], run.grid, run.episodes)
    by_condition = dict(zip(run.conditions, successes, strict=True))
    alone = by_condition.pop(BASELINE)
    success = Success.of(run.episodes[: len(run.grid.episodes)], headline_of(run))
    values = {name: (alone, b) for name, b in by_condition.items()}
    return _Sides(printable(path), f"gain over {BASELINE}", success, values, _cost([run]))


def _difference(a: Path, b: Path) -> _Sides:
    both = pair(a, b)
    success = both.success_rule(both.conditions[0])
    values = {}
    for name in both.conditions:
        of_a, of_b = both.values(both.a, SUCCESS, name), both.values(both.b, SUCCESS, name)
        values[name] = of_a.T, of_b.T
    cost = _cost([both.a.run, both.b.run])
    return _Sides(f"{printable(a)} and {printable(b)}", "B - A", success, values, cost)


def _cost(runs: Sequence[Run]) -> Cost:
    """Return what the answers of one layout take, in all of the runs."""
    costs = [_cost_of(run) for run in runs]
    return Cost(
        sum(each.requests for each in costs),
        _sum(each.tokens for each in costs),
        _sum(each.minutes for each in costs),
    )


def _cost_of(run: Run) -> Cost:
    answers, layouts = list(run.answers), len(run.grid.episodes)
    timed = [answer.seconds for answer in answers if answer.seconds is not None]
    minutes = float(np.mean(timed)) * len(answers) / 60 / layouts if timed else None
    tokens = _sum(_tokens(answer) for answer in answers)
    return Cost(len(answers) / layouts, tokens and tokens / layouts, minutes)


def _tokens(answer: Answer) -> float | None:
    return _sum((answer.prompt_tokens, answer.completion_tokens))


def _sum(values: Iterable[float | None]) -> float | None:
    terms = list(values)
    return None if None in terms else float(sum(value for value in terms if value is not None))


def as_mapping(plan: Plan, detect: float, power: float) -> dict[str, object]:
    """Return a power analysis as plain values for JSON: differences from 0 to 1, unknown as None.

    `plan` is its result, `detect` the difference to find and `power` the probability to find it,
    both 0 to 1.
    """
    conditions = []
    for row in plan.rows:
        cost = row.cost
        condition = {
            "condition": row.condition or None,
            "layouts": row.layouts,
            "finds": number_or_none(row.finds),
            "requests": cost and cost.requests,
            "tokens": cost and cost.tokens,
            "minutes": cost and cost.minutes,
        }
        conditions.append(condition)
    return {
        "difference": plan.difference,
        "basis": plan.basis,
        "detect": detect,
        "power": power,
        "finds_with": plan.layouts,
        "conditions": conditions,
    }
