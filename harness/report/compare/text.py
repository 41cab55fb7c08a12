"""A comparison for a terminal, for a pull request and for machines."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from textwrap import wrap
from typing import Any

import msgspec

from harness.core.errors import printable
from harness.core.junit import Case
from harness.core.junit import junit as test_suite
from harness.prompts.difference import PromptChange
from harness.report.compare import words
from harness.report.compare.difference import AnswersHeld, Comparison, Difference, InCondition
from harness.report.compare.gate import Verdict
from harness.report.compare.pair import where
from harness.runs.leading import SUCCESS

WIDTH = 80
# of an answer that changed
ANSWERS = ("request", "role", "verdict_a", "verdict_b", "raw_a", "raw_b")
WHOLE = 10**6  # lists are cut by number, never in the middle of an id


def terminal(
    comparison: Comparison, verdicts: Sequence[Verdict], most: int, whole: bool = False
) -> str:
    """Write lines of at most `WIDTH` columns;
    `most` episodes, requests and so on are listed of each kind.

    Unless `whole`, only those metrics are listed that come first.
    """
    return "\n".join(
        piece
        for text in _lines(comparison, verdicts, most, whole)
        for piece in wrap(printable(text, WHOLE), WIDTH, subsequent_indent="    ")
    )


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
    for c in comparison.conditions:
        label = printable(c.condition)
        if len(label) > 25:
            yield label
            label = ""
        yield f"{label:<26}{'A':>8}{'B':>9}{'B - A':>9} {'[95 % interval]':>18}{'p':>9}"
        primary, exploratory, more = _groups(c, whole)
        yield from map(_row, primary)
        if exploratory:
            yield "exploratory, p not corrected:"
            yield from map(_row, exploratory)
        if more:
            yield f"{more} more metrics: --all"
        yield words.success(c, pair)
        yield from words.adjusted(c)
        yield from (f"  {way}: {episodes}" for way, episodes in words.both_ways(c, pair, most))
        yield words.decisions(c, pair)
        yield from (f"  {how}: {scenes}" for how, scenes in words.given_away(c, pair, most))
    yield words.many(comparison)
    held = comparison.held
    yield f"answers: {words.answers_held(held)}"
    if held.changed:
        yield from (f"  {line}" for line in words.first_changed(held.changed[0]))
        yield f"  all, side by side: --html FILE --show {len(held.changed)}"
    for turned, requests in words.answers_flipped(comparison, most):
        yield f"answers: {turned}"
        yield f"  {requests}"
    yield from map(words.judged, verdicts)


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
    """GitHub's Markdown, in which a run's text is code: no link, no picture, no mention."""
    pair = comparison.pair
    failed = sum(bool(verdict.failed) for verdict in verdicts)
    title = f"{failed} of {len(verdicts)} gates failed" if verdicts else "Comparison of two runs"
    lines = [f"### {title}", ""]
    lines += [f"- {'❌' if v.failed else '✅'} {code(words.judged(v))}" for v in verdicts]
    lines += [f"- {name}: {code(side)}" for name, side in words.sides(pair)]
    lines += [f"- {code(caveat)}" for caveat in words.caveats(pair)]
    lines += [f"- paired: {code(words.paired(pair))}", f"- {words.differing(comparison)}", ""]
    for c in comparison.conditions:
        lines += [
            f"#### {code(c.condition)}",
            "",
            *_table(c, whole),
            "",
            words.success(c, pair),
            "",
        ]
        lines += [f"- {line}" for line in words.adjusted(c)]
        lines += [f"- {way}: {code(episodes)}" for way, episodes in words.both_ways(c, pair, most)]
        lines += ["", words.decisions(c, pair), ""]
        lines += [f"- {how}: {code(scenes)}" for how, scenes in words.given_away(c, pair, most)]
        lines += [""]
    lines += [f"{words.many(comparison)}.", ""]
    lines += ["<details><summary>Answers and settings</summary>", ""]
    lines += [f"- {words.answers_held(comparison.held)}"]
    for changed in comparison.held.changed[:1]:
        lines += [f"- {code(line.strip())}" for line in words.first_changed(changed)]
    lines += [
        f"- {code(turned)}: {code(ids)}" for turned, ids in words.answers_flipped(comparison, most)
    ]
    lines += [f"- {code(setting)}" for setting in words.settings(comparison)]
    lines += [
        f"- {code(line.strip())}" for line in (*words.prompts(comparison), *words.paces(pair))
    ]
    return "\n".join([*lines, "", "</details>"])


def _table(c: InCondition, whole: bool) -> list[str]:
    primary, exploratory, more = _groups(c, whole)
    rows = [
        f"| {words.SIGNS[text.verdict]} {text.metric} | {text.a} | {text.b} | {text.change} "
        f"| {text.interval} | {text.p}{'' if d.primary else ' exploratory'} |"
        for d in (*primary, *exploratory)
        for text in [words.line(d)]
    ]
    head = ["| metric | A | B | B - A | 95 % interval | p |", "|---|--:|--:|--:|--:|--:|"]
    return [*head, *rows, *(["", f"{more} more metrics: --all"] if more else [])]


def junit(comparison: Comparison, verdicts: Sequence[Verdict]) -> str:
    """Return the gates as test cases, for what shows JUnit's XML."""
    runs = " against ".join(
        printable(words.who(side)) for side in (comparison.pair.b, comparison.pair.a)
    )
    cases = [Case(runs, v.gate, words.judged(v) if v.failed else None) for v in verdicts]
    return test_suite("harness compare", cases)


def junit_of_none(gates: Sequence[str], reason: str) -> str:
    """Return the gates as test cases where they cannot be judged,
    since a model could not be asked.
    """
    return test_suite(
        "harness compare", [Case("harness compare", gate, error=reason) for gate in gates]
    )


def code(text: str) -> str:
    """Return a text as Markdown's code, whatever backticks it has."""
    text = printable(text, WHOLE)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def mapping(comparison: Comparison, verdicts: Sequence[Verdict], most: int) -> dict[str, Any]:
    """For machines: metrics in their own units, null where there is no number."""
    pair = comparison.pair
    return {
        **{
            name: {
                "run": str(side.run.path),
                "settings": dict(side.settings),
                "answer_times": msgspec.to_builtins(side.run.manifest.answer_times),
            }
            for name, side in (("a", pair.a), ("b", pair.b))
        },
        "caveats": words.caveats(pair),
        "scenes": where(pair.a.run),
        "seeds": list(pair.seeds),
        "episodes": len(pair.episodes),
        "settings": [{"name": name, "a": a, "b": b} for name, a, b in comparison.settings],
        "prompts": asdict(change)
        if isinstance(change := comparison.prompts, PromptChange)
        else change,
        "conditions": [_in_condition(c, most) for c in comparison.conditions],
        "answers_in_both": comparison.answers_in_both,
        "answers": [
            {
                "role": t.role,
                "a": t.a,
                "b": t.b,
                "count": len(t.requests),
                "requests": t.requests[:most],
            }
            for t in comparison.answers
        ],
        "answers_changed": {
            "count": len(comparison.held.changed),
            "verdicts": comparison.held.verdicts,
            "of": comparison.held.same,
            "asked_otherwise": comparison.held.other,
            "listed": changed_answers(comparison.held, most),
        },
        "gates": [
            {
                "gate": v.gate,
                "passed": not v.failed,
                "failed_in": [{"condition": name, "value": value} for name, value in v.failed],
            }
            for v in verdicts
        ],
        "passed": not any(v.failed for v in verdicts),
    }


def changed_answers(held: AnswersHeld, most: int | None = None) -> list[dict[str, Any]]:
    """Return the answers that changed, each with both verdicts and texts;
    `most` of them, or all.
    """
    return [
        dict(zip(ANSWERS, (each.request, each.role, *each.verdicts, each.a, each.b), strict=True))
        for each in held.changed[:most]
    ]


def _in_condition(c: InCondition, most: int) -> dict[str, Any]:
    metrics = {
        d.metric: {
            "a": d.a,
            "b": d.b,
            "difference": d.change.value,
            "low": _number(d.change.low),
            "high": _number(d.change.high),
            "n": d.change.n,
            "n_excluded": d.change.n_excluded,
            "p": d.p_value,
            "p_holm": d.p_corrected,
            "primary": d.primary,
        }
        for d in c.differences
    }
    entry: dict[str, Any] = {"condition": c.condition, "metrics": metrics, "test": _test(metrics)}
    for name, some in (("gained", c.gained), ("lost", c.lost)):
        listed = [asdict(t) for t in some[:most]]
        entry[name] = {
            "count": sum(len(t.seeds) for t in some),
            "episodes": len(some),
            "listed": listed,
        }
    flips = [asdict(flip) for flip in c.flips[:most]]
    count = sum(len(flip.seeds) for flip in c.flips)
    return {**entry, "flips": {"count": count, "of": c.decisions, "listed": flips}}


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


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
