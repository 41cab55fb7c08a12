"""A comparison for a terminal, for a pull request and for machines."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from textwrap import wrap
from typing import Any

import msgspec

from harness.core import places
from harness.core.errors import printable
from harness.core.figures import number_or_none
from harness.core.junit import Case
from harness.core.junit import junit as test_suite
from harness.prompts.difference import PromptChange
from harness.report.compare import words
from harness.report.compare.difference import (
    AnswersFlipped,
    AnswersHeld,
    Comparison,
    Difference,
    Flip,
    InCondition,
)
from harness.report.compare.gate import Verdict
from harness.report.compare.pair import Side, where
from harness.report.findings import Kind
from harness.report.words import first_note
from harness.runs.headline import IN_WORDS, SUCCESS

WIDTH = 80
# of an answer that changed
ANSWERS = ("request", "role", "verdict_a", "verdict_b", "raw_a", "raw_b")
WHOLE = 10**6  # lists are cut by number, never in the middle of an id


def terminal(
    comparison: Comparison, verdicts: Sequence[Verdict], most: int, whole: bool = False
) -> str:
    """Return a comparison and its gates' verdicts as text of at most `WIDTH` columns.

    A gate is a test that a comparison may fail. `most` is how many episodes and requests a list
    shows; `whole` also shows all exploratory metrics, those that are not corrected for multiple
    testing.
    """
    lines = []
    for text in _lines(comparison, verdicts, most, whole):
        lines += wrap(printable(text, WHOLE), WIDTH, subsequent_indent="    ")
    return "\n".join(lines)


def brief(comparison: Comparison, verdicts: Sequence[Verdict]) -> str:
    """Return what a comparison comes to, and its gates' verdicts, as text of `WIDTH` columns.

    It has success by condition, what changed in episodes and answers, and the first note;
    `terminal` has all. A gate is a test that a comparison may fail.
    """
    lines = []
    for text in _brief_lines(comparison, verdicts):
        lines += wrap(printable(text, WHOLE), WIDTH, subsequent_indent="    ")
    return "\n".join(lines)


def _brief_lines(comparison: Comparison, verdicts: Sequence[Verdict]) -> Iterator[str]:
    pair = comparison.pair
    yield from (f"{name}: {side}" for name, side in words.sides(pair, whole=True))
    yield f"paired: {words.paired(pair)}; {words.differing(comparison)}"
    changes = words.of_success(comparison)
    metrics = dict.fromkeys(f"{IN_WORDS[d.metric]}, %" for d in changes.values())
    numbers = f"{'A':>6}{'B':>6}{'B - A':>7} {'[95 % interval]':>17}{'p':>8}"
    yield f"{' or '.join(metrics):<22}{numbers}{'gained':>8}{'lost':>5}"
    for condition in comparison.conditions:
        if condition.condition not in changes:
            continue
        row = words.line(changes[condition.condition])
        label = f"{words.SIGNS[row.verdict]} {printable(condition.condition, 19)}".strip()
        gained, lost = words.counts(condition)
        numbers = f"{row.a:>6}{row.b:>6}{row.change:>7} {row.interval:>17}{row.p:>8}"
        yield f"{label:<22}{numbers}{gained:>8}{lost:>5}"
    yield (
        f"p: Holm's, of {len(words.corrected(comparison))} differences; gained, lost: of "
        f"{len(pair.episodes) * len(pair.seeds)} episodes × seeds"
    )
    for condition in comparison.conditions[-1:]:
        ways = dict(words.both_ways(condition, pair, 3))
        if episodes := ways.get("lost"):
            yield f"lost under {printable(condition.condition)}: {episodes}"
    yield f"answers: {words.answers_held(comparison.held)}"
    yield from words.caveats(pair, (Kind.VOID, Kind.CAVEAT))
    notes = words.caveats(pair, (Kind.LIMIT,))
    if notes:
        more = f" ({len(notes) - 1} more: --verbose)" if len(notes) > 1 else ""
        yield f"{first_note(notes[0])}{more}"
    for verdict in verdicts:
        yield words.judged(verdict)


def _lines(
    comparison: Comparison, verdicts: Sequence[Verdict], most: int, whole: bool
) -> Iterator[str]:
    pair = comparison.pair
    yield from (f"{name}: {side}" for name, side in words.sides(pair, whole=True))
    yield from words.caveats(pair)
    yield f"paired: {words.paired(pair)}"
    yield words.differing(comparison)
    yield from (f"  {setting}" for setting in words.settings(comparison))
    yield from words.prompts(comparison)
    yield from words.paces(pair)
    for condition in comparison.conditions:
        yield from _metric_lines(condition, whole)
        yield words.success(condition, pair)
        yield from words.adjusted(condition)
        for way, episodes in words.both_ways(condition, pair, most):
            yield f"  {way}: {episodes}"
        yield words.decisions(condition, pair)
        for how, scenes in words.given_away(condition, pair, most):
            yield f"  {how}: {scenes}"
    yield words.many(comparison)
    held = comparison.held
    yield f"answers: {words.answers_held(held)}"
    if held.changed:
        yield from (f"  {line}" for line in words.first_changed(held.changed[0]))
        yield f"  all, side by side: --html FILE --show {len(held.changed)}"
    for change, requests in words.answers_flipped(comparison, most):
        yield f"answers: {change}"
        yield f"  {requests}"
    for verdict in verdicts:
        yield words.judged(verdict)


def _metric_lines(condition: InCondition, whole: bool) -> Iterator[str]:
    """Yield the table of a condition's metrics, a line each, below its name and its heads."""
    label = printable(condition.condition)
    if len(label) > 25:
        yield label
        label = ""
    yield f"{label:<26}{'A':>8}{'B':>9}{'B - A':>9} {'[95 % interval]':>18}{'p':>9}"
    primary, exploratory, more = _groups(condition, whole)
    for difference in primary:
        yield _row(difference)
    if exploratory:
        yield "exploratory, p not corrected:"
        for difference in exploratory:
            yield _row(difference)
    if more:
        yield f"{more} more metrics: --all"


def _groups(c: InCondition, whole: bool) -> tuple[list[Difference], list[Difference], int]:
    """Return the primary metrics, the exploratory ones that are shown, and how many are not."""
    primary, exploratory = words.first(c)
    if whole:
        exploratory = [d for d in c.differences if not d.primary]
    return primary, exploratory, len(c.differences) - len(primary) - len(exploratory)


def _row(d: Difference) -> str:
    text = words.line(d)
    named = f"{words.SIGNS[text.verdict]:<2}{text.metric}"
    return f"{named:<27}{text.a:>7}{text.b:>9}{text.change:>9} {text.interval:>18}{text.p:>9}"


def markdown(
    comparison: Comparison, verdicts: Sequence[Verdict], most: int, whole: bool = False
) -> str:
    """Return a comparison and its gates' verdicts in GitHub's Markdown.

    A gate is a test that a comparison may fail. `most` is how many episodes and requests a list
    shows; `whole` also shows all exploratory metrics, those that are not corrected for multiple
    testing. Every text of a run is formatted as code, so that it cannot become a link, picture or
    mention.
    """
    pair = comparison.pair
    failed = sum(bool(verdict.failed) for verdict in verdicts)
    title = f"{failed} of {len(verdicts)} gates failed" if verdicts else "Comparison of two runs"
    lines = [f"### {title}", ""]
    for verdict in verdicts:
        lines.append(f"- {'❌' if verdict.failed else '✅'} {code(words.judged(verdict))}")
    lines += [f"- {name}: {code(side)}" for name, side in words.sides(pair)]
    lines += [f"- {code(caveat)}" for caveat in words.caveats(pair)]
    lines += [f"- paired: {code(words.paired(pair))}", f"- {words.differing(comparison)}", ""]
    for condition in comparison.conditions:
        lines += _markdown_of_condition(comparison, condition, most, whole)
    lines += [f"{words.many(comparison)}.", ""]
    lines += ["<details><summary>Answers and settings</summary>", ""]
    lines += [f"- {words.answers_held(comparison.held)}"]
    for changed in comparison.held.changed[:1]:
        lines += [f"- {code(line.strip())}" for line in words.first_changed(changed)]
    for change, ids in words.answers_flipped(comparison, most):
        lines.append(f"- {code(change)}: {code(ids)}")
    lines += [f"- {code(setting)}" for setting in words.settings(comparison)]
    lines += [f"- {code(line.strip())}" for line in words.prompts(comparison)]
    lines += [f"- {code(line.strip())}" for line in words.paces(pair)]
    return "\n".join([*lines, "", "</details>"])


def _markdown_of_condition(
    comparison: Comparison, condition: InCondition, most: int, whole: bool
) -> list[str]:
    pair = comparison.pair
    lines = [f"#### {code(condition.condition)}", "", *_table(condition, whole), ""]
    lines += [words.success(condition, pair), ""]
    lines += [f"- {line}" for line in words.adjusted(condition)]
    for way, episodes in words.both_ways(condition, pair, most):
        lines.append(f"- {way}: {code(episodes)}")
    lines += ["", words.decisions(condition, pair), ""]
    for how, scenes in words.given_away(condition, pair, most):
        lines.append(f"- {how}: {code(scenes)}")
    return [*lines, ""]


def _table(condition: InCondition, whole: bool) -> list[str]:
    """Return the Markdown table of a condition's metrics, a line each."""
    primary, exploratory, more = _groups(condition, whole)
    lines = ["| metric | A | B | B - A | 95 % interval | p |", "|---|--:|--:|--:|--:|--:|"]
    for difference in (*primary, *exploratory):
        row = words.line(difference)
        name = f"{words.SIGNS[row.verdict]} {row.metric}"
        p = row.p if difference.primary else f"{row.p} exploratory"
        cells = (name, row.a, row.b, row.change, row.interval, p)
        lines.append(f"| {' | '.join(cells)} |")
    if more:
        lines += ["", f"{more} more metrics: --all"]
    return lines


def junit(comparison: Comparison, verdicts: Sequence[Verdict]) -> str:
    """Return the verdicts of a comparison's gates as test cases in JUnit's XML.

    A gate is a test that a comparison may fail.
    """
    pair = comparison.pair
    runs = f"{printable(words.who(pair.b))} against {printable(words.who(pair.a))}"
    return test_suite("harness compare", [case(runs, verdict) for verdict in verdicts])


def case(of: str, verdict: Verdict) -> Case:
    """Return a gate's verdict as a test case, of the class `of`, that says what it judged."""
    failure = words.judged(verdict) if verdict.failed else None
    return Case(of, verdict.gate, failure, said=f"judged: {', '.join(verdict.conditions)}")


def junit_of_none(gates: Sequence[str], reason: str) -> str:
    """Return gates as test cases with an error, in JUnit's XML.

    It is for gates that cannot be judged, such as where a model did not answer; `reason` says why,
    with file names in place of paths. `gates` are their texts.
    """
    given = places.text(reason)
    cases = [Case("harness compare", gate, error=given) for gate in gates]
    return test_suite("harness compare", cases)


def code(text: str) -> str:
    """Return a text as code in a line of Markdown, so that nothing in it is formatted.

    The fence is longer than any row of backticks in the text.
    """
    text = printable(text, WHOLE)
    longest = max((len(ticks) for ticks in re.findall("`+", text)), default=0)
    fence = "`" * (1 + longest)
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def mapping(comparison: Comparison, verdicts: Sequence[Verdict], most: int) -> dict[str, Any]:
    """Return a comparison as plain values for JSON: metrics in their units, unknown numbers null.

    The keys are those of the output of `harness compare --json`. `verdicts` are those of its gates,
    tests that it may fail; `most` is how many episodes and requests a list shows.
    """
    pair, prompts = comparison.pair, comparison.prompts
    return {
        "a": _side(pair.a),
        "b": _side(pair.b),
        "caveats": words.caveats(pair),
        "scenes": where(pair.a.run),
        "seeds": list(pair.seeds),
        "episodes": len(pair.episodes),
        "settings": [{"name": name, "a": a, "b": b} for name, a, b in comparison.settings],
        "prompts": asdict(prompts) if isinstance(prompts, PromptChange) else prompts,
        "conditions": [_in_condition(c, most) for c in comparison.conditions],
        "answers_in_both": comparison.answers_in_both,
        "answers": [_answers_flipped(flipped, most) for flipped in comparison.answers],
        "answers_changed": {
            "count": len(comparison.held.changed),
            "verdicts": comparison.held.verdicts,
            "of": comparison.held.same,
            "asked_otherwise": comparison.held.other,
            "asked_otherwise_leaning": comparison.held.other_leaning,
            "listed": changed_answers(comparison.held, most),
        },
        "gates": [_gate(verdict) for verdict in verdicts],
        "passed": not any(verdict.failed for verdict in verdicts),
    }


def _side(side: Side) -> dict[str, Any]:
    return {
        "run": str(side.run.path),
        "settings": dict(side.settings),
        "answer_times": msgspec.to_builtins(side.run.manifest.answer_times),
    }


def _answers_flipped(flipped: AnswersFlipped, most: int) -> dict[str, Any]:
    return {
        "role": flipped.role,
        "a": flipped.a,
        "b": flipped.b,
        "count": len(flipped.requests),
        "requests": flipped.requests[:most],
    }


def _gate(verdict: Verdict) -> dict[str, Any]:
    failed_in = [{"condition": name, "value": value} for name, value in verdict.failed]
    return {
        "gate": verdict.gate,
        "conditions": list(verdict.conditions),
        "passed": not verdict.failed,
        "failed_in": failed_in,
    }


def changed_answers(held: AnswersHeld, most: int | None = None) -> list[dict[str, Any]]:
    """Return the answers that differ as dicts: request, role, and each run's verdict and text.

    `held` is the comparison of both runs' answers to the same questions; up to `most` are taken, or
    all. The keys are `ANSWERS`.
    """
    rows = []
    for answer in held.changed[:most]:
        values = (answer.request, answer.role, *answer.verdicts, answer.a, answer.b)
        rows.append(dict(zip(ANSWERS, values, strict=True)))
    return rows


def _in_condition(condition: InCondition, most: int) -> dict[str, Any]:
    metrics = {each.metric: _difference(each) for each in condition.differences}
    return {
        "condition": condition.condition,
        "metrics": metrics,
        "test": _test(metrics),
        "gained": _episodes(condition.gained, most),
        "lost": _episodes(condition.lost, most),
        "flips": {
            "count": sum(len(flip.seeds) for flip in condition.flips),
            "of": condition.decisions,
            "listed": [asdict(flip) for flip in condition.flips[:most]],
        },
    }


def _difference(d: Difference) -> dict[str, Any]:
    return {
        "a": d.a,
        "b": d.b,
        "difference": d.change.value,
        "low": number_or_none(d.change.low),
        "high": number_or_none(d.change.high),
        "n": d.change.n,
        "n_excluded": d.change.n_excluded,
        "p": d.p_value,
        "p_holm": d.p_corrected,
        "primary": d.primary,
    }


def _episodes(flips: Sequence[Flip], most: int) -> dict[str, Any]:
    return {
        "count": sum(len(flip.seeds) for flip in flips),
        "episodes": len(flips),
        "listed": [asdict(flip) for flip in flips[:most]],
    }


def _test(metrics: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return what else stands in the row of success, which had a test of its own."""
    if SUCCESS not in metrics or metrics[SUCCESS]["p"] is None:
        return None
    success = metrics[SUCCESS]
    return {
        "method": "interval",
        "p_value": success["p"],
        "low": success["low"],
        "high": success["high"],
    }
