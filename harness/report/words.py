"""Numbers and findings in the words of the report."""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

from markupsafe import Markup

from harness.core.covariate import worth
from harness.core.errors import printable
from harness.core.figures import PERCENT, POINTS, within
from harness.core.figures import interval_of as shown_estimate
from harness.core.multiplicity import clear
from harness.core.statistics import Estimate
from harness.report.caveats import doubted
from harness.runs.estimates import written
from harness.runs.folder import Run
from harness.runs.headline import ANY_TIME, IN_WORDS, SUCCESS, best_of, headline_of
from harness.runs.metric_names import ADJUSTED, ALL, BASELINE, GAINS, LATENCY
from harness.runs.metrics import entry
from harness.runs.records import Score
from harness.runs.success import half_difference, mean_difference, p_of_mean
from harness.runs.suite import SuiteRun, plays

# Layouts from which on a corrected figure is shown beside the plain one, whatever both are:
# intervals of so many hold the truth in 94 % of studies or more, plain and balanced
# (`benchmarks/difficulty.py`).
SHOWN_FROM = 40


def score_texts(score: Score) -> dict[str, str]:
    """Return a score as text for a table cell: `value`, `interval` and `n`, with the unit."""
    unit = entry(score.metric).unit
    n = f"n = {score.n} {score.interval}"
    if score.n_excluded:
        n += f", {score.n_excluded} excluded"
    return {"value": unit.text(score.value), "interval": unit.ends(score), "n": n}


def cell(score: Score | None) -> Markup:
    """Return a score's value and interval as HTML for a table cell; a dash for None."""
    if score is None:
        return Markup("–")
    text = score_texts(score)
    small = Markup("<small>{}</small>").format(text["interval"]) if text["interval"] else ""
    return Markup("<strong>{}</strong>{}").format(text["value"], small)


def headline(run: Run | SuiteRun) -> str:
    """Return the result of a run or suite in one sentence: success at best and without radio.

    The best is of the condition (set of settings) with the most; without radio (V2V) the ego hears
    no other vehicle. A suite is a run on each of several scenarios.
    """
    model = f"{run.manifest.variant.model}{run.manifest.variant.mix}"
    best, base = compared(run)
    if not best:
        return f"{model} on {run.source}: the run has no success rate."
    metric = headline_of(run)
    families = f" (mean over {len(run.runs)} families)" if isinstance(run, SuiteRun) else ""
    value = _value_text(run, best, metric)
    if not base:
        outcome = f"has {value} balanced success"
        if metric == SUCCESS:
            outcome = f"clears {value} of the episodes"
        text = f"Under {best}, {model} {outcome}{families}"
        if halves := entry(metric).halves:
            dangerous, harmless = (_value_text(run, best, half) for half in halves)
            text += f": {dangerous} with a danger, {harmless} without"
        if len(run.conditions) == 1:
            return f"{text}."
        unwarned = " without a warning" if doubted(*_runs(run)) else ""
        return f"{text}, and no other condition{unwarned} does better."
    pairs = plays(_runs(run), metric).pairs(best, base)
    change = judged(*gain(run, best, base))
    if metric == SUCCESS:
        text = f"Under {best}, {model} clears {value} of the episodes{families}; under {base}, "
        return f"{text}{_value_text(run, base, metric)}: {change}."
    shares = [_value_text(run, best, half) for half in entry(metric).halves]
    changes = [shown_change(half_difference(pairs, dangerous)) for dangerous in (True, False)]
    return (
        f"Under {best}, {model} succeeds in {shares[0]} of the layouts with a danger, {changes[0]} "
        f"against {base}, and in {shares[1]} of those without, {changes[1]}{families}; the mean of "
        f"both is {value}, {change}."
    )


def gain(run: Run | SuiteRun, best: str, base: str) -> tuple[Estimate, bool]:
    """Return what success gains in one condition over another, and whether that is clear.

    `best` and `base` name the conditions (sets of settings). Success is balanced if the run has
    that. It is clear by Holm's method for all of the run's conditions, of which the best was
    chosen.
    """
    played, intervals = plays(_runs(run), headline_of(run)), {}
    for condition in run.conditions:
        if condition != base:
            intervals[condition] = partial(mean_difference, played.pairs(condition, base))
    return intervals[best](), best in clear(intervals)


def questions(run: Run) -> str:
    """Return how many questions each role was asked, and how many answers could be read, as text.

    A role is `ego`, `helper` or `merge`, the ego with messages that it heard, unasked or in reply.
    """
    counts = run.answered.count
    words = {role: "ego with messages" if role == "merge" else role for role in counts}
    failed = {role: sum(run.answered.failed.get(role, {}).values()) for role in counts}
    if not any(failed.values()):
        numbers = ", ".join(f"{words[role]} {n}" for role, n in counts.items())
        return f"asked: {numbers}; all answers could be read"
    parts = []
    for role, n in counts.items():
        parts.append(f"{words[role]} {n} ({PERCENT.text(1 - failed[role] / n)} read)")
    return f"asked: {', '.join(parts)}"


def first_note(sentences: str) -> str:
    """Return the first of a note's sentences as the beginning of a line, without its full stop."""
    first, _, _ = sentences.partition(". ")
    return f"note: {first.rstrip('.')}"


def shown_change(change: Estimate) -> str:
    """Return a difference of success and its interval as text: `+7.7 [+3.1, +12.4] points`."""
    return f"{shown_estimate(change, POINTS, '+')} points"


def judged(change: Estimate, is_clear: bool, bounded: bool = True) -> str:
    """Return a difference of success as text that says whether it is clear.

    If it is not clear, the text says how large the difference can be by its interval, unless
    `bounded` is false.
    """
    text = shown_change(change)
    if math.isnan(change.low):
        return f"{text}, too few episodes for an interval"
    unclear = "not clear"
    if bounded:
        unclear += f", but within {within(change.low, change.high)}"
    return f"{text}, {'a clear difference' if is_clear else unclear}"


def compared(run: Run | SuiteRun) -> tuple[str, str]:
    """Return the names of the conditions that sum up a run: the best one and its baseline.

    Best is the most balanced or plain success. The baseline is the first condition without V2V, in
    which the ego hears nobody, else the worst; an empty string where there is none. A condition is
    a named set of settings of the radio, of asking helpers and of fusing their messages.
    """
    metric = headline_of(run)
    values = {}
    for condition in run.conditions:
        score = run.score(condition, metric)
        if score is not None:
            values[condition] = score.value or 0.0
    points = run.manifest.conditions
    with_radio = {point["name"] for point in points if point.get("profile") is not None}
    alone = [point["name"] for point in points if point["name"] not in with_radio]
    alone = [name for name in alone if name in values]
    best = best_of(values, with_radio, doubted(*_runs(run)))
    base = alone[0] if alone else min(values, key=lambda name: values[name], default="")
    return best, "" if base == best else base


def figures(run: Run) -> list[dict[str, str]]:
    """Return the key figures of a run, each as text: `what` it is, `value`, `interval` and `n`.

    `n` is the number of episodes or the like behind it.
    """
    best, base = compared(run)
    metric = headline_of(run)
    scores = {f"{IN_WORDS[metric]} under {best}": run.score(best, metric)}
    if base == BASELINE:
        scores[f"what messages add over {base}"] = run.score(best, GAINS[metric])
    if halves := entry(metric).halves:
        dangerous, harmless = halves
        scores["with a danger"] = run.score(best, dangerous)
        scores["without a danger"] = run.score(best, harmless)
    if better := adjusted(run, best, metric):
        score, worth_of_it = better
        scores[f"adjusted for difficulty, {worth_of_it}"] = score
    scores[f"unsafe episodes under {best}"] = run.score(best, "unsafe_rate")
    scores[f"latency of a decision under {best}"] = run.score(best, LATENCY)
    scores["ego's answers that could not be read"] = run.score(ALL, "failed_rate_ego")
    return [
        {"what": what, **score_texts(score)} for what, score in scores.items() if score is not None
    ]


def as_good_as(plain: Estimate, corrected: Estimate) -> str:
    """Return a phrase on what a correction for difficulty gains: as good as 1.3 times the episodes.

    `plain` is the mean as it is, `corrected` that by covariate adjustment for the difficulty of the
    layouts (start situations of episodes), with a narrower interval.
    """
    return f"as good as {worth(plain, corrected):.1f} times as many layouts"


def adjusted(run: Run, condition: str, metric: str) -> tuple[Score, str] | None:
    """Return success adjusted for the layouts' difficulty, and a phrase on how much that gains.

    `metric` is the name of plain or balanced success, and `condition` that of a set of settings of
    the radio, of asking helpers and of fusing their messages. A layout is one drawn start
    situation, one for each episode; how hard it is, is known before anybody is asked. None with
    fewer than `SHOWN_FROM` layouts, and for a run whose intervals are valid at any stopping time,
    since this one is not.
    """
    plain, better = run.score(condition, metric), run.score(condition, ADJUSTED[metric])
    if not plain or not better or plain.interval == ANY_TIME or plain.n < SHOWN_FROM:
        return None
    return better, as_good_as(plain.estimate, better.estimate)


def adjusted_lines(run: Run) -> Iterator[str]:
    """Yield a line on difficulty-adjusted success, and one on balanced success, by condition.

    It is adjusted for how hard the run's start situations are among all of its dataset. It yields
    none where no condition has an adjusted score. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    for metric, words in IN_WORDS.items():
        cells = []
        for name in run.conditions:
            if better := adjusted(run, name, metric):
                score, worth_of_it = better
                cells.append(f"{printable(name)} {written(score)}, {worth_of_it}")
        if cells:
            yield f"{words} % adjusted for difficulty: {'; '.join(cells)}"


def p_values(run: Run | SuiteRun, base: str) -> dict[str, float]:
    """Return the p-value of each other condition's gain in success over the condition `base`.

    A gain is the difference in success over the same episodes. For a suite, a run on each of
    several families (scenarios), it is the mean over these. P-values are not corrected for
    multiplicity; 1 where the gain has no interval. A condition is a named set of settings of the
    radio, of asking helpers and of fusing their messages.
    """
    played = plays(_runs(run), headline_of(run))
    p_values = {}
    for condition in run.conditions:
        if condition != base:
            p = p_of_mean(played.pairs(condition, base))
            p_values[condition] = 1.0 if p is None else p
    return p_values


def p_value(p: float) -> str:
    """Return a p-value as it follows the letter p: `= 0.012`, or `< 0.001`."""
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _runs(run: Run | SuiteRun) -> list[Run]:
    return [*run.runs.values()] if isinstance(run, SuiteRun) else [run]


def _value_text(run: Run | SuiteRun, condition: str, metric: str) -> str:
    score = run.score(condition, metric)
    return score_texts(score)["value"] if score else "–"


def facts(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Return the rows of a table of a nested mapping: dotted name and value.

    Names begin with `name`. Items of a list of mappings are numbered from 1; any other list is
    joined by commas.
    """
    if isinstance(value, Mapping):
        lines = []
        for key, inner in value.items():
            lines += facts(inner, f"{name}.{key}" if name else str(key))
        return lines
    if isinstance(value, list | tuple) and any(isinstance(inner, Mapping) for inner in value):
        return facts({str(n): inner for n, inner in enumerate(value, 1)}, name)
    if isinstance(value, list):
        return [(name, ", ".join(map(str, value)))]
    return [(name, value)]
