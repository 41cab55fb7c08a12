"""A comparison in words and numbers, as its table, its Markdown and its page all say them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from harness.core.errors import printable
from harness.core.figures import POINTS, amount, crossed, interval_of, within
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
from harness.runs.headline import IN_WORDS, SUCCESS, headline_metric
from harness.runs.metric_names import ADJUSTED, ONE_OPTIMAL
from harness.runs.metrics import entry
from harness.runs.records import role_word

BETTER, WORSE, HINT = "better", "worse", "hint"
SIGNS = {BETTER: "✓", WORSE: "✗", HINT: "?", "": ""}
HUNKS = 3  # changes of a prompt's text that are shown beside the numbers
SHOWN = 6  # metrics that are shown first
BEFORE = 20  # characters of an answer that are shown before its change
EXCERPT = 140  # characters of an answer in a line


@dataclass(frozen=True)
class Line:
    """Hold one row of a comparison's table as text: a metric in runs A and B.

    `a` and `b` are its means there, `change` is B - A, `interval` that of the change, and `p` its
    p-value. Shares are in percent. A metric is primary if comparisons are judged by it, else
    exploratory. `verdict` is `better` or `worse` if it is primary and its corrected p is at most
    0.05, `hint` if it is exploratory and its uncorrected p is, else empty.
    """

    verdict: str  # `better`, `worse`, `hint` or empty
    metric: str  # the metric's label
    a: str  # its mean in A
    b: str  # its mean in B
    change: str  # B - A
    interval: str  # 95 % interval of the change; empty without one
    p: str  # p-value of no difference; empty without one


def line(d: Difference) -> Line:
    """Return a metric's difference between runs as the text of a table's row.

    Numbers have four significant figures at most; shares are in percent.
    """
    unit, change = entry(d.metric).unit, d.change
    interval = "–"
    if not math.isnan(change.low):
        interval = f"[{unit.number(change.low, '+', 4)}, {unit.number(change.high, '+', 4)}]"
    p = d.p_corrected if d.primary else d.p_value
    return Line(
        verdict=verdict(d),
        metric=f"{d.metric}{' %' if unit.name == '%' else ''}",
        a=unit.number(d.a, digits=4),
        b=unit.number(d.b, digits=4),
        change=unit.number(change.value, "+", 4),
        interval=interval,
        p="–" if p is None else p_value(p).removeprefix("= "),
    )


def verdict(d: Difference) -> str:
    """Return `better` or `worse` for a primary metric, `hint` for another; empty if unclear.

    Primary are the metrics that comparisons are judged by; their p is corrected for multiple
    testing, and at most 0.05. It is empty, too, if the difference rounds to 0, or no direction is
    better.
    """
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
    """Return a condition's differences that are shown first, the primary and then others.

    Primary are the metrics that comparisons are judged by, all of which are returned. Of the
    others, exploratory ones, it is the most significant, so that there are `SHOWN` in all: those
    with a preferred direction come first, percentiles of latency last. If one of them is over
    decisions with one optimal action alone, the number of these is added. A condition is a named
    set of settings of the radio, of asking helpers and of fusing their messages.
    """

    def order(d: Difference) -> tuple[bool, float]:
        metric = entry(d.metric)
        comes_last = metric.better == "neither" or bool(metric.percentile)
        # What changed alike in every episode has no interval.
        return comes_last, -1.0 if d.p_value is None else d.p_value

    def is_clear(d: Difference) -> bool:
        return _visible(d) and bool(verdict(d) or d.p_value is None)

    primary = [d for d in c.differences if d.primary]
    exploratory = [d for d in c.differences if not d.primary and d.metric != ONE_OPTIMAL]
    changed = [d for d in exploratory if is_clear(d)]
    striking = sorted(changed, key=order)[: max(SHOWN - len(primary), 0)]
    if any(entry(d.metric).pooled for d in striking):
        striking += [d for d in c.differences if d.metric == ONE_OPTIMAL]
    return primary, striking


def rest(c: InCondition) -> list[Difference]:
    """Return a condition's differences in the metrics that a page shows last.

    They are those that `first` leaves out: exploratory ones that are less significant. A condition
    is a named set of settings of the radio, of asking helpers and of fusing their messages.
    """
    primary, striking = first(c)
    return [d for d in c.differences if d not in (*primary, *striking)]


def outcomes(comparison: Comparison) -> list[tuple[str, str]]:
    """Return for each condition a sentence on the change of success, and its verdict.

    Success is balanced if both runs have that. The verdict is `better`, `worse` or empty. A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    outcomes = []
    for name, d in of_success(comparison).items():
        row = line(d)
        if math.isnan(d.change.low):
            verdict, interval = "not clear, since there is no interval", ""
        else:
            bounds = within(d.change.low, d.change.high)
            verdict, interval = row.verdict or f"not clear, but within {bounds}", f" {row.interval}"
        p = "" if d.p_corrected is None else f", Holm's p {row.p}"
        change = f"{IN_WORDS[d.metric]} {row.change} points{interval}: {verdict}{p}"
        outcomes.append((f"{name}: {change}", row.verdict))
    return outcomes


def of_success(comparison: Comparison) -> dict[str, Difference]:
    """Return by condition the difference of success, balanced if both runs have that.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages; one without success is left out.
    """
    differences = {}
    for condition in comparison.conditions:
        by_metric = {d.metric: d for d in condition.differences}
        metric = headline_metric(set(by_metric))
        if metric in by_metric:
            differences[condition.condition] = by_metric[metric]
    return differences


def key_figures(comparison: Comparison) -> list[dict[str, str]]:
    """Return success in A and in B as key figures: texts at `what` and `value`.

    They are of the condition in which both together have the most, a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    differences = of_success(comparison)
    if not differences:
        return []
    best = max(differences, key=lambda name: differences[name].a + differences[name].b)
    d = differences[best]
    row, what = line(d), f"{IN_WORDS[d.metric]} under {best}"
    return [
        {"what": f"A: {what}", "value": f"{row.a} %"},
        {"what": f"B: {what}", "value": f"{row.b} %"},
    ]


def first_lost(comparison: Comparison) -> tuple[InCondition, DecisionFlip] | None:
    """Return a decision by which one run alone lost an episode, and its condition.

    It is B's, else A's, of the last condition that has one; None where none is known.
    """
    for run in ("B", "A"):
        for condition in reversed(comparison.conditions):
            for flip in condition.flips:
                if flip.lost_by == run:
                    return condition, flip
    return None


def lost_by(condition: InCondition, flip: DecisionFlip) -> str:
    """Return sentences on a decision by which one run alone lost an episode, under a condition."""
    chose = {"A": flip.a, "B": flip.b}
    run, other = ("A", "B") if flip.lost_by == "A" else ("B", "A")
    return (
        f"Under {condition.condition}, {amount(len(condition.lost), 'episode')} that A clears "
        f"{'is' if len(condition.lost) == 1 else 'are'} lost by B, and {len(condition.gained)} the "
        f"other way. {run} lost episode {flip.episode} by {chose[run]}, where {other} chose "
        f"{chose[other]}"
    )


def who(side: Side) -> str:
    """Return who answered in a run as text: its model, prompt version and answer mode."""
    variant = side.run.manifest.variant
    return f"{variant.model} · prompt {variant.prompt} · {variant.answer}{variant.mix}"


def sides(pair: Pair, whole: bool = False) -> list[tuple[str, str]]:
    """Return (`A`, text) and (`B`, text), each with the folder's name and the model.

    `whole` gives the folder's path instead of its name.
    """
    rows = []
    for name, side in (("A", pair.a), ("B", pair.b)):
        folder = side.run.path if whole else side.run.path.name
        rows.append((name, f"{folder}: {who(side)}"))
    return rows


def paces(pair: Pair) -> list[str]:
    """Return sentences on how long prefill (reading) and decode (writing) take, for A and for B.

    Each begins with its run's letter.
    """
    sentences = []
    for name, side in (("A", pair.a), ("B", pair.b)):
        pace = findings(side.run, Kind.PACE)
        sentences += [f"{name}: {finding.sentence.strip()}" for finding in pace]
    return sentences


def caveats(pair: Pair, kinds: Sequence[Kind] = FIRST) -> list[str]:
    """Return the warnings on two compared runs; one about a single run begins with `A` or `B`.

    `kinds` says which. If a run might stop early, the differences of success with intervals that
    allow for it belong to the limits.
    """
    warnings = of_runs({"A": pair.a.run, "B": pair.b.run}, *kinds)
    limits = _by_stopping_rule(pair) if Kind.LIMIT in kinds else ()
    return [*(finding.sentence for finding in warnings), *limits]


def _by_stopping_rule(pair: Pair) -> Iterator[str]:
    """Yield each difference of success with an interval that holds at every look,
    if a run was looked at.
    """
    rule = pair.a.run.manifest.stopping_rule or pair.b.run.manifest.stopping_rule
    if rule is None:
        return
    for condition in pair.conditions:
        success = pair.success_rule(condition)
        a = pair.values(pair.a, SUCCESS, condition).T
        b = pair.values(pair.b, SUCCESS, condition).T
        change = interval_of(rule.difference(success, b, a), POINTS, "+")
        yield (f"{printable(condition)}: {success.words} B - A {change} points, by {rule.interval}")


def paired(pair: Pair) -> str:
    """Return a phrase on how many episodes and seeds two runs share, and what only one has."""
    text = f"{crossed(len(pair.episodes), len(pair.seeds))} of {where(pair.a.run)}"
    for name, side, other in (("A", pair.a, "B"), ("B", pair.b, "A")):
        conditions = pair.alone[name]
        episodes = len(side.run.grid.episodes) - len(pair.episodes)
        if conditions:
            text += f"; only {name} has {', '.join(conditions)}"
        if episodes:
            text += f"; {name} has {amount(episodes, 'more episode')}"
            if chosen := pair.left_out.get(other):
                text += f", left out of {other} by {chosen}"
    return text


def differing(comparison: Comparison) -> str:
    """Return a phrase with the kinds of settings in which runs differ, such as `model, prompt`."""
    a, b = (side.run.path.resolve() for side in (comparison.pair.a, comparison.pair.b))
    if a == b:
        return "A and B are one folder"
    kinds = list(dict.fromkeys(name.partition(".")[0] for name, _, _ in comparison.settings))
    return f"differ in {', '.join(kinds)}" if kinds else "differ in no setting"


def counts(c: InCondition) -> tuple[int, int]:
    """Return how many episodes × seeds changed to success in a condition, and how many to failure.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    gained = sum(len(flip.seeds) for flip in c.gained)
    lost = sum(len(flip.seeds) for flip in c.lost)
    return gained, lost


def success(c: InCondition, pair: Pair) -> str:
    """Return a sentence on how many episodes × seeds changed to success, how many to failure.

    `c` is what differs in one condition, and `pair` has the runs. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    gained, lost = counts(c)
    unit = "episodes × seeds" if len(pair.seeds) > 1 else "episodes"
    return f"success: {gained} gained, {lost} lost of {len(pair.episodes) * len(pair.seeds)} {unit}"


def adjusted(c: InCondition) -> Iterator[str]:
    """Yield how success in a condition changed, adjusted for how hard the layouts are.

    A layout is one drawn start situation, one for each episode. `c` is what differs in the
    condition. It yields nothing for fewer than `SHOWN_FROM` layouts. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    changes = {d.metric: d.change for d in c.differences}
    for metric, name in IN_WORDS.items():
        better = changes.get(ADJUSTED[metric])
        if better and changes[metric].n >= SHOWN_FROM:
            gained = as_good_as(changes[metric], better)
            yield (
                f"{name} adjusted for difficulty: B - A {interval_of(better, POINTS, '+')} points, "
                f"{gained}"
            )


def corrected(comparison: Comparison) -> list[float]:
    """Return the p-values that are corrected for multiple testing, those of primary metrics."""
    differences = [d for c in comparison.conditions for d in c.differences]
    return [d.p_corrected for d in differences if d.p_corrected is not None]


def many(comparison: Comparison) -> str:
    """Return a sentence on multiple testing: how many differences were tested, how corrected.

    The more are tested, the more seem significant by chance.
    """
    tested = [d for c in comparison.conditions for d in c.differences if d.p_value is not None]
    if not tested:
        return "no difference has a p: too few episodes, or none of them changed"
    p_values = corrected(comparison)
    exploratory = len(tested) - len(p_values)
    hints = sum(not d.primary and (d.p_value or 0.0) <= LEVEL for d in tested)
    return (
        "p comes from the interval: it is 1 minus the confidence level at which the interval "
        f"would just touch 0. Holm's method corrects that of the primary metrics, {len(p_values)} "
        f"differences: the chance that one or more of them is at most {LEVEL} without a real "
        f"difference is {100 * LEVEL:.0f} % at most. {sum(p <= LEVEL for p in p_values)} are at "
        f"most {LEVEL}: {SIGNS[BETTER]} better, {SIGNS[WORSE]} worse. The other "
        f"{exploratory} are exploratory and not corrected: {hints} are at most "
        f"{LEVEL} ({SIGNS[HINT]}), and {LEVEL * exploratory:.0f} would be by "
        "chance alone. Intervals and gates are not corrected"
    )


def both_ways(c: InCondition, pair: Pair, most: int) -> list[tuple[str, str]]:
    """Return (`lost`, text) and (`gained`, text) of one condition of a comparison of B with A.

    Lost are the episodes that succeed in A alone, gained those that succeed in B alone. Each text
    has up to `most` of them and how they failed; one without episodes is left out. A condition is a
    named set of settings of the radio, of asking helpers and of fusing their messages.
    """
    ways = (("lost", c.lost), ("gained", c.gained))
    return [(way, _flips(some, pair, most)) for way, some in ways if some]


def _flips(some: Sequence[Flip], pair: Pair, most: int) -> str:
    """Return up to so many episodes, each with how it failed; seeds where it is not all of them."""
    episodes = []
    for flip in some[:most]:
        failure = flip.a if flip.b == "success" else flip.b
        episodes.append(f"{flip.episode} {failure}{_seeds(flip.seeds, pair)}")
    return _listed(episodes, len(some), most)


def decisions(c: InCondition, pair: Pair) -> str:
    """Return a sentence on how many decisions differ, and how many made success impossible.

    `c` is what differs in one condition, and `pair` has the runs. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    count = dict.fromkeys(LOST_BY, 0)
    for flip in c.flips:
        count[flip.lost_by] += len(flip.seeds)
    text = f"decisions: {sum(count.values())} flipped of the {c.decisions} that both runs have"
    if not c.flips or pair.a.run.world == "closed-loop":  # which knows no regret
        return text
    return f"{text}; B alone gave success away in {count['B']}, A alone in {count['A']}"


def given_away(c: InCondition, pair: Pair, most: int) -> list[tuple[str, str]]:
    """Return texts on differing decisions by which one run alone made success impossible.

    `c` is what differs in one condition. An item is a phrase that names the run, and a text with up
    to `most` decisions. A condition is a named set of settings of the radio, of asking helpers and
    of fusing their messages.
    """
    rows = []
    for run in ("B", "A"):
        flips = [flip for flip in c.flips if flip.lost_by == run]
        if flips:
            scenes = [decision_flip(flip, pair) for flip in flips[:most]]
            rows.append((f"{run} alone gave success away", _listed(scenes, len(flips), most)))
    return rows


def decision_flip(flip: DecisionFlip, pair: Pair) -> str:
    """Return a scene's id with the actions that the two runs take there.

    The seeds are added if it is not all of them.
    """
    return f"{flip.scene} {flip.a} → {flip.b}{_seeds(flip.seeds, pair)}"


def _seeds(seeds: Sequence[int], pair: Pair) -> str:
    return "" if len(seeds) == len(pair.seeds) else f" (seeds {', '.join(map(str, seeds))})"


def prompts(comparison: Comparison, most: int = HUNKS) -> list[str]:
    """Return lines on how the prompts' texts and settings differ, with up to `most` changes.

    Empty if the prompts are the same.
    """
    change = comparison.prompts
    if change is None or isinstance(change, str):
        return [change] if change else []
    ego, helper = _versions(comparison.pair)
    title = f"prompt {' → '.join(ego)}"
    if ego != helper:
        title = f"ego's {title}, helper's {' → '.join(helper)}"
    counts = []
    for file, text in change.texts.items():
        count = f"{text.removed} words removed, {text.added} added" if text.hunks else "the same"
        counts.append(f"{file} {count}")
    lines = [f"{title}: {', '.join(counts)}"]
    for name, before, after in change.settings:
        lines.append(f"  {name}: {'none' if before is None else before} → {after}")
    hunks = [(file, hunk) for file, text in change.texts.items() for hunk in text.hunks]
    for file, hunk in hunks[:most]:
        lines.append(f"  {file} line {hunk.line_a} → {hunk.line_b}")
        whole = "".join(piece for _, piece in marked(hunk))
        lines += [f"    {line.strip()}" for line in whole.split("\n") if line.strip()]
    if len(hunks) > most:
        lines.append(f"  {len(hunks) - most} more changes: {_where_all_are(comparison.pair)}")
    return lines


def _versions(pair: Pair) -> list[tuple[str, str]]:
    """Return the prompt versions of A and B: of the ego, then of the first helper."""
    sides = zip(pair.a.prompts, pair.b.prompts, strict=True)
    return [(printable(a["version"], 40), printable(b["version"], 40)) for a, b in sides]


def _where_all_are(pair: Pair) -> str:
    """Say what shows all changes of the prompts: a command where all of them are here."""
    prompts = [*pair.a.prompts, *pair.b.prompts]
    here = all(as_it_was(prompt["version"], prompt["sha256"]) for prompt in prompts)
    differing = [(a, b) for a, b in _versions(pair) if a != b]
    commands = dict.fromkeys(f"`harness prompt compare {a} {b}`" for a, b in differing)
    return " and ".join(commands) if here and commands else "the page of --html has them"


def answers_flipped(comparison: Comparison, most: int) -> list[tuple[str, str]]:
    """Return for each change of parse verdict a phrase with its count and a list of requests.

    A verdict is how an answer could be read: `strict`, `recovered` or `failed`. The list is a text
    with up to `most` ids.
    """
    rows = []
    for flipped in comparison.answers:
        n, of = len(flipped.requests), comparison.answers_in_both[flipped.role]
        change = f"{role_word(flipped.role)} {flipped.a} → {flipped.b}: {n} of {of}"
        rows.append((change, _listed(flipped.requests[:most], n, most)))
    return rows


def answers_held(held: AnswersHeld) -> str:
    """Return a phrase on how many answers to the same questions differ between two runs."""
    if not (held.same or held.other):
        return "the runs have no question in common"
    otherwise = (
        f"{amount(held.other, 'question')} asked otherwise (prompt, messages or picture), and "
        f"{amount(held.other_leaning, 'answer')} to them with another likeliest action or status"
    )
    if not held.same:
        return otherwise
    text = f"{len(held.changed)} of {held.same} to the same questions changed"
    if held.changed:
        text += f" in their text, {held.verdicts or 'none'} of them in their status"
    return f"{text}; {otherwise}" if held.other else text


def first_changed(changed: AnswerChanged) -> list[str]:
    """Return lines on a changed answer: its request, and each run's text from where they differ.

    Texts are cut to `EXCERPT` characters.
    """
    start = max(_alike(changed.a, changed.b) - BEFORE, 0) if changed.a != changed.b else 0
    lines = [f"first: {changed.request}, {role_word(changed.role)}"]
    answers = zip("AB", changed.verdicts, (changed.a, changed.b), strict=True)
    for name, verdict, text in answers:
        excerpt = printable(text[start:], EXCERPT) or "nothing"
        lines.append(f"  {name} {verdict}: {'…' if start else ''}{excerpt}")
    return lines


def both_texts(changed: AnswerChanged) -> list[tuple[str, str, str, str, str]]:
    """Return a row for A and for B: letter, verdict, and the answer's text in three parts.

    The verdict is how the answer could be read, such as `strict`; the parts are the text before, in
    and after the passage that differs.
    """
    a, b = changed.a, changed.b
    start = _alike(a, b)
    alike_at_end = _alike(a[start:][::-1], b[start:][::-1])
    rows = []
    for name, verdict, text in zip("AB", changed.verdicts, (a, b), strict=True):
        end = len(text) - alike_at_end
        rows.append((name, verdict, text[:start], text[start:end], text[end:]))
    return rows


def _alike(a: str, b: str) -> int:
    """Return how many characters two texts begin with alike."""
    shorter = min(len(a), len(b))
    return next((n for n in range(shorter) if a[n] != b[n]), shorter)


def _listed(some: Sequence[str], n: int, most: int) -> str:
    """Return some of n, and how many more there are."""
    return ", ".join([*some, f"{n - most} more"] if n > most else some)


def settings(comparison: Comparison) -> list[str]:
    """Return a text for each setting that differs: its name, and its values in A and in B."""

    def in_words(value: str | None) -> str:
        return "none" if value is None else printable(value, 60)

    return [f"{name}: {in_words(a)} → {in_words(b)}" for name, a, b in comparison.settings]


def judged(verdict: Verdict, sign: str = "+") -> str:
    """Return a sentence on whether a gate passed or failed, and where.

    A gate is a test that a comparison may fail. `sign` is the sign option of the format of values:
    `+` for differences, `-` for plain values.
    """
    gate = printable(verdict.gate)
    if not verdict.failed:
        return f"passed: {gate}"
    conditions = [f"{name} ({value:{sign}.4g})" for name, value in verdict.failed]
    return f"FAILED: {gate} in {', '.join(conditions)}"
