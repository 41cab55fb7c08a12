"""A comparison in words and numbers, as its table, its Markdown and its page all say them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from harness.core.errors import printable
from harness.core.figures import POINTS, amount, crossed, shown, within
from harness.core.multiplicity import LEVEL
from harness.prompts.difference import marked
from harness.prompts.versions import as_it_was
from harness.report.compare.difference import (
    LOST_BY,
    AnswerChanged,
    AnswersHeld,
    Comparison,
    DecisionFlip,
    Difference,
    Flip,
    InCondition,
)
from harness.report.compare.gate import Verdict
from harness.report.compare.pair import Pair, Side, where
from harness.report.findings import FIRST, Kind, findings, of_runs
from harness.report.words import SHOWN_FROM, as_good_as, p_value
from harness.runs.leading import IN_WORDS, SUCCESS, lead_of, leading
from harness.runs.metrics import ADJUSTED, ONE_OPTIMAL, entry
from harness.runs.records import role_word
from harness.runs.success import Success

BETTER, WORSE, HINT = "better", "worse", "hint"
SIGNS = {BETTER: "✓", WORSE: "✗", HINT: "?", "": ""}
HUNKS = 3  # changes of a prompt's text that are shown beside the numbers
SHOWN = 6  # metrics that are shown first
BEFORE = 20  # characters of an answer that are shown before its change
EXCERPT = 140  # characters of an answer in a line


@dataclass(frozen=True)
class Line:
    """A difference as text: the metric with its unit, both means, B - A, its interval and its p.

    `verdict` is `better` or `worse` where the corrected p of a primary metric is at most 0.05;
    `hint` where that of an exploratory one is, uncorrected.
    """

    verdict: str
    metric: str
    a: str
    b: str
    change: str
    interval: str
    p: str


def line(d: Difference) -> Line:
    """Write a difference, with four figures at most; shares in percent."""
    unit, e = entry(d.metric).unit, d.change
    interval = (
        "–"
        if math.isnan(e.low)
        else f"[{', '.join(unit.number(x, '+', 4) for x in (e.low, e.high))}]"
    )
    p = d.p_corrected if d.primary else d.p_value
    return Line(
        verdict(d),
        f"{d.metric}{' %' if unit.name == '%' else ''}",
        unit.number(d.a, digits=4),
        unit.number(d.b, digits=4),
        unit.number(e.value, "+", 4),
        interval,
        "–" if p is None else p_value(p).removeprefix("= "),
    )


def verdict(d: Difference) -> str:
    """Judge a difference that is beyond chance and large enough to be shown; any other is empty."""
    better, p = entry(d.metric).better, d.p_corrected if d.primary else d.p_value
    if p is None or p > LEVEL or not _visible(d):
        return ""
    if not d.primary:
        return HINT
    if better == "neither":
        return ""
    return BETTER if (d.change.value > 0) == (better == "higher") else WORSE


def _visible(d: Difference) -> bool:
    unit = entry(d.metric).unit
    return round(d.change.value * unit.factor, unit.decimals) != 0


def first(c: InCondition) -> tuple[list[Difference], list[Difference]]:
    """Choose what is shown first: the primary metrics,
    and the exploratory ones that changed most clearly.

    Together they are `SHOWN` at most, and the number of decisions where one of them is over some
    alone. Those of which one way is better come before all others, and before percentiles, which
    say again how long a decision takes.
    """

    def order(d: Difference) -> tuple[bool, float]:
        metric = entry(d.metric)
        # What changed alike in every episode has no interval.
        return metric.better == "neither" or bool(
            metric.percentile
        ), -1.0 if d.p_value is None else d.p_value

    primary = [d for d in c.differences if d.primary]
    changed = [
        d
        for d in c.differences
        if not d.primary
        and d.metric != ONE_OPTIMAL
        and _visible(d)
        and (verdict(d) or d.p_value is None)
    ]
    striking = sorted(changed, key=order)[: max(SHOWN - len(primary), 0)]
    if any(entry(d.metric).pooled for d in striking):
        striking += [d for d in c.differences if d.metric == ONE_OPTIMAL and d not in striking]
    return primary, striking


def rest(c: InCondition) -> list[Difference]:
    """Return the differences that are not among the `first`."""
    primary, striking = first(c)
    return [d for d in c.differences if d not in (*primary, *striking)]


def outcomes(comparison: Comparison) -> list[tuple[str, str]]:
    """Return how what leads changed in each condition: a sentence and its verdict."""
    outcomes = []
    for c in comparison.conditions:
        lead = leading({d.metric for d in c.differences})
        for d in [d for d in c.differences if d.metric == lead]:
            row = line(d)
            p = "" if d.p_corrected is None else f", Holm's p {row.p}"
            if math.isnan(d.change.low):
                verdict = "not clear, since there is no interval"
            else:
                verdict = (
                    row.verdict or f"not clear, but within {within(d.change.low, d.change.high)}"
                )
            interval = f" {row.interval}".removesuffix(" –")
            change = f"{IN_WORDS[lead]} {row.change} points{interval}: {verdict}"
            outcomes.append((f"{c.condition}: {change}{p}", row.verdict))
    return outcomes


def who(side: Side) -> str:
    """Return the model, prompt and answer mode of a run."""
    variant = side.run.manifest.variant
    return f"{variant.model} · prompt {variant.prompt} · {variant.answer}{variant.mix}"


def sides(pair: Pair, whole: bool = False) -> list[tuple[str, str]]:
    """`A` and `B`, each with the name of its folder, or its `whole` path, and who answered."""
    return [
        (name, f"{side.run.path if whole else side.run.path.name}: {who(side)}")
        for name, side in (("A", pair.a), ("B", pair.b))
    ]


def paces(pair: Pair) -> list[str]:
    """Return what prefill and decode take, with the run's letter."""
    sides = (("A", pair.a.run), ("B", pair.b.run))
    return [
        f"{name}: {finding.sentence.strip()}"
        for name, run in sides
        for finding in findings(run, Kind.PACE)
    ]


def caveats(pair: Pair) -> list[str]:
    """Return what must be said of the runs before their numbers,
    with the run's letter where it is of one.
    """
    found = of_runs({"A": pair.a.run, "B": pair.b.run}, *FIRST)
    return [*(finding.sentence for finding in found), *_any_time(pair)]


def _any_time(pair: Pair) -> Iterator[str]:
    """Yield each difference of success with an interval that holds at every look,
    if a run was looked at.
    """
    if all(side.run.manifest.world.looks is None for side in (pair.a, pair.b)):
        return
    for condition in pair.conditions:
        ends = [pair.a.ends[condition, pair.seeds[0], episode] for episode in pair.episodes]
        success = Success.of(ends, lead_of(pair.a.run, pair.b.run))
        a, b = (pair.values(side, SUCCESS, condition).T for side in (pair.a, pair.b))
        change = shown(success.any_time_difference(b, a), POINTS, "+")
        yield (
            f"{printable(condition)}: {success.words} B - A {change} points, by an interval of "
            "every look"
        )


def paired(pair: Pair) -> str:
    """Return what is paired, and what only one of the runs has."""
    text = f"{crossed(len(pair.episodes), len(pair.seeds))} of {where(pair.a.run)}"
    for name, side in (("A", pair.a), ("B", pair.b)):
        conditions = [c for c in side.run.conditions if c not in pair.conditions]
        episodes = len(side.run.grid.episodes) - len(pair.episodes)
        if conditions:
            text += f"; only {name} has {', '.join(conditions)}"
        if episodes:
            text += f"; {name} has {amount(episodes, 'more episode')}"
    return text


def differing(comparison: Comparison) -> str:
    """Return what kinds of settings the runs differ in."""
    kinds = list(dict.fromkeys(name.partition(".")[0] for name, _, _ in comparison.settings))
    return f"differ in {', '.join(kinds)}" if kinds else "differ in no setting"


def success(c: InCondition, pair: Pair) -> str:
    """Return how many successes were gained and lost."""
    gained, lost = (sum(len(t.seeds) for t in flips) for flips in (c.gained, c.lost))
    of = f"{len(pair.episodes) * len(pair.seeds)} episodes" + (
        " × seeds" if len(pair.seeds) > 1 else ""
    )
    return f"success: {gained} gained, {lost} lost of {of}"


def adjusted(c: InCondition) -> Iterator[str]:
    """Yield how success changed once corrected by the layouts' difficulty,
    from `SHOWN_FROM` layouts on.
    """
    changes = {d.metric: d.change for d in c.differences}
    for metric, name in IN_WORDS.items():
        better = changes.get(ADJUSTED[metric])
        if better and changes[metric].n >= SHOWN_FROM:
            gained = as_good_as(changes[metric], better)
            yield (
                f"{name} adjusted for difficulty: B - A {shown(better, POINTS, '+')} points, "
                f"{gained}"
            )


def many(comparison: Comparison) -> str:
    """Say how many differences were tested, how p counts that, and how many hold."""
    tested = [d for c in comparison.conditions for d in c.differences if d.p_value is not None]
    if not tested:
        return "no difference has a p: too few episodes, or none of them changed"
    p_values = [d.p_corrected for d in tested if d.p_corrected is not None]
    hints = sum(not d.primary and (d.p_value or 0.0) <= LEVEL for d in tested)
    return (
        "p comes from the interval: it is 1 minus the confidence level at which the interval "
        f"would just touch 0. Holm's method corrects that of the primary metrics, {len(p_values)} "
        f"differences: the chance that one or more of them is at most {LEVEL} without a real "
        f"difference is {100 * LEVEL:.0f} % at most. {sum(p <= LEVEL for p in p_values)} are at "
        f"most {LEVEL}: {SIGNS[BETTER]} better, {SIGNS[WORSE]} worse. The other "
        f"{len(tested) - len(p_values)} are exploratory and not corrected: {hints} are at most "
        f"{LEVEL} ({SIGNS[HINT]}), and {LEVEL * (len(tested) - len(p_values)):.0f} would be by "
        "chance alone. Intervals and gates are not corrected"
    )


def both_ways(c: InCondition, pair: Pair, most: int) -> list[tuple[str, str]]:
    """Return what a condition lost and what it gained, where it did:
    up to so many episodes of each.
    """
    ways = (("lost", c.lost), ("gained", c.gained))
    return [(way, _flips(some, pair, most)) for way, some in ways if some]


def _flips(some: Sequence[Flip], pair: Pair, most: int) -> str:
    """Return up to so many episodes, each with how it failed; seeds where it is not all of them."""
    episodes = [
        f"{t.episode} {t.a if t.b == 'success' else t.b}{_seeds(t.seeds, pair)}"
        for t in some[:most]
    ]
    return _listed(episodes, len(some), most)


def decisions(c: InCondition, pair: Pair) -> str:
    """Return how many decisions flipped, and in how many one run alone gave success away."""
    n = {by: sum(len(flip.seeds) for flip in c.flips if flip.lost_by == by) for by in LOST_BY}
    text = f"decisions: {sum(n.values())} flipped of the {c.decisions} that both runs have"
    if not c.flips or pair.a.run.world == "closed-loop":  # which knows no regret
        return text
    return f"{text}; B alone gave success away in {n['B']}, A alone in {n['A']}"


def given_away(c: InCondition, pair: Pair, most: int) -> list[tuple[str, str]]:
    """Decisions that flipped and gave success away in one run alone: up to so many of each run."""
    kinds = {by: [flip for flip in c.flips if flip.lost_by == by] for by in ("B", "A")}
    return [
        (
            f"{by} alone gave success away",
            _listed([decision_flip(flip, pair) for flip in some[:most]], len(some), most),
        )
        for by, some in kinds.items()
        if some
    ]


def decision_flip(flip: DecisionFlip, pair: Pair) -> str:
    """Return a decision point and what both did there; seeds where it is not all of them."""
    return f"{flip.scene} {flip.a} → {flip.b}{_seeds(flip.seeds, pair)}"


def _seeds(seeds: Sequence[int], pair: Pair) -> str:
    return "" if len(seeds) == len(pair.seeds) else f" (seeds {', '.join(map(str, seeds))})"


def prompts(comparison: Comparison, most: int = HUNKS) -> list[str]:
    """Return what differs between the texts, up to so many changes;
    none where the prompts are the same.
    """
    change = comparison.prompts
    if change is None or isinstance(change, str):
        return [change] if change else []
    pair = comparison.pair
    ego, helper = (
        [
            printable(side.run.manifest.agent(place)["prompt"]["version"], 40)
            for side in (pair.a, pair.b)
        ]
        for place in (0, 1)
    )
    who = f"prompt {' → '.join(ego)}"
    if ego != helper:
        who = f"ego's {who}, helper's {' → '.join(helper)}"
    counts = [
        f"{file} {t.removed} words removed, {t.added} added" if t.hunks else f"{file} the same"
        for file, t in change.texts.items()
    ]
    lines = [f"{who}: {', '.join(counts)}"]
    lines += [f"  {name}: {'none' if x is None else x} → {y}" for name, x, y in change.settings]
    hunks = [(file, hunk) for file, text in change.texts.items() for hunk in text.hunks]
    for file, hunk in hunks[:most]:
        lines.append(f"  {file} line {hunk.line_a} → {hunk.line_b}")
        text = "".join(piece for _, piece in marked(hunk))
        lines += [f"    {line.strip()}" for line in text.split("\n") if line.strip()]
    if len(hunks) > most:
        stated = [
            side.run.manifest.agent(place)["prompt"]
            for side in (pair.a, pair.b)
            for place in (0, 1)
        ]
        here = all(as_it_was(prompt["version"], prompt["sha256"]) for prompt in stated)
        seen = dict.fromkeys(
            f"`harness prompt compare {a} {b}`" for a, b in (ego, helper) if a != b
        )
        shown = " and ".join(seen) if here and seen else "the page of --html has them"
        lines.append(f"  {len(hunks) - most} more changes: {shown}")
    return lines


def answers_flipped(comparison: Comparison, most: int) -> list[tuple[str, str]]:
    """Return how many answers of a role changed their verdict, and up to so many of them."""
    return [
        (
            f"{role_word(t.role)} {t.a} → {t.b}: {len(t.requests)} of "
            f"{comparison.answers_in_both[t.role]}",
            _listed(t.requests[:most], len(t.requests), most),
        )
        for t in comparison.answers
    ]


def answers_held(held: AnswersHeld) -> str:
    """Return how many answers to the same questions changed, and what could not be compared."""
    if not (held.same or held.other):
        return "the runs have no question in common"
    if not held.same:
        return (
            f"none can be compared: each of the {held.other} questions that both runs have was "
            "asked otherwise (prompt, messages or picture)"
        )
    text = f"{len(held.changed)} of {held.same} to the same questions changed"
    if held.changed:
        text += f", {held.verdicts or 'none'} of them in their verdict"
    if held.other:
        text += f"; {amount(held.other, 'more question')} asked otherwise and not compared"
    return text


def first_changed(changed: AnswerChanged) -> list[str]:
    """Return an answer that changed, and the text of both from a little before they part."""
    start = max(_alike(changed.a, changed.b) - BEFORE, 0) if changed.a != changed.b else 0
    texts = [
        f"  {name} {verdict}: {'…' if start else ''}{printable(text[start:], EXCERPT) or 'nothing'}"
        for name, verdict, text in zip("AB", changed.verdicts, (changed.a, changed.b), strict=True)
    ]
    return [f"first: {changed.request}, {role_word(changed.role)}", *texts]


def both_texts(changed: AnswerChanged) -> list[tuple[str, str, str, str, str]]:
    """Return A's answer and B's: letter of the run, verdict, and the text before,
    in and after its change.
    """
    a, b = changed.a, changed.b
    start = _alike(a, b)
    end = _alike(a[start:][::-1], b[start:][::-1])
    return [
        (name, verdict, text[:start], text[start : len(text) - end], text[len(text) - end :])
        for name, verdict, text in zip("AB", changed.verdicts, (a, b), strict=True)
    ]


def _alike(a: str, b: str) -> int:
    """Return how many characters two texts begin with alike."""
    shorter = min(len(a), len(b))
    return next((n for n in range(shorter) if a[n] != b[n]), shorter)


def _listed(some: Sequence[str], n: int, most: int) -> str:
    """Return some of n, and how many more there are."""
    return ", ".join([*some, f"{n - most} more"] if n > most else some)


def settings(comparison: Comparison) -> list[str]:
    """Each setting in which the runs differ, with both values."""

    def shown(value: str | None) -> str:
        return "none" if value is None else printable(value, 60)

    return [f"{name}: {shown(a)} → {shown(b)}" for name, a, b in comparison.settings]


def judged(verdict: Verdict, sign: str = "+") -> str:
    """Say whether a gate held; `sign` is the format's, of values that are no differences `-`."""
    gate = printable(verdict.gate)
    if not verdict.failed:
        return f"passed: {gate}"
    return f"FAILED: {gate} in " + ", ".join(
        f"{name} ({value:{sign}.4g})" for name, value in verdict.failed
    )
