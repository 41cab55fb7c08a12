"""The comparison of two logs of another program: for a terminal, for Markdown and for machines."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from textwrap import wrap
from typing import Any

from harness.core.errors import printable
from harness.core.figures import DASH, Unit, amount, number_or_none
from harness.extensions.interop.sample_pairs import (
    Key,
    SampleComparison,
    SampleLog,
    ScorerDifference,
)
from harness.report.compare import words
from harness.report.compare.gate import Verdict
from harness.report.compare.text import WHOLE, WIDTH, code
from harness.report.words import p_value

SCORE = Unit(decimals=3)
NAME = 26  # columns of a scorer's name
HEADS = ("A", "B", "B - A", "95 % interval", "p")


def terminal(comparison: SampleComparison, verdicts: Sequence[Verdict], most: int) -> str:
    """Return a comparison and its gates' verdicts as text of at most `WIDTH` columns.

    A gate is a test that a comparison may fail. `most` is how many answers and samples a list
    shows.
    """
    a, b, change, interval, p = HEADS
    lines = list(_facts(comparison, most))
    lines.append(f"{'scorer':<{NAME}}{a:>8}{b:>9}{change:>9} {f'[{interval}]':>18}{p:>9}")
    for difference in comparison.differences:
        lines += _rows(difference)
    lines += _below(comparison, most)
    lines += [words.judged(verdict) for verdict in verdicts]
    wrapped = []
    for line in lines:
        wrapped += wrap(printable(line, WHOLE), WIDTH, subsequent_indent="    ")
    return "\n".join(wrapped)


def markdown(comparison: SampleComparison, verdicts: Sequence[Verdict], most: int) -> str:
    """Return a comparison and its gates' verdicts in GitHub's Markdown.

    Every text of a log is formatted as code, so that it cannot become a link, picture or mention.
    `most` is how many answers and samples a list shows.
    """
    failed = sum(bool(verdict.failed) for verdict in verdicts)
    title = f"{failed} of {len(verdicts)} gates failed" if verdicts else "Comparison of two logs"
    lines = [f"### {title}", ""]
    for verdict in verdicts:
        lines.append(f"- {'❌' if verdict.failed else '✅'} {code(words.judged(verdict))}")
    lines += [f"- {code(fact)}" for fact in _facts(comparison, most)]
    lines += ["", f"| scorer | {' | '.join(HEADS)} |", f"|---|{'--:|' * len(HEADS)}"]
    for difference in comparison.differences:
        name = code(printable(difference.scorer).replace("|", "¦"))
        lines.append(f"| {name} | {' | '.join(_cells(difference))} |")
    lines += ["", *(f"- {code(line)}" for line in _below(comparison, most))]
    return "\n".join(lines)


def mapping(comparison: SampleComparison, verdicts: Sequence[Verdict], most: int) -> dict[str, Any]:
    """Return a comparison as plain values for JSON; unknown numbers are null.

    `verdicts` are those of its gates, tests that it may fail; `most` is how many answers and
    samples a list shows.
    """
    a, b = comparison.a, comparison.b
    gates = []
    for verdict in verdicts:
        failed_in = [{"scorer": name, "value": value} for name, value in verdict.failed]
        scorers, passed = list(verdict.conditions), not failed_in
        gates.append(
            {"gate": verdict.gate, "scorers": scorers, "passed": passed, "failed_in": failed_in}
        )
    return {
        "a": _log(a, most),
        "b": _log(b, most),
        "samples": len({sample for sample, _ in comparison.answers}),
        "answers": len(comparison.answers),
        "only_in_a": _answers(comparison.only_a, most),
        "only_in_b": _answers(comparison.only_b, most),
        "scorers_only_in_a": comparison.alone["A"],
        "scorers_only_in_b": comparison.alone["B"],
        "scorers_with_other_options": comparison.other_options,
        "answers_with_other_prompts": comparison.other_prompts,
        "scorers": [_scorer(difference, most) for difference in comparison.differences],
        "gates": gates,
        "passed": all(gate["passed"] for gate in gates),
    }


def _facts(comparison: SampleComparison, most: int) -> Iterator[str]:
    """Yield which logs are compared, what of them failed, and what is paired."""
    a, b = comparison.a, comparison.b
    for name, log in (("A", a), ("B", b)):
        unfinished = "" if log.status == "success" else f"; status {log.status}"
        yield (
            f"{name}: {log.path.name}: {log.task} · {log.model}: "
            f"{amount(len(log.inputs), 'answer')}, {len(log.errors)} with an error{unfinished}"
        )
        for key, message in list(log.errors.items())[: min(most, 1)]:
            yield f"  the first error: {_name(key)}: {printable(message)}"
    samples = len({sample for sample, _ in comparison.answers})
    yield f"paired: {amount(len(comparison.answers), 'answer')} to {amount(samples, 'sample')}"
    for name, keys in (("A", comparison.only_a), ("B", comparison.only_b)):
        if keys:
            yield f"only in {name}, left out: {len(keys)}: {_some([_name(k) for k in keys], most)}"
    for name, scorers in comparison.alone.items():
        if scorers:
            yield f"scorers only in {name}, left out: {_some(scorers, most)}"
    if comparison.other_options:
        yield f"other options in A and B, of scorers: {_some(comparison.other_options, most)}"
    if comparison.other_prompts:
        yield f"asked with another prompt in B than in A: {comparison.other_prompts} of these"
    for what in ("task", "dataset"):
        names = getattr(a, what), getattr(b, what)
        if names[0] != names[1]:
            yield f"{what}: {names[0]} → {names[1]}, with the same inputs and targets"


def _rows(difference: ScorerDifference) -> Iterator[str]:
    label = printable(difference.scorer)
    if len(label) >= NAME:
        yield label
        label = ""
    a, b, change, interval, p = _cells(difference)
    yield f"{label:<{NAME}}{a:>8}{b:>9}{change:>9} {interval:>18}{p:>9}"


def _cells(difference: ScorerDifference) -> tuple[str, str, str, str, str]:
    """Return the means in A and B, their difference, its interval and p as text."""
    change = difference.change
    interval = DASH
    if not math.isnan(change.low):
        low, high = (SCORE.number(end, "+", 4) for end in (change.low, change.high))
        interval = f"[{low}, {high}]"
    p = DASH if difference.p_value is None else p_value(difference.p_value).removeprefix("= ")
    a, b = SCORE.number(difference.a, digits=4), SCORE.number(difference.b, digits=4)
    return a, b, SCORE.number(change.value, "+", 4), interval, p


def _below(comparison: SampleComparison, most: int) -> Iterator[str]:
    """Yield what each scorer's row is of, and which samples changed."""
    for each in comparison.differences:
        name, n = printable(each.scorer), each.change.n
        left_out = ""
        if each.unscored:
            answers = amount(each.unscored, "answer")
            left_out = f"; without a number in A or B, left out: {answers}"
            if each.change.n_excluded:
                left_out += f", with them {amount(each.change.n_excluded, 'whole sample')}"
        yield f"{name}: {amount(n, 'sample')}, {amount(each.answers, 'answer')}{left_out}"
        changes = [f"{printable(c.sample)} {c.a:.4g} → {c.b:.4g}" for c in each.changed]
        if changes:
            yield f"  changed {len(changes)}: {_some(changes, most)}"
    if len(comparison.differences) > 1:
        yield f"p is not corrected for {len(comparison.differences)} scorers"


def _some(names: Sequence[str], most: int) -> str:
    """Return the first names, and how many more there are."""
    more = [f"{len(names) - most} more"] if len(names) > most else []
    return ", ".join([*(printable(name, 60) for name in names[:most]), *more])


def _name(key: Key) -> str:
    sample, epoch = key
    return f"{printable(sample, 40)} epoch {epoch}"


def _log(log: SampleLog, most: int) -> dict[str, Any]:
    errors = []
    for (sample, epoch), message in list(log.errors.items())[:most]:
        errors.append({"sample": sample, "epoch": epoch, "message": printable(message, 300)})
    return {
        "file": str(log.path),
        "task": log.task,
        "model": log.model,
        "dataset": log.dataset,
        "status": log.status,
        "answers": len(log.inputs),
        "errors": {"count": len(log.errors), "listed": errors},
    }


def _answers(keys: Sequence[Key], most: int) -> dict[str, Any]:
    listed = [{"sample": sample, "epoch": epoch} for sample, epoch in keys[:most]]
    return {"count": len(keys), "listed": listed}


def _scorer(difference: ScorerDifference, most: int) -> dict[str, Any]:
    change = difference.change
    return {
        "scorer": difference.scorer,
        "a": number_or_none(difference.a),
        "b": number_or_none(difference.b),
        "difference": number_or_none(change.value),
        "low": number_or_none(change.low),
        "high": number_or_none(change.high),
        "n": change.n,
        "n_excluded": change.n_excluded,
        "p": difference.p_value,
        "p_holm": difference.p_corrected,
        "answers": difference.answers,
        "answers_without_number": difference.unscored,
        "changed": {
            "count": len(difference.changed),
            "listed": [asdict(changed) for changed in difference.changed[:most]],
        },
    }
