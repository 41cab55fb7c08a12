"""Gates: a difference that fails a comparison, as typed after --fail-if."""

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from harness.core.errors import UserError, printable, unknown
from harness.core.figures import amount
from harness.core.statistics import Estimate
from harness.report.compare.difference import Comparison
from harness.report.compare.pair import Pair
from harness.runs.metrics import METRICS
from harness.runs.records import FrozenScenes
from harness.runs.run_dataset import check_episodes, dataset_of

OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
# A condition may have colons in its name, and a metric has none.
_GATE = re.compile(
    r"(?:(?P<condition>.+):)?\s*"
    r"(?P<metric>\w+)(?:\.(?P<end>\w+))?\s*"
    r"(?P<op>[<>]=?)\s*(?P<number>\S+)\s*"
)
ENDS = ("low", "high")


@dataclass(frozen=True)
class Gate:
    """Hold one test of --fail-if: a comparison fails if B - A satisfies it in some condition.

    A gate is such as `6g:success_rate < -0.01`. `condition` is the condition (named set of settings
    of the runs) that it is about, None for all. `end` chooses the difference itself (`value`) or an
    end of its interval (`low`, `high`), which is compared with `number`, in the metric's unit, by
    `op`.
    """

    text: str  # as it was typed
    condition: str | None  # name of the only condition it looks at; None for all
    metric: str  # the metric's name
    end: str  # `low` or `high` end of the interval; `value` for the difference itself
    op: str  # one of `OPERATORS`
    number: float  # in the metric's own unit, shares from 0 to 1


@dataclass(frozen=True)
class Verdict:
    """Hold the result of a gate, a test that a comparison may fail.

    `gate` is its text, `conditions` are those that it judged, and `failed` has each in which it
    failed with the value that did it; empty if it passed. A condition is a named set of settings of
    the radio, of asking helpers and of fusing their messages.
    """

    gate: str  # its text, as it was typed
    conditions: tuple[str, ...]  # names of those that it judged
    failed: tuple[tuple[str, float], ...]  # condition and value, wherever it failed


def gate(
    text: str,
    names: Sequence[str] = (),
    place: str = "CONDITION",
    example: str = "6g:success_rate < -0.01",
    scale: tuple[float, float] = (-math.inf, math.inf),
) -> Gate:
    """Parse the text of a gate and return it.

    Examples are `success_rate < -0.01`, `6g:success_rate < -0.01` and `success_rate.high < 0`.

    Args:
        text: the gate as typed.
        names: allowed metrics; if empty, those in which runs are compared.
        place: for the error message, what stands before the colon.
        example: for the error message, a valid gate.
        scale: the least and the greatest value of all of `names`; without those, that of a
            difference follows from the metric.

    Raises:
        UserError: the text is no gate, its metric is unknown, or no value could make it pass or
            fail.
    """
    match = _GATE.fullmatch(text)
    try:
        number = float(match["number"]) if match else math.nan
    except ValueError:
        number = math.nan
    if not match or not math.isfinite(number):
        raise UserError(
            f"--fail-if {printable(text)!r} cannot be read; give [{place}:]METRIC[.low|.high] OP "
            f"NUMBER with OP one of {' '.join(OPERATORS)}, such as {example!r}"
        )
    compared = [name for name, m in METRICS.items() if m.compared]
    if match["metric"] not in (names or compared):
        raise unknown("metric of --fail-if", match["metric"], names or compared)
    if match["end"] not in (None, *ENDS):
        raise unknown(f"end of {match['metric']}'s interval in --fail-if", match["end"], ENDS)
    what, (least, most) = match["metric"], scale
    if not names:
        what, most = f"a difference of {what}", METRICS[what].most
        least = -most
    # Each operator holds from a number on, up or down.
    holds = OPERATORS[match["op"]]
    if holds(least, number) == holds(most, number):
        verdict = "fails" if holds(least, number) else "passes"
        points = ", where 0.01 is one point" if most == 1 else ""
        raise UserError(
            f"--fail-if {printable(text)!r} {verdict} whatever was run: {what} is from {least:g} "
            f"to {most:g}{points}; give a number on that scale, such as {example!r}"
        )
    condition = match["condition"]
    return Gate(
        text,
        condition and condition.strip(),
        match["metric"],
        match["end"] or "value",
        match["op"],
        number,
    )


def refuse_misstated(pair: Pair) -> None:
    """Raise UserError if runs of unlike episodes have others than they state.

    One may state that chance chose its episodes, or nothing did. It is for gates alone, since it
    reads datasets.
    """
    runs = pair.a.run, pair.b.run
    if runs[0].grid.episodes != runs[1].grid.episodes:
        for run in runs:
            is_frozen = isinstance(run.manifest.world, FrozenScenes)
            check_episodes(run, dataset_of(run) if is_frozen else None)


def judge(gate: Gate, comparison: Comparison) -> Verdict:
    """Return in which conditions of a comparison a gate, a test of a difference, fails.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.

    Raises:
        UserError: the gate's condition is not compared, a run lacks one that it is on, the
            difference is unknown there, or a run was chosen to lack episodes of the other.
    """
    pair = comparison.pair
    for side, chosen in pair.left_out.items():
        other = pair.b if side == "A" else pair.a
        lacks = amount(len(other.run.grid.episodes) - len(pair.episodes), "episode")
        raise UserError(
            f"--fail-if {printable(gate.text)!r}: {side} lacks {lacks} of the other run by "
            f"{chosen}, perhaps for how they end; compare two runs that are chosen alike"
        )
    changes: dict[str, Estimate | None] = {}
    for condition in comparison.conditions:
        changes[condition.condition] = None
        for each in condition.differences:
            if each.metric == gate.metric:
                change = each.change
                changes[condition.condition] = of_no_width(change) if each.is_alike else change
    return judge_changes(gate, changes, pair.alone)


def of_no_width(change: Estimate) -> Estimate:
    """Return a difference by which all units changed alike with its value for the missing ends."""
    return replace(change, low=change.value, high=change.value)


def judge_changes(
    gate: Gate, changes: Mapping[str, Estimate | None], alone: Mapping[str, Sequence[str]]
) -> Verdict:
    """Return in which conditions a gate, a test of a difference, fails.

    `changes` has the difference of the gate's metric by condition, None where it is not known, and
    `alone` the conditions that only `A` or only `B` has. Of logs of other programs, the conditions
    are scorers.

    Raises:
        UserError: the gate's condition is not compared, one side lacks a condition that the gate is
            on, or the difference is unknown there.
    """
    if gate.condition is not None and gate.condition not in changes:
        raise unknown(f"condition of --fail-if {printable(gate.text)!r}", gate.condition, changes)
    for side, names in alone.items():
        if names and gate.condition is None:
            raise UserError(
                f"--fail-if {printable(gate.text)!r} is on all, and only {side} has "
                f"{printable(', '.join(names), 60)}; compare two that have the same, or name what "
                f"both have: {printable(f'{next(iter(changes))}:{gate.text}')!r}"
            )
    judged = [name for name in changes if gate.condition in (None, name)]
    failed = []
    for name, change in changes.items():
        if name in judged:
            value = float(getattr(change, gate.end)) if change else math.nan
            if math.isnan(value):
                # A gate that passes because nothing is known would guard nothing.
                is_known = gate.end in ENDS and change is not None and not math.isnan(change.value)
                lacks = "interval" if is_known else "such number"
                more = ", of more recordings if of some," if is_known else ""
                raise UserError(
                    f"--fail-if {printable(gate.text)!r}: {printable(name)} has no {lacks} in "
                    "these runs; name a condition or a metric that has, or compare more episodes"
                    f"{more}"
                )
            # Means over seeds carry rounding errors, which decide no gate.
            if OPERATORS[gate.op](round(value, 9), gate.number):
                failed.append((name, value))
    return Verdict(gate.text, tuple(judged), tuple(failed))
